"""Text files of poses, as KITTI, TUM, RealEstate10K, ScanNet and DA3-Streaming have them, and of intrinsics.

DA3-Streaming has ``results_output/frame_N.npz`` beside it as well: depth map, image and intrinsics of the view of line
N, from 0 on.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import islice, repeat
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import quat_to_rotmat
from gsmerge.io.bounds import MAX_TEXT_BYTES, check_file, read_lines
from gsmerge.io.cameras.camera_file import W2C_OPENCV, StoredView, check_count, make_pinhole
from gsmerge.io.cameras.camera_source import CameraSource, StoredCameras
from gsmerge.io.cameras.foreign import INTRINSICS, POSE_FOLDERS
from gsmerge.io.cameras.npz_files import array_shape
from gsmerge.io.formats.table import FRAMES, POSES
from gsmerge.io.image_names import natural_key

_FRAME = re.compile(r"frame_(\d{1,9})\.npz")
_POSE_COLUMNS = (12, 16)  # numbers of a pose in a line
# of a matrix's row; of a time, shift and quaternion xyzw (TUM); of a time, intrinsics, two zeros and a pose
_ROW, _TUM, _RE10K = 4, 8, 19
_MOST_COLUMNS = _RE10K
_OTHER_LINE = re.compile(r"\s*(#|https?:)")  # comments, and the address of RealEstate10K's video


def lists_poses(path: Path) -> bool:
    """Return whether the first numbers of a text file, or of the files of a folder, are a pose or a matrix's row."""
    if path.is_dir() and path.name not in POSE_FOLDERS:
        return False
    with suppress(OSError, ValueError, SceneError):
        first = next(filter(str.strip, _lines(path)), "")
        return len(np.array(_words(first), np.float64)) in (_ROW, _TUM, _RE10K, *_POSE_COLUMNS)
    return False


def read_poses(source: CameraSource) -> StoredCameras:
    """Read the cameras of a text file, or of a folder's, with one pose per line or a matrix in four.

    A pose of 12 or 16 numbers, row by row, is camera-to-world with OpenCV axes, as is TUM's; RealEstate10K's is
    world-to-camera and has intrinsics before it. Those of others are beside it, see :data:`INTRINSICS`: fx, fy, cx, cy
    in pixels or a matrix, for all views or for each; or nothing. The size is that of DA3-Streaming's frames, or of the
    images. Views of a folder whose matrix is not finite have no camera. SceneError if a line has another number of
    numbers.
    """
    path = source.path
    columns = len(_words(next(filter(str.strip, _lines(path)), "")))
    rows = _parse(path, _lines(path), (columns,) if columns in (_ROW, _TUM, _RE10K) else _POSE_COLUMNS)
    poses, names = _join_rows(path, rows), [f"{i:06d}" for i in range(len(rows))]
    beside = [path.parent / name for name in INTRINSICS]
    place = next((file for file in beside if file.exists()), None)
    Ks = [] if place is None or columns == _RE10K else _read_intrinsics(place)
    if columns == _TUM:
        with np.errstate(all="ignore"):  # what is not finite is refused with the cameras
            names, turns = [f"{row[0]:.6f}" for row in rows], quat_to_rotmat(np.array(rows)[:, [7, 4, 5, 6]])
        poses = [np.column_stack([turn, row[1:4]]) for turn, row in zip(turns, rows, strict=True)]
    elif columns == _RE10K:
        names, Ks = [f"{row[0]:.0f}" for row in rows], [make_pinhole(*row[1:5]) for row in rows]
        poses = [row[7:] for row in rows]
    elif path.is_dir():
        names = [file.stem for file in _files(path)]
    if place is not None and len(Ks) not in (1, len(poses)):
        raise SceneError(place, f"expected one line, or one for each of {len(poses)} views, found {len(Ks)}")
    shape = array_shape(path.parent / FRAMES / "frame_0.npz", "depth")  # empty without frames
    size = (shape[1], shape[0]) if len(shape) == 2 and Ks else (0, 0)
    each = repeat(Ks[0] if Ks else None) if len(Ks) < 2 else Ks
    views = [StoredView(name, pose.reshape(-1, 4), K, size) for name, pose, K in zip(names, poses, each, strict=False)]
    views = [view for view in views if not path.is_dir() or np.isfinite(view.pose).all()]
    return StoredCameras(views, convention=W2C_OPENCV if columns == _RE10K else None)


def _read_intrinsics(path: Path) -> list[np.ndarray]:
    """Read lines of fx, fy, cx, cy or of matrices, or a matrix in several lines, or SRN's and NSVF's f, cx, cy, 0."""
    rows = _join_rows(path, _parse(path, _lines(path), (1, 2, 3, 4, 9, 16)))
    if len(rows) > 1 and len(rows[0]) == 4 != len(rows[-1]):
        rows = [rows[0][[0, 0, 1, 2]]]
    if any(len(row) not in (4, 9, 16) for row in rows):
        raise SceneError(path, "expected fx, fy, cx, cy or a matrix of 9 or 16 numbers, found other lines")
    sides = {9: 3, 16: 4}
    return [make_pinhole(*row) if len(row) == 4 else row.reshape(sides[len(row)], -1)[:3, :3] for row in rows]


def _join_rows(path: Path, rows: list[np.ndarray]) -> list[np.ndarray]:
    """Join the rows of matrices, a line each, of which the last is 0 0 1 or 0 0 0 1; unchanged where they are none."""
    side = len(rows[-1]) if rows else 0
    if side not in (3, 4) or rows[-1].tolist() != [0] * (side - 1) + [1]:
        return rows
    if len(rows) % side or {len(row) for row in rows} != {side}:
        raise SceneError(path, f"expected {side} lines of {side} numbers for each matrix, found others")
    return [np.concatenate(rows[i : i + side]) for i in range(0, len(rows), side)]


def _files(path: Path) -> list[Path]:
    texts = sorted(path.glob("[!.]*.txt"), key=lambda file: natural_key(file.name))
    check_count(path, len(texts))
    return texts


def _lines(path: Path) -> Iterator[str]:
    """Yield the lines of a text file, or of all in a folder; empty ones for comments and the indices of a ``.log``.

    SceneError if the files of a folder together have more bytes than one may have.
    """
    files = _files(path) if path.is_dir() else [path]
    if sum(map(check_file, files)) > MAX_TEXT_BYTES:
        raise SceneError(path, f"expected text files of at most {MAX_TEXT_BYTES >> 20} MiB together, found more")
    for file in files:
        for line in read_lines(file):
            is_other = _OTHER_LINE.match(line) or (file.suffix == ".log" and len(line.split()) == 3)
            yield "" if is_other else line


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
