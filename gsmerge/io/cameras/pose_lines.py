"""Read text files of DA3-Streaming and VGGT-Long with a pose in each line, and files of intrinsics beside them."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from itertools import repeat
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import read_lines
from gsmerge.io.cameras.camera_file import StoredView, check_camera_count, make_pinhole
from gsmerge.io.cameras.camera_source import CameraSource, StoredCameras
from gsmerge.io.cameras.foreign import INTRINSICS

_POSE_COLUMNS = (12, 16)  # possible counts of numbers in a line with a pose


def lists_poses(path: Path) -> bool:
    """Return whether the first line of a text file that is not empty is a pose."""
    with suppress(OSError, ValueError, SceneError):
        first = next(filter(str.strip, read_lines(path)), "")
        return len(np.array(_words(first), np.float64)) in _POSE_COLUMNS
    return False


def read_poses(source: CameraSource) -> StoredCameras:
    """Read the cameras of a text file, each line of which has the 12 or 16 numbers of a pose, row by row.

    The file :data:`INTRINSICS` beside it may have one line of intrinsics for all views, or a line for each view. The
    size of the views is unknown. Raise SceneError if a line of poses has other than 12 or 16 numbers, or a line of
    intrinsics other than 4.
    """
    path = source.path
    intrinsics = source.path.parent / INTRINSICS
    poses = _parse(path, read_lines(path), _POSE_COLUMNS)
    Ks: list[np.ndarray | None] = [None]
    if intrinsics.is_file():
        # A line has fx, fy, cx and cy in pixels
        Ks = [make_pinhole(*row) for row in _parse(intrinsics, read_lines(intrinsics), lengths=(4,))]
    if len(Ks) not in (1, len(poses)):
        raise SceneError(intrinsics, f"expected one line, or one for each of {len(poses)} views, found {len(Ks)}")
    pairs = zip(poses, repeat(Ks[0]) if len(Ks) == 1 else Ks, strict=False)
    return StoredCameras([StoredView(f"{i:06d}", pose.reshape(-1, 4), K, (0, 0)) for i, (pose, K) in enumerate(pairs)])


def _parse(path: Path, lines: Iterable[str], lengths: tuple[int, ...]) -> list[np.ndarray]:
    """Parse lines of numbers, and skip empty lines. ``lengths`` are the possible counts of numbers in a line.

    If a line is wrong, SceneError says the line's number.
    """
    rows: list[np.ndarray] = []
    for number, line in enumerate(lines, 1):
        words = _words(line)
        if words and len(words) not in lengths:
            counts = " or ".join(map(str, lengths))
            found = len(words) if len(words) <= _POSE_COLUMNS[-1] else f"more than {_POSE_COLUMNS[-1]}"
            raise SceneError(path, f"line {number}: expected {counts} numbers, found {found}")
        try:
            rows += [np.array(words, np.float64)] if words else []
        except ValueError as error:
            raise SceneError(path, f"line {number}: expected numbers ({error})") from error
        check_camera_count(path, len(rows))
    return rows


def _words(line: str) -> list[str]:
    """Split a line into as many words as a pose has numbers; if more follow, they are one last word."""
    return line.split(maxsplit=_POSE_COLUMNS[-1])
