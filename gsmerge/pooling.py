"""Pool groups of Gaussians into moments, and convert moments back into Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gsmerge.arrays import to_float32
from gsmerge.geometry import camera_depths
from gsmerge.kernels.elementary import exp, log
from gsmerge.kernels.gaussians.pool import decompose, pool
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import FeatureGaussians, Gaussians, Pixels, Scene

Rule = Literal["depth", "paper"]

MIN_SCALE = 1e-12
MAX_OPACITY = 0.999  # of a merged Gaussian, so that its logit is finite and a later fit can still change it
ROWS_PER_TASK = 4096  # groups that one task pools
ROWS = 65536  # Gaussians whose footprints one task computes


@dataclass(frozen=True)
class Members:
    """Input Gaussians as contiguous float32 arrays for the kernels, with their footprints and pixels."""

    means: np.ndarray  # [n,3]
    quats: np.ndarray  # [n,4] wxyz
    scales: np.ndarray  # [n,3]
    opacities: np.ndarray  # [n]
    sh0: np.ndarray  # [n,1,3]
    shN: np.ndarray  # [n,k-1,3], separate because they are most of a scene of degree 4 and only pooling reads them
    footprints: np.ndarray  # [n] size of the own view's pixel at the member's depth, world units
    pixels: np.ndarray  # [n] int, the pixel (view-major, row-major over all views) of each member, -1 for none
    fronts: np.ndarray  # [v,h,w] int32, the member that each pixel shows, -1 for none


def _array(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.float32)


def scene_members(scene: Scene) -> Members:
    """Return the Gaussians of a canonical scene with pixels as members.

    Footprints are measured in the view of each Gaussian's pixel, or for Gaussians without a pixel in the view with the
    smallest footprint.
    """
    g, cameras, homes = scene.gaussians, scene.cameras, scene.get_pixels().homes
    means, footprints = _array(g.means), np.empty(len(g), np.float32)
    viewmats, Ks = cameras.viewmats.astype(np.float32), cameras.Ks
    focals = np.array([float(np.sqrt(abs(K[0, 0] * K[1, 1]))) for K in Ks])

    def fill(first: int) -> None:
        rows = slice(first, first + ROWS)
        views = homes[rows] // scene.pixels_per_view
        depths = np.abs(camera_depths(means[rows], viewmats[views]))
        footprints[rows] = np.maximum(depths, np.float32(1e-6)) / focals.astype(np.float32)[views]

    parallel_map(fill, range(0, len(g), ROWS))
    alone = np.flatnonzero(homes < 0)
    if len(alone):
        nearest = np.full(len(alone), np.inf)
        for centre, focal in zip(cameras.centres.astype(np.float64), focals, strict=True):
            np.minimum(nearest, np.linalg.norm(means[alone] - centre, axis=1) / focal, out=nearest)
        footprints[alone] = np.maximum(nearest, 1e-6)
    return _make_members(g, footprints, scene.get_pixels())


def gaussian_members(g: Gaussians, footprints: np.ndarray) -> Members:
    """Return Gaussians without pixels as members, with the given footprints ``[n]``."""
    nowhere = np.full(len(g), -1, np.int32), np.zeros((0, 1, 1), np.int32)
    return _make_members(g, footprints, Pixels(*nowhere, own=False))


def _make_members(g: Gaussians, footprints: np.ndarray, pixels: Pixels) -> Members:
    columns = {name: _array(column) for name, column in vars(g).items()}
    return Members(**columns, footprints=footprints, pixels=pixels.homes, fronts=pixels.fronts)


@dataclass(frozen=True)
class Moments:
    """Pooled moments of g groups, float64 except for float32 ``sh``; see :class:`FeatureGaussians`."""

    means: np.ndarray  # [g,3]
    covars: np.ndarray  # [g,3,3]
    weights: np.ndarray  # [g]
    masses: np.ndarray  # [g]
    extinctions: np.ndarray  # [g]
    footprints: np.ndarray  # [g]
    sh: np.ndarray  # [g,k,3]


def pool_members(members: Members, starts: np.ndarray, ids: np.ndarray, rule: Rule = "depth") -> Moments:
    """Pool every group of members into moments, weighted by opacity.

    ``ids [m]`` int32 are rows of ``members``, group after group. ``starts [g+1]`` int64 are the starts of the groups in
    ``ids``. The ``rule`` ``"depth"`` adds the members' own covariances to the covariance of their means, and sums their
    integrated optical depths. ``"paper"`` is the paper's moment matching (eq. teacher_mean, teacher_cov). The paper
    states no opacity, so the mean opacity of the members is used.
    """
    num_groups = len(starts) - 1
    geometry = np.zeros((num_groups, 13))
    sh = np.zeros((num_groups, 1 + members.shN.shape[1], 3), np.float32)

    def run(first: int) -> None:
        last = min(first + ROWS_PER_TASK, num_groups)
        m = members
        pool(
            starts[first : last + 1], ids, m.means, m.quats, m.scales, m.opacities, m.sh0, m.shN, m.footprints,
            rule == "depth", geometry[first:last], sh[first:last],
        )  # fmt: skip

    parallel_map(run, range(0, num_groups, ROWS_PER_TASK))
    covars, extinctions = geometry[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]].reshape(-1, 3, 3), geometry[:, 11]
    if rule == "paper" and num_groups:
        scales, _ = principal_axes(covars)
        mean = np.add.reduceat(members.opacities[ids].astype(np.float64), starts[:-1]) / np.diff(starts)
        extinctions = -log(1 - np.clip(mean, 1e-4, MAX_OPACITY)) * scales[:, 1] * scales[:, 2]
    return Moments(geometry[:, :3], covars, geometry[:, 9], geometry[:, 10], extinctions, geometry[:, 12], sh)


def principal_axes(covars: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return standard deviations ``[g,3]``, ascending, and unit quaternions ``[g,4]`` of covariances ``[g,3,3]``."""
    covars = np.ascontiguousarray(covars, dtype=np.float64)
    scales, quats = np.empty((len(covars), 3)), np.empty((len(covars), 4))

    def run(first: int) -> None:
        rows = slice(first, first + ROWS_PER_TASK)
        decompose(covars[rows], scales[rows], quats[rows])

    parallel_map(run, range(0, len(covars), ROWS_PER_TASK))
    return np.maximum(scales, MIN_SCALE), quats


def to_gaussians(covars: np.ndarray, extinctions: np.ndarray, means: np.ndarray, sh: np.ndarray) -> Gaussians:
    """Convert moments to Gaussians; the opacity follows from the optical depth spread over the Gaussian's disc."""
    scales, quats = principal_axes(covars)
    opacities = 1 - exp(-extinctions / (scales[:, 1] * scales[:, 2]))
    return Gaussians(
        means=to_float32(means),
        quats=to_float32(quats),
        scales=to_float32(scales),
        opacities=np.clip(opacities, 0, MAX_OPACITY).astype(np.float32),
        sh0=sh[:, :1],
        shN=sh[:, 1:],
    )


def feature_to_gaussians(features: FeatureGaussians) -> Gaussians:
    """Decode every Feature Gaussian into one Gaussian (K = 1)."""
    return to_gaussians(
        features.covars,
        features.extinctions.astype(np.float64) * features.gains,
        features.means,
        np.concatenate([features.sh0, features.shN], 1),
    )
