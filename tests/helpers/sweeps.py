"""Of tests over many cases a few run always, and all others in the sweeps (``-m slow``)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

import pytest


def sweep(names: str | Sequence[str], values: Iterable[Any], *, often: int = 1, **options: Any) -> pytest.MarkDecorator:
    """Return ``pytest.mark.parametrize``, of whose values the first few are in the default run."""
    one_name = isinstance(names, str) and "," not in names
    cases = [
        value if i < often else pytest.param(*([value] if one_name else value), marks=pytest.mark.slow)
        for i, value in enumerate(values)
    ]
    return pytest.mark.parametrize(names, cases, **options)


def in_words(value: object) -> str | None:
    """Name a case by its value: settings as ``k=2 fit=none``, words of a list, and of the name of a function.

    None of what has no short text, which pytest names by the argument and a number.
    """
    if callable(value):
        return value.__name__.replace("_", " ") if value.__name__ != "<lambda>" else None
    if not isinstance(value, dict | list | tuple | set):
        return None
    text = repr(sorted(value) if isinstance(value, set) else value)
    if len(text) > 100 or " at 0x" in text or "array(" in text:
        return None
    words = re.sub(r"[\[\](){}'\",]", "", text).replace(": ", "=")
    return words or ("defaults" if isinstance(value, dict) else "none")
