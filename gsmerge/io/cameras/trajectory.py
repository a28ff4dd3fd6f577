"""Text files with one pose per line, as KITTI and the streaming mode of Depth Anything 3 write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import MAX_VIEWS, read_text
from gsmerge.io.cameras.camera_file import C2W_OPENCV, CameraFile, View, make_camera_file, make_pinhole

INTRINSICS = ("intrinsic.txt", "intrinsics.txt")


def read_trajectory(path: Path) -> CameraFile:
    """Cameras of a text file with 12 or 16 numbers a line: camera-to-world, OpenCV axes, row by row.

    Next to it is ``intrinsic.txt`` (or ``intrinsics.txt``) with fx, fy, cx, cy in pixels, one line for all views or one
    for each. The images have the size. SceneError if a line has another number of numbers, or there are no intrinsics.
    """
    poses = _rows(path, (12, 16))
    intrinsics = next((path.with_name(name) for name in INTRINSICS if path.with_name(name).is_file()), None)
    if intrinsics is None:
        problem = f"expected the intrinsics next to it in {INTRINSICS[0]}, found none"
        raise SceneError(path, problem, "write fx fy cx cy")
    values = _rows(intrinsics, (4,))
    if len(values) not in (1, len(poses)):
        raise SceneError(intrinsics, f"expected one line, or one for each of {len(poses)} views, found {len(values)}")
    Ks = [make_pinhole(*row) for row in (values * len(poses) if len(values) == 1 else values)]
    views = [View(f"{i:06d}", pose.reshape(-1, 4), K) for i, (pose, K) in enumerate(zip(poses, Ks, strict=True))]
    return make_camera_file(path, "pose list", C2W_OPENCV, views)


def is_trajectory(path: Path) -> bool:
    """Whether the first line holds 12 or 16 numbers."""
    try:
        with path.open(encoding="utf-8") as file:
            return len(_numbers(file.readline(4096))) in (12, 16)
    except (OSError, ValueError):
        return False


def _rows(path: Path, lengths: tuple[int, ...]) -> list[np.ndarray]:
    lines = [(number, line) for number, line in enumerate(read_text(path).splitlines(), 1) if line.strip()]
    if len(lines) > MAX_VIEWS:
        raise SceneError(path, f"expected at most {MAX_VIEWS} views, found more")
    rows = []
    for number, line in lines:
        try:
            rows.append(_numbers(line))
        except ValueError as error:
            raise SceneError(path, f"line {number}: expected numbers ({error})") from error
        if len(rows[-1]) not in lengths:
            counts = " or ".join(map(str, lengths))
            raise SceneError(path, f"line {number}: expected {counts} numbers, found {len(rows[-1])}")
    return rows


def _numbers(line: str) -> np.ndarray:
    return np.array(line.replace(",", " ").split(), np.float64)
