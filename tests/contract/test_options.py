"""Each option of the command line is declared once."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import typer.main

from gsmerge.cli import main
from gsmerge.cli.app import app
from gsmerge.jobs.batch import BatchOptions
from gsmerge.research.generate import GenerateOptions
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.files import FileOptions
from gsmerge.settings.setting import flat_settings
from gsmerge.settings.stages import Engine

TOP: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
LAB: dict[str, Any] = TOP["lab"].commands
COMMANDS = {name: command for name, command in TOP.items() if name != "lab"}
COMMANDS |= {f"lab {name}": command for name, command in LAB.items()}
# Options of all commands, of which each has --threads, --progress, --json and --quiet, and those of compact
FEW, OF_COMPACT = 158, 25


def shown(command: str, name: str) -> str:
    """Return the default of an option of a command as its help words it."""
    (parameter,) = (p for p in COMMANDS[command].params if p.name == name)
    (default,) = re.findall(r"\[default: (.*)\]$", parameter.help)
    return str(default)


def test_defaults_of_single_commands_are_the_library_s() -> None:
    assert shown("batch", "engine") == BatchOptions().engine == "local"
    assert shown("batch", "name") == BatchOptions().output
    made = GenerateOptions()
    assert (shown("lab generate", "views"), shown("lab generate", "size")) == ("6", "320x240")
    assert (made.views, made.width, made.height) == (6, 320, 240)


def test_commands_are_eight_beside_four_of_research() -> None:
    assert set(TOP) == {"compact", "batch", "convert", "extend", "inspect", "render", "view", "evaluate", "lab"}
    assert set(LAB) == {"chart", "generate", "stress", "train"}


def options_of(command: str) -> list[str]:
    return [p.name for p in COMMANDS[command].params if p.param_type_name == "option" and p.name != "help"]


def test_there_are_few_options() -> None:
    assert sum(len(options_of(command)) for command in COMMANDS) <= FEW
    assert len(options_of("compact")) <= OF_COMPACT
    assert not any(getattr(p, "hidden", False) for command in COMMANDS.values() for p in command.params)


def flags_of(command: str) -> dict[str, str]:
    return {flag: p.name for p in COMMANDS[command].params for flag in (*p.opts, *p.secondary_opts)}


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_output_is_one_option_everywhere(command: str) -> None:
    flags = flags_of(command)
    assert flags.get("-o") == flags.get("--output")


def test_sources_of_the_package_name_only_options_that_exist(root: Path) -> None:
    others = {"--help", "--version", "--debug", "--no-deps", "--force-reinstall", "--extra-index-url", "--head"}
    others |= {"--lod-chunk-count"}  # of splat-transform
    known = others | {flag for name in COMMANDS for flag in flags_of(name)}
    files = sorted((root / "gsmerge").rglob("*.py"))
    named = {(file.name, flag) for file in files for flag in re.findall(r"(?<![\w-])--[a-z][a-z-]+", file.read_text())}
    assert [pair for pair in sorted(named) if pair[1] not in known] == []


def help_of(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main([*words]) == 0
    return capsys.readouterr().out


def test_help_shows_all_options_in_panels(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    text = help_of(capsys, "compact", "--help")
    listed = set(re.findall(r"^│ (--[\w-]+)", text, re.MULTILINE))
    assert listed - {"--help"} == {f"--{name.replace('_', '-')}" for name in options_of("compact")}
    assert all(title in text for title in ("─ Input ─", "─ How many Gaussians ─", "─ Method ─", "─ Output ─"))


@pytest.mark.parametrize("command", ["compact", "batch", "view", "render", "evaluate", "lab stress"])
def test_defaults_in_words_have_one_pair_of_brackets(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "400")
        assert main([*command.split(), "--help"]) == 0
    defaults = re.findall(r"\[default: (.*?)\]", capsys.readouterr().out)
    assert defaults
    assert not any(words.startswith("(") for words in defaults)


def test_set_help_lists_all_settings(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    for command in ("compact", "extend", "convert", "lab chart"):
        text = help_of(capsys, *command.split(), "--set", "help")
        assert max(map(len, text.splitlines())) <= 60
    text = help_of(capsys, "compact", "--set", "help")
    assert {name.partition("=")[0] for name in re.findall(r"^\S+", text, re.MULTILINE)} == {
        *flat_settings(CompactOptions), *flat_settings(FileOptions), *flat_settings(Engine)
    }  # fmt: skip
    assert "superpixels=4.4%\n    Superpixels per view" in text


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_help_fits_a_terminal(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = help_of(capsys, *command.split(), "--help")
    assert max(map(len, text.splitlines())) <= 80
    usage = next(line.split() for line in text.splitlines() if "Usage:" in line)
    assert usage[-1] == "[OPTIONS]"
    assert "{" not in " ".join(usage)
    assert re.findall(r"<\w[^>]*>?", text) == []
