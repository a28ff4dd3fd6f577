"""What is made once in a run, whichever process needs it first."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path


def make_once(place: Path, make: Callable[[Path], object]) -> Path:
    """A folder that ``make`` fills under another name, so that whoever finds it finds it whole."""
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
