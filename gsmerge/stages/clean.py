"""Fitted Gaussians -> wanted Gaussians: cropped to a box or a sphere, without floaters, sky or what no view shows."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gsmerge.facts.crop import inside_crop
from gsmerge.facts.place_cameras import place_viewpoints
from gsmerge.facts.support import count_views
from gsmerge.kernels.gaussians.cross_view import make_tree, nearest_of_others
from gsmerge.raster.photos import LEAST_OPACITY
from gsmerge.runtime.threads import parallel_map, use_threads
from gsmerge.settings.stages import CleanOptions
from gsmerge.stages.sky import sky
from gsmerge.types import Cameras, Gaussians

BOX_QUANTILES = (1, 99)  # % of the positions along each axis: the scene's box
OUTLIER_BOX = 10.0  # times that box: what lies beyond is far from the scene
NEIGHBORS = 8  # nearest Gaussians, of which a floater touches none
ROWS = 1 << 14  # Gaussians per task
TOUCH = 3.0  # Gaussians touch within so many of their largest scales together
APART = 3.0  # times the median distance of nearest Gaussians: a floater's own is larger
# Second and largest scale, as shares of half the diagonal of the scene's box, from which on a Gaussian hangs across the
# scene if it is also so many times as large as the median one. Exports, and results without a fit, have none
CURTAIN, WIDER = (0.1, 0.33), 8.0
MAX_SAMPLE_GAUSSIANS = 200_000  # Gaussians that a share is estimated from

ToWorld = Callable[[Gaussians], Gaussians]
Counts = dict[str, int]


def beyond_scene(means: np.ndarray, samples: np.ndarray | None = None) -> np.ndarray:
    """Return a mask ``[n]`` of centres ``[n,3]`` outside ten times the box of the scene.

    The box contains 1 % to 99 % of the ``samples``, or of the centres themselves, along each axis.
    """
    low, high = np.percentile(means if samples is None else samples, BOX_QUANTILES, axis=0)
    half = np.maximum((high - low) / 2, 1e-3 * max(float(np.sqrt(((high - low) ** 2).sum())), 1e-30))
    return np.asarray((np.abs(means - (low + high) / 2) > OUTLIER_BOX * half).any(1))


def floaters(gaussians: Gaussians, rows: np.ndarray | None = None) -> np.ndarray:
    """Return a mask ``[n]`` of finite Gaussians that are isolated, far beyond the scene, or hang across it.

    A Gaussian is isolated if none of its eight nearest neighbours is within three times the largest scales of both, and
    the nearest is more than three times as far away as for the median Gaussian. For the others see :func:`beyond_scene`
    and :func:`curtains`. ``rows [m]``: test only these.
    """
    rows = np.arange(len(gaussians)) if rows is None else rows
    means, sizes = gaussians.means.astype(np.float64), gaussians.scales.max(1).astype(np.float64)
    if len(means) <= NEIGHBORS:
        return np.zeros(len(rows), bool)
    untested = np.ones(len(means), bool)
    untested[rows] = False
    order = np.concatenate([rows, np.flatnonzero(untested)])
    points, sizes, ids = means[order], sizes[order], np.empty((len(means), NEIGHBORS), np.int64)
    tree, axes, splits = make_tree(points)
    nobody = np.full(len(means), -1)  # every point is of another view than all others
    touched, nearest = np.empty(len(rows), bool), np.empty(len(rows))

    def measure(first: int) -> None:
        span = slice(first, min(first + ROWS, len(rows)))
        nearest_of_others(points, nobody, tree, axes, splits, span.start, span.stop, len(means), ids)
        distances = np.sqrt(((points[ids[span]] - points[span, None]) ** 2).sum(2))
        touched[span] = (distances <= TOUCH * (sizes[span, None] + sizes[ids[span]])).any(1)
        nearest[span] = distances[:, 0]

    with use_threads():
        parallel_map(measure, range(0, len(rows), ROWS))
    isolated = ~touched & (nearest > APART * np.median(nearest))
    return np.asarray(isolated) | beyond_scene(means[rows], means) | curtains(gaussians, rows)


def curtains(gaussians: Gaussians, rows: np.ndarray) -> np.ndarray:
    """Return a mask ``[m]`` of the Gaussians ``rows [m]`` that hang across the scene: huge, unlike their neighbours."""
    low, high = np.percentile(gaussians.means.astype(np.float64), BOX_QUANTILES, axis=0)
    radius = np.sqrt(((high - low) ** 2).sum()) / 2
    scales = np.sort(gaussians.scales, axis=1)[:, 1:]
    wide = (scales[rows] > radius * np.array(CURTAIN)) & (scales[rows] > WIDER * np.median(scales, axis=0))
    return np.asarray(wide.any(1))


def floater_share(gaussians: Gaussians) -> float:
    """Estimate the share of finite Gaussians that are :func:`floaters`; 0 without any."""
    rows = np.arange(0, len(gaussians), max(1, -(-len(gaussians) // MAX_SAMPLE_GAUSSIANS)))
    return float(floaters(gaussians, rows).mean()) if len(rows) else 0.0


def clean(
    gaussians: Gaussians, options: CleanOptions, cameras: Cameras | None, photos: np.ndarray | None, to_world: ToWorld
) -> tuple[np.ndarray, Counts]:
    """Choose wanted Gaussians; return their rows, and the numbers of others: ``cropped``, and one for each of ``drop``.

    Gaussians and ``cameras`` are canonical; ``to_world`` maps to the frame of the crop. The sky is found in the
    ``photos [v,h,w,3]``; without cameras, what no placed camera shows is unseen.
    """
    rows, counts = np.arange(len(gaussians)), Counts()

    def remove(name: str, unwanted: np.ndarray) -> Gaussians:
        nonlocal rows
        rows, counts[name] = rows[~unwanted], int(unwanted.sum())
        return gaussians[rows]

    left = gaussians
    if "unseen" in options.drops:  # before others go that hide it
        placed = place_viewpoints(left) if cameras is None and len(left) else cameras
        left = remove("unseen", np.ones(0, bool) if placed is None else count_views(left, placed) == 0)
    if options.crop is not None:
        left = remove("cropped", ~inside_crop(to_world(left).means, options.crop))
    if "transparent" in options.drops:
        left = remove("transparent", left.opacities < LEAST_OPACITY)
    if "sky" in options.drops:
        assert cameras is not None, "sky is dropped where there are photos"
        assert photos is not None, "sky is dropped where there are photos"
        left = remove("sky", sky(left, cameras, photos))
    if "floaters" in options.drops:
        remove("floaters", floaters(left))
    return rows, counts


def describe_counts(counts: Counts, *, placed: bool) -> str:
    """Say how many Gaussians :func:`clean` removed for each reason; ``placed``: no camera of the scene is known."""
    words = {
        "cropped": "outside of the crop",
        "sky": "sky",
        "floaters": "floaters",
        "transparent": "transparent",
        "unseen": f"that no {'placed camera' if placed else 'view'} shows",
        "surplus": "more than the budget",
    }
    return ", ".join(f"{number:,} {words[name]}" for name, number in counts.items())


def faintest_dropped(gaussians: Gaussians, count: int) -> Gaussians:
    """Keep the ``count`` Gaussians with the largest opacity times area (of the two largest axes), in their order."""
    area = np.sort(gaussians.scales, axis=1)[:, 1:].prod(1)
    return gaussians[np.sort(np.argsort(-gaussians.opacities * area, kind="stable")[:count])]
