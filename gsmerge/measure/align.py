"""Renders aligned with photos whose exposure or pose is not quite that of the scene, so that the rest is measured.

Colours: the affine map of colours that brings a render closest to its photo, as evaluations of photo collections use it
(Martin-Brualla et al. 2021). Poses: the camera is moved to where its render is closest, as methods without known poses
are scored (Lin et al. 2021), by Levenberg-Marquardt steps. Their slope is the rasterizer's own gradient; their
curvature comes from how the picture would move, given its depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from gsmerge.geometry import Schedule, descend, motion_matrices, pose_changes
from gsmerge.kernels.elementary import log1p
from gsmerge.kernels.matrices import matmul, solve, solve_symmetric
from gsmerge.measure.sizes import resize_mask
from gsmerge.raster import Splats, ViewPlan, composite, plan_view
from gsmerge.raster.composite import mean_depths
from gsmerge.raster.gradient import color_gradients, plan_gradients, pose_gradient
from gsmerge.raster.photos import photos_of
from gsmerge.types import Cameras

LEVELS = (4, 2, 1)  # what the sides of the photo are divided by, one after the other
MIN_SIDE = 32  # pixels of a photo's shorter side below which it says little about a pose
SCHEDULE = Schedule(steps=20, first=1e-3, ease=0.25, brake=5.0, most=1e4, min_gain=1e-5)  # at each of these sizes
MAX_STEP = 0.2  # radians and median depths
DOUBT = 3.0  # times the median residual at the given pose: beyond, a pixel is taken for something else than the pose
MIN_RESIDUAL = 0.01  # the least that this median is taken for, sRGB in [0, 1]
OPAQUE = 0.5  # alpha from which a rendered depth is that of a surface


@dataclass(frozen=True)
class PoseChange:
    """Distance and angle by which a camera was moved."""

    degrees: float  # that it turned
    shift: float  # of its centre, as a share of the median depth of what it sees


def fit_colors(image: np.ndarray, photo: np.ndarray, mask: NDArray[np.bool_]) -> np.ndarray:
    """Apply the affine colour map (3 x 4) that brings a render ``[h,w,3]`` closest to its photo.

    Least squares over the pixels ``[h,w]`` of the mask, clipped to [0, 1]; the render itself where there are none.
    """
    if not mask.any():
        return image
    colors = np.concatenate([image[mask], np.ones((int(mask.sum()), 1))], 1, dtype=np.float64)
    affine = solve_symmetric(matmul(colors.T, colors), matmul(colors.T, photo[mask].astype(np.float64)))
    return np.asarray((matmul(image, affine[:3]) + affine[3]).clip(0, 1), np.float32)


@dataclass(frozen=True, eq=False)
class _Target:
    """A photo at one size, and the settings that a pose is judged with there."""

    splats: Splats
    photo: np.ndarray  # [h,w,3]
    mask: NDArray[np.bool_]  # [h,w] pixels that count
    K: np.ndarray  # [3,3] intrinsics at this size
    eps2d: float  # low-pass, square pixels of this size
    near: float  # near plane, world units
    antialiased: bool  # whether small Gaussians keep their energy
    centre: np.ndarray  # [3] world point that the camera turns about

    def try_pose(self, viewmat: np.ndarray) -> _Trial:
        height, width = self.mask.shape
        plan = plan_view(
            self.splats, viewmat, self.K, width, height,
            eps2d=self.eps2d, antialiased=self.antialiased, near=self.near,
        )  # fmt: skip
        image, transmittance = composite(plan)
        residual = np.where(self.mask[..., None], image.clip(0, 1) - self.photo, np.float32(0))
        return _Trial(viewmat, plan, image, transmittance, residual, (residual**2).sum(2))

    def doubt(self, trial: _Trial) -> float:
        """Compute the squared residual from which on a pixel counts less."""
        median = float(np.sqrt(np.median(trial.squares[self.mask])))
        return (DOUBT * max(median, MIN_RESIDUAL)) ** 2


@dataclass(frozen=True, eq=False)
class _Trial:
    """A camera's picture and its residual."""

    viewmat: np.ndarray  # [4,4] world to camera, float64
    plan: ViewPlan
    image: np.ndarray  # [h,w,3], not clipped
    transmittance: np.ndarray  # [h,w]
    residual: np.ndarray  # [h,w,3] clipped image less photo, 0 outside the mask
    squares: np.ndarray  # [h,w] of it, summed over channels

    def error(self, doubt: float) -> float:
        """Sum a robust error (Cauchy's), which grows as the squares do up to ``doubt`` and slowly beyond."""
        return doubt * float(log1p(self.squares / doubt).sum(dtype=np.float64))

    def weights(self, doubt: float) -> np.ndarray:
        """Compute the derivatives ``[h,w]`` of that error with respect to the squares."""
        return np.asarray(1 / (1 + self.squares / doubt))

    def depth(self) -> np.ndarray:
        """Compute the mean depth ``[h,w]`` of the drawn Gaussians, world units; 0 where little is drawn."""
        return mean_depths(self.plan, 1 - self.transmittance, OPAQUE)


def refine_pose(
    splats: Splats,
    camera: Cameras,
    photo: np.ndarray,
    mask: NDArray[np.bool_],
    *,
    centre: np.ndarray,
    near: float,
    antialiased: bool = False,
) -> tuple[Cameras, PoseChange]:
    """Move a camera so that its render fits its photo best; it stays where the squared error does not fall.

    The photo ``[h,w,3]``, sRGB in [0, 1], is compared within ``mask [h,w]`` at a quarter, at half and at its full size.
    Pixels whose error is large count less, so that the camera is not moved to get a flaw of the scene out of the
    picture. It turns about ``centre [3]``, the scene's middle in the world. ``splats`` are those of
    :func:`gsmerge.raster.prepare`, ``near`` is in world units, ``antialiased`` that of :func:`gsmerge.render`.
    """
    start = camera.viewmats[0].astype(np.float64)
    viewmat, unit = start, 0.0
    ends: tuple[_Trial, _Trial] | None = None  # the given pose and the last, at the finest size
    for level in LEVELS:
        small = photos_of(photo[None], camera, level)
        seen = resize_mask(mask, small.width, small.height)
        if not seen.any() or (level > 1 and min(small.width, small.height) < MIN_SIDE):
            continue
        target = _Target(splats, small.images[0], seen, small.Ks[0], small.eps2d, near, antialiased, centre)
        first = target.try_pose(start)
        depth = first.depth()[seen]
        if not (depth > 0).any():
            continue
        unit = float(np.median(depth[depth > 0]))
        doubt = target.doubt(first)
        best = first if viewmat is start else min(first, target.try_pose(viewmat), key=lambda trial: trial.error(doubt))
        ends = first, _descend(target, best, unit, doubt)
        viewmat = ends[1].viewmat
    if ends and ends[1].squares.sum(dtype=np.float64) >= ends[0].squares.sum(dtype=np.float64):
        viewmat = start
    degrees, distances = pose_changes(start[None], viewmat[None])
    change = PoseChange(float(degrees[0]), float(distances[0]) / unit if unit else 0.0)
    return Cameras(viewmat[None], camera.Ks, camera.width, camera.height), change


def _descend(target: _Target, best: _Trial, unit: float, doubt: float) -> _Trial:
    """Take steps that each lower the error, and return the pose; lengths are in ``unit`` world units."""

    @lru_cache(maxsize=1)  # of a pose from which several steps are tried
    def equations(state: _Trial) -> tuple[np.ndarray, np.ndarray]:
        return _slope(target, state, unit, doubt), _curvature(target, state, unit, doubt)

    def step(state: _Trial, damping: float) -> _Trial | None:
        slope, curvature = equations(state)
        scale = damping * np.diag(curvature) + 1e-9 * curvature.trace() + 1e-30
        motion = -solve(curvature + np.diag(scale), slope)
        length = float(np.sqrt((motion * motion).sum()))
        if not np.isfinite(length):
            return None
        motion *= min(1.0, MAX_STEP / max(length, MAX_STEP))
        return target.try_pose(_moved(state.viewmat, motion, target, unit))

    return descend(best, lambda state: state.error(doubt), step, SCHEDULE)


def _slope(target: _Target, trial: _Trial, unit: float, doubt: float) -> np.ndarray:
    """Derive the error with respect to a turn about the centre (radians) and a shift (in ``unit``): ``[6]``."""
    inside = (trial.image > 0) & (trial.image < 1)  # clipped values stay as they are
    grad_image = np.where(inside, 2 * trial.residual * trial.weights(doubt)[..., None], np.float32(0))
    plan, drawn = trial.plan, {"image": trial.image, "transmittance": trial.transmittance}
    gradients = plan_gradients(plan, grad_image, **drawn, with_viewmat=True)
    shade = color_gradients(plan, gradients.colors) if plan.splats.shN.shape[1] else None
    grad = pose_gradient(plan, gradients, shade)
    rotation, shift = trial.viewmat[:3, :3], trial.viewmat[:3, 3]
    turns = matmul(grad[:3, :3], rotation.T) + np.outer(grad[:3, 3], shift - _in_camera(target.centre, trial.viewmat))
    turn = [turns[2, 1] - turns[1, 2], turns[0, 2] - turns[2, 0], turns[1, 0] - turns[0, 1]]
    return np.concatenate([turn, unit * grad[:3, 3]])


def _curvature(target: _Target, trial: _Trial, unit: float, doubt: float) -> np.ndarray:
    """Compute Gauss-Newton's second derivatives ``[6,6]``, of the picture moved as its depth says."""
    depth = trial.depth().astype(np.float64)
    y, x = np.nonzero(target.mask & (depth > 0))
    dy, dx = np.gradient(trial.image.clip(0, 1), axis=(0, 1))
    dx, dy, z = dx[y, x].astype(np.float64), dy[y, x].astype(np.float64), depth[y, x]
    fx, fy, cx, cy = target.K[0, 0], target.K[1, 1], target.K[0, 2], target.K[1, 2]
    rays = np.stack([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy], 1)
    a, b, c = (rays[:, 0] * z, rays[:, 1] * z, z) - _in_camera(target.centre, trial.viewmat)[:, None]
    zero, units = np.zeros_like(z), np.full_like(z, unit)
    forward = np.stack([b, -a, zero, zero, zero, units], 1)  # how z changes with the six numbers
    right = np.stack([zero, c, -b, units, zero, zero], 1) - rays[:, :1] * forward
    down = np.stack([-c, zero, a, zero, units, zero], 1) - rays[:, 1:] * forward
    right, down = right * (fx / z)[:, None], down * (fy / z)[:, None]  # pixels
    weights = 2 * trial.weights(doubt)[y, x].astype(np.float64)[:, None]
    xx, xy, yy = (weights * (first * second).sum(1)[:, None] for first, second in ((dx, dx), (dx, dy), (dy, dy)))
    return matmul(right.T, xx * right + xy * down) + matmul(down.T, xy * right + yy * down)


def _in_camera(point: np.ndarray, viewmat: np.ndarray) -> np.ndarray:
    return np.asarray(matmul(viewmat[:3, :3], point) + viewmat[:3, 3])


def _moved(viewmat: np.ndarray, step: np.ndarray, target: _Target, unit: float) -> np.ndarray:
    """Turn a view matrix about the centre by ``step[:3]`` radians, and shift it by ``step[3:]`` in ``unit``."""
    turn, centre = motion_matrices(step[None])[0, :3, :3], _in_camera(target.centre, viewmat)
    moved = np.eye(4)
    moved[:3, :3] = matmul(turn, viewmat[:3, :3])
    moved[:3, 3] = matmul(turn, viewmat[:3, 3] - centre) + centre + unit * step[3:]
    return moved
