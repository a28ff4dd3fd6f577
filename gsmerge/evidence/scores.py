"""How alike photos and pictures are, in units of the noise that wrong pairs have.

Two pictures are compared by the local contrast of their colours at two sizes: exposure, white balance and soft colours
change its correlation little. Fisher's z of the correlation has the same spread for all values, and nearly all pairs
are wrong: the median absolute deviation of their z is the noise, in which every pair is judged.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gsmerge.evidence.pictures import ViewPictures, fit_size
from gsmerge.kernels.elementary import log
from gsmerge.kernels.matrices import matmul
from gsmerge.kernels.pictures import TURNS, blur, turn_back
from gsmerge.raster.photos import LEAST_OPACITY, shrink_pictures

SIZES = (24, 64)  # pixels of the longer side at which pictures are compared
AROUND = 6  # part of a side that is the standard deviation of the mean that contrast is taken from
REACH = 2  # standard deviations of it that the mean reaches to each side
MARGIN = 5.0  # standard deviations of noise that evidence stands above it
NORMAL = 1.4826  # standard deviations of a normal distribution that its median absolute deviation is
CLOSEST = 0.999  # correlation beyond which pictures are equally alike


def fisher_z(correlations: np.ndarray) -> np.ndarray:
    """Return the inverse hyperbolic tangent of correlations."""
    near = correlations.clip(-CLOSEST, CLOSEST)
    return np.asarray(0.5 * log((1 + near) / (1 - near)))


def find_contrast(picture: np.ndarray, weight: np.ndarray | None = None, side: int | None = None) -> np.ndarray:
    """Return the colours of a picture ``[h,w,3]`` less their mean around, in a square of ``side`` or of the picture's.

    ``weight [h,w]``: how much pixels count; None: all alike.
    """
    weight = np.ones(picture.shape[:2], np.float32) if weight is None else weight
    sigma = (side or max(picture.shape[:2])) / AROUND
    sums = blur(np.dstack([picture * weight[..., None], weight]), sigma, round(REACH * 2 * sigma) | 1)
    return np.asarray(picture - sums[..., :3] / np.maximum(sums[..., 3:], np.float32(LEAST_OPACITY)))


@dataclass(frozen=True, eq=False)
class _Filters:
    """What the views show at one size, turned as a stored photo may be, to be multiplied with its contrast."""

    size: tuple[int, int]  # width and height of the photos that they are for
    turns: tuple[int, ...]  # of such photos
    products: np.ndarray  # [v·t,h·w·3] weight times contrast, of length 1
    weights: np.ndarray  # [v·t,h·w]
    lengths: np.ndarray  # [v] of the products before


class Comparer:
    """Correlations of any number of photos, in all turns, with what the views of a scene show."""

    def __init__(self, shown: ViewPictures) -> None:
        self.views = len(shown)
        self._small = small = [shown.shrink(side) for side in SIZES]
        width, height = small[0].weights.shape[2:0:-1]
        self._portrait, self._square = height > width, height == width
        self.least_noise = 1 / np.sqrt(width * height)  # of Fisher's z of so many independent pixels
        self._empty = small[0].weights.max((1, 2)) < LEAST_OPACITY  # with which nothing can be compared

    @cached_property
    def _upright(self) -> list[_Filters]:
        return [_make_filters(each, (0, 2)) for each in self._small]

    @cached_property
    def _lying(self) -> list[_Filters]:
        return [_make_filters(each, (1, 3)) for each in self._small]

    def measure_contrast(self) -> np.ndarray:
        """Return the root mean square contrast ``[v]`` of what each view shows, where it shows anything."""
        weight = self._small[-1].weights.sum((1, 2), dtype=np.float64)
        return np.asarray(self._upright[-1].lengths / np.sqrt(3 * np.maximum(weight, 1.0)))

    def correlate(self, photos: Sequence[np.ndarray]) -> np.ndarray:
        """Return mean correlations ``[p,v,8]`` over the sizes of stored photos in each turn; NaN for impossible ones.

        A photo ``[h,w,3]`` is squeezed to the views' shape; it cannot stand where they lie.
        """
        out = np.full((len(photos), self.views, TURNS), np.nan)
        small = [shrink_pictures(photo[None], *fit_size(photo.shape[1::-1], SIZES[-1]))[0] for photo in photos]
        shapes = np.array([photo.shape for photo in photos]).reshape(-1, 3)
        square, portrait = shapes[:, 0] == shapes[:, 1], shapes[:, 0] > shapes[:, 1]
        upright = self._square | square | (portrait == self._portrait)
        lying = self._square | square | (portrait != self._portrait)
        for is_upright, stand in ((True, upright), (False, lying)):
            ids = np.flatnonzero(stand)
            if len(ids):
                filters = self._upright if is_upright else self._lying
                scores = np.mean([_correlate([small[photo] for photo in ids], each) for each in filters], 0)
                turns = np.array(filters[0].turns)
                out[np.ix_(ids, np.arange(self.views), turns)] = scores.reshape(len(ids), self.views, -1)
        out[:, self._empty] = np.nan
        return out


def _make_filters(small: ViewPictures, quarters: Sequence[int]) -> _Filters:
    """Turn pictures back as photos may be stored that show them, by some ``quarters`` and mirrored."""
    turns = tuple(turn + mirrored for mirrored in (0, TURNS // 2) for turn in quarters)
    products, weights, lengths = [], [], []
    for picture, weight in zip(small.pictures, small.weights, strict=True):
        heavy = find_contrast(picture, weight) * weight[..., None]
        size = float(np.sqrt((heavy * heavy / np.maximum(weight, LEAST_OPACITY)[..., None]).sum(dtype=np.float64)))
        heavy = heavy / max(size, 1e-9)
        lengths.append(size)
        products += [turn_back(heavy, turn).reshape(-1) for turn in turns]
        weights += [turn_back(weight, turn).reshape(-1) for turn in turns]
    height, width = turn_back(small.weights[0], turns[0]).shape
    return _Filters((width, height), turns, np.stack(products), np.stack(weights), np.array(lengths))


def _correlate(photos: Sequence[np.ndarray], filters: _Filters) -> np.ndarray:
    """Correlate photos' contrast with pictures that are turned as they are, ``[p,v·t]``."""
    contrast = np.stack([find_contrast(shrink_pictures(photo[None], *filters.size)[0]) for photo in photos])
    products = matmul(filters.products, contrast.reshape(len(photos), -1).T)
    squares = matmul(filters.weights, (contrast * contrast).sum(-1).reshape(len(photos), -1).T)
    return np.asarray(products / np.sqrt(np.maximum(squares, 1e-12))).T


def measure_noise(z_scores: np.ndarray, least: float) -> tuple[np.ndarray, float]:
    """Return the middle ``[v]`` of each view's scores ``[v,...]``, and the spread of all about it, without NaN.

    The spread is at ``least`` that of pixels which have nothing to do with each other.
    """
    flat = z_scores.reshape(len(z_scores), -1)
    with warnings.catch_warnings():  # of views that show nothing
        warnings.simplefilter("ignore", RuntimeWarning)
        middle = np.nan_to_num(np.nanmedian(flat, 1))
        spread = np.nan_to_num(np.nanmedian(np.abs(flat - middle[:, None])))
    return middle, max(NORMAL * float(spread), least)


def signed_ranks(gains: np.ndarray) -> float:
    """Return how far the signed ranks of gains ``[n]`` sum above zero, in standard deviations (Wilcoxon 1945).

    Few large gains count no more than that many, so their distribution does not matter. Gains of 0 and NaN are left
    out; 0 without others.
    """
    gains = gains[np.isfinite(gains) & (gains != 0)]
    count = len(gains)
    if count == 0:
        return 0.0
    ranks = np.empty(count)
    ranks[np.argsort(np.abs(gains), kind="stable")] = np.arange(1, count + 1)
    return float((np.sign(gains) * ranks).sum() / np.sqrt(count * (count + 1) * (2 * count + 1) / 6))


def stands_out(gains: np.ndarray) -> bool:
    """Return whether gains ``[n]`` are above zero by more than :data:`MARGIN` standard deviations of their noise.

    Gains are those of parts that did not choose what gains: views, or parts of them.
    """
    return signed_ranks(gains) > MARGIN
