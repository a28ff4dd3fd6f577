"""Finding camera files and choosing their reader."""

from __future__ import annotations

import os
from pathlib import Path

from gsmerge.errors import SceneError
from gsmerge.io.bounds import check_file, read_json
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.cameras.colmap import is_colmap, read_colmap
from gsmerge.io.cameras.da3 import read_da3
from gsmerge.io.cameras.dump import is_dump, read_dump
from gsmerge.io.cameras.inria import read_inria
from gsmerge.io.cameras.long_lrm import read_long_lrm
from gsmerge.io.cameras.re10k import SUFFIX as CHUNK
from gsmerge.io.cameras.re10k import read_re10k
from gsmerge.io.cameras.trajectory import is_trajectory, read_trajectory
from gsmerge.io.cameras.transforms import read_transforms
from gsmerge.io.cameras.world_mirror import read_world_mirror

# Where cameras are in a scene's folder, the first that exists wins; a COLMAP model directly in the folder comes last,
# because Depth Anything 3 puts one there at the photos' own size.
CAMERA_PLACES = (
    "views.npz",
    "transforms.json",
    "cameras.json",
    "camera_params.json",
    "sparse/0",
    "sparse",
    "colmap/sparse/0",
    "colmap",
    "exports/npz/results.npz",
    "exports/mini_npz/results.npz",
    "results.npz",
    "camera_poses.txt",
    "0",
    ".",
)


def find_cameras(folder: Path) -> Path | None:
    """The first of the known camera files below a folder, or its only ``.torch`` chunk; None where there is none."""
    for place in CAMERA_PLACES:
        candidate = folder / place
        if candidate.is_file() or (candidate.is_dir() and is_colmap(candidate)):
            return candidate
    chunks = [chunk for chunk in folder.glob(f"*{CHUNK}") if chunk.is_file()]
    return chunks[0] if len(chunks) == 1 else None


def read_cameras(path: str | os.PathLike[str], *, scene: str | None = None) -> CameraFile:
    """Read cameras from a file, or from a folder that holds one of the known kinds.

    ``transforms.json`` (nerfstudio, instant-ngp), COLMAP text and binary models, INRIA's ``cameras.json``,
    ``results.npz`` of Depth Anything 3, ``views.npz`` dumped from a running model, ``camera_params.json`` of
    WorldMirror, the dataset file of Long-LRM, ``.torch`` chunks of re10k, and text files with one pose per line. Poses
    become world-to-camera with OpenCV axes.

    Args:
        path: The file, a COLMAP folder, or a folder that has the cameras in one of the usual places.
        scene: Which scene, where a file holds several (``.torch`` chunks); usually the name of the ``.ply``.

    Raises:
        SceneError: If there are no cameras, a file is damaged or incomplete, or a lens of an unknown kind.
    """
    path = Path(path)
    if not os.path.exists(path):
        raise SceneError(path, "no such file or folder")
    if path.is_dir():
        inside = path if is_colmap(path) else find_cameras(path)
        if inside is None:
            raise SceneError(path, "expected transforms.json, cameras.json, a COLMAP model or results.npz, found none")
        path = inside
    if path.is_dir():
        return read_colmap(path)
    check_file(path)
    if path.suffix in (".bin", ".txt"):
        if is_trajectory(path):
            return read_trajectory(path)
        if not is_colmap(path.parent):
            raise SceneError(path, "expected a COLMAP model with cameras and images files, found no pair of them")
        return read_colmap(path.parent)
    if path.suffix == ".npz":
        return read_dump(path) if is_dump(path) else read_da3(path)
    if path.suffix == CHUNK:
        return read_re10k(path, scene)
    if path.suffix == ".json":
        return _read_json(path)
    raise SceneError(path, "expected cameras as .json, .npz, .torch or a COLMAP folder, found another kind of file")


def _read_json(path: Path) -> CameraFile:
    data = read_json(path)
    if isinstance(data, dict) and "frames" in data:
        frames = data["frames"]
        if isinstance(frames, list) and frames and all(isinstance(f, dict) and "w2c" in f for f in frames):
            return read_long_lrm(path, data)
        return read_transforms(path, data)
    if isinstance(data, list) and data and all(isinstance(entry, dict) for entry in data):
        if "transform_matrix" in data[0]:
            return read_transforms(path, data)
        if "position" in data[0] or "rotation" in data[0]:
            return read_inria(path, data)
    if isinstance(data, dict) and {"extrinsics", "intrinsics"} <= data.keys():
        return read_world_mirror(path, data)
    raise SceneError(path, "expected 'frames' (nerfstudio) or a list of cameras (INRIA), found neither")
