"""Decoded -> decoded: what an earlier result shows right is taken over, the rest is as it was decoded.

For moments of one place: what stands still keeps its Gaussians, and so does not flicker.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from gsmerge.kernels.pictures import convolve
from gsmerge.raster import plan_view, prepare, render
from gsmerge.raster.composite import splat_adjoint
from gsmerge.raster.photos import NEAR
from gsmerge.runtime.record import choose, note, stage
from gsmerge.types import Cameras, Decoded, Gaussians, Scene

AROUND = 5  # pixels, side of the square over which errors are averaged, and by which what has changed is widened
# an error, 0 to 1, that means a change: times the photo's median error, but at least and at most
TYPICAL, LEAST, MOST = 3.0, 0.04, 0.12
MOSTLY = 0.5  # share of a Gaussian's blending weights in changed pixels from which on it is one of what has changed
MOST_TIMES = 8  # times as many Gaussians as are decoded: those that are left of more start worse than the scene's own
LOST = 0.5  # share of changed pixels from which on an earlier result is of no use


@stage("earlier")
def take_over(earlier: Gaussians, decoded: Decoded, scene: Scene, views: Sequence[int]) -> Decoded | None:
    """Replace decoded Gaussians by those of an earlier result wherever it shows the photos of ``views`` as they are.

    ``earlier``: in the frame of the scene. Of both together as many stay as were decoded for: what has changed, and of
    the rest those with the largest weights. None, with a note, where the earlier result shows most pixels wrong, or has
    too many Gaussians.
    """
    if len(earlier) > MOST_TIMES * decoded.count:
        note(f"the earlier result has {len(earlier):,} Gaussians for {decoded.count:,}: nothing is taken over")
        return None
    earlier = _with_harmonics(earlier, decoded.gaussians.shN.shape[1])
    changed = find_changes(earlier, scene, views)
    share, cameras = float(changed.mean()), scene.cameras[list(views)]
    if share > LOST:
        note(f"the earlier result shows {share:.0%} of the pixels otherwise than the photos: nothing is taken over")
        return None
    old, old_changed = sum_weights(earlier, cameras, changed)
    new, new_changed = sum_weights(decoded.gaussians, cameras, changed)
    added = _largest((new_changed > MOSTLY * new) & (new > 0), new, decoded.count)  # else holes where things moved
    kept = _largest(old_changed <= MOSTLY * old, old, decoded.count - len(added))
    choose(taken_over={"kept": len(kept), "new": len(added), "changed": round(share, 4)})
    return replace(decoded, gaussians=Gaussians.concat([earlier[kept], decoded.gaussians[added]]), baseline_start=None)


def find_changes(gaussians: Gaussians, scene: Scene, views: Sequence[int]) -> np.ndarray:
    """Return a mask ``[v,h,w]`` of pixels around which Gaussians show something else than the photos of ``views``."""
    assert scene.images is not None
    changed, taps = np.empty((len(views), *scene.images.shape[1:3]), np.bool_), np.full(AROUND, 1 / AROUND)
    for i, view in enumerate(views):
        drawn = render(gaussians, scene.cameras[[view]], near=NEAR).images[0]
        error = np.abs(drawn - scene.images[view]).mean(2)
        if scene.masks is not None:
            error[~scene.masks[view]] = 0
        error = convolve(error, taps, taps)
        large = error > np.clip(TYPICAL * float(np.median(error)), LEAST, MOST)
        changed[i] = cv2.dilate(large.astype(np.uint8), np.ones((AROUND, AROUND), np.uint8)) > 0
    return changed


def sum_weights(gaussians: Gaussians, cameras: Cameras, changed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum each Gaussian's blending weights over all pixels, and over those that have ``changed [v,h,w]``: ``[n]``."""
    splats, sums = prepare(gaussians), np.zeros((len(gaussians), 2))
    for viewmat, K, mask in zip(cameras.viewmats, cameras.Ks, changed, strict=True):
        plan = plan_view(splats, viewmat, K, cameras.width, cameras.height, near=NEAR)
        sums += splat_adjoint(plan, np.stack([np.ones(mask.shape), mask], 2))
    return sums[:, 0], sums[:, 1]


def measure_flicker(earlier: Gaussians, later: Gaussians, scene: Scene, views: Sequence[int]) -> float | None:
    """Measure the root mean square of the difference, 0 to 1, of two results' renders where ``earlier`` still holds.

    None where it does nowhere.
    """
    still, squares = ~find_changes(earlier, scene, views), 0.0
    for mask, view in zip(still, views, strict=True):
        before, after = (render(g, scene.cameras[[view]], near=NEAR).images[0][mask] for g in (earlier, later))
        squares += float(np.square(after - before, dtype=np.float64).sum())
    return float(np.sqrt(squares / (3 * still.sum()))) if still.any() else None


def _largest(chosen: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Return the indices of chosen Gaussians, at most ``count``, those of the largest weights, in their order."""
    rows = np.flatnonzero(chosen)
    order = np.argsort(-weights[rows], kind="stable")[: max(0, count)]
    return np.sort(rows[order])


def _with_harmonics(gaussians: Gaussians, count: int) -> Gaussians:
    """Return Gaussians with ``count`` harmonics above degree 0: further ones are left out, missing ones are 0."""
    shN = gaussians.shN[:, :count]
    return replace(gaussians, shN=np.pad(shN, ((0, 0), (0, count - shN.shape[1]), (0, 0))))
