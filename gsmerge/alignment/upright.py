"""Solve for the frame of rows that the pixelSplat family centres, rescales and turns upright.

Its exporter subtracts the median, divides by the 95 % quantile of the widest axis and turns the world from the first
camera, and saves neither. Rows cannot show their cameras where views were fused (FreeSplat), where layers of a pixel
have gaps, or where so many far pixels were cut that no lines repeat; but such a file shows itself, and the rotation is
known; scale and shift follow from some rows' pixels. Stretches of rows without a gap show the colours of a stretch of a
photo; those that agree on a frame give it, the others are wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmerge.alignment.frames import UPRIGHT, ray_directions, solve_frame
from gsmerge.alignment.layouts import TRIMS, trim_box
from gsmerge.alignment.score import AlignmentInput, Correspondences, base_colors, pixel_errors, pixel_limit
from gsmerge.errors import SceneError
from gsmerge.geometry import Similarity
from gsmerge.io.formats.read import FileInfo
from gsmerge.kernels.matrices import matmul
from gsmerge.types import Cameras

_QUANTILE = 0.95  # of the distances along the widest axis, which is 1 in such a file
_SMALL = 1e-3  # how exactly
_ROUGH_ROWS, _ROUGH = 2000, 1.0  # rows that are looked at first, and how far off before they are turned back
_PER_PIXEL = (1, 2, 3)  # Gaussians of a pixel
_OUTSIDE = 999  # a colour that no pixel has
_UNIQUE = 1.1  # times as far as the nearest place is the next one, at least
_STEP = 2  # every how many pixels of a stretch are compared
_LENGTH, _STRETCHES = 48, 96  # rows of a stretch without gaps, and stretches that are searched
_PER_STRETCH = 12  # rows of each that the frame is solved from
_SHARE = 3  # part of the rows that fused views begin and end with
_SLACK = 8  # pixels more than the bounds on both sides that are searched
_MAX_COST = 3.0  # times the distance of the nearest quarter of the stretches
_FAR = 1 << 30  # distance of a stretch that has no place
_PAIRS = 200  # of stretches from which a frame is tried
_NEAR = 3.0  # times the limit of pixels that count as agreeing with a frame tried from two stretches
_ROUNDS = 3  # of a frame and the stretches that agree with it
_MIN_VIEWS, _MIN_STRETCHES, _MIN_AGREEING = 2, 3, 0.25  # views that agree, stretches of each, share of all unique ones


@dataclass(frozen=True)
class _Try:
    """A stretch of rows, and where in a photo it is searched."""

    view: int
    start: int  # first row
    step: int  # from one row to the next
    low: int  # bounds of its place among the pixels of a trimmed picture
    high: int


def upright_rotation(inputs: AlignmentInput) -> Similarity | None:
    """Return the rotation, from any camera, of rows centred, rescaled and turned upright; None for other rows."""
    means = inputs.gaussians.means[inputs.valid].astype(np.float64)
    few = means[:: max(1, len(means) // _ROUGH_ROWS)]
    if not len(few) or _uneven(few) > _ROUGH:
        return None
    for view, viewmat in enumerate(inputs.cameras.viewmats):
        rotation = matmul(UPRIGHT, viewmat[:3, :3])
        if _uneven(matmul(few, rotation)) < _ROUGH / 2 and _uneven(matmul(means, rotation)) < _SMALL:
            source = "the first camera" if view == 0 else f"camera {view + 1}"
            return Similarity(rotation, 1.0, np.zeros(3), f"rotated upright from {source}", "upright")
    return None


def _uneven(points: np.ndarray) -> float:
    """Measure how far points ``[n,3]`` are from having a median of 0 and a quantile of 1."""
    quantile = float(np.quantile(np.abs(points), _QUANTILE, axis=0).max())
    return max(float(np.abs(np.median(points, 0)).max()), abs(quantile - 1))


def solve_upright(inputs: AlignmentInput, rotation: Similarity) -> Similarity | None:
    """Solve for the frame of upright rows from their colours in the photos; None if too few stretches agree."""
    for pixels, tries in _possible_orders(len(inputs.gaussians), inputs.cameras):
        frame = _agreed_frame(inputs, _match(inputs, tries, pixels), rotation)
        if frame is not None:
            return frame
    return None


def _possible_orders(count: int, cameras: Cameras) -> Iterator[tuple[np.ndarray, list[_Try]]]:
    """Yield the orders that ``count`` rows may have: pixels ``[p]`` of a picture, and the places to search."""
    views = len(cameras)
    inner, every = (trim_box(trim).pixels(cameras.width, cameras.height).reshape(-1) for trim in (TRIMS[0], 0))
    for per_pixel in _PER_PIXEL:  # row, column, layer, view, with pixels dropped
        step = views * per_pixel
        dropped = len(inner) * step - count
        if 0 <= dropped < count and count >= _LENGTH * step:
            starts = np.unique(np.linspace(0, count - _LENGTH * step, _STRETCHES).astype(int))
            bounds = [(int(start), start // step - _SLACK, (start + dropped) // step + _SLACK) for start in starts]
            yield inner, [_Try(view, start, step, low, high) for start, low, high in bounds for view in range(views)]
    # views that are fused one after the other: what only the first one shows comes first, of the last one last
    if _SHARE * _LENGTH <= count < views * len(every):
        starts = np.unique(np.linspace(0, count // _SHARE, _STRETCHES).astype(int))
        first = [_Try(0, int(start), 1, int(start) - _SLACK, len(every)) for start in starts]
        ends = (len(every) - t.start - _LENGTH + _SLACK for t in first)
        last = [_Try(views - 1, count - _LENGTH - t.start, 1, 0, end) for t, end in zip(first, ends, strict=True)]
        yield every, first + last


def _match(inputs: AlignmentInput, tries: Sequence[_Try], pixels: np.ndarray) -> Correspondences:
    """Find stretches in the photos; return rows of those that are alike and in one place, a part for each."""
    colors, images = base_colors(inputs.gaussians), inputs.images
    colors = np.ascontiguousarray(np.rint(255 * colors).astype(np.int16).T)
    shown = [_shown_colors(np.rint(255 * photo).astype(np.uint8), pixels, _LENGTH) for photo in images]
    rows = np.array([t.start + t.step * np.arange(_LENGTH) for t in tries])
    bounds = [(max(0, t.low), min(len(pixels), t.high)) for t in tries]
    places = np.array([
        _place_stretch(shown[t.view], colors[:, stretch], low, high) if low < high else (0, _FAR, 0)
        for t, stretch, (low, high) in zip(tries, rows, bounds, strict=True)
    ])  # fmt: skip
    near = places[:, 1] <= _MAX_COST * max(1.0, float(np.quantile(places[:, 1], 0.25)))
    chosen = np.flatnonzero(near & (places[:, 2] > _UNIQUE * places[:, 1]))
    within = np.linspace(0, _LENGTH - 1, _PER_STRETCH).astype(int)
    ids = rows[chosen][:, within].reshape(-1)
    y, x = np.divmod(pixels[(places[chosen, :1] + within).clip(max=len(pixels) - 1).reshape(-1)], inputs.cameras.width)
    views = np.array([t.view for t in tries])[chosen].repeat(_PER_STRETCH)
    parts = np.arange(len(chosen)).repeat(_PER_STRETCH)
    pairs = Correspondences(
        inputs.gaussians.means[ids].astype(np.float64), np.stack([x, y], 1) + 0.5, views, parts, ids
    )
    return pairs.select(inputs.valid[ids])


def _shown_colors(photo: np.ndarray, pixels: np.ndarray, length: int) -> np.ndarray:
    """Return the colours ``[3,p+length]`` int16 at ``pixels [p]`` of a uint8 ``photo [h,w,3]``, padded at the end."""
    shown = photo.reshape(-1, 3)[pixels].T.astype(np.int16)
    return np.concatenate([shown, np.full((3, length), _OUTSIDE, np.int16)], 1)


def _place_stretch(shown: np.ndarray, wanted: np.ndarray, low: int, high: int) -> tuple[int, int, int]:
    """Find the place of the colours ``wanted [3,l]`` in ``shown [3,m]`` by the sum of absolute differences.

    Returns the best place, from ``low`` on and below ``high``, its sum, and the sum of the next best place.
    """
    sums, difference = np.zeros(high - low, np.int32), np.empty(high - low, np.int16)
    for offset in range(0, wanted.shape[1], _STEP):
        for channel in range(3):
            values = shown[channel, low + offset : high + offset]
            np.subtract(values, wanted[channel, offset], out=difference)
            np.abs(difference, out=difference)
            sums += difference
    best = int(sums.argmin())
    other_sums = np.concatenate([sums[: max(0, best - 2)], sums[best + 3 :]])
    return low + best, int(sums[best]), int(other_sums.min(initial=np.iinfo(np.int32).max))


def _agreed_frame(inputs: AlignmentInput, pairs: Correspondences, rotation: Similarity) -> Similarity | None:
    """Solve for scale and shift that the most stretches agree on; None if they are few."""
    stretches = np.unique(pairs.parts)
    views = np.array([pairs.views[pairs.parts == stretch][0] for stretch in stretches])
    if len(np.unique(views)) < _MIN_VIEWS:
        return None
    limit, rng = pixel_limit(inputs.cameras.width, inputs.cameras.height), np.random.default_rng(0)

    def solve(chosen: np.ndarray) -> Similarity | None:
        part = pairs.select(np.isin(pairs.parts, chosen))
        rays = ray_directions(part, inputs.cameras)
        return solve_frame(part.points, rays, rotation.rotation, shifted=True)

    def find_agreeing(frame: Similarity | None, limit: float) -> np.ndarray:
        if frame is None:
            return stretches[:0]
        errors = pixel_errors(pairs, frame.move(inputs.cameras))
        return stretches[[float(np.median(errors[pairs.parts == stretch])) < limit for stretch in stretches]]

    best = stretches[:0]
    for _ in range(_PAIRS):
        first = rng.choice(len(stretches))
        second = rng.choice(np.flatnonzero(views != views[first]))
        best = max(best, find_agreeing(solve(stretches[[first, second]]), _NEAR * limit), key=len)
    frame = None
    for _ in range(_ROUNDS):
        frame = solve(best) if len(best) else None
        best = find_agreeing(frame, limit)
    counts = np.bincount(views[np.isin(stretches, best)], minlength=1)
    if frame is None or (counts >= _MIN_STRETCHES).sum() < _MIN_VIEWS or len(best) < _MIN_AGREEING * len(stretches):
        return None
    text = f"{rotation.description}, positions scaled by {frame.scale:.4g} and shifted"
    return replace(frame, description=text, kind=rotation.kind)


def upright_error(ply: FileInfo, num_photos: int) -> SceneError:
    """Make the SceneError for upright rows that no photo locates."""
    photos = "photos that do not show" if num_photos else "no photos that show"
    return SceneError(
        ply.path,
        "expected cameras in the frame of the Gaussians, found Gaussians that were centred, rescaled and turned upright"
        f" (by how much, no file says), and {photos} where they lie",
        "give the photos that the model saw, or cameras in the file's frame; or export all pixels, without a far cut",
    )
