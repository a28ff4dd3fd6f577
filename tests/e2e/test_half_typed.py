"""Every option of every command, half typed: exit 2 and one line that names it, before anything is read or written."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from gsmerge.cli import app

from .conftest import Run, assert_refused

COMMAND = app.make_command()


def missing(param: Any, name: str) -> list[list[str]]:
    return [] if param.is_flag else [[name], [name, "--help"], [name, "-q"] if name != "-q" else [name]]


def flag_with_a_value(param: Any, name: str) -> list[list[str]]:
    return [[f"{name}=x"]] if param.is_flag and name.startswith("--") else []


def unknown_neighbour(param: Any, name: str) -> list[list[str]]:
    return [[f"{name}x"], [f"{name[:-1]}-"]] if name.startswith("--") else []


def empty(param: Any, name: str) -> list[list[str]]:
    return [] if param.is_flag else [[name, ""], *([[f"{name}="]] if name.startswith("--") else [])]


def twice(param: Any, name: str) -> list[list[str]]:
    value = param.metavar.split("|")[0] if "|" in (param.metavar or "") else "2"
    return [] if param.is_flag else [[name, value, name, value]]


def commands(command: Any, *words: str) -> Iterator[tuple[list[str], Any]]:
    """Each command with the words that call it, its arguments among them."""
    needed = [f"{param.name}.ply" for param in command.params if param.param_type_name == "argument" and param.required]
    yield [*words, *needed], command
    for word, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, *words, word)


@pytest.mark.parametrize("half_typed", [missing, flag_with_a_value, unknown_neighbour, empty, twice])
def test_every_option_of_every_command(
    half_typed: Callable[[Any, str], list[list[str]]], run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app, "make_command", lambda only=None: COMMAND)
    monkeypatch.chdir(tmp_path)
    count = 0
    for words, command in commands(COMMAND):
        options = [param for param in command.params if param.param_type_name == "option"]
        for option, name in ((one, name) for one in options for name in one.opts):
            needed = [
                word for other in options if other.required and other is not option for word in (other.opts[0], "d")
            ]
            for tail in half_typed(option, name):
                outcome, count = run(*words, *needed, *tail), count + 1
                assert_refused(outcome, 2, "")
                assert option.opts[0] in outcome.err or tail[0] in outcome.err, outcome.err
    assert count > 20
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("words", [["compact", ""], ["convert", "a.ply", ""], ["batch", "", "-o", "out"], [""]])
def test_an_empty_name_is_not_this_folder(
    words: list[str], run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a shell passes ``"$SCENE"`` where the variable is not set."""
    monkeypatch.chdir(tmp_path)
    assert_refused(run(*words), 2, "")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "suggestion"),
    [
        ("compact x.ply --force", "--overwrite"),
        ("x.ply --force", "--overwrite"),
        ("compact x.ply --format spz", "-o x.spz"),
        ("convert x.ply y.ply --format spz", "x.spz"),
        ("convert x.ply y.ply --budget 3", "use gsmerge compact"),
        ("compact x.ply --workers 2", "use gsmerge batch"),
        ("compact x.ply --qualty 3", "use --quality"),
        ("render x.ply --data d", "use gsmerge lab train"),
        ("compact x.ply --over", "use --overwrite"),
        ("compact x.ply --no-fit", "--set fit=none"),
        ("compact x.ply --no-open", "use gsmerge view"),
        ("compact x.ply -overwrite", "two dashes, --overwrite"),
        ("render x.ply -output=a.png", "two dashes, --output=a.png"),
        ("compact x.ply -o -", "--output: expected a file"),
        ("convert x.ply -o y.spz", "gsmerge convert a.ply x.spz"),
        ("evaluate x.ply --format json", "the ending of -o sets the format;"),
        ("--quiet x.ply", "after the name of a command or scene"),
    ],
)
def test_what_to_type_instead(words: str, suggestion: str, run: Run) -> None:
    outcome = run(*words.split(), code=2)
    assert suggestion in outcome.err


@pytest.mark.parametrize("word", ["o", "q", "h"])
def test_a_letter_of_an_option_is_a_value(word: str, run: Run) -> None:
    assert_refused(run("compact", "nowhere.ply", "-o", word), 3, "nowhere.ply")


@pytest.mark.parametrize("option", ["--verbose", "--gpu", "--zzz", "-v", "--no-overwrite"])
def test_nothing_near_is_no_guess(option: str, run: Run) -> None:
    assert_refused(run("compact", "x.ply", option), 2, "", f"No such option: {option}; see 'gsmerge compact --help'")


def test_what_fails_while_an_error_is_explained(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def explain(*_: object) -> str:
        raise AttributeError("lost")

    monkeypatch.setattr(app, "usage_message", explain)
    assert_refused(run("compact", "--k"), 1, "", "unexpected error: AttributeError: lost; run again with --debug")
