"""Pool groups of Gaussians into moments, and convert moments back into Gaussians."""

from __future__ import annotations

from typing import Literal

import numpy as np

from gsmerge.arrays import to_float32
from gsmerge.frozen import dataclass
from gsmerge.method.geometry.transforms import camera_depths
from gsmerge.method.kernels.elementary import exp, log
from gsmerge.method.kernels.gaussians.pool import decompose, pool
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, FeatureGaussians, Gaussians, Pixels, Scene

Rule = Literal["depth", "paper"]

MAX_OPACITY = 0.999  # largest opacity of a merged Gaussian, so that its logit is finite and a later fit can change it
ROWS_PER_TASK = 4096  # groups that one task pools
FOOTPRINT_ROWS = 65536  # Gaussians whose footprints one task computes
# Columns of a group in the output of the kernel `pool`
POOLED_MEAN, POOLED_COVAR, POOLED_WEIGHT, POOLED_MASS = slice(0, 3), slice(3, 9), 9, 10
# the last is the number of columns
POOLED_EXTINCTION = 11
POOLED_FOOTPRINT = 12
POOLED_COLUMNS = 13
FULL_MATRIX = [0, 1, 2, 1, 3, 4, 2, 4, 5]  # entries of an upper triangle xx xy xz yy yz zz in a flattened 3 x 3 matrix


@dataclass(frozen=True, eq=False)
class Members:
    """Input Gaussians as contiguous float32 arrays for the kernels, with their footprints and pixels."""

    means: np.ndarray  # [n,3]
    quats: np.ndarray  # [n,4] wxyz
    scales: np.ndarray  # [n,3]
    opacities: np.ndarray  # [n]
    sh0: np.ndarray  # [n,1,3]
    shN: np.ndarray  # [n,k-1,3], separate because it is most of a scene of degree 4 and only pooling reads it
    footprints: np.ndarray  # [n] size of a pixel of the member's view at the member's depth, world units
    pixels: np.ndarray  # [n] int, the pixel (view-major, row-major over all views) of each member, -1 for none
    fronts: np.ndarray  # [v,h,w] int32, the member that each pixel shows, -1 for none


def _as_float32(values: np.ndarray) -> np.ndarray:
    """Return values as a contiguous float32 array."""
    return np.ascontiguousarray(values, dtype=np.float32)


def scene_members(scene: Scene) -> Members:
    """Return the Gaussians of a canonical scene as members, whose footprints are the widths of their pixels."""
    g = scene.gaussians
    pixels = scene.get_pixels()
    return _make_members(g, measure_pixel_sizes(_as_float32(g.means), pixels.homes, scene.cameras), pixels)


def measure_pixel_sizes(means: np.ndarray, homes: np.ndarray, cameras: Cameras) -> np.ndarray:
    """Measure the width ``[n]`` of a pixel, the smallest detail that a photo shows, at each of ``means [n,3]``.

    ``homes [n]`` are the pixels of the means, numbered over all views; -1 for none. A width is in units of the world,
    at the depth of the mean in its pixel's view. For a mean without a pixel, the width is the smallest of the widths in
    all views, at the distance of the mean from the camera.
    """
    widths, viewmats = np.empty(len(means), np.float32), cameras.viewmats.astype(np.float32)
    focals = np.array([float(np.sqrt(abs(K[0, 0] * K[1, 1]))) for K in cameras.Ks])

    def measure_widths(start: int) -> None:
        """Measure the width of a pixel at some of the means, as if all means had a pixel."""
        rows = slice(start, start + FOOTPRINT_ROWS)
        views = homes[rows] // (cameras.height * cameras.width)
        depths = np.abs(camera_depths(means[rows], viewmats, views))
        widths[rows] = np.maximum(depths, np.float32(1e-6)) / focals.astype(np.float32)[views]

    parallel_map(measure_widths, range(0, len(means), FOOTPRINT_ROWS))
    without_pixel = np.flatnonzero(homes < 0)
    if len(without_pixel):
        smallest = np.full(len(without_pixel), np.inf)
        for centre, focal in zip(cameras.centres.astype(np.float64), focals, strict=True):
            np.minimum(smallest, np.linalg.norm(means[without_pixel] - centre, axis=1) / focal, out=smallest)
        widths[without_pixel] = np.maximum(smallest, 1e-6)
    return widths


def gaussian_members(g: Gaussians, footprints: np.ndarray) -> Members:
    """Return Gaussians without pixels as members, with the given footprints ``[n]``."""
    no_pixels = np.full(len(g), -1, np.int32), np.zeros((0, 1, 1), np.int32)
    return _make_members(g, footprints, Pixels(*no_pixels, own=False))


def _make_members(g: Gaussians, footprints: np.ndarray, pixels: Pixels) -> Members:
    """Return Gaussians as members with the given footprints ``[n]`` and pixels."""
    columns = {name: _as_float32(column) for name, column in vars(g).items()}
    return Members(**columns, footprints=footprints, pixels=pixels.homes, fronts=pixels.fronts)


@dataclass(frozen=True, eq=False)
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
    ``ids``. The ``rule`` ``"depth"`` adds the members' covariances to the covariance of their means, and sums their
    integrated optical depths. The rule ``"paper"`` is the paper's moment matching (eq. teacher_mean, teacher_cov). For
    the opacity, which the paper does not state, this rule takes the mean opacity of the members.
    """
    num_groups = len(starts) - 1
    pooled = np.zeros((num_groups, POOLED_COLUMNS))
    sh = np.zeros((num_groups, 1 + members.shN.shape[1], 3), np.float32)

    def pool_groups(begin: int) -> None:
        """Pool some of the groups into the arrays ``pooled`` and ``sh``."""
        end = min(begin + ROWS_PER_TASK, num_groups)
        pool(
            starts[begin : end + 1], ids, means=members.means, quats=members.quats, scales=members.scales,
            opacities=members.opacities, sh0=members.sh0, shN=members.shN, footprints=members.footprints,
            own_covariance=rule == "depth", out_geometry=pooled[begin:end], out_sh=sh[begin:end],
        )  # fmt: skip

    parallel_map(pool_groups, range(0, num_groups, ROWS_PER_TASK))
    covars = pooled[:, POOLED_COVAR][:, FULL_MATRIX].reshape(-1, 3, 3)
    extinctions = pooled[:, POOLED_EXTINCTION]
    if rule == "paper" and num_groups:
        scales, _ = principal_axes(covars)
        opacities = np.add.reduceat(members.opacities[ids].astype(np.float64), starts[:-1]) / np.diff(starts)
        extinctions = -log(1 - np.clip(opacities, 1e-4, MAX_OPACITY)) * scales[:, 1] * scales[:, 2]
    return Moments(
        pooled[:, POOLED_MEAN], covars=covars, weights=pooled[:, POOLED_WEIGHT], masses=pooled[:, POOLED_MASS],
        extinctions=extinctions, footprints=pooled[:, POOLED_FOOTPRINT], sh=sh,
    )  # fmt: skip


def principal_axes(covars: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return standard deviations ``[g,3]``, ascending, and unit quaternions ``[g,4]`` of covariances ``[g,3,3]``."""
    covars = np.ascontiguousarray(covars, dtype=np.float64)
    scales, quats = np.empty((len(covars), 3)), np.empty((len(covars), 4))

    def decompose_rows(start: int) -> None:
        rows = slice(start, start + ROWS_PER_TASK)
        decompose(covars[rows], scales[rows], quats[rows])  # fills `scales` and `quats`

    parallel_map(decompose_rows, range(0, len(covars), ROWS_PER_TASK))
    min_scale = 1e-12  # world units; replaces scales of 0, because opacities are divided by scales
    return np.maximum(scales, min_scale), quats


def to_gaussians(covars: np.ndarray, extinctions: np.ndarray, means: np.ndarray, sh: np.ndarray) -> Gaussians:
    """Convert the moments of g groups to Gaussians; ``sh [g,k,3]`` are harmonics of all degrees.

    Moments are ``covars [g,3,3]`` and ``means [g,3]``. The opacity follows from the optical depth ``extinctions [g]``,
    spread over the Gaussian's disc.
    """
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
