"""Move Gaussians and cameras into the frame of an output file, and cut or pad their harmonics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.geometry.transforms import IDENTITY, Similarity, euler_to_rotmat, normalize
from gsmerge.kernels.matrices import matmul
from gsmerge.settings.placement import AXES, PlacementOptions, parse_triple
from gsmerge.types import Cameras, Gaussians

NUM_FULL = 15  # number of harmonics of the degrees 1 to 3


def pad_harmonics(gaussians: Gaussians, count: int) -> Gaussians:
    """Pad the harmonics above degree 0 with zeros, so that each Gaussian has at least ``count`` of them."""
    missing = max(0, count - gaussians.shN.shape[1])
    return replace(gaussians, shN=np.pad(gaussians.shN, ((0, 0), (0, missing), (0, 0))))


def find_placement(options: PlacementOptions, cameras: Cameras | None, marked: str | None = None) -> Similarity:
    """Return the map from the frame of the scene to the frame of the output file.

    The upward axis of the scene is the mean upward axis of the ``cameras``. Without cameras it is ``marked``, the axis
    that the header of the input file names, or else -y.
    """
    if not options.moves:
        return IDENTITY
    rotation = np.eye(3)
    if options.up is not None:
        upward = _axis(marked or "-y") if cameras is None else -cameras.viewmats[:, 1, :3].sum(0)
        rotation = rotation_between(normalize(upward), _axis(options.up))
    if options.rotate is not None:
        rotation = matmul(euler_to_rotmat(np.array(parse_triple("rotate", options.rotate))), rotation)
    scale = 1.0 if options.scale is None else float(options.scale)
    return Similarity(rotation, scale, np.array(parse_triple("translate", options.translate)))


def _axis(name: str) -> np.ndarray:
    """Return the unit vector ``[3]`` of an axis such as ``"y"`` or ``"-y"``."""
    axis = np.zeros(3)
    axis[AXES.index(name) // 2] = -1 if name[0] == "-" else 1
    return axis


def rotation_between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the rotation ``[3,3]`` by the smallest angle from one unit vector to another (Rodrigues' formula)."""
    cosine = float((start * end).sum())
    if cosine < -1 + 1e-12:  # opposite vectors: turn by 180 degrees about any axis that is perpendicular to them
        axis = np.eye(3)[0] if abs(start[0]) < 0.9 else np.eye(3)[1]
        axis = normalize(axis - (axis * start).sum() * start)
        return 2 * np.outer(axis, axis) - np.eye(3)
    x, y, z = np.cross(start, end)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + cross + matmul(cross, cross) / (1 + cosine))


def move_to_frame(
    gaussians: Gaussians, cameras: Cameras, frame: Similarity, sh_degree: int | None
) -> tuple[Gaussians, Cameras]:
    """Move Gaussians and cameras into ``frame``, and leave out harmonics above ``sh_degree``; None: keep all."""
    if sh_degree is not None:
        gaussians = replace(gaussians, shN=gaussians.shN[:, : (sh_degree + 1) ** 2 - 1])
    if frame is IDENTITY:
        return gaussians, cameras
    in_float64 = replace(gaussians, means=gaussians.means.astype(np.float64))  # until the file is written
    return frame.move_gaussians(in_float64), frame.move_cameras(cameras)
