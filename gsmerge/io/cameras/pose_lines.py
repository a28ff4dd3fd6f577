"""Text files with one pose a line, as KITTI and DA3-Streaming write them, and ``intrinsic.txt`` beside them.

DA3-Streaming has ``results_output/frame_N.npz`` beside it as well: depth map, image and intrinsics of the view of line
N, from 0 on.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import suppress
from itertools import islice
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import read_lines
from gsmerge.io.cameras.camera_file import StoredView, check_count, make_pinhole
from gsmerge.io.cameras.camera_format import CameraSource, StoredCameras
from gsmerge.io.cameras.npz_files import array_shape
from gsmerge.io.formats.table import FRAMES, POSES

INTRINSICS = ("intrinsic.txt", "intrinsics.txt")
_FRAME = re.compile(r"frame_(\d{1,9})\.npz")
_POSE_COLUMNS = (12, 16)  # numbers of a pose in a line
_MOST_COLUMNS = max(_POSE_COLUMNS)


def lists_poses(path: Path) -> bool:
    """Return whether the first line of a text file is a pose."""
    with suppress(OSError, ValueError), path.open(encoding="utf-8-sig") as file:
        return len(np.array(_words(file.readline(4096)), np.float64)) in _POSE_COLUMNS
    return False


def read_poses(source: CameraSource) -> StoredCameras:
    """Read the cameras of a text file with one pose per line, as KITTI and DA3 write it.

    A line has 12 or 16 numbers: camera-to-world, OpenCV axes, row by row. Next to the file is ``intrinsic.txt`` (or
    ``intrinsics.txt``) with fx, fy, cx, cy in pixels, one line for all views or one for each, or nothing; the size is
    that of DA3-Streaming's frames, or of the images. SceneError if a line has another number of numbers.
    """
    path, poses = source.path, _parse(source.path, read_lines(source.path), _POSE_COLUMNS)
    intrinsics = next((path.with_name(name) for name in INTRINSICS if path.with_name(name).is_file()), None)
    if intrinsics is None:
        return StoredCameras([StoredView(f"{i:06d}", pose.reshape(-1, 4), None) for i, pose in enumerate(poses)])
    values = _parse(intrinsics, read_lines(intrinsics), (4,))
    if len(values) not in (1, len(poses)):
        raise SceneError(intrinsics, f"expected one line, or one for each of {len(poses)} views, found {len(values)}")
    shape = array_shape(path.parent / FRAMES / "frame_0.npz", "depth")  # empty without frames
    size = (shape[1], shape[0]) if len(shape) == 2 else (0, 0)
    Ks = [make_pinhole(*row) for row in (values * len(poses) if len(values) == 1 else values)]
    views = [
        StoredView(f"{i:06d}", pose.reshape(-1, 4), K, size) for i, (pose, K) in enumerate(zip(poses, Ks, strict=True))
    ]
    return StoredCameras(views)


def list_frames(folder: Path) -> list[Path]:
    """List the frames of DA3-Streaming in its folder or in ``results_output`` by number; empty without poses.

    SceneError if a number is missing.
    """
    place = folder if folder.name == FRAMES else folder / FRAMES
    with suppress(OSError):
        if (place.parent / POSES).is_file():
            matches = [(_FRAME.fullmatch(path.name), path) for path in place.iterdir()]
            numbers = {int(match[1]): path for match, path in matches if match}
            missing = next((number for number in range(len(numbers)) if number not in numbers), None)
            if missing is not None:
                problem = f"expected {len(numbers)} frames from frame_0.npz on, found none with number {missing}"
                raise SceneError(place, problem, "add it, and one line of camera_poses.txt for each")
            return [numbers[number] for number in range(len(numbers))]
    return []


def pose_of_frame(frame: Path) -> np.ndarray:
    """Read the pose ``[3,4]`` or ``[4,4]``, camera to world, of a frame of DA3-Streaming; SceneError without one."""
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
            found = len(words) if len(words) <= _MOST_COLUMNS else f"more than {_MOST_COLUMNS}"
            raise SceneError(path, f"line {number}: expected {counts} numbers, found {found}")
        try:
            rows += [np.array(words, np.float64)] if words else []
        except ValueError as error:
            raise SceneError(path, f"line {number}: expected numbers ({error})") from error
        check_count(path, len(rows))
    return rows


def _words(line: str) -> list[str]:
    """Split a line into words; the last word holds the rest of the line after the numbers of a pose."""
    return line.replace(",", " ").split(maxsplit=_MOST_COLUMNS)
