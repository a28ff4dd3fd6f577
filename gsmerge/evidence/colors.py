"""Whether a change of their colours makes photos look as what the Gaussians show.

Each change is a hypothesis with parameters: red and blue in each other's place, a tone curve for each channel, a linear
map of colours. Pictures are cut into blocks, dealt like the fields of a chess board: what changes one half is fitted to
the other. A change counts where blocks, which did not choose it, are nearer with it than without by more than their
noise, and by more than what it leaves. Means of blocks are compared: wrong depth displaces little beyond them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from gsmerge.evidence.pictures import Pairs
from gsmerge.evidence.scores import stands_out
from gsmerge.kernels.matrices import matmul, solve
from gsmerge.runtime.threads import parallel_map

BLOCKS = 12  # along the longer side
SOLID = 0.2  # least opacity of a block that is compared: what fainter ones show is a few Gaussians
LEVELS = 33  # quantiles that a tone curve joins
STEP = 0.05  # what a third of a stop, the least step of cameras, changes middle grey by
VISIBLE = 0.01  # root mean square of differences that are just seen on plain surfaces
RIDGE = 1e-6  # of the mean square of colours: keeps grey photos' maps finite
Change = Callable[[np.ndarray], np.ndarray]  # of colours [...,3]
Fit = Callable[[np.ndarray, np.ndarray, np.ndarray], Change]  # of colours [n,3] to others [n,3], by weights [n]


@dataclass(frozen=True, eq=False)
class Blocks:
    """Photos and pictures of v views, as means of blocks."""

    photos: np.ndarray  # [v,H,W,3]
    pictures: np.ndarray  # [v,H,W,3] what the Gaussians show there
    solid: np.ndarray  # [v,H,W] whether a block is opaque enough to be compared

    def errors(self, views: Sequence[int] | slice = slice(None)) -> np.ndarray:
        """Return the mean difference of colours of blocks ``[n]`` of some views; NaN of those that are faint."""
        return self.distances(self.pictures, views)

    def distances(self, colors: np.ndarray, views: Sequence[int] | slice = slice(None)) -> np.ndarray:
        """Return the mean difference of photos from other colours ``[v,H,W,3]``, as :meth:`errors` does."""
        away = np.abs(self.photos - colors).mean(-1)
        return np.where(self.solid, away, np.nan)[views].reshape(-1)


def is_visible(errors: np.ndarray) -> bool:
    """Return whether errors of blocks ``[n]`` are seen."""
    return _sum_squares(errors) > VISIBLE**2 * np.isfinite(errors).sum()


def explains(before: np.ndarray, after: np.ndarray) -> bool:
    """Return whether errors of blocks ``[n]`` fall by more than their noise, and, in squares, by more than stays."""
    return stands_out(before - after) and _sum_squares(before) > 2 * _sum_squares(after)


def _sum_squares(errors: np.ndarray) -> float:
    return float(np.nansum(errors.astype(np.float64) ** 2))


def cut_blocks(pairs: Pairs) -> Blocks:
    """Average photos and pictures over blocks."""
    small = pairs.shrink(BLOCKS)
    return Blocks(small.photos, small.shown.pictures, small.shown.weights > SOLID)


def fit_tones(colors: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Fit a tone curve ``[3,256]``: quantiles of colours become those of targets, proportional at its ends.

    Wrong depth and noise hardly change quantiles.
    """
    return np.stack([_join_quantiles(colors[:, channel], targets[:, channel], weights) for channel in range(3)])


def map_tones(tones: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Map the colours of a photo ``[...,3]`` in [0, 1] by a tone curve ``[3,256]``, one row per channel."""
    places = photo.astype(np.float32) * np.float32(255)
    first = np.clip(places.astype(np.int64), 0, 254)
    part, channel = places - first, np.arange(3)
    return np.asarray(tones[channel, first] * (1 - part) + tones[channel, first + 1] * part)


def fit_map(colors: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Fit the linear map ``[4,3]`` of colours, with a constant, to targets by least squares."""
    columns = np.concatenate([colors, np.ones((len(colors), 1))], 1).astype(np.float64)
    heavy = columns * weights[:, None]
    return solve(
        matmul(heavy.T, columns) + RIDGE * len(colors) * np.eye(4), matmul(heavy.T, targets.astype(np.float64))
    )


def map_colors(matrix: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Map the colours of a photo ``[...,3]`` by a matrix ``[4,3]``; float32."""
    flat = photo.reshape(-1, 3).astype(np.float64)
    return np.asarray((matmul(flat, matrix[:3]) + matrix[3]).reshape(photo.shape), np.float32)


def tone_blocks(pairs: Pairs, groups: Sequence[Sequence[int]]) -> Blocks:
    """Return blocks of photos after tone curves, one for each group of views, that were fitted to other blocks."""
    toned = pairs.photos.copy()

    def fit(group: Sequence[int]) -> None:
        part = pairs[group]
        shown = part.shown
        toned[group] = _cross_fit(part.photos, shown.pictures, shown.weights, _tone_change)

    parallel_map(fit, groups)
    return cut_blocks(pairs.with_photos(toned))


def map_blocks(blocks: Blocks) -> Blocks:
    """Return blocks after a linear map of colours, that was fitted to other blocks."""
    mapped = _cross_fit(blocks.photos, blocks.pictures, blocks.solid.astype(np.float32), _map_change)
    return Blocks(mapped, blocks.pictures, blocks.solid)


def plain_blocks(blocks: Blocks) -> Blocks:
    """Return blocks of one colour, the mean of what the Gaussians show in other blocks."""
    plain = _cross_fit(blocks.photos, blocks.pictures, blocks.solid.astype(np.float32), _plain_change)
    return Blocks(plain, blocks.pictures, blocks.solid)


def _tone_change(colors: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> Change:
    return partial(map_tones, fit_tones(colors, targets, weights))


def _map_change(colors: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> Change:
    return partial(map_colors, fit_map(colors, targets, weights))


def _plain_change(_: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> Change:
    mean = (targets * weights[:, None]).sum(0, dtype=np.float64) / max(float(weights.sum(dtype=np.float64)), 1e-9)
    return partial(np.full_like, fill_value=mean)


def _cross_fit(photos: np.ndarray, pictures: np.ndarray, weights: np.ndarray, fit: Fit) -> np.ndarray:
    """Change photos ``[v,h,w,3]`` by what was fitted to all of them: every other block by those between."""
    out, side = np.empty_like(photos), max(1.0, max(photos.shape[1:3]) / BLOCKS)
    y, x = ((np.arange(size) / side).astype(int) for size in photos.shape[1:3])
    odd = (y[:, None] + x) % 2 == 1
    for fold in (odd, ~odd):
        colors, targets = (each[:, ~fold].reshape(-1, 3) for each in (photos, pictures))
        out[:, fold] = fit(colors, targets, weights[:, ~fold].reshape(-1))(photos[:, fold])
    return out


def _join_quantiles(levels: np.ndarray, tones: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the curve ``[256]`` float32 that maps the quantiles of one sample to another, proportional at its ends."""
    counts = weights > 0
    if not counts.any():
        return np.linspace(0, 1, 256, dtype=np.float32)
    x, y = (np.round(_weigh_quantiles(values[counts], weights[counts]), 6) for values in (levels, tones))
    keep = np.concatenate([[True], np.diff(x) > 1 / 255]) & (x > 0) & (x < 1)
    x, y = x[keep], np.maximum.accumulate(y[keep].clip(0, 1))
    end = min(1.0, max(y[-1], y[-1] / x[-1])) if len(x) else 1.0
    curve = np.interp(np.arange(256) / 255, [0, *x, 1], [0, *y, end])
    return np.round(curve, 6).astype(np.float32)


def _weigh_quantiles(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return evenly spaced quantiles of weighted values."""
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order], dtype=np.float64)
    shares = (sums - weights[order] / 2) / sums[-1]
    return np.interp((np.arange(LEVELS) + 0.5) / LEVELS, shares, values[order].astype(np.float64))
