"""Options of the command line: declared once, and as the library has them."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from enum import Enum
from inspect import Parameter
from pathlib import Path
from typing import Any, get_args

import pytest
import typer.main

import gsmerge
from gsmerge.batch import BatchOptions
from gsmerge.batch.options import ENGINES
from gsmerge.cli import main
from gsmerge.cli.app import app
from gsmerge.cli.options import OPTIONS
from gsmerge.io import ReadHints
from gsmerge.io.formats.ply import OpacityChoice
from gsmerge.measure.evaluate import NETS
from gsmerge.online.options import OnlineOptions
from gsmerge.research.generate import GenerateOptions
from gsmerge.research.training import preset_options

COMMANDS: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
SETTINGS = gsmerge.CompactOptions().to_dict()
# Defaults that help describes, because they depend on other settings or on the machine
WORDED = {
    "fit_steps": "by effort", "match": "overlap, none for a draft", "threads": "all processors",
    "min_opacity": "1/255",
}  # fmt: skip


def choices(parameter: Parameter) -> tuple[str, ...]:
    """Possible values of an option; none where it takes any."""
    kind = get_args(parameter.annotation)[0]
    enums = [k for k in (*get_args(kind), kind) if isinstance(k, type) and issubclass(k, Enum)]
    return tuple(value.value for enum in enums for value in enum)


def expected(make: Callable[..., Any], *arguments: Any, **settings: Any) -> set[str]:
    """The values that the library's error names as possible."""
    with pytest.raises(ValueError, match=r"expected .*, got") as error:
        make(*arguments, **settings)
    listed = re.search(r"expected (?:one of )?(.*?), (?:or \w+, )?got", str(error.value))
    assert listed is not None
    return set(re.findall(r"[\w-]+", listed[1])) - {"or"}


@pytest.mark.parametrize("name", [name for name in OPTIONS if choices(OPTIONS[name])])
def test_choices_are_the_library_s(name: str) -> None:
    given = choices(OPTIONS[name])
    if name in SETTINGS:
        known = expected(gsmerge.CompactOptions().with_settings, {name: "?"})
    elif name in ("quats", "order"):
        known = expected(ReadHints, **{name: "?"})
    else:
        known = set({"opacity": get_args(OpacityChoice), "lpips": (*NETS, "both", "none")}[name])
    assert set(given) == known


@pytest.mark.parametrize("name", [name for name in OPTIONS if name in SETTINGS])
def test_shown_defaults_are_the_library_s(name: str) -> None:
    """An option that is a setting leaves the default to the library, and help shows that default."""
    _, info = get_args(OPTIONS[name].annotation)
    assert OPTIONS[name].default is None
    if SETTINGS[name] is None or SETTINGS[name] is False:
        assert info.show_default in (True, WORDED.get(name))
    else:
        assert info.show_default == WORDED.get(name, str(SETTINGS[name])) or str(SETTINGS[name]) in info.help


def shown(command: str, name: str) -> Any:
    """Default of an option of a command: its own, or as help words the library's."""
    (parameter,) = (p for p in COMMANDS[command].params if p.name == name)
    worded = isinstance(parameter.show_default, str)
    default = parameter.show_default if worded else parameter.default
    return default.value if isinstance(default, Enum) else default


def test_defaults_of_single_commands_are_the_library_s() -> None:
    assert shown("compact", "max_side") == str(ReadHints().max_side)
    assert shown("compact", "exporter") == ReadHints().exporter
    assert [shown("extend", name) for name in ("max_k", "tolerance", "replay")] == [
        str(getattr(OnlineOptions(), name)) for name in ("max_k", "tolerance", "replay")
    ]
    assert [shown("batch", name) for name in ("retries", "engine", "timeout")] == [1, "local", None]
    assert (BatchOptions().retries, BatchOptions().engine, BatchOptions().timeout) == (1, ENGINES[0], None)
    assert shown("batch", "name") == BatchOptions().output
    made = GenerateOptions()
    assert [shown("generate", name) for name in ("style", "path", "noise")] == [made.style, made.path, made.noise]
    assert (shown("generate", "views"), shown("generate", "size")) == ("6", "320x240")
    assert (made.views, made.width, made.height) == ((6, 6), 320, 240)
    assert shown("train", "steps") == str(preset_options("default").steps)


def declared(path: Path) -> int:
    """Options and arguments that are written down in a file; not those declared elsewhere and worded anew."""
    calls = [node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    names = [f.attr if isinstance(f, ast.Attribute) else getattr(f, "id", "") for f in calls]
    return sum(names.count(name) for name in ("option", "switch", "argument", "_list"))


def test_options_are_declared_once(root: Path) -> None:
    """366 before there was a table of them."""
    assert sum(map(declared, (root / "gsmerge" / "cli").glob("*.py"))) <= 130


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_output_is_one_option_everywhere(command: str) -> None:
    flags = {flag: p.name for p in COMMANDS[command].params for flag in p.opts}
    assert flags.get("-o") == flags.get("--output")
    assert "--out" not in flags


def help_of(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main([*words]) == 0
    return capsys.readouterr().out


def test_short_help_and_all_of_it(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    brief, full = help_of(capsys, "compact", "--help"), help_of(capsys, "compact", "--help-all")
    listed = [set(re.findall(r"^│ (--[\w-]+)", text, re.MULTILINE)) for text in (brief, full)]
    assert 10 <= len(listed[0] - {"--help", "--help-all"}) <= 15
    every = {p.opts[0] for p in COMMANDS["compact"].params if p.opts[0].startswith("--")}
    assert listed[1] - {"--help"} == every
    assert all(title in brief for title in ("─ Input ─", "─ How many Gaussians ─", "─ Fitting ─", "─ Output ─"))
    assert help_of(capsys, "compact", "--help") == brief


def test_help_prints_brackets(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    assert "gsmerge[cuda]" in help_of(capsys, "compact", "--help")
    assert "gsmerge[ray]" in help_of(capsys, "batch", "--help")


def test_commands_are_grouped(capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of(capsys, "--help")
    titles = ("Compact", "Many scenes, and encoding once", "Look and measure", "Research")
    assert [text.index(f"─ {title} ─") for title in titles] == sorted(text.index(f"─ {title} ─") for title in titles)
