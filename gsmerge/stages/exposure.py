"""Aligned scene -> the same in one exposure, where its photos and their Gaussians differ in it at random.

Cameras that choose exposure and white balance for each photo, and models that copy them into their
Gaussians, show one surface in several tones. Pixels of a view are looked up in the others, where
these have Gaussians at the same depth; the median ratio of each channel is the pair's, and the
gains of the views follow from all pairs by least squares, with a geometric mean of one.

Exposure that drifts along a video stays: new views lie between photos of nearly the same exposure,
and a mean of all would be farther from them (in a video of a kitchen by 3.6 dB). So gains are taken
out where neighbours differ, and either all pairs agree on them or they are large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from gsmerge.geometry import camera_depths, project, rgb_to_sh0, sh0_to_rgb
from gsmerge.kernels.elementary import exp, log
from gsmerge.kernels.matrices import solve_symmetric
from gsmerge.render.photos import NEAR
from gsmerge.runtime.record import choose, note
from gsmerge.runtime.threads import parallel_map
from gsmerge.stages.mend_photos import CLIPPED, PhotoChange, change_large
from gsmerge.types import Scene

Exposure = Literal["auto", "fixed", "per-photo"]
SAMPLES = 2000  # pixels of a view that are looked up in the others
SAME_DEPTH = 0.05  # logarithm of depths that are of one surface
LOW, HIGH = 0.05, 0.95  # colours in between are neither noise nor clipped
MIN_PAIRS = 60  # pixels that two views must share
# Logarithmic gains between nearest neighbours, root mean square; what pairs disagree by, as a share; and the step
# above which gains are taken out all the same. 15 captures have steps up to 0.176 with shares from 0.07 on; random
# gains of 0.8 to 1.25 have steps of 0.1 to 0.25 with shares below 0.04, or up to 0.25 with five views far apart.
DIFFERENT, CONSISTENT, LARGE = 0.08, 0.05, 0.19
BRIGHT = 1.15  # gain from which on clipped pixels no longer count


@dataclass(frozen=True)
class _Pair:
    """Ratio of the colours of one view's pixels in another."""

    view: int
    other: int
    ratios: np.ndarray  # [3] logarithm
    count: int


def equalise_exposure(scene: Scene, views: Sequence[int], exposure: Exposure) -> Scene:
    """Divide the photos, and the Gaussians of their pixels, by the gains of their views, if that is called for.

    ``views`` are those whose photos show the scene. Clipped pixels of brighter photos no longer count.
    The record gets a note and the choice ``exposure``: the gain of each view, red, green and blue.
    """
    if exposure == "fixed" or not scene.aligned or scene.images is None or len(views) < 2:
        return scene
    pairs = _measure_pairs(scene, views)
    gains = _solve_gains(pairs, len(scene))
    if gains is None or not (exposure == "per-photo" or _is_random(pairs, gains)):
        return scene
    factors = np.round(exp(gains), 3)
    low, high = factors.min(), factors.max()
    if low == high:
        return scene
    choose(exposure=factors.tolist())
    note(f"the photos differ in exposure by factors of {low:.2f} to {high:.2f}: brought to their mean")
    return _divide(scene, factors)


def _measure_pairs(scene: Scene, views: Sequence[int]) -> list[_Pair]:
    """Measure the ratios of colours between views that see the same surfaces."""
    assert scene.images is not None
    height, width, size = scene.cameras.height, scene.cameras.width, scene.pixels_per_view
    means = scene.gaussians.means.reshape(len(scene), size, 3)
    photos, valid = scene.images.reshape(len(scene), size, 3), scene.valid.reshape(len(scene), size)
    if scene.masks is not None:
        valid = valid & scene.masks.reshape(len(scene), size)
    some = np.random.default_rng(0).permutation(size)[:SAMPLES]

    def measure(view: int) -> list[_Pair]:
        rows = some[valid[view, some]]
        pixels, z = project(means[view, rows], scene.cameras)
        pairs = []
        for other in (other for other in views if other != view):
            x, y = np.floor(np.nan_to_num(pixels[other], nan=-1.0).clip(-1, max(width, height))).astype(np.int64).T
            inside = (z[other] > NEAR) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
            places = np.where(inside, y * width + x, 0)
            both = np.flatnonzero(inside & valid[other, places])
            depths = camera_depths(means[other, places[both]], scene.cameras.viewmats[other])
            same = np.abs(log(np.maximum(z[other, both], NEAR) / np.maximum(depths, NEAR))) < SAME_DEPTH
            both = both[same]
            here, there = photos[view, rows[both]], photos[other, places[both]]
            clear = ((here > LOW) & (here < HIGH) & (there > LOW) & (there < HIGH)).all(1)
            if clear.sum() >= MIN_PAIRS:
                ratios = np.median(log(there[clear].astype(np.float64) / here[clear]), 0)
                pairs.append(_Pair(view, other, ratios, int(clear.sum())))
        return pairs

    return [pair for pairs in parallel_map(measure, views) for pair in pairs]


def _solve_gains(pairs: Sequence[_Pair], num_views: int) -> np.ndarray | None:
    """Solve for the logarithmic gains ``[v,3]`` of all views, with mean zero; None without pairs."""
    if not pairs:
        return None
    matrix, right = np.full((num_views, num_views), 1.0 / num_views), np.zeros((num_views, 3))
    for pair in pairs:
        ends, weight = [pair.view, pair.other], np.sqrt(min(pair.count, 1000))
        matrix[np.ix_(ends, ends)] += weight * np.array([[1, -1], [-1, 1]])
        right[ends] += weight * np.array([-pair.ratios, pair.ratios])
    matrix[np.diag_indices(num_views)] += 1e-6  # of views without pairs
    gains: np.ndarray = solve_symmetric(matrix, right)
    return gains


def _is_random(pairs: Sequence[_Pair], gains: np.ndarray) -> bool:
    """Return whether gains differ between neighbours, and are what all pairs agree on, or large."""
    nearest = dict[int, _Pair]()
    for pair in pairs:
        if pair.view not in nearest or pair.count > nearest[pair.view].count:
            nearest[pair.view] = pair
    steps = np.array([gains[pair.other] - gains[pair.view] for pair in nearest.values()])
    left = [np.abs(pair.ratios - gains[pair.other] + gains[pair.view]).mean() for pair in pairs]
    step = float(np.sqrt((steps * steps).mean()))
    return step > LARGE or (step > DIFFERENT and float(np.median(left)) < CONSISTENT * step)


def _divide(scene: Scene, gains: np.ndarray) -> Scene:
    """Divide photos and colours of Gaussians by the gains ``[v,3]``; clipped pixels leave the masks."""
    assert scene.images is not None
    factors = (1 / gains).astype(np.float32)
    levels = np.arange(256, dtype=np.float32) / np.float32(255)
    changes = [PhotoChange(tones=(factor[:, None] * levels).clip(0, 1)) for factor in factors]
    images, masks = np.empty_like(scene.images), np.full(scene.images.shape[:3], True)
    if scene.masks is not None:
        masks[:] = scene.masks

    def divide(view: int) -> None:
        images[view] = (scene.images[view] * factors[view]).clip(0, 1)  # type: ignore[index]
        masks[view] &= ~((scene.images[view] >= CLIPPED) & (gains[view] > BRIGHT)).any(-1)  # type: ignore[index]

    parallel_map(divide, range(len(scene)))
    g, each = scene.gaussians, factors.repeat(scene.pixels_per_view, 0)[:, None]
    gaussians = replace(g, sh0=rgb_to_sh0(sh0_to_rgb(g.sh0) * each).astype(np.float32), shN=g.shN * each)
    large = scene.large_photos
    large = None if large is None else change_large(large, changes, {})
    counting = scene.masks if masks.all() else masks
    return replace(scene, images=images, gaussians=gaussians, masks=counting, large_photos=large)
