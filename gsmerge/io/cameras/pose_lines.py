"""Read text files with a pose in each line, and the intrinsics beside them.

DA3-Streaming and VGGT-Long write such files, and so do the data sets KITTI, Replica and RealEstate10K.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import read_json, read_lines
from gsmerge.io.cameras.camera_file import StoredView, check_camera_count, make_pinhole
from gsmerge.io.cameras.camera_source import CameraSource, StoredCameras, number_errors, to_number
from gsmerge.io.cameras.foreign import CALIBRATION, INTRINSICS, REPLICA_CAMERA
from gsmerge.io.first_bytes import read_start
from gsmerge.method.kernels.matrices import invert, matmul

_POSE_COLUMNS = (12, 16)  # possible counts of numbers in a line with a pose
_REALESTATE_COLUMNS = 19  # numbers in a line of RealEstate10K: a time, the lens, two zeros and a pose
_KITTI_CAMERAS = (2, 3, 0, 1)  # cameras of KITTI, whose photos lie in image_2 and so on, the most preferred first


class _Intrinsics(NamedTuple):
    """Intrinsics of the views of a list of poses, and what a program's list of poses does not say."""

    Ks: list[np.ndarray | None]  # ``[3,3]`` for all views, or for each view; [None] if they are unknown
    size: tuple[int, int] = (0, 0)  # pixels; 0 if unknown
    name: str = "{:06d}"  # name of the photo of a view, from its number
    offset: np.ndarray = np.eye(4)  # [4,4] from the frame of the pose to the camera, both with OpenCV axes


def lists_poses(path: Path) -> bool:
    """Return whether the first line of a text file that is not empty is a pose."""
    with suppress(OSError, ValueError, SceneError):
        first = next(filter(str.strip, read_lines(path)), "")
        return len(np.array(_words(first), np.float64)) in _POSE_COLUMNS
    return False


def read_poses(source: CameraSource) -> StoredCameras:
    """Read the cameras of a text file, each line of which has the 12 or 16 numbers of a pose, row by row.

    A file beside it may have the intrinsics: :data:`INTRINSICS`, with one line for all views or a line for each,
    KITTI's :data:`CALIBRATION`, or Replica's :data:`REPLICA_CAMERA`, which may also lie in the folder above. Raise
    SceneError if a line of poses has other than 12 or 16 numbers, or if intrinsics are damaged.
    """
    path = source.path
    poses = _parse(path, read_lines(path), _POSE_COLUMNS)
    folder = path.parent
    places: list[tuple[Path, Callable[[Path], _Intrinsics]]] = [
        (folder / INTRINSICS, _read_lines_of_intrinsics),
        (folder / CALIBRATION, _read_kitti),
        (folder / REPLICA_CAMERA, _read_replica),
        (folder.parent / REPLICA_CAMERA, _read_replica),
    ]
    found = next(((place, read) for place, read in places if place.is_file()), None)
    intrinsics = _Intrinsics([None]) if found is None else found[1](found[0])
    Ks = intrinsics.Ks
    if len(Ks) not in (1, len(poses)):
        raise SceneError(
            folder / INTRINSICS, f"expected one line, or one for each of {len(poses)} views, found {len(Ks)}"
        )
    to_pose = None if (intrinsics.offset == np.eye(4)).all() else invert(intrinsics.offset)
    views = list[StoredView]()
    for i, numbers in enumerate(poses):
        pose = numbers.reshape(-1, 4)
        if to_pose is not None:
            pose = matmul(pose, to_pose)
        views.append(StoredView(intrinsics.name.format(i), pose, Ks[i % len(Ks)], intrinsics.size))
    return StoredCameras(views)


def is_realestate(path: Path) -> bool:
    """Return whether a text file has the address of a video, and then cameras, as those of RealEstate10K have."""
    lines = read_start(path).decode("latin-1").splitlines()
    return len(lines) > 1 and lines[0].startswith("http") and len(lines[1].split()) == _REALESTATE_COLUMNS


def read_realestate(source: CameraSource) -> StoredCameras:
    """Read the cameras of a video of RealEstate10K.

    After the video's address, a line has the time of a photo, which is its name, then fx, fy, cx and cy divided by the
    size, two zeros, and the 12 numbers of a world-to-camera pose. Raise SceneError for a damaged line.
    """
    lines = read_lines(source.path)
    next(lines, None)  # the address
    rows = _parse(source.path, lines, (_REALESTATE_COLUMNS,), first=2)
    return StoredCameras([StoredView(f"{row[0]:.0f}", row[7:].reshape(3, 4), make_pinhole(*row[1:5])) for row in rows])


def _read_lines_of_intrinsics(path: Path) -> _Intrinsics:
    """Read lines of fx, fy, cx and cy in pixels, of all views or of each."""
    return _Intrinsics([make_pinhole(*row) for row in _parse(path, read_lines(path), lengths=(4,))])


def _read_kitti(path: Path) -> _Intrinsics:
    """Read the camera of KITTI whose photos are there.

    A line has the name of a camera, P0 to P3, and the 12 numbers of its projection from the frame of the poses, which
    is that of camera 0: the intrinsics, and times these the shift of the camera.
    """
    projections = dict[str, np.ndarray]()
    for line in read_lines(path):
        name, _, numbers = line.partition(":")
        if name.startswith("P") and len(numbers.split(maxsplit=12)) == 12:
            with number_errors(path, f"{name}: expected numbers"):
                projections[name.strip()] = np.array(numbers.split(), np.float64).reshape(3, 4)
    shown = [camera for camera in _KITTI_CAMERAS if (path.parent / f"image_{camera}").is_dir()]
    name = f"P{(shown or _KITTI_CAMERAS)[0]}"
    if name not in projections:
        raise SceneError(path, f"expected a line {name} with 12 numbers, as in KITTI's odometry, found none")
    projection = projections[name]
    offset = np.eye(4)
    with number_errors(path, "expected intrinsics"):
        offset[:3, 3] = matmul(invert(projection[:, :3]), projection[:, 3])
    return _Intrinsics([projection[:, :3]], offset=offset)


def _read_replica(path: Path) -> _Intrinsics:
    """Read the camera of all views of Replica, as NICE-SLAM renders it."""
    with number_errors(path, "expected an object 'camera' with w, h, fx, fy, cx and cy"):
        camera: dict[str, Any] = read_json(path)["camera"]
        fx, fy, cx, cy, width, height = (to_number(camera[key]) for key in ("fx", "fy", "cx", "cy", "w", "h"))
        return _Intrinsics([make_pinhole(fx, fy, cx, cy)], (round(width), round(height)), "frame{:06d}")


def _parse(path: Path, lines: Iterable[str], lengths: tuple[int, ...], *, first: int = 1) -> list[np.ndarray]:
    """Parse lines of numbers, and skip empty lines. ``lengths`` are the possible counts of numbers in a line.

    If a line is wrong, SceneError says the line's number; ``first`` is that of the first of ``lines``.
    """
    rows: list[np.ndarray] = []
    most = max(*lengths, _POSE_COLUMNS[-1])
    for number, line in enumerate(lines, first):
        words = _words(line, most)
        if words and len(words) not in lengths:
            counts = " or ".join(map(str, lengths))
            found = len(words) if len(words) <= most else f"more than {most}"
            raise SceneError(path, f"line {number}: expected {counts} numbers, found {found}")
        try:
            rows += [np.array(words, np.float64)] if words else []
        except ValueError as error:
            raise SceneError(path, f"line {number}: expected numbers ({error})") from error
        check_camera_count(path, len(rows))
    return rows


def _words(line: str, most: int = _POSE_COLUMNS[-1]) -> list[str]:
    """Split a line into at most so many words; if more follow, they are one last word."""
    return line.split(maxsplit=most)
