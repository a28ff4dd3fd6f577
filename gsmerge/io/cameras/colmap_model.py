"""Write COLMAP models (colmap.github.io, "Output Format"): cameras, views, and Gaussians as points with tracks.

Trainers begin with the points, and COLMAP's dense steps choose by the tracks which views to compare. The track of a
point lists the views that see it, and where in their images. Here that is the projection of the Gaussian's centre, so
reprojection errors are zero.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry.transforms import project, rotmat_to_quat, sh0_to_rgb
from gsmerge.io.formats.table import CAMERAS, IMAGES, POINTS
from gsmerge.types import Cameras, Gaussians

_FOREIGN = ("rigs.bin", "frames.bin")  # files of COLMAP since 3.12, which it would read together with this model
_PINHOLE = 1  # COLMAP's id of the camera model
_OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])
_POINT = np.dtype(
    [("id", "<u8"), ("mean", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("num_views", "<u8")]
)  # two int32 follow for each view that sees the point: the view's id, and the point's index in the view's list


def files_beside(points: Path) -> tuple[Path, Path]:
    """Return the paths of a model's cameras and views; SceneError if COLMAP's own files are in the folder."""
    foreign = next((points.with_name(name) for name in _FOREIGN if points.with_name(name).exists()), None)
    if foreign is not None:
        raise SceneError(foreign, "expected no model of another program in the folder", "choose another folder")
    return points.with_name(CAMERAS), points.with_name(IMAGES)


def model_files(
    gaussians: Gaussians, cameras: Cameras, names: Sequence[str], seen: Sequence[np.ndarray]
) -> dict[str, bytes]:
    """Encode the files of a model by name; ``seen`` lists for each view the rows of the Gaussians that it shows."""
    Ks, camera_ids = np.unique(cameras.Ks.astype(np.float64), axis=0, return_inverse=True)
    files = {CAMERAS: _cameras(Ks, cameras.width, cameras.height)}
    files[IMAGES] = _images(gaussians, cameras, names, seen, camera_ids.reshape(-1) + 1)
    return files | {POINTS: _points(gaussians, seen)}


def _cameras(Ks: np.ndarray, width: int, height: int) -> bytes:
    rows = [
        struct.pack("<iiQQ4d", i, _PINHOLE, width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        for i, K in enumerate(Ks, 1)
    ]
    return struct.pack("<Q", len(rows)) + b"".join(rows)


def _images(
    gaussians: Gaussians, cameras: Cameras, names: Sequence[str], seen: Sequence[np.ndarray], camera_ids: np.ndarray
) -> bytes:
    parts = [struct.pack("<Q", len(names))]
    viewmats = cameras.viewmats.astype(np.float64)
    quats = rotmat_to_quat(viewmats[:, :3, :3])
    for i, (name, rows) in enumerate(zip(names, seen, strict=True)):
        observations = np.empty(len(rows), _OBSERVATION)
        observations["pixel"] = project(gaussians.means[rows], cameras[[i]])[0][0]
        observations["point"] = rows + 1
        parts.append(struct.pack("<i7di", i + 1, *quats[i], *viewmats[i, :3, 3], camera_ids[i]))
        parts += [
            name.replace("\0", "").encode("utf-8", "replace") + b"\0",
            struct.pack("<Q", len(observations)),
            observations.tobytes(),
        ]
    return b"".join(parts)


def _points(gaussians: Gaussians, seen: Sequence[np.ndarray]) -> bytes:
    count, head_bytes = len(gaussians), _POINT.itemsize
    points = np.zeros(count, _POINT)
    points["id"], points["mean"] = np.arange(1, count + 1), gaussians.means
    points["color"] = np.rint(255 * sh0_to_rgb(gaussians.sh0[:, 0]).clip(0, 1))
    rows = np.concatenate([np.zeros(0, np.int64), *seen])
    views = np.repeat(np.arange(1, len(seen) + 1), [len(part) for part in seen])
    indices = np.concatenate([np.zeros(0, np.int64), *(np.arange(len(part)) for part in seen)])
    points["num_views"] = np.bincount(rows, minlength=count)
    order = np.argsort(rows, kind="stable")
    pairs = np.stack([views, indices], 1)[order].astype("<i4")
    ends = pairs.itemsize * 2 * np.cumsum(points["num_views"].astype(np.int64))
    heads, tracks, start = points.tobytes(), pairs.tobytes(), 0
    parts = [struct.pack("<Q", count)]
    for i, end in enumerate(ends.tolist()):
        parts += [heads[head_bytes * i : head_bytes * (i + 1)], tracks[start:end]]
        start = end
    return b"".join(parts)
