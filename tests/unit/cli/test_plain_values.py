"""Plain words are converted as Typer does it, and all other words by Typer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import typer

from gsmerge.cli.app import make_command
from gsmerge.cli.plain_values import convert_plain_values

WORDS = {
    "levels": ["1", "8", "0", "9", "03", " 2", "1_0", "2.0", "true"],
    "effort": ["draft", "best", "Draft", "dra", "effort_choice.draft"],
    "k": ["2", "auto", "1.5", "x"],
    "output": ["a.ply", "nowhere/é.ply", "a\0b", "x" * 5000],
    "budget": ["2%", "40000"],
    "seed": ["0", "-1", "12345678901234567890"],
    "cameras": ["none", "cameras.json"],
    "set": [["fit_steps=5", "k=2"]],
    "scenes": [("a.ply", "b.ply"), ()],
}


def converted(param: Any, word: Any) -> tuple[Any, str]:
    """Return the value of a word, or the class and text of the error."""
    try:
        value = param.process_value(typer.Context(make_command("compact")), word)
    except Exception as error:
        return type(error), str(error)
    return value, type(value).__name__


@pytest.mark.parametrize(("name", "word"), [(name, word) for name, words in WORDS.items() for word in (*words, None)])
def test_words_mean_what_typer_says(name: str, word: Any) -> None:
    (param,) = (param for param in make_command("compact").commands["compact"].params if param.name == name)
    if not hasattr(param, "type_descriptor"):
        pytest.skip("this version of Typer converts words without Pydantic")
    param.__dict__.pop("process_value", None)
    of_typer = converted(param, word)
    convert_plain_values(param)
    assert converted(param, word) == of_typer


def test_an_unreadable_file_is_left_to_typer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.access", lambda *_: False)
    (tmp_path / "a.ply").touch()
    (param,) = (param for param in make_command("compact").commands["compact"].params if param.name == "output")
    convert_plain_values(param)
    error, text = converted(param, str(tmp_path / "a.ply"))
    assert issubclass(error, typer.BadParameter)
    assert "not readable" in text
