"""A damage is what is done to a sound file, and what may come of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

# Changes a sound file in place, or its folder where the kind names none; a list that it returns is what the command
# gets in place of the file
Change = Callable[[Path], Any]

READ, USAGE, REFUSED = 0, 2, 3  # exit codes of the command


@dataclass(frozen=True)
class Damage:
    """A change to a sound file, and what may come of it.

    Args:
        change: Of the file.
        codes: The exit codes that are right.
        says: Values in the error line, as ``messages.names``.
        place: The file, or the file and the place in it, that begins the line; that of the sound file if empty.
        slow: The change or its reading takes long: it is tried in the sweep alone.
        in_scene: Cameras that are damaged like this are sound until they are used: the scene is read in every run.
        compacts: Tried without ``--dry-run``, which reads no masks and does not decode photos.
        other_kind: What the file is now is sound, though not what the command expects.
    """

    change: Change
    codes: tuple[int, ...] = (REFUSED,)
    says: tuple[object, ...] = ()
    place: str = ""
    slow: bool = False
    in_scene: bool = False
    compacts: bool = False
    other_kind: bool = False


def refuse(change: Change, *says: object, place: str = "", **settings: Any) -> Damage:
    """Make a damage that is refused in a line that begins with the place and has these values."""
    return Damage(change, says=says, place=place, **settings)


def accept(change: Change, **settings: Any) -> Damage:
    """Make a change that the file is read with as before."""
    return Damage(change, (READ,), **settings)


def allow(change: Change, **settings: Any) -> Damage:
    """Make a damage that is read or refused, as it comes."""
    return Damage(change, (READ, REFUSED), **settings)


def leave_to_sweep(damages: dict[Any, Damage]) -> dict[Any, Damage]:
    """Return the same damages for the sweep alone."""
    return {name: replace(damage, slow=True) for name, damage in damages.items()}
