"""What is made once in a run, whichever process needs it first."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

PLACE: list[Path] = []  # the folder that all processes of a run share; conftest.py puts it here


def make_once(name: str, make: Callable[[Path], object]) -> Path:
    """Return a folder that ``make`` fills under another name, so that whoever finds it finds it whole."""
    place = PLACE[0] / name
    if place.exists():
        return place
    place.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=place.parent) as own:
        made = Path(own) / "made"
        make(made)
        try:
            made.rename(place)
        except OSError:  # another process was first
            if not place.exists():
                raise
    return place
