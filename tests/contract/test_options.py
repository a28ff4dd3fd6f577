"""Options of the command line: declared once."""

from __future__ import annotations

import re
from enum import Enum
from pathlib import Path
from typing import Any

import pytest
import typer.main

from gsmerge.batch import BatchOptions
from gsmerge.cli import main
from gsmerge.cli.app import app
from gsmerge.research.generate import GenerateOptions
from gsmerge.settings.extend import ExtendOptions
from gsmerge.settings.setting import flat_settings

COMMANDS: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def shown(command: str, name: str) -> Any:
    """Default of an option of a command: its own, or as help words the library's."""
    (parameter,) = (p for p in COMMANDS[command].params if p.name == name)
    worded = isinstance(parameter.show_default, str)
    default = parameter.show_default if worded else parameter.default
    return default.value if isinstance(default, Enum) else default


def test_defaults_of_single_commands_are_the_library_s() -> None:
    assert shown("extend", "max_k") == flat_settings(ExtendOptions)["max_k"].shown
    assert shown("batch", "engine") == BatchOptions().engine == "local"
    assert shown("batch", "name") == BatchOptions().output
    made = GenerateOptions()
    assert [shown("generate", name) for name in ("style", "path", "noise")] == [made.style, made.path, made.noise]
    assert (shown("generate", "views"), shown("generate", "size")) == ("6", "320x240")
    assert (made.views, made.width, made.height) == ((6, 6), 320, 240)


def test_default_of_training_is_the_preset_s() -> None:
    pytest.importorskip("torch", reason="the package's training imports it")
    from gsmerge.research.training import preset_options

    assert shown("train", "steps") == str(preset_options("default").steps)


def test_there_are_few_options() -> None:
    """401 before settings and hints were given by name; 248 before ``convert``, which 20 more are for."""
    assert sum(len(command.params) for command in COMMANDS.values()) <= 267
    assert sum(not getattr(p, "hidden", False) for p in COMMANDS["compact"].params) <= 15


def flags_of(command: str) -> dict[str, str]:
    return {flag: p.name for p in COMMANDS[command].params for flag in (*p.opts, *p.secondary_opts)}


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_output_is_one_option_everywhere(command: str) -> None:
    flags = flags_of(command)
    assert flags.get("-o") == flags.get("--output")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("compact scene --fit-steps 60", "--set fit_steps=VALUE"),
        ("batch scene --require-checkpoint", "--set require_checkpoint=true"),
        ("compact a.gsm --no-normals", "--set normals=false"),
        ("inspect scene --order none", "--hint order=VALUE"),
        ("inspect scene --poses fixed", ": --poses"),
        ("generate -o rooms --segmentation grid", ": --segmentation"),
    ],
)
def test_settings_without_an_option_say_how_to_give_them(
    words: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words.split()) == 2
    captured = capsys.readouterr()
    assert said in captured.err
    assert (captured.out, captured.err.count("\n")) == ("", 1)


def test_the_package_names_only_options_that_exist(root: Path) -> None:
    others = {"--help", "--version", "--debug", "--no-deps", "--force-reinstall", "--extra-index-url", "--head"}
    known = others | {flag for name in COMMANDS for flag in flags_of(name)}
    files = sorted((root / "gsmerge").rglob("*.py"))
    named = {(file.name, flag) for file in files for flag in re.findall(r"(?<![\w-])--[a-z][a-z-]+", file.read_text())}
    assert [pair for pair in sorted(named) if pair[1] not in known] == []


def help_of(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main([*words]) == 0
    return capsys.readouterr().out


def test_short_help_and_all_of_it(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    brief, full = help_of(capsys, "compact", "--help"), help_of(capsys, "compact", "--help-all")
    listed = [set(re.findall(r"^│ (--[\w-]+)", text, re.MULTILINE)) for text in (brief, full)]
    assert len(listed[0] - {"--help"}) == 13  # and the argument SCENE
    every = {p.opts[0] for p in COMMANDS["compact"].params if p.opts[0].startswith("--")}
    assert listed[1] - {"--help"} == every
    named = set(re.findall(r"--[a-z-]+", brief.partition("─ Input ─")[0]))
    assert named - {"--help", "--help-all"} == every - listed[0]  # what the short help leaves out is named in it
    assert all(title in brief for title in ("─ Input ─", "─ How many Gaussians ─", "─ Method ─", "─ Output ─"))
    assert help_of(capsys, "compact", "--help") == brief


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_help_fits_a_terminal(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = help_of(capsys, command, "--help")
    assert max(map(len, text.splitlines())) <= 80
    usage = next(line.split() for line in text.splitlines() if "Usage:" in line)
    assert usage[-1] == "[OPTIONS]"
    assert "{" not in " ".join(usage)
    assert re.findall(r"<\w[^>]*>?", text.partition("─ Options ─")[2].replace("<=x<=", "")) == ["<bool>"]  # of --help


def test_help_prints_brackets(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    assert "gsmerge[ray]" in help_of(capsys, "batch", "--help-all")


def test_commands_are_grouped(capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of(capsys, "--help")
    titles = ("Compact", "Many scenes, and views in batches", "Look and measure", "Research")
    assert [text.index(f"─ {title} ─") for title in titles] == sorted(text.index(f"─ {title} ─") for title in titles)
