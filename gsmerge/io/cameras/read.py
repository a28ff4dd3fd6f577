"""Read cameras by the kind of their file; lists of poses and cameras inside a ``.ply`` are read here."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import numpy as np
from plyfile import PlyListProperty

from gsmerge.errors import SceneError
from gsmerge.io.bounds import MAX_VIEWS, check_file, read_text
from gsmerge.io.cameras.camera_file import C2W_OPENCV, W2C_OPENCV, CameraFile, View, make_camera_file, make_pinhole
from gsmerge.io.cameras.colmap import is_colmap, read_colmap
from gsmerge.io.cameras.embedded import read_embedded
from gsmerge.io.cameras.json_files import VIEWER_CAMERAS, read_json_cameras
from gsmerge.io.cameras.npz_files import array_names, holds_poses, read_da3, read_dump
from gsmerge.io.cameras.re10k import SUFFIX as CHUNK
from gsmerge.io.cameras.re10k import read_re10k
from gsmerge.io.formats.ply import open_ply
from gsmerge.io.formats.table import PLY, input_format
from gsmerge.types import StrPath

# Where cameras are in a scene's folder, the first that exists wins; a COLMAP model directly in the folder comes last,
# because Depth Anything 3 puts one there at the photos' own size.
CAMERA_PLACES = (
    "views.npz", "transforms.json", "cameras.json", "camera_params.json", "sparse/0", "sparse",
    "colmap/sparse/0", "colmap", "exports/npz/results.npz", "exports/mini_npz/results.npz",
    "results.npz", "camera_poses.txt", "0", ".",
)  # fmt: skip
INTRINSICS = ("intrinsic.txt", "intrinsics.txt")
_POSE_COLUMNS = (12, 16)  # numbers of a pose in a line
_MAX_OTHERS = 16  # files in a folder that are looked into for cameras
SHARP = "SHARP"
_SHARP_ELEMENTS = ("extrinsic", "intrinsic", "image_size")  # the last not in its first versions
SHARP_LAYERS = 2  # Gaussians per cell: a front and a back layer


def find_cameras(folder: Path) -> Path | None:
    """Find the first known camera file below a folder, or its only ``.torch`` chunk."""
    for place in CAMERA_PLACES:
        candidate = folder / place
        if candidate.is_file() or (candidate.is_dir() and is_colmap(candidate)):
            return candidate
    chunks = [chunk for chunk in folder.glob(f"*{CHUNK}") if chunk.is_file()]
    return chunks[0] if len(chunks) == 1 else None


def find_other_cameras(folder: Path) -> Path | None:
    """Find the only ``.json`` or ``.npz`` in a folder that holds cameras, whatever its name; None without one."""
    files = sorted(path for path in folder.glob("[!.]*") if path.suffix in (".json", ".npz"))
    files = [path for path in files if path.is_file() and not path.name.endswith(VIEWER_CAMERAS)]
    found = [path for path in files[:_MAX_OTHERS] if _holds_cameras(path)]
    return found[0] if len(found) == 1 else None


def _holds_cameras(path: Path) -> bool:
    if path.suffix == ".npz":
        return holds_poses(path)
    try:
        return len(read_json_cameras(path)) > 0
    except SceneError:
        return False


def read_cameras(path: StrPath, *, scene: str | None = None, folder: Path | None = None) -> CameraFile:
    """Read cameras from a file, or from a folder that holds one of the known kinds.

    ``transforms.json`` (nerfstudio, instant-ngp), COLMAP text and binary models, INRIA's ``cameras.json``,
    ``results.npz`` of Depth Anything 3, ``views.npz`` dumped from a running model, ``camera_params.json`` of
    WorldMirror, the dataset file of Long-LRM, ``.torch`` chunks of re10k, text files with one pose per line, and a
    ``.ply`` of gsmerge that holds its own. Poses become world-to-camera with OpenCV axes.

    Args:
        path: The file, a COLMAP folder, or a folder that has the cameras in one of the usual places.
        scene: Which scene, where a file holds several (``.torch`` chunks); usually the name of the ``.ply``.
        folder: Of the Gaussians, where Long-LRM writes how it moved the cameras; None: that of the cameras.

    Raises:
        SceneError: If there are no cameras, a file is damaged or incomplete, or a lens of an unknown kind.
    """
    path = Path(path)
    if not os.path.exists(path):
        raise SceneError(path, "no such file or folder")
    if path.is_dir():
        inside = path if is_colmap(path) else find_cameras(path) or find_other_cameras(path)
        if inside is None:
            raise SceneError(path, "expected transforms.json, cameras.json, a COLMAP model or results.npz, found none")
        path = inside
    if path.is_dir():
        return read_colmap(path)
    check_file(path)
    if path.suffix in (".bin", ".txt"):
        columns = 0
        with suppress(OSError, ValueError), path.open(encoding="utf-8-sig") as file:
            columns = len(_numbers(file.readline(4096)))
        if columns in _POSE_COLUMNS:
            return read_trajectory(path)
        if not is_colmap(path.parent):
            raise SceneError(path, "expected a COLMAP model with cameras and images files, found no pair of them")
        return read_colmap(path.parent)
    if path.suffix == ".npz":
        return read_dump(path) if "c2w" in array_names(path) else read_da3(path)
    if path.suffix == CHUNK:
        return read_re10k(path, scene)
    if path.suffix == ".json":
        return read_json_cameras(path, folder)
    if path.suffix.lower() == ".ply":
        return read_embedded(path)
    raise SceneError(path, "expected cameras as .json, .npz, .torch or a COLMAP folder, found another kind of file")


def read_trajectory(path: Path) -> CameraFile:
    """Read the cameras of a text file with one pose per line, as KITTI and DA3 write it.

    A line has 12 or 16 numbers: camera-to-world, OpenCV axes, row by row. Next to the file is ``intrinsic.txt`` (or
    ``intrinsics.txt``) with fx, fy, cx, cy in pixels, one line for all views or one for each, or nothing; the images
    have the size. SceneError if a line has another number of numbers.
    """
    poses = _rows(path, _POSE_COLUMNS)
    intrinsics = next((path.with_name(name) for name in INTRINSICS if path.with_name(name).is_file()), None)
    if intrinsics is None:
        views = [View(f"{i:06d}", pose.reshape(-1, 4), None) for i, pose in enumerate(poses)]
        return make_camera_file(path, "pose list", C2W_OPENCV, views)
    values = _rows(intrinsics, (4,))
    if len(values) not in (1, len(poses)):
        raise SceneError(intrinsics, f"expected one line, or one for each of {len(poses)} views, found {len(values)}")
    Ks = [make_pinhole(*row) for row in (values * len(poses) if len(values) == 1 else values)]
    views = [View(f"{i:06d}", pose.reshape(-1, 4), K) for i, (pose, K) in enumerate(zip(poses, Ks, strict=True))]
    return make_camera_file(path, "pose list", C2W_OPENCV, views)


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


def read_sharp(path: Path) -> CameraFile | None:
    """Read the camera that SHARP writes into its ``.ply``, at the size of the file's grid; None without one.

    The grid is square whatever the photo's shape: the photo was stretched to it. SceneError if the numbers are
    damaged.
    """
    if input_format(path).read is not PLY.read:
        return None
    data = open_ply(path)
    present = [name for name in _SHARP_ELEMENTS if name in data]
    if "vertex" not in data or not {"extrinsic", "intrinsic"}.issubset(present):
        return None
    for element in (data[name] for name in present):
        if element.count > 16 or len(element.properties) != 1 or isinstance(element.properties[0], PlyListProperty):
            return None
    rows = {name: [row[0] for row in data[name].data] for name in present}
    numbers = {name: np.asarray(values, np.float64) for name, values in rows.items()}
    extrinsic, intrinsic = numbers["extrinsic"], numbers["intrinsic"]
    if len(intrinsic) == 4 and "image_size" not in numbers:  # first versions: focal lengths and size
        numbers["image_size"] = intrinsic[2:]
        intrinsic = make_pinhole(*intrinsic[:2], *(intrinsic[2:] / 2)).reshape(-1)
    size = numbers.get("image_size", np.zeros(0))
    side = round((data["vertex"].count / SHARP_LAYERS) ** 0.5)
    if SHARP_LAYERS * side * side != data["vertex"].count or len(size) != 2 or not (size > 0).all():
        return None
    if len(extrinsic) not in (12, 16) or len(intrinsic) != 9:
        raise SceneError(path, f"expected 16 and 9 numbers of a camera, found {len(extrinsic)} and {len(intrinsic)}")
    pose, K = extrinsic.reshape(-1, 4).copy(), intrinsic.reshape(3, 3)
    if len(extrinsic) == 12:  # its first versions: the rotation column by column
        pose[:, :3] = pose[:, :3].T.copy()
    K = K * np.array([[side / size[0]], [side / size[1]], [1.0]])
    view = View(path.stem, pose, K, (side, side))
    return make_camera_file(path, SHARP, W2C_OPENCV, [view])
