"""The helpers of ``messages.py`` let no other kind, place or value pass."""

from __future__ import annotations

import pytest
from messages import names, refuses, says


@pytest.mark.parametrize(
    ("text", "value"),
    [("got 15", 5), ("got 5.1", 5), ("got -5", 5), ("k_low", "k"), ("a", "b")],
    ids=["5 is not in 15", "5 is not in 5.1", "5 is not in -5", "k is not in k_low", "b is not in a"],
)
def test_names_takes_whole_words_as_values(text: str, value: object) -> None:
    assert not names(text, value)
    assert names(f"{text}, got {value}; more", value)


def test_says_takes_whole_parts_of_a_path_as_the_place() -> None:
    text = "/b/a/scene.ply: got 5"
    assert not any(says(text, place, 5) for place in ("scene.pl", "ply", "other.ply", "scene.ply: rows"))
    assert all(says(text, place, 5) for place in ("scene.ply", "a/scene.ply", "/b/a/scene.ply", ""))


@pytest.mark.parametrize(
    ("kind", "place", "value"),
    [(KeyError, "k", 9), (ValueError, "kk", 9), (ValueError, "k", 7)],
    ids=["another kind", "another place", "another value"],
)
def test_refuses_lets_no_other_kind_place_or_value_pass(kind: type[Exception], place: str, value: int) -> None:
    with pytest.raises((AssertionError, ValueError)), refuses(kind, place, value):
        raise ValueError("k: expected 1 to 8, got 9")
