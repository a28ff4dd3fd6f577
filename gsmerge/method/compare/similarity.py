"""Score how similar photos and pictures of views are, in units of the noise of wrong pairs.

A photo and a view are a wrong pair if the photo does not show the view. The similarity of a photo and a picture is the
correlation of their local contrast at two sizes. Exposure, white balance and soft colours hardly change this
correlation. Correlations are converted to Fisher's z, whose noise does not depend on its value. Nearly all pairs of
photos and views are wrong, so the median absolute deviation of all z is the noise of wrong pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from gsmerge.frozen import dataclass
from gsmerge.method.compare.view_pictures import ViewPictures, fit_size
from gsmerge.method.geometry.transforms import NORMAL_SPREAD, median
from gsmerge.method.kernels.elementary import log
from gsmerge.method.kernels.matrices import matmul
from gsmerge.method.kernels.pictures import ORIENTATIONS, blur, turn_back
from gsmerge.method.raster.photos import LEAST_OPACITY, shrink_pictures

SCORE_PIXELS = (24, 64)  # pixels of the longer side at which pictures are compared
PICTURE_SPREADS = 6  # side of a picture, in standard deviations of the blur that gives the local mean
CUT_OFF_SPREADS = 2  # standard deviations at which the blur of the local mean is cut off
NOISE_MARGIN = 5.0  # standard deviations of the noise above which a value is evidence


def fisher_z(correlations: np.ndarray) -> np.ndarray:
    """Return Fisher's z, the inverse hyperbolic tangent of correlations."""
    max_correlation = 0.999  # larger correlations are clipped to it
    clipped = correlations.clip(-max_correlation, max_correlation)
    return np.asarray(0.5 * log((1 + clipped) / (1 - clipped)))


def find_contrast(picture: np.ndarray, weight: np.ndarray | None = None, side: int | None = None) -> np.ndarray:
    """Return the differences between the colours of a picture ``[h,w,3]`` and their local mean.

    The local mean is a Gaussian blur with a standard deviation of a sixth of ``side``, by default of the longer side of
    the picture. ``weight [h,w]`` are weights of the pixels, by default 1.
    """
    weight = np.ones(picture.shape[:2], np.float32) if weight is None else weight
    sigma = (side or max(picture.shape[:2])) / PICTURE_SPREADS
    sums = blur(np.dstack([picture * weight[..., None], weight]), sigma, round(CUT_OFF_SPREADS * 2 * sigma) | 1)
    return np.asarray(picture - sums[..., :3] / np.maximum(sums[..., 3:], np.float32(LEAST_OPACITY)))


@dataclass(frozen=True, eq=False)
class _Filters:
    """Contrast of the pictures of v views at one size, turned to t orientations that a stored photo may have."""

    size: tuple[int, int]  # width and height of the photos that are multiplied with the filters
    orientations: tuple[int, ...]  # the t orientations
    products: np.ndarray  # [v·t,h·w·3] weight times contrast, normalised to length 1
    weights: np.ndarray  # [v·t,h·w]
    lengths: np.ndarray  # [v] lengths of the products before these were normalised


class Comparer:
    """Correlate any number of photos, in all orientations, with the pictures of the views of a scene."""

    def __init__(self, shown: ViewPictures) -> None:
        self.views = len(shown)
        self._small = small = [shown.shrink(side) for side in SCORE_PIXELS]
        width, height = small[0].weights.shape[2:0:-1]
        self._portrait, self._square = height > width, height == width
        self.least_noise = 1 / np.sqrt(width * height)  # noise of Fisher's z if all pixels are independent
        self._empty = small[0].weights.max((1, 2)) < LEAST_OPACITY  # views without Gaussians

    @cached_property
    def _upright(self) -> list[_Filters]:
        """Filters at each size, for photos that are stored upright or upside down."""
        return [_make_filters(shown, (0, 2)) for shown in self._small]

    @cached_property
    def _sideways(self) -> list[_Filters]:
        """Filters at each size, for photos that are stored on their side."""
        return [_make_filters(shown, (1, 3)) for shown in self._small]

    def measure_contrast(self) -> np.ndarray:
        """Return the root mean square contrast ``[v]`` of each view, over the pixels that show Gaussians."""
        weight = self._small[-1].weights.sum((1, 2), dtype=np.float64)
        return np.asarray(self._upright[-1].lengths / np.sqrt(3 * np.maximum(weight, 1.0)))

    def correlate(self, photos: Sequence[np.ndarray]) -> np.ndarray:
        """Return correlations ``[p,v,8]`` of stored photos in each orientation with each view, averaged over the sizes.

        A photo ``[h,w,3]`` is resized to the shape of the views. NaN where an oriented photo is portrait and the views
        are landscape or vice versa, and for views without Gaussians.
        """
        out = np.full((len(photos), self.views, ORIENTATIONS), np.nan)
        small = [shrink_pictures(photo[None], *fit_size(photo.shape[1::-1], SCORE_PIXELS[-1]))[0] for photo in photos]
        shapes = np.array([photo.shape for photo in photos]).reshape(-1, 3)
        square = shapes[:, 0] == shapes[:, 1]
        portrait = shapes[:, 0] > shapes[:, 1]
        upright = self._square | square | (portrait == self._portrait)
        sideways = self._square | square | (portrait != self._portrait)
        for is_upright, fits in ((True, upright), (False, sideways)):
            ids = np.flatnonzero(fits)
            if len(ids):
                filters = self._upright if is_upright else self._sideways
                fitting = [small[photo] for photo in ids]
                scores = np.mean([_correlate(fitting, size_filters) for size_filters in filters], 0)
                orientations = np.array(filters[0].orientations)
                out[np.ix_(ids, np.arange(self.views), orientations)] = scores.reshape(len(ids), self.views, -1)
        out[:, self._empty] = np.nan
        return out


def _make_filters(small: ViewPictures, quarters: Sequence[int]) -> _Filters:
    """Make filters for photos that are stored turned by any of the numbers ``quarters`` of quarter turns.

    Each view has two filters for each number of quarter turns, one of them for the mirrored photo.
    """
    orientations = tuple(quarter + mirrored for mirrored in (0, ORIENTATIONS // 2) for quarter in quarters)
    products = []
    weights = []
    lengths = []
    for picture, weight in zip(small.pictures, small.weights, strict=True):
        weighted = find_contrast(picture, weight) * weight[..., None]
        squares = weighted * weighted / np.maximum(weight, LEAST_OPACITY)[..., None]
        length = float(np.sqrt(squares.sum(dtype=np.float64)))
        weighted = weighted / max(length, 1e-9)
        lengths.append(length)
        products += [turn_back(weighted, orientation).reshape(-1) for orientation in orientations]
        weights += [turn_back(weight, orientation).reshape(-1) for orientation in orientations]
    height, width = turn_back(small.weights[0], orientations[0]).shape
    return _Filters((width, height), orientations, np.stack(products), np.stack(weights), np.array(lengths))


def _correlate(photos: Sequence[np.ndarray], filters: _Filters) -> np.ndarray:
    """Return the correlations ``[p,v·t]`` of the contrast of p photos with the filters of v views in t orientations."""
    contrast = np.stack([find_contrast(shrink_pictures(photo[None], *filters.size)[0]) for photo in photos])
    products = matmul(filters.products, contrast.reshape(len(photos), -1).T)
    squares = matmul(filters.weights, (contrast * contrast).sum(-1).reshape(len(photos), -1).T)
    return np.asarray(products / np.sqrt(np.maximum(squares, 1e-12))).T


def measure_noise(z_scores: np.ndarray, least: float) -> tuple[np.ndarray, float]:
    """Return the median ``[v]`` of each view's z ``[v,...]``, and the standard deviation of all z about these medians.

    The deviation is estimated from the median absolute deviation, and is at least ``least``. NaN are ignored.
    """
    flat = z_scores.reshape(len(z_scores), -1)
    middle = np.array([_median_of_known(scores) for scores in flat], flat.dtype)
    return middle, max(NORMAL_SPREAD * _median_of_known(np.abs(flat - middle[:, None]).reshape(-1)), least)


def _median_of_known(scores: np.ndarray) -> float:
    """Return the median of the ``scores [n]`` that are not NaN; 0 if all are NaN, as for views without Gaussians."""
    known = scores[~np.isnan(scores)]
    return median(known) if len(known) else 0.0


def signed_ranks(gains: np.ndarray) -> float:
    """Return the sum of the signed ranks of gains ``[n]``, divided by its standard deviation (Wilcoxon 1945).

    Ranks do not depend on the distribution of the gains, so a few large gains do not decide. Gains of 0 and NaN are
    left out. Returns 0 if no gain remains.
    """
    gains = gains[np.isfinite(gains) & (gains != 0)]
    count = len(gains)
    if count == 0:
        return 0.0
    ranks = np.empty(count)
    ranks[np.argsort(np.abs(gains), kind="stable")] = np.arange(1, count + 1)
    return float((np.sign(gains) * ranks).sum() / np.sqrt(count * (count + 1) * (2 * count + 1) / 6))


def stands_out(gains: np.ndarray) -> bool:
    """Return True if gains ``[n]`` are above zero by more than :data:`NOISE_MARGIN` standard deviations of their noise.

    The gains must be held out: the change that causes a gain was fitted without the view, or the part of the view, in
    which the gain is measured.
    """
    return signed_ranks(gains) > NOISE_MARGIN
