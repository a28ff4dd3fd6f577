"""Text files of poses, as KITTI, TUM, RealEstate10K, ScanNet and DA3-Streaming write them, and of intrinsics."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import repeat
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import quat_to_rotmat
from gsmerge.io.bounds import MAX_TEXT_BYTES, check_file, read_lines
from gsmerge.io.cameras.camera_file import W2C_OPENCV, StoredView, check_count, make_pinhole
from gsmerge.io.cameras.camera_source import CameraSource, StoredCameras
from gsmerge.io.cameras.foreign import INTRINSICS, POSE_FOLDERS
from gsmerge.io.image_names import natural_order

_POSE_COLUMNS = (12, 16)  # numbers in a line that is a pose
_ROW = 4  # numbers in a line that is a row of a matrix
_TUM = 8  # a time, the camera's centre and a quaternion xyzw
_RE10K = 19  # a time, fx, fy, cx, cy, two zeros and a pose
_MOST_COLUMNS = _RE10K
_NO_NUMBERS = re.compile(r"\s*(#|https?:)")  # a comment, or the address of RealEstate10K's video


def lists_poses(path: Path) -> bool:
    """Return whether a text file, or the files of a folder, begin with a pose or with a row of a matrix."""
    if path.is_dir() and path.name not in POSE_FOLDERS:
        return False
    with suppress(OSError, ValueError, SceneError):
        first = next(filter(str.strip, _lines(path)), "")
        return len(np.array(_words(first), np.float64)) in (_ROW, _TUM, _RE10K, *_POSE_COLUMNS)
    return False


def read_poses(source: CameraSource) -> StoredCameras:
    """Read the cameras of a text file, or of the text files in a folder: a pose per line, or a matrix in four lines.

    Poses have 12 or 16 numbers, row by row, or TUM's 8 numbers; they are camera-to-world with OpenCV axes. Only poses
    of RealEstate10K are world-to-camera, with intrinsics in the same line. Intrinsics of other poses may be in a file
    beside them, see :data:`INTRINSICS`: fx, fy, cx, cy in pixels or a matrix, for all views or for each. In a folder,
    views without a finite matrix are left out. SceneError if a line has another count of numbers.
    """
    path = source.path
    columns = len(_words(next(filter(str.strip, _lines(path)), "")))
    rows = _parse(path, _lines(path), (columns,) if columns in (_ROW, _TUM, _RE10K) else _POSE_COLUMNS)
    poses, names = _join_rows(path, rows), [f"{i:06d}" for i in range(len(rows))]
    intrinsics = next((path.parent / name for name in INTRINSICS if (path.parent / name).exists()), None)
    Ks = [] if intrinsics is None or columns == _RE10K else _read_intrinsics(intrinsics)
    if columns == _TUM:
        names, poses = [f"{row[0]:.6f}" for row in rows], _tum_poses(np.array(rows))
    elif columns == _RE10K:
        names, Ks = [f"{row[0]:.0f}" for row in rows], [make_pinhole(*row[1:5]) for row in rows]
        poses = [row[7:] for row in rows]
    elif path.is_dir():
        names = [file.stem for file in _files(path)]
    if intrinsics is not None and len(Ks) not in (1, len(poses)):
        raise SceneError(intrinsics, f"expected one line, or one for each of {len(poses)} views, found {len(Ks)}")
    Ks_by_view = repeat(Ks[0] if Ks else None) if len(Ks) < 2 else Ks
    triples = zip(names, poses, Ks_by_view, strict=False)
    views = [StoredView(name, pose.reshape(-1, 4), K, (0, 0)) for name, pose, K in triples]
    views = [view for view in views if not path.is_dir() or np.isfinite(view.pose).all()]
    return StoredCameras(views, convention=W2C_OPENCV if columns == _RE10K else None)


def _tum_poses(rows: np.ndarray) -> list[np.ndarray]:
    """Convert rows ``[n,8]`` of time, centre and quaternion xyzw to poses ``[3,4]``."""
    centres, quats = rows[:, 1:4], rows[:, [7, 4, 5, 6]]  # wxyz
    with np.errstate(all="ignore"):  # the check of the cameras refuses numbers that are not finite
        rotations = quat_to_rotmat(quats)
    return [np.column_stack([rotation, centre]) for rotation, centre in zip(rotations, centres, strict=True)]


def _read_intrinsics(path: Path) -> list[np.ndarray]:
    """Read intrinsics ``[3,3]``: lines of fx, fy, cx, cy or of matrices, or a matrix in several lines.

    SRN and NSVF write f, cx, cy, 0 in the first line, and other numbers in further lines.
    """
    rows = _join_rows(path, _parse(path, _lines(path), (1, 2, 3, 4, 9, 16)))
    if len(rows) > 1 and len(rows[0]) == 4 != len(rows[-1]):
        f, cx, cy, _ = rows[0]
        rows = [np.array([f, f, cx, cy])]
    if any(len(row) not in (4, 9, 16) for row in rows):
        raise SceneError(path, "expected lines of fx, fy, cx, cy or a matrix of 9 or 16 numbers, found another count")
    sides = {9: 3, 16: 4}
    return [make_pinhole(*row) if len(row) == 4 else row.reshape(sides[len(row)], -1)[:3, :3] for row in rows]


def _join_rows(path: Path, rows: list[np.ndarray]) -> list[np.ndarray]:
    """Join the rows of matrices whose last row is 0 0 1 or 0 0 0 1; return other rows unchanged."""
    side = len(rows[-1]) if rows else 0
    if side not in (3, 4) or rows[-1].tolist() != [0] * (side - 1) + [1]:
        return rows
    if len(rows) % side or {len(row) for row in rows} != {side}:
        raise SceneError(path, f"expected {side} lines of {side} numbers for each matrix, found another count")
    return [np.concatenate(rows[i : i + side]) for i in range(0, len(rows), side)]


def _files(path: Path) -> list[Path]:
    texts = natural_order(path.glob("[!.]*.txt"))
    check_count(path, len(texts))
    return texts


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file, or of all text files in a folder.

    Comments, and the lines of indices in a ``.log``, become empty. SceneError if the files of a folder together have
    more bytes than a single file may have.
    """
    files = _files(path) if path.is_dir() else [path]
    if sum(map(check_file, files)) > MAX_TEXT_BYTES:
        raise SceneError(path, f"expected text files of at most {MAX_TEXT_BYTES >> 20} MiB together, found more")
    for file in files:
        for line in read_lines(file):
            has_no_pose = _NO_NUMBERS.match(line) or (file.suffix == ".log" and len(line.split()) == 3)
            yield "" if has_no_pose else line


def _parse(path: Path, lines: Iterable[str], lengths: tuple[int, ...]) -> list[np.ndarray]:
    """Parse the numbers of lines; SceneError with the number of the line if one is wrong."""
    rows: list[np.ndarray] = []
    for number, line in enumerate(lines, 1):
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
    """Split a line into words; the last word holds all that follows the largest count of numbers in a line."""
    return line.replace(",", " ").split(maxsplit=_MOST_COLUMNS)
