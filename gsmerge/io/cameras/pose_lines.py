"""Text files of a pose in each line, as DA3-Streaming and VGGT-Long write them, with intrinsics beside them.

Beside the poses, DA3-Streaming writes ``results_output/frame_N.npz`` with depth map, image and intrinsics of the view
whose pose is in line N, counted from 0.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from itertools import islice, repeat
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import read_lines
from gsmerge.io.cameras.camera_file import StoredView, check_count, make_pinhole
from gsmerge.io.cameras.camera_source import CameraSource, StoredCameras
from gsmerge.io.cameras.foreign import INTRINSICS
from gsmerge.io.cameras.npz_files import array_shape
from gsmerge.io.formats.table import FRAMES, POSES

_FRAME = re.compile(r"frame_(\d{1,9})\.npz")
_POSE_COLUMNS = (12, 16)  # numbers in a line that is a pose
_INTRINSIC_COLUMNS = (4,)  # fx, fy, cx, cy, pixels


def lists_poses(path: Path) -> bool:
    """Return whether the first line of a text file with content is a pose."""
    with suppress(OSError, ValueError, SceneError):
        first = next(filter(str.strip, read_lines(path)), "")
        return len(np.array(_words(first), np.float64)) in _POSE_COLUMNS
    return False


def read_poses(source: CameraSource) -> StoredCameras:
    """Read the cameras of a text file with a pose of 12 or 16 numbers in each line, row by row.

    Intrinsics may be in :data:`INTRINSICS` beside it, for all views or for each. The size is that of DA3-Streaming's
    frames; without frames it is unknown. SceneError if a line has another count of numbers.
    """
    path, intrinsics = source.path, source.path.parent / INTRINSICS
    poses = _parse(path, read_lines(path), _POSE_COLUMNS)
    Ks: list[np.ndarray | None] = [None]
    if intrinsics.is_file():
        Ks = [make_pinhole(*row) for row in _parse(intrinsics, read_lines(intrinsics), _INTRINSIC_COLUMNS)]
    if len(Ks) not in (1, len(poses)):
        raise SceneError(intrinsics, f"expected one line, or one for each of {len(poses)} views, found {len(Ks)}")
    shape = array_shape(path.parent / FRAMES / "frame_0.npz", "depth")  # empty without frames
    size = (shape[1], shape[0]) if len(shape) == 2 and intrinsics.is_file() else (0, 0)
    pairs = zip(poses, repeat(Ks[0]) if len(Ks) == 1 else Ks, strict=False)
    return StoredCameras([StoredView(f"{i:06d}", pose.reshape(-1, 4), K, size) for i, (pose, K) in enumerate(pairs)])


def list_frames(folder: Path) -> list[Path]:
    """List the frames of DA3-Streaming by number, in its folder or in ``results_output``; empty if there are no poses.

    SceneError if a number is missing.
    """
    frames_folder = folder if folder.name == FRAMES else folder / FRAMES
    with suppress(OSError):
        if (frames_folder.parent / POSES).is_file():
            matches = [(_FRAME.fullmatch(path.name), path) for path in frames_folder.iterdir()]
            numbers = {int(match[1]): path for match, path in matches if match}
            missing = next((number for number in range(len(numbers)) if number not in numbers), None)
            if missing is not None:
                problem = f"expected {len(numbers)} frames from frame_0.npz on, found none with number {missing}"
                raise SceneError(frames_folder, problem, "add it, and one line of camera_poses.txt for each")
            return [numbers[number] for number in range(len(numbers))]
    return []


def pose_of_frame(frame: Path) -> np.ndarray:
    """Read the camera-to-world pose ``[3,4]`` or ``[4,4]`` of a frame of DA3-Streaming; SceneError if it has none."""
    match, path = _FRAME.fullmatch(frame.name), frame.parent.parent / POSES
    number = int(match[1]) if match else 0
    lines = (line for line in read_lines(path) if line.strip())
    poses = _parse(path, islice(lines, number, number + 1), _POSE_COLUMNS, number + 1)
    if not poses:
        raise SceneError(path, f"expected {number + 1} poses or more, one for each frame, found fewer")
    return poses[0].reshape(-1, 4)


def _parse(path: Path, lines: Iterable[str], lengths: tuple[int, ...], first: int = 1) -> list[np.ndarray]:
    """Parse the numbers of lines; SceneError with the line number, counted from ``first``, if one is wrong."""
    rows: list[np.ndarray] = []
    for number, line in enumerate(lines, first):
        words = _words(line)
        if words and len(words) not in lengths:
            counts = " or ".join(map(str, lengths))
            found = len(words) if len(words) <= _POSE_COLUMNS[-1] else f"more than {_POSE_COLUMNS[-1]}"
            raise SceneError(path, f"line {number}: expected {counts} numbers, found {found}")
        try:
            rows += [np.array(words, np.float64)] if words else []
        except ValueError as error:
            raise SceneError(path, f"line {number}: expected numbers ({error})") from error
        check_count(path, len(rows))
    return rows


def _words(line: str) -> list[str]:
    """Split a line into words; the last word holds all that follows the largest count of numbers in a line."""
    return line.split(maxsplit=_POSE_COLUMNS[-1])
