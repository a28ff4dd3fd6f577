"""Test whether a change of colours makes photos equal to what the Gaussians show.

A change exchanges red and blue, applies a tone curve to each channel, or is a linear map of colours. Pictures are cut
into blocks, half of which are black and half white like the squares of a chess board. The change for the black blocks
is fitted to the white blocks, and the other way round, so no block scores a change that was fitted to this block. A
change is accepted if it reduces the errors of blocks by more than their noise and by more than half. The error of a
block is the error of its mean colour, because wrong depth moves few Gaussians into other blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gsmerge.arrays import mean_columns
from gsmerge.frozen import dataclass
from gsmerge.method.compare.similarity import stands_out
from gsmerge.method.compare.view_pictures import Pairs
from gsmerge.method.kernels.matrices import matmul, solve
from gsmerge.runtime.threads import parallel_map

BLOCKS = 12  # along the longer side
SOLID_BLOCK = 0.2  # opacity above which a block is compared; fainter blocks show only a few Gaussians
TONE_LEVELS = 33  # number of quantiles of a tone curve
EXPOSURE_STEP = 0.05  # change of middle grey by a third of a stop, the smallest exposure step of cameras
VISIBLE = 0.01  # root mean square of differences that are just visible on plain surfaces
# Changes colours [...,3], the first argument, by a change that is fitted to the other arguments: colours [n,3], their
# targets [n,3] and weights [n]
ChangeColors = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Blocks:
    """Photos of v views and pictures of their Gaussians, as means of blocks."""

    photos: np.ndarray  # [v,H,W,3]
    pictures: np.ndarray  # [v,H,W,3] colours of the Gaussians
    solid: np.ndarray  # [v,H,W] True where a block is opaque enough to be compared

    def errors(self, views: Sequence[int] | slice = slice(None)) -> np.ndarray:
        """Return the mean difference ``[n]`` of photo and picture in each block of ``views``; NaN in faint blocks."""
        return self.distances(self.pictures, views)

    def distances(self, colors: np.ndarray, views: Sequence[int] | slice = slice(None)) -> np.ndarray:
        """Return the mean difference ``[n]`` of photo and ``colors [v,H,W,3]`` in each block; NaN in faint blocks."""
        differences = mean_columns(np.abs(self.photos - colors))
        return np.where(self.solid, differences, np.nan)[views].reshape(-1)


def is_visible(errors: np.ndarray) -> bool:
    """Return True if the root mean square of errors of blocks ``[n]`` is above :data:`VISIBLE`."""
    return _sum_squares(errors) > VISIBLE**2 * np.isfinite(errors).sum()


def explains(before: np.ndarray, after: np.ndarray) -> bool:
    """Return True if a change reduces the errors of blocks ``[n]`` significantly, from ``before`` to ``after``.

    The change also has to halve the sum of the squared errors.
    """
    return stands_out(before - after) and _sum_squares(before) > 2 * _sum_squares(after)


def _sum_squares(errors: np.ndarray) -> float:
    """Sum the squares of all errors that are not NaN."""
    return float(np.nansum(errors.astype(np.float64) ** 2))


def cut_blocks(pairs: Pairs) -> Blocks:
    """Average photos and pictures over blocks."""
    small = pairs.shrink(BLOCKS)
    return Blocks(small.photos, small.shown.pictures, small.shown.weights > SOLID_BLOCK)


def fit_tones(colors: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Fit a tone curve ``[3,256]`` that maps the quantiles of ``colors`` to those of ``targets``, channel by channel.

    Colours and targets are ``[n,3]``, with ``weights [n]``. Wrong depth and noise hardly change quantiles. Levels below
    and above all quantiles are mapped in proportion.
    """
    used = weights > 0
    if not used.any():
        return np.tile(np.linspace(0, 1, 256, dtype=np.float32), (3, 1))
    curves = []
    for channel in range(3):
        before, after = (
            np.round(_weigh_quantiles(values[used, channel], weights[used]), 6) for values in (colors, targets)
        )
        is_distinct = np.concatenate([[True], np.diff(before) > 1 / 255]) & (before > 0) & (before < 1)
        # points of the curve
        x = before[is_distinct]
        y = np.maximum.accumulate(after[is_distinct].clip(0, 1))
        # at x = 1: the last point, extended in proportion
        last_y = min(1.0, max(y[-1], y[-1] / x[-1])) if len(x) else 1.0
        curve = np.interp(np.arange(256) / 255, [0, *x, 1], [0, *y, last_y])
        curves.append(np.round(curve, 6).astype(np.float32))
    return np.stack(curves)


def map_tones(tones: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Map the colours of a photo ``[...,3]`` in [0, 1] by a tone curve ``[3,256]``, one row per channel."""
    levels = photo.astype(np.float32) * np.float32(255)
    lower = np.clip(levels.astype(np.int64), 0, 254)
    fraction = levels - lower
    channel = np.arange(3)
    return np.asarray(tones[channel, lower] * (1 - fraction) + tones[channel, lower + 1] * fraction)


def fit_map(colors: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Fit the linear map ``[4,3]`` of ``colors [n,3]`` to ``targets [n,3]`` by least squares with ``weights [n]``.

    The last row of the map is a constant.
    """
    columns = np.concatenate([colors, np.ones((len(colors), 1))], 1).astype(np.float64)
    weighted = columns * weights[:, None]
    ridge = 1e-6  # ridge of the least squares, relative to the mean square of colours; keeps maps of grey photos finite
    normal = matmul(weighted.T, columns) + ridge * len(colors) * np.eye(4)
    return solve(normal, matmul(weighted.T, targets.astype(np.float64)))


def map_colors(matrix: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Map the colours of a photo ``[...,3]`` by a matrix ``[4,3]``; float32."""
    flat = photo.reshape(-1, 3).astype(np.float64)
    return np.asarray((matmul(flat, matrix[:3]) + matrix[3]).reshape(photo.shape), np.float32)


def vary_in_hue(colors: np.ndarray, weights: np.ndarray) -> float:
    """Measure how far colours ``[n,3]``, with ``weights [n]``, are from colours that depend only on brightness.

    The result is the root mean square distance of the colours from the best tone curve of their grey levels. The result
    is about 0 for grey photos, and for photos of a single tint.
    """
    grey = colors.mean(1, keepdims=True).repeat(3, 1)
    away = (colors - map_tones(fit_tones(grey, colors, weights), grey)) ** 2 * weights[:, None]
    return float(np.sqrt(away.mean() / max(float(weights.mean()), 1e-9)))


def tone_blocks(pairs: Pairs, groups: Sequence[Sequence[int]]) -> Blocks:
    """Return blocks of the photos after a tone curve, which is fitted to each group of views by :func:`_cross_fit`."""
    toned = pairs.photos.copy()

    def change_group(group: Sequence[int]) -> None:
        """Fit a tone curve to a group of views, and apply it to their photos in ``toned``."""
        group_pairs = pairs[group]
        shown = group_pairs.shown
        toned[group] = _cross_fit(
            group_pairs.photos,
            shown.pictures,
            shown.weights,
            lambda photo, *fitted: map_tones(fit_tones(*fitted), photo),
        )

    parallel_map(change_group, groups)
    return cut_blocks(pairs.with_photos(toned))


def map_blocks(blocks: Blocks) -> Blocks:
    """Return the blocks after a linear map of the photos' colours, which is fitted by :func:`_cross_fit`."""
    mapped = _cross_fit(
        blocks.photos,
        blocks.pictures,
        blocks.solid.astype(np.float32),
        lambda photo, *fitted: map_colors(fit_map(*fitted), photo),
    )
    return Blocks(mapped, blocks.pictures, blocks.solid)


def plain_blocks(blocks: Blocks) -> Blocks:
    """Return the blocks with photos of one colour, the mean colour of the Gaussians that :func:`_cross_fit` finds."""

    def fill(photo: np.ndarray, _: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Give every pixel the mean of the colours ``targets``."""
        mean = (targets * weights[:, None]).sum(0, dtype=np.float64) / max(float(weights.sum(dtype=np.float64)), 1e-9)
        return np.full_like(photo, mean)

    plain = _cross_fit(blocks.photos, blocks.pictures, blocks.solid.astype(np.float32), fill)
    return Blocks(plain, blocks.pictures, blocks.solid)


def _cross_fit(photos: np.ndarray, pictures: np.ndarray, weights: np.ndarray, change: ChangeColors) -> np.ndarray:
    """Fit a change to the white blocks of photos ``[v,h,w,3]``, apply it to the black blocks, and vice versa.

    The ``change`` maps photos to ``pictures [v,h,w,3]``, with ``weights [v,h,w]``.
    """
    out = np.empty_like(photos)
    block_side = max(1.0, max(photos.shape[1:3]) / BLOCKS)
    y, x = ((np.arange(size) / block_side).astype(int) for size in photos.shape[1:3])
    black_squares = (y[:, None] + x) % 2 == 1  # like those of a chess board
    for fold in (black_squares, ~black_squares):
        colors = photos[:, ~fold].reshape(-1, 3)
        targets = pictures[:, ~fold].reshape(-1, 3)
        out[:, fold] = change(photos[:, fold], colors, targets, weights[:, ~fold].reshape(-1))
    return out


def _weigh_quantiles(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return evenly spaced quantiles of weighted values."""
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order], dtype=np.float64)
    shares = (sums - weights[order] / 2) / sums[-1]
    return np.interp((np.arange(TONE_LEVELS) + 0.5) / TONE_LEVELS, shares, values[order].astype(np.float64))
