"""Declarations of settings make checks, help and options."""

from __future__ import annotations

import math
import pydoc
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pytest

from gsmerge import CompactOptions
from gsmerge.settings.evaluate import EvaluateOptions
from gsmerge.settings.files import PlacementOptions
from gsmerge.settings.setting import Settings, flat_settings, setting, settings_of


@dataclass(frozen=True)
class Inner(Settings):
    """A stage."""

    depth: float = setting(1.0, "Depth.", above=0, below=math.inf, unit="m")


@dataclass(frozen=True)
class Example(Settings):
    """Settings of all kinds."""

    word: Literal["a", "b"] | None = setting(None, "A word.", "It may be missing.")
    count: int | Literal["auto"] = setting("auto", "A count.", least=1, most=8)
    number: int = setting(1, "A whole number.", choices=(1, 2, 4))
    share: float = setting(0.5, "A share.", least=0, below=1)
    switch: bool = setting(False, "A switch.")
    sizes: tuple[int, ...] = setting((1,), "Sizes.", least=1, unique=True, filled=True)
    file: str | None = setting(None, "A file.")
    inner: Inner = setting(Inner(), "The stage.")
    state: int = setting(0, "What the program sets.", internal=True)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("word", "c", "a or b, got 'c'"),
        ("count", 0, "a whole number from 1 to 8 or auto, got 0"),
        ("count", 2.5, "a whole number from 1 to 8 or auto, got 2.5"),
        ("count", True, "a whole number from 1 to 8 or auto, got True"),
        ("number", 3, "1, 2 or 4, got 3"),
        ("share", 1, "a number from 0 to below 1, got 1"),
        ("share", math.nan, "a number from 0 to below 1, got nan"),
        ("share", [0.5], r"a number from 0 to below 1, got \[0.5\]"),
        ("state", "a", "a whole number, got 'a'"),
        ("inner", {"depth": 1.0}, "Inner, got {'depth': 1.0}; Example.*"),
        ("inner", None, "Inner, got None; Example.*"),
        ("file", 7, "text, got 7"),
        ("switch", "no", "true or false, got 'no'"),
        ("sizes", (), "at least one value, got none"),
        ("sizes", 2, r"a list of a whole number of at least 1, got 2"),
        ("sizes", (2, 0), "a whole number of at least 1, got 0"),
        ("sizes", (2, 2), "every value once, got 2,2"),
    ],
)
def test_impossible_values_are_refused(name: str, value: Any, expected: str) -> None:
    with pytest.raises(ValueError, match=f"^{name}: expected {expected}$"):
        Example(**{name: value})


@pytest.mark.parametrize("value", [0.0, math.inf, math.nan, -1])
def test_values_at_or_beyond_the_end_of_an_open_range_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match="depth: expected a number above 0 m"):
        Inner(value)


def test_possible_values_are_kept() -> None:
    made = Example("a", np.int64(3), 4, np.float32(0.25), np.True_, [1, 5], "x")  # type: ignore[arg-type]
    assert (made.word, made.count, made.number, made.share) == ("a", 3, 4, 0.25)
    assert Example(share=0).share == 0


def test_settings_of_inner_classes_are_listed_flat() -> None:
    assert list(flat_settings(Example)) == ["word", "count", "number", "share", "switch", "sizes", "file", "depth"]
    assert settings_of(Example)["inner"].kind is Inner


def test_help_has_the_text_of_each_field() -> None:
    text = pydoc.render_doc(Example, renderer=pydoc.plaintext)
    assert "word: A word. It may be missing." in text
    assert "depth: Depth." in pydoc.render_doc(Inner, renderer=pydoc.plaintext)


def test_every_default_is_possible() -> None:
    for name, declared in (
        flat_settings(CompactOptions) | flat_settings(EvaluateOptions) | flat_settings(PlacementOptions)
    ).items():
        assert declared.fits(declared.default), name
