"""Rotations that an exporter stored in another order, or left in the camera's frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gsmerge.geometry import quat_to_rotmat
from gsmerge.io.reading import QuatChoice
from gsmerge.types import PixelScene

_SAMPLES = 3000  # pixels per view whose surface is looked at
_STEP = 2  # pixels to the neighbours that span the surface
_FLAT = 0.8  # thinnest over middle scale, at most, where a Gaussian says which way its surface faces
_MIN_TESTED = 300
_MIN_COSINE, _MIN_GAIN = 0.6, 0.15  # of the mean cosine between thinnest axis and normal, for another reading
_READINGS: tuple[QuatChoice, ...] = ("wxyz", "xyzw", "camera")


def read_rotations(scene: PixelScene, reading: QuatChoice) -> PixelScene:
    """The scene with its stored rotations read in another way.

    Args:
        scene: Rotations as they stand in the file, read as wxyz, local to world.
        reading: "wxyz": as they are; "xyzw": w comes last; "camera": wxyz, relative to the camera of the own view.
    """
    if reading in ("auto", "wxyz"):
        return scene
    quats = scene.gaussians.quats
    if reading == "xyzw":
        turned = from_xyzw(quats)
    else:
        pose = _quats_of(scene.cameras.viewmats[:, :3, :3].transpose(1, 2)).float()
        turned = _multiply(pose.repeat_interleave(scene.pixels_per_view, 0), quats)
    return replace(scene, gaussians=replace(scene.gaussians, quats=turned))


def from_xyzw(quats: Tensor) -> Tensor:
    """``[n,4]`` xyzw -> wxyz."""
    return quats[:, [3, 0, 1, 2]]


def likely_rotations(scene: PixelScene) -> tuple[QuatChoice, str]:
    """How the rotations are to be read: the way that turns the thinnest axes towards the surface's normals.

    Args:
        scene: Rotations as they stand in the file, read as wxyz.

    Returns:
        The reading, and a sentence about it; "wxyz" and "" unless another one is better by a large margin.
    """
    normals, rows, views = _normals(scene)
    scales = scene.gaussians.scales[rows]
    ordered = scales.sort(1).values
    flat = ordered[:, 0] < _FLAT * ordered[:, 1]
    normals, rows, views = normals[flat], rows[flat], views[flat]
    if len(rows) < _MIN_TESTED:
        return "wxyz", ""
    thinnest, quats = scene.gaussians.scales[rows].argmin(1), scene.gaussians.quats[rows]
    poses = scene.cameras.viewmats[:, :3, :3].transpose(1, 2)[views].float()
    rotations = {
        "wxyz": quat_to_rotmat(quats),
        "xyzw": quat_to_rotmat(from_xyzw(quats)),
        "camera": poses @ quat_to_rotmat(quats),
    }
    cosine = {}
    for name in _READINGS:
        axes = rotations[name].gather(2, thinnest[:, None, None].expand(-1, 3, 1))[:, :, 0]
        cosine[name] = float((axes * normals).sum(1).abs().mean())
    best = max(_READINGS, key=lambda name: cosine[name])
    if best == "wxyz" or cosine[best] < _MIN_COSINE or cosine[best] < cosine["wxyz"] + _MIN_GAIN:
        return "wxyz", ""
    words = {"xyzw": "stored with w last", "camera": "relative to each view's camera"}[best]
    return best, (
        f"rotations are {words}: the thinnest axes are at a mean cosine of {cosine[best]:.2f} to the surface then,"
        f" {cosine['wxyz']:.2f} as stored; quats 'wxyz' says otherwise"
    )


def _normals(scene: PixelScene) -> tuple[Tensor, Tensor, Tensor]:
    """Normals ``[t,3]`` of some pixels' surface, their rows and their views."""
    v, h, w = scene.valid.shape
    if min(h, w) <= 2 * _STEP:
        empty = torch.zeros(0, dtype=torch.int64)
        return torch.zeros(0, 3), empty, empty
    inner = torch.arange(v * h * w).reshape(v, h, w)[:, _STEP:-_STEP, _STEP:-_STEP].reshape(v, -1)
    step = max(1, inner.shape[1] // _SAMPLES)
    while step > 1 and np.gcd(step, w - 2 * _STEP) > 1:
        step += 1
    rows = inner[:, ::step].reshape(-1)
    valid, means = scene.valid.reshape(-1), scene.gaussians.means
    good = valid[rows]
    for offset in (_STEP, -_STEP, _STEP * w, -_STEP * w):
        good = good & valid[rows + offset]
    rows = rows[good]
    across = (means[rows + _STEP] - means[rows - _STEP]).float()
    down = (means[rows + _STEP * w] - means[rows - _STEP * w]).float()
    normals = torch.nn.functional.normalize(torch.linalg.cross(across, down), dim=1)
    return normals, rows, rows.div(h * w, rounding_mode="floor")


def _quats_of(rotations: Tensor) -> Tensor:
    """``[c,3,3]`` rotations -> ``[c,4]`` unit quaternions wxyz."""
    r = rotations.double()
    trace = r.diagonal(dim1=1, dim2=2)
    m = torch.zeros(len(r), 4, 4, dtype=torch.float64)
    m[:, 0, 0] = trace.sum(1)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        m[:, i + 1, i + 1] = trace[:, i] - trace[:, j] - trace[:, k]
        m[:, 0, i + 1] = m[:, i + 1, 0] = r[:, k, j] - r[:, j, k]
        m[:, i + 1, j + 1] = m[:, j + 1, i + 1] = r[:, i, j] + r[:, j, i]
    return torch.linalg.eigh(m).eigenvectors[:, :, -1]  # of the largest eigenvalue, 3


def _multiply(a: Tensor, b: Tensor) -> Tensor:
    """Products of quaternions wxyz: first ``b``, then ``a``."""
    aw, ax, ay, az = a.unbind(1)
    bw, bx, by, bz = b.unbind(1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        1,
    )
