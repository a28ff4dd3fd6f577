"""Solve for the frame of rows that an exporter of the pixelSplat family centred, rescaled and turned upright.

The exporter subtracts the median, divides by the 95 % quantile of the widest axis and rotates the world upright from
the first camera. It saves none of these. Often the rows do not determine their cameras: views were fused (FreeSplat),
layers of a pixel have gaps, or so many far pixels were cut that no lines repeat. But the file is recognised by its
median and quantile, so the rotation is known. Scale and shift are solved from rows whose pixels are found by colours:
a stretch of rows without a gap has the colours of a stretch of a photo. Stretches that agree on one frame are right,
and all other matches are wrong.
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

_QUANTILE = 0.95  # quantile of the distances along the widest axis; it is 1 in these files
_TOLERANCE = 1e-3  # of the median and the quantile
_ROUGH_ROWS, _ROUGH = 2000, 1.0  # rows of a first check, and its tolerance before the rotation is undone
_PER_PIXEL = (1, 2, 3)  # Gaussians of a pixel
_OUTSIDE = 999  # a colour that no pixel has
_UNIQUE = 1.1  # least distance of the second-best place of a stretch, over that of the best place
_STEP = 2  # every second pixel of a stretch is compared
_LENGTH, _STRETCHES = 48, 96  # rows of a stretch, and number of stretches that are searched
_PER_STRETCH = 12  # rows of each stretch that the frame is solved from
_SHARE = 3  # stretches of fused views are taken from the first and the last third of the rows
_SLACK = 8  # pixels beyond the bounds on both sides that are searched too
_MAX_COST = 3.0  # largest distance of a stretch, over the lower quartile of all distances
_NO_PLACE = 1 << 30  # distance of a stretch that cannot be in its photo
_PAIRS = 200  # pairs of stretches from which a frame is tried
_NEAR = 3.0  # limits within which a stretch agrees with a frame tried from a pair
_ROUNDS = 3  # of solving for the frame from the stretches that agree with it
_MIN_VIEWS, _MIN_STRETCHES, _MIN_AGREEING = 2, 3, 0.25  # views that agree, stretches of each, share of all stretches


@dataclass(frozen=True)
class _Stretch:
    """A stretch of rows, and where in a photo it is searched."""

    view: int
    start: int  # first row
    step: int  # from one row to the next
    low: int  # least and largest place of the first row among the pixels of a trimmed photo
    high: int


def upright_rotation(inputs: AlignmentInput) -> Similarity | None:
    """Find the camera from which rows were centred, rescaled and turned upright; return the rotation, or None."""
    means = inputs.gaussians.means[inputs.valid].astype(np.float64)
    few = means[:: max(1, len(means) // _ROUGH_ROWS)]
    if not len(few) or _deviation(few) > _ROUGH:
        return None
    for view, viewmat in enumerate(inputs.cameras.viewmats):
        rotation = matmul(UPRIGHT, viewmat[:3, :3])
        if _deviation(matmul(few, rotation)) < _ROUGH / 2 and _deviation(matmul(means, rotation)) < _TOLERANCE:
            source = "the first camera" if view == 0 else f"camera {view + 1}"
            return Similarity(rotation, 1.0, np.zeros(3), f"rotated upright from {source}", "upright")
    return None


def _deviation(points: np.ndarray) -> float:
    """Measure how far points ``[n,3]`` are from a median of 0 and a quantile of 1."""
    quantile = float(np.quantile(np.abs(points), _QUANTILE, axis=0).max())
    return max(float(np.abs(np.median(points, 0)).max()), abs(quantile - 1))


def solve_upright(inputs: AlignmentInput, rotation: Similarity) -> Similarity | None:
    """Solve for the frame of upright rows from their colours in the photos; None if too few stretches agree."""
    for pixels, stretches in _possible_orders(len(inputs.gaussians), inputs.cameras):
        frame = _solve_agreed_frame(inputs, _match(inputs, stretches, pixels), rotation)
        if frame is not None:
            return frame
    return None


def _possible_orders(count: int, cameras: Cameras) -> Iterator[tuple[np.ndarray, list[_Stretch]]]:
    """Yield the orders that ``count`` rows may have, as pixels ``[p]`` of a photo and the stretches to search."""
    views = len(cameras)
    inner, every = (trim_box(trim).pixels(cameras.width, cameras.height).reshape(-1) for trim in (TRIMS[0], 0))
    for per_pixel in _PER_PIXEL:  # the order is line, column, layer, view, and some pixels are dropped
        step = views * per_pixel
        dropped = len(inner) * step - count
        if 0 <= dropped < count and count >= _LENGTH * step:
            starts = np.unique(np.linspace(0, count - _LENGTH * step, _STRETCHES).astype(int))
            bounds = [(int(start), start // step - _SLACK, (start + dropped) // step + _SLACK) for start in starts]
            yield (
                inner,
                [_Stretch(view, start, step, low, high) for start, low, high in bounds for view in range(views)],
            )
    # views that are fused one after another: the rows of the first view come first, those of the last view last
    if _SHARE * _LENGTH <= count < views * len(every):
        starts = np.unique(np.linspace(0, count // _SHARE, _STRETCHES).astype(int))
        first = [_Stretch(0, int(start), 1, int(start) - _SLACK, len(every)) for start in starts]
        ends = (len(every) - each.start - _LENGTH + _SLACK for each in first)
        from_end = [count - _LENGTH - each.start for each in first]
        last = [_Stretch(views - 1, start, 1, 0, end) for start, end in zip(from_end, ends, strict=True)]
        yield every, first + last


def _match(inputs: AlignmentInput, stretches: Sequence[_Stretch], pixels: np.ndarray) -> Correspondences:
    """Search for stretches in the photos; return rows of those with a unique place of nearly equal colours.

    Each stretch is a part of the result.
    """
    colors, images = base_colors(inputs.gaussians), inputs.images
    colors = np.ascontiguousarray(np.rint(255 * colors).astype(np.int16).T)
    shown = [_shown_colors(np.rint(255 * photo).astype(np.uint8), pixels, _LENGTH) for photo in images]
    rows = np.array([each.start + each.step * np.arange(_LENGTH) for each in stretches])
    bounds = [(max(0, each.low), min(len(pixels), each.high)) for each in stretches]
    places = np.array([
        _place_stretch(shown[each.view], colors[:, ids], low, high) if low < high else (0, _NO_PLACE, 0)
        for each, ids, (low, high) in zip(stretches, rows, bounds, strict=True)
    ])  # fmt: skip
    near = places[:, 1] <= _MAX_COST * max(1.0, float(np.quantile(places[:, 1], 0.25)))
    chosen = np.flatnonzero(near & (places[:, 2] > _UNIQUE * places[:, 1]))
    within = np.linspace(0, _LENGTH - 1, _PER_STRETCH).astype(int)
    ids = rows[chosen][:, within].reshape(-1)
    y, x = np.divmod(pixels[(places[chosen, :1] + within).clip(max=len(pixels) - 1).reshape(-1)], inputs.cameras.width)
    views = np.array([each.view for each in stretches])[chosen].repeat(_PER_STRETCH)
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
    """Find the place of the colours ``wanted [3,l]`` in ``shown [3,m]`` with the least sum of absolute differences.

    Places from ``low`` to before ``high`` are searched. Returns the best place, its sum, and the sum of the second-best
    place that is more than two pixels away.
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


def _solve_agreed_frame(inputs: AlignmentInput, pairs: Correspondences, rotation: Similarity) -> Similarity | None:
    """Solve for the scale and shift that most stretches agree on; None if too few agree."""
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
        f" by amounts that no file states, and {photos} where they lie",
        "give the photos that the model saw, or cameras in the frame of the Gaussians, or export all pixels without a"
        " far cut",
    )
