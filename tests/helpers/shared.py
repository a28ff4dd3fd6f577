"""Folders of scenes and of what commands make of them are made once in a run, by the process that needs them first."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from floors import NUDGE, nudged
from scripts import EXAMPLES, load_script

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


def write_scene(out: Path, **sizes: int) -> Path:
    """Write the scene of the first example as other programs do -> its folder.

    Other programs leave out the comment by which the project's own files name the encoding of their opacities.

    Args:
        out: The folder, which is not there yet.
        sizes: ``num_views``, ``width``, ``height``, ``seed``.
    """
    name = "-".join(f"{key}-{value}" for key, value in sorted(sizes.items()))
    return Path(shutil.copytree(make_once(name, lambda place: _make_scene(place, **sizes)), out))


def _make_scene(out: Path, **sizes: int) -> None:
    ply = load_script(EXAMPLES / "01_make_scene.py").make_scene(out, **sizes) / "scene.ply"
    if NUDGE in os.environ:
        import gsmerge

        gsmerge.write_ply(ply, nudged(gsmerge.read_ply(ply).gaussians), overwrite=True)
    head, rows = ply.read_bytes().split(b"end_header\n", 1)
    ply.write_bytes(head.replace(b"comment opacity: logit\n", b"") + b"end_header\n" + rows)


def write_made(out: Path) -> Path:
    """Write scene.ply, transforms.json, images/ and targets/: 5 views of 96 x 64."""
    return write_scene(out, num_views=5, width=96, height=64)


def write_small(out: Path) -> Path:
    """Write the same in a quarter of the pixels, 5 views of 48 x 32, where size does not matter."""
    return write_scene(out, num_views=5, width=48, height=32)


def write_smallest(out: Path) -> Path:
    """Write three views of 24 x 16 with cameras and images, without targets."""
    folder = write_scene(out, num_views=3, width=24, height=16)
    shutil.rmtree(folder / "targets")
    return folder
