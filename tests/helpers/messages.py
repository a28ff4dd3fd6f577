"""A message has to say the kind of error, its place and its value wherever its wording is not the subject.

A message begins with its place, such as ``k: expected 1 to 8, got 9`` and ``a/b.ply: no such file``; after it come the
values, which are numbers, names and options, or one word that tells it from others of that place.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

ERROR = "gsmerge: error: "  # at the start of the command line's error lines
NO_FOLDER = () if os.name == "nt" else ("Not a directory",)  # what systems say of a file as a folder


def names(text: str, *values: object) -> bool:
    """Return whether a text has all of these as whole words: 5 is not in "15", "-5" or "5.1"."""
    return all(re.search(rf"(?<![\w.-]){re.escape(str(value))}(?!\w|[.,]\d)", text) for value in values)


def says(text: str, place: object, *values: object) -> bool:
    """Return whether a message begins with a place and has these values after it.

    Of a path its end suffices; ``view.ply: rows`` is a place in a place. An empty place is none. What the parser of
    the command line refuses reads ``Invalid value for '--k': ...``.
    """
    if os.name == "nt":
        text, place = text.replace("\\", "/"), str(place).replace("\\", "/")
        values = tuple(str(value).replace("\\", "/") for value in values)
    before = "(?:(?:[A-Z]:)?[^:]*/|Invalid value for ')?"
    start = re.match(rf"{before}{re.escape(str(place))}'?: " if str(place) else "", text)
    return start is not None and names(text[start.end() :], *values)


@contextmanager
def refuses(kind: type[BaseException], place: object, *values: object) -> Iterator[pytest.ExceptionInfo[Any]]:
    """Check that a block ends in an error of a kind, in one line with a place and values, as :func:`says`."""
    with pytest.raises(kind) as raised:
        yield raised
    text = str(raised.value)
    assert says(text, place, *values), f"{place}, {values}: {text}"
    assert "\n" not in text


def refuse_all(kind: type[BaseException], calls: Iterable[tuple[Any, ...]]) -> None:
    """Check that each call ends in an error as :func:`refuses`: calls, places and values."""
    for call, place, *values in calls:
        with refuses(kind, place, *values):
            call()


def noted(notes: Iterable[str], *values: object) -> bool:
    """Return whether one of several notes has all of these, as :func:`names`."""
    return any(names(note, *values) for note in notes)
