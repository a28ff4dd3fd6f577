"""Fitted Gaussians -> wanted Gaussians: leave out what is outside a crop, floaters, sky, and unseen Gaussians."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gsmerge.method.geometry.regions import inside_crop
from gsmerge.method.geometry.transforms import find_nearest
from gsmerge.method.raster.photos import LEAST_OPACITY
from gsmerge.method.stages.sky import sky
from gsmerge.method.viewpoints.place_cameras import place_viewpoints
from gsmerge.method.viewpoints.support import count_views
from gsmerge.settings.stages import CleanOptions
from gsmerge.types import Cameras, Gaussians

BOX_QUANTILES = (1, 99)  # the scene's box reaches from the first to the second percentile of positions on each axis
FLOATER_NEIGHBORS = 8  # an isolated Gaussian touches none of its FLOATER_NEIGHBORS nearest Gaussians
# A fit may leave Gaussians that hang across the scene like curtains. The second largest scale of such a curtain exceeds
# the share CURTAIN[0] of half the diagonal of the scene's box, or its largest scale exceeds the share CURTAIN[1] of
# half the diagonal. The same scale, second largest or largest, also exceeds CURTAIN_FACTOR times its median over all
# Gaussians
CURTAIN = (0.1, 0.33)
CURTAIN_FACTOR = 8.0
FLOATER_GAUSSIANS = 200_000  # the share of floaters is estimated from at most about this many Gaussians

ToWorld = Callable[[Gaussians], Gaussians]
Counts = dict[str, int]


def beyond_scene(means: np.ndarray, samples: np.ndarray | None = None) -> np.ndarray:
    """Return a mask ``[n]`` of the centres ``means [n,3]`` outside of a box ten times as large as the scene's box.

    The scene's box reaches along each axis from the 1st to the 99th percentile of ``samples [m,3]``, or of the centres
    if there are no samples.
    """
    low, high = np.percentile(means if samples is None else samples, BOX_QUANTILES, axis=0)
    half_sides = np.maximum((high - low) / 2, 1e-3 * max(float(np.sqrt(((high - low) ** 2).sum())), 1e-30))
    outlier_box = 10.0  # side of the larger box, in sides of the scene's box
    return np.asarray((np.abs(means - (low + high) / 2) > outlier_box * half_sides).any(1))


def floaters(gaussians: Gaussians, rows: np.ndarray | None = None) -> np.ndarray:
    """Return a mask ``[n]`` of finite Gaussians that are isolated, far beyond the scene, or hang across it.

    A Gaussian is isolated if it touches none of its eight nearest neighbours, and if the nearest of them is more than
    three times as far away as the median. Two Gaussians touch if their distance is at most three times the sum of their
    largest scales. :func:`beyond_scene` finds Gaussians far beyond the scene, and :func:`curtains` finds Gaussians that
    hang across it. If ``rows [m]`` are given, only these Gaussians are tested, and the mask is ``[m]``.
    """
    rows = np.arange(len(gaussians)) if rows is None else rows
    means = gaussians.means.astype(np.float64)
    sizes = _sorted_scales(gaussians)[1].astype(np.float64)
    if len(means) <= FLOATER_NEIGHBORS:
        return np.zeros(len(rows), bool)
    nearest, touches = _nearest_distances(means, sizes, rows, 1)
    apart_factor = 3.0  # the nearest Gaussian of a floater is farther away than this many times the median distance
    isolated = ~touches & (nearest > apart_factor * np.median(nearest))
    candidates = np.flatnonzero(isolated)  # few, because most Gaussians touch their nearest neighbour
    if len(candidates):
        isolated[candidates] = ~_nearest_distances(means, sizes, rows[candidates], FLOATER_NEIGHBORS)[1]
    return isolated | beyond_scene(means[rows], means) | curtains(gaussians, rows)


def _nearest_distances(
    means: np.ndarray, sizes: np.ndarray, rows: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance ``[m]`` of each of the Gaussians ``rows [m]`` from its nearest neighbour, and a mask ``[m]``.

    The mask is true for Gaussians that touch one of their ``count`` nearest neighbours. ``means [n,3]`` and the largest
    scales ``sizes [n]`` describe all Gaussians.
    """
    ids, distances = find_nearest(means, count, rows)
    touch_factor = 3.0  # Gaussians touch if their distance is at most this many times the sum of their largest scales
    return distances[:, 0], (distances <= touch_factor * (sizes[rows, None] + sizes[ids])).any(1)


def _sorted_scales(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Return the second largest and the largest scale ``[n]`` of each Gaussian."""
    x, y, z = gaussians.scales.T  # NumPy takes a tenth of the time if it works column by column
    larger = np.maximum(x, y)
    return np.maximum(np.minimum(x, y), np.minimum(larger, z)), np.maximum(larger, z)


def curtains(gaussians: Gaussians, rows: np.ndarray) -> np.ndarray:
    """Return a mask ``[m]`` of the Gaussians among ``rows [m]`` that hang across the scene like curtains.

    The second largest or the largest scale of a curtain is too large for the scene, see ``CURTAIN``.
    """
    low, high = np.percentile(gaussians.means.astype(np.float64), BOX_QUANTILES, axis=0)
    radius = np.sqrt(((high - low) ** 2).sum()) / 2
    is_wide, is_long = (
        (scales[rows] > radius * share) & (scales[rows] > CURTAIN_FACTOR * np.median(scales))
        for scales, share in zip(_sorted_scales(gaussians), CURTAIN, strict=True)
    )
    return np.asarray(is_wide | is_long)


def floater_share(gaussians: Gaussians) -> float:
    """Estimate the share of finite Gaussians that are :func:`floaters` from a sample, or return 0 without Gaussians."""
    rows = np.arange(0, len(gaussians), max(1, -(-len(gaussians) // FLOATER_GAUSSIANS)))
    return float(floaters(gaussians, rows).mean()) if len(rows) else 0.0


def clean(
    gaussians: Gaussians, options: CleanOptions, cameras: Cameras | None, photos: np.ndarray | None, to_world: ToWorld
) -> tuple[np.ndarray, Counts]:
    """Return the rows of the Gaussians to keep, and the number of dropped Gaussians for each reason.

    The reasons are ``cropped`` and the names in ``options.drops``. Gaussians and ``cameras`` are canonical. The crop is
    in the world's frame, to which ``to_world`` maps Gaussians. The sky is found in the ``photos [v,h,w,3]``. A Gaussian
    is unseen if no camera shows it. If there are no cameras, some are placed.
    """
    rows, counts = np.arange(len(gaussians)), Counts()

    def remove(name: str, unwanted: np.ndarray) -> Gaussians:
        """Drop the Gaussians in the mask ``unwanted``, count them under ``name``, and return the remaining ones."""
        nonlocal rows
        rows, counts[name] = rows[~unwanted], int(unwanted.sum())
        return gaussians[rows]

    remaining = gaussians
    if "unseen" in options.drops:  # first, because Gaussians that are dropped later may hide others now
        placed = place_viewpoints(remaining) if cameras is None and len(remaining) else cameras
        remaining = remove("unseen", np.ones(0, bool) if placed is None else count_views(remaining, placed) == 0)
    if options.crop is not None:
        remaining = remove("cropped", ~inside_crop(to_world(remaining).means, options.crop))
    if "transparent" in options.drops:
        remaining = remove("transparent", remaining.opacities < LEAST_OPACITY)
    if "sky" in options.drops:
        assert cameras is not None, "dropping the sky requires photos"
        assert photos is not None, "dropping the sky requires photos"
        remaining = remove("sky", sky(remaining, cameras, photos))
    if "floaters" in options.drops:
        remove("floaters", floaters(remaining))
    return rows, counts


def describe_counts(counts: Counts, *, placed: bool) -> str:
    """Describe how many Gaussians were dropped for each reason, which is ``surplus`` or a reason of :func:`clean`.

    ``placed`` is true if cameras were placed, because the scene has none.
    """
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
    """Return, in their order, the ``count`` Gaussians whose opacity times their two largest scales is largest."""
    area = np.sort(gaussians.scales, axis=1)[:, 1:].prod(1)
    return gaussians[np.sort(np.argsort(-gaussians.opacities * area, kind="stable")[:count])]
