"""Tests over many cases: a few in every run, all others in the sweeps (``-m slow``)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pytest


def sweep(names: str | Sequence[str], values: Iterable[Any], *, often: int = 1, **options: Any) -> pytest.MarkDecorator:
    """``pytest.mark.parametrize``, of whose values the first few are in the default run."""
    one_name = isinstance(names, str) and "," not in names
    cases = [
        value if i < often else pytest.param(*([value] if one_name else value), marks=pytest.mark.slow)
        for i, value in enumerate(values)
    ]
    return pytest.mark.parametrize(names, cases, **options)


def in_words(value: Any) -> str:
    """Name a case by what a user sets: ``k=2 fit=none`` of settings, words of a function's name."""
    if isinstance(value, Mapping):
        return " ".join(f"{name}={one}" for name, one in value.items()) or "defaults"
    return value.__name__.replace("_", " ") if callable(value) else str(value)
