"""Scene with masks -> the scene without the Gaussians of masked pixels that other views contradict.

A mask hides something that is no part of the scene, such as a passer-by, and a model has made Gaussians of it. A mask
may also hide a background that the model shows rightly. Other views tell which: where their own pixels count, they see
through these Gaussians, or they see another colour at their place.
"""

from __future__ import annotations

from itertools import combinations

import cv2
import numpy as np

from gsmerge.arrays import mean_columns
from gsmerge.frozen import dataclass
from gsmerge.method.geometry.transforms import nearest_views, project, sh0_to_rgb
from gsmerge.method.geometry.views import take_rows
from gsmerge.method.kernels.elementary import log
from gsmerge.method.raster import TiledView
from gsmerge.method.raster.composite import composite
from gsmerge.method.raster.images import tile_views
from gsmerge.method.raster.photos import COVERED_TRANSMITTANCE, counting_pixels
from gsmerge.prepare.surfaces import SAME_LOG_DEPTH
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

LEAST_VIEWS = 3  # of two views, one cannot say which is right
SAMPLE = 4000  # pixels of a view that are compared, of those that are masked and of those that count
NEIGHBORS = 8  # nearest other views in which a pixel's Gaussian is looked up
THROUGH = 2 * SAME_LOG_DEPTH  # a view sees through a Gaussian if its own surface is farther by more (log of depths)
OTHER_COLOR = 0.15  # difference of the colours of two things (sRGB, mean over the channels)
# A part of a mask goes if others contradict more than LEAST_SHARE of the Gaussians that they see, and MORE times as
# many as of pixels that count. What passes by is contradicted at .62 to .99, sound surfaces at 0 to .43
LEAST_SHARE = 0.5
MORE = 2.0
LEAST_SEEN = 8  # fewest sampled Gaussians of a part that others see; of fewer, chance decides


@dataclass(frozen=True, eq=False)
class _Answers:
    """What other views say of the Gaussians of sampled pixels of a view."""

    pixels: np.ndarray  # [n] ids of the pixels in the view
    counts: np.ndarray  # [n] bool, the pixel counts
    seen: np.ndarray  # [n] bool, at least one other view sees the place of its Gaussian
    denied: np.ndarray  # [n] bool, more views see through it, or another colour there, than confirm it


def drop_masked(scene: Scene) -> tuple[Scene, np.ndarray | None, str]:
    """Drop the Gaussians of masked parts that other views contradict.

    Each Gaussian belongs to a view; of Gaussians that views share, nothing is dropped. Also returns the pixels
    ``[v,h,w]`` bool of these parts and of those that :func:`find_covered` finds, None if there are none, and a sentence
    about the Gaussians that were dropped.
    """
    if scene.masks is None or scene.masks.all() or not scene.has_own_pixels:
        return scene, None, ""
    foreign = find_denied(scene)
    goes = foreign.reshape(-1)[scene.get_pixels().homes]
    change = ""
    if goes.any():
        share = f"{100 * goes.mean():.1f} % of the Gaussians"
        change = f"{share} belong to masked pixels at which other views see something else: left out"
        scene = take_rows(scene, np.flatnonzero(~goes))
    covered = find_covered(scene)
    if covered is not None:
        foreign |= covered
    return scene, foreign if foreign.any() else None, change


def find_denied(scene: Scene) -> np.ndarray:
    """Find the pixels ``[v,h,w]`` bool of masked parts whose Gaussians other views contradict."""
    labels = np.zeros(counting_pixels(scene).shape, np.int32)  # of the part of a mask at each pixel, from 1; else 0
    if len(scene) < LEAST_VIEWS:
        return labels > 0
    answers = parallel_map(lambda view: _ask_others(scene, view), range(len(scene)))
    counts, seen, denied = (
        np.concatenate([getattr(answer, name) for answer in answers]) for name in ("counts", "seen", "denied")
    )
    most_denied = max(LEAST_SHARE, MORE * (denied & counts).sum() / max(1, (seen & counts).sum()))
    number = 1
    for view, mask in enumerate(counting_pixels(scene)):
        count, parts = cv2.connectedComponents((~mask).astype(np.uint8), connectivity=8)
        labels[view] = np.where(parts > 0, parts + number - 1, 0)
        number += count - 1
    sizes = np.bincount(labels.reshape(-1), minlength=number)
    label_of = np.concatenate([labels[view].reshape(-1)[a.pixels] for view, a in enumerate(answers)])
    tallies = np.stack([np.bincount(label_of[some], minlength=number) for some in (seen, denied)], 1)
    totals = tallies.copy()
    # parts with most of their pixels in common in several photos are one thing, such as the bonnet of a car
    for first, second in combinations(labels, 2):
        both = (first > 0) & (second > 0)
        pairs, common = np.unique(np.stack([first[both], second[both]]), axis=1, return_counts=True)
        one, other = pairs[:, 2 * common > sizes[pairs].sum(0) - common]
        np.add.at(totals, one, tallies[other])
        np.add.at(totals, other, tallies[one])
    goes = (totals[:, 0] >= LEAST_SEEN) & (totals[:, 1] > most_denied * totals[:, 0])
    goes[0] = False  # pixels that count
    return np.asarray(goes[labels])


def find_covered(scene: Scene) -> np.ndarray | None:
    """Find the pixels ``[v,h,w]`` bool of masked parts that have no Gaussians of their own, and that others cover.

    Their Gaussians were left out before, and other views show what lies behind. Parts that mostly show nothing are not
    among them, such as the background that was taken away from an object. None if there are none.
    """
    if scene.masks is None or not scene.has_own_pixels:
        return None
    hidden = ~scene.masks & ~scene.get_pixels().shown
    if not hidden.any():
        return None
    covered = np.zeros(hidden.shape, bool)

    def cover(view: int, tiled: TiledView) -> None:
        """Keep the parts of a view that Gaussians of other views mostly cover."""
        _, transmittance = composite(tiled)
        number, labels = cv2.connectedComponents(hidden[view].astype(np.uint8), connectivity=8)
        is_open = np.bincount(labels.reshape(-1), (transmittance > COVERED_TRANSMITTANCE).reshape(-1), number)
        is_covered = is_open < np.bincount(labels.reshape(-1), minlength=number) / 2
        is_covered[0] = False
        covered[view] = is_covered[labels]

    tile_views(scene.gaussians, scene.cameras, cover, np.flatnonzero(hidden.any((1, 2))).tolist())
    return covered if covered.any() else None


def _ask_others(scene: Scene, view: int) -> _Answers:
    """Look up sampled Gaussians of a view in the nearest other views, where the pixels of these count."""
    gaussians = scene.gaussians
    cameras = scene.cameras
    fronts = scene.get_pixels().fronts
    counts = counting_pixels(scene)
    has_row = fronts[view].reshape(-1) >= 0
    is_counted = counts[view].reshape(-1)
    rng = np.random.default_rng(view)
    kinds = [np.flatnonzero(has_row & (is_counted == kind)) for kind in (False, True)]
    pixels = np.concatenate([ids if len(ids) <= SAMPLE else rng.choice(ids, SAMPLE, replace=False) for ids in kinds])
    rows = fronts[view].reshape(-1)[pixels]
    colors = sh0_to_rgb(gaussians.sh0[rows, 0])
    num_denying = np.zeros(len(pixels), int)
    num_confirming = np.zeros(len(pixels), int)
    neighbors = nearest_views(cameras.centres, view)[:NEIGHBORS]
    places, depths = project(gaussians.means[rows], cameras[neighbors])
    for neighbor, place, depth in zip(neighbors, places, depths, strict=True):
        inside = (depth > 0) & (place > 0).all(1) & (place < [cameras.width, cameras.height]).all(1)
        x, y = np.where(inside[:, None], place, 0).astype(int).T
        front = fronts[neighbor, y, x]
        inside &= counts[neighbor, y, x] & (front >= 0)
        (front_depth,) = project(gaussians.means[np.maximum(front, 0)], cameras[[neighbor]])[1]
        inside &= front_depth > 0
        behind = np.where(inside, log(np.where(inside, front_depth / np.where(inside, depth, 1), 1)), 0)
        is_near = inside & (np.abs(behind) <= SAME_LOG_DEPTH)
        differs = mean_columns(np.abs(sh0_to_rgb(gaussians.sh0[np.maximum(front, 0), 0]) - colors)) > OTHER_COLOR
        num_denying += (inside & (behind > THROUGH)) | (is_near & differs)
        num_confirming += is_near & ~differs
    seen = num_denying + num_confirming > 0
    return _Answers(pixels, is_counted[pixels], seen, num_denying > num_confirming)
