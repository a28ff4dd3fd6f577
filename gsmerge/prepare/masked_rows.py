"""Scene with masks -> the scene without the Gaussians of masked pixels that other views contradict.

A mask hides something that is no part of the scene, such as a passer-by, and a model has made Gaussians of it. A mask
may also hide a background that the model shows rightly. Other views tell which: where their own pixels count, they see
through these Gaussians, or they see another colour at their place.
"""

from __future__ import annotations

import cv2
import numpy as np

from gsmerge.frozen import dataclass
from gsmerge.method.geometry.transforms import nearest_views, project, sh0_to_rgb
from gsmerge.method.geometry.views import take_rows
from gsmerge.method.kernels.elementary import log
from gsmerge.method.raster import TiledView
from gsmerge.method.raster.composite import composite
from gsmerge.method.raster.images import tile_views
from gsmerge.method.raster.photos import COVERED_TRANSMITTANCE, counting_pixels
from gsmerge.prepare.confirm_depths import SAME_LOG_DEPTH
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
    ``[v,h,w]`` bool of these parts, None if there are none, and a sentence about them.
    """
    if scene.masks is None or scene.masks.all() or not scene.has_own_pixels or len(scene) < LEAST_VIEWS:
        return scene, None, ""
    answers = parallel_map(lambda view: _ask_others(scene, view), range(len(scene)))
    num_seen = sum(int((a.seen & a.counts).sum()) for a in answers)
    num_denied = sum(int((a.denied & a.counts).sum()) for a in answers)
    most_denied = max(LEAST_SHARE, MORE * num_denied / max(1, num_seen))
    parts = list[tuple[int, np.ndarray]]()  # the view of a part of a mask, and its pixels
    tallies = list[np.ndarray]()  # of each part, how many sampled Gaussians others see, and how many of these they deny
    for view, answer in enumerate(answers):
        number, labels = cv2.connectedComponents((~scene.masks[view]).astype(np.uint8), connectivity=8)
        label_of = labels.reshape(-1)[answer.pixels]
        for label in range(1, number):
            seen = answer.seen & (label_of == label)
            parts.append((view, labels == label))
            tallies.append(np.array([seen.sum(), (seen & answer.denied).sum()]))
    foreign = np.zeros(scene.masks.shape, bool)
    for view, part in parts:
        # a part at the same pixels of several photos is one thing, such as the bonnet of a car
        same = [tally for (_, other), tally in zip(parts, tallies, strict=True) if _share_pixels(part, other)]
        seen_count, denied_count = np.sum(same, 0)
        if seen_count >= LEAST_SEEN and denied_count > most_denied * seen_count:
            foreign[view] |= part
    if not foreign.any():
        return scene, None, ""
    goes = foreign.reshape(-1)[scene.get_pixels().homes]
    share = f"{100 * goes.mean():.1f} % of the Gaussians"
    change = f"{share} belong to masked pixels at which other views see something else: left out"
    return take_rows(scene, np.flatnonzero(~goes)), foreign, change


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

    tile_views(scene, cover, np.flatnonzero(hidden.any((1, 2))).tolist())
    return covered if covered.any() else None


def _share_pixels(first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether two parts ``[h,w]`` of masks have most of their pixels in common."""
    return bool(2 * np.count_nonzero(first & second) > np.count_nonzero(first | second))


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
        differs = np.abs(sh0_to_rgb(gaussians.sh0[np.maximum(front, 0), 0]) - colors).mean(-1) > OTHER_COLOR
        num_denying += (inside & (behind > THROUGH)) | (is_near & differs)
        num_confirming += is_near & ~differs
    seen = num_denying + num_confirming > 0
    return _Answers(pixels, is_counted[pixels], seen, num_denying > num_confirming)
