"""This package has sound files of every kind, changes to them, and what may come of each.

``SOUNDS`` are the sound files, one maker for each kind. ``DAMAGES`` are the changes of each kind with what is expected:
``generic`` has those that fit every kind, the other modules those of one kind. ``tests/e2e/test_damaged_files.py``
tries all of them; ``tests/property/test_readers_fuzz.py`` and ``tools/fuzz.py`` change the same sound files at random.
"""

from __future__ import annotations

from itertools import chain

from . import arrays, cameras, gaussians, generic, json_cameras, photos, places, ply, sog, tensors
from .case import Damage
from .sounds import SOUNDS

MODULES = (generic, ply, gaussians, sog, json_cameras, cameras, arrays, photos, tensors, places)
DAMAGES: dict[str, tuple[str, Damage]] = {  # by its name: the kind of sound file, and what is done to it
    f"{kind}: {name}": (kind, damage)
    for kind, damages in chain.from_iterable(module.DAMAGES.items() for module in MODULES)
    for name, damage in damages.items()
}

__all__ = ["DAMAGES", "SOUNDS", "Damage"]
