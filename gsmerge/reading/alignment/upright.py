"""Solve for the frame of rows that an exporter of the pixelSplat family centred, rescaled and turned upright.

The exporter subtracts the median, divides by the 95 % quantile of the widest axis and rotates the world upright from
the first camera. No file stores median, quantile or rotation. Often the rows alone do not determine their cameras:
views may be fused (FreeSplat), layers of a pixel may have gaps, or so many far pixels may be cut that no lines repeat.
A median of 0 and a quantile of 1 identify the exporter's files, and show which rotation it used. Scale and shift follow
from rows whose pixels are found by colours. A stretch of rows without a gap has the colours of a stretch of pixels in a
photo. Matches between such stretches are right if they agree on one frame, and wrong otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, replace
from gsmerge.method.geometry.transforms import Similarity, sh0_to_rgb
from gsmerge.method.kernels.matrices import matmul
from gsmerge.reading.alignment.frames import UPRIGHT, ray_directions, solve_frame
from gsmerge.reading.alignment.layouts import TRIMS
from gsmerge.reading.alignment.score import AlignmentInput, Correspondences, pixel_errors, pixel_limit
from gsmerge.types import Cameras

# rows of a stretch, and places in the file at which stretches begin
_LENGTH = 48
_STRETCHES = 96
_SLACK = 8  # pixels by which the range of a search exceeds the possible places on each side
_ROUNDS = 3  # times that the frame is solved for from the stretches that agree with it


@dataclass(frozen=True)
class _Stretch:
    """A stretch of rows, and where in a photo it is searched."""

    view: int
    start: int  # first row
    step: int  # from one row to the next
    # the stretch's first row is searched among the pixels of a photo from index ``low`` to index ``high``
    low: int
    high: int  # exclusive


def upright_rotation(inputs: AlignmentInput) -> Similarity | None:
    """Return the rotation by which rows were turned upright from a camera; None if no camera explains the rows."""
    means = inputs.gaussians.means[inputs.valid].astype(np.float64)
    # a first check of each rotation uses rough_rows rows, and allows deviations up to rough_tolerance
    rough_rows = 2000
    rough_tolerance = 1.0
    sample = means[:: max(1, len(means) // rough_rows)]
    if not len(sample) or _measure_deviation(sample) > rough_tolerance:
        return None
    tolerance = 1e-3  # largest deviation of the median and the quantile
    for view, viewmat in enumerate(inputs.cameras.viewmats):
        rotation = matmul(UPRIGHT, viewmat[:3, :3])
        if (
            _measure_deviation(matmul(sample, rotation)) < rough_tolerance / 2
            and _measure_deviation(matmul(means, rotation)) < tolerance
        ):
            source = "the first camera" if view == 0 else f"camera {view + 1}"
            return Similarity(rotation, 1.0, np.zeros(3), f"rotated upright from {source}")
    return None


def _measure_deviation(points: np.ndarray) -> float:
    """Measure how far points ``[n,3]`` are from a median of 0 and a quantile of 1; return the larger difference."""
    widest_quantile = 0.95  # this quantile of the distances along the widest axis is 1 in these files
    quantile = float(np.quantile(np.abs(points), widest_quantile, axis=0).max())
    return max(float(np.abs(np.median(points, 0)).max()), abs(quantile - 1))


def solve_upright(inputs: AlignmentInput, rotation: Similarity, path: str) -> Similarity:
    """Solve for the frame of upright rows from their colours in the photos.

    Raises SceneError, about the file at ``path``, if too few stretches agree.
    """
    orders = _possible_orders(len(inputs.gaussians), inputs.cameras) if len(inputs.images) else ()
    for pixels, stretches in orders:
        frame = _solve_agreed_frame(inputs, *_match_stretches(inputs, stretches, pixels), rotation)
        if frame is not None:
            return frame
    raise SceneError(
        path,
        "expected cameras in the frame of the Gaussians, found Gaussians that were centred, rescaled and turned upright"
        " by amounts that no file states, and no photos that show where they lie",
        "give the photos that the model saw, or cameras in the frame of the Gaussians",
    )


def _possible_orders(count: int, cameras: Cameras) -> Iterator[tuple[np.ndarray, list[_Stretch]]]:
    """Yield the orders that ``count`` rows may have.

    Each order is a pair: the pixels ``[p]`` of a photo that have rows, and the stretches of rows to search for in them.
    """
    grid = np.arange(cameras.width * cameras.height).reshape(cameras.height, cameras.width)
    views = len(cameras)
    # Rows that are sorted by line, column, layer and view, where some rows are missing. Exporters that write them cut
    # off a border
    trim = TRIMS[0]
    trimmed = grid[trim:-trim, trim:-trim].reshape(-1)
    per_pixel_counts = (1, 2, 3)  # possible numbers of Gaussians of a pixel
    for per_pixel in per_pixel_counts:
        step = views * per_pixel
        dropped = len(trimmed) * step - count
        if 0 <= dropped < count and count >= _LENGTH * step:
            starts = np.unique(np.linspace(0, count - _LENGTH * step, _STRETCHES).astype(int)).tolist()
            yield (
                trimmed,
                [
                    _Stretch(view, start, step, start // step - _SLACK, (start + dropped) // step + _SLACK)
                    for start in starts
                    for view in range(views)
                ],
            )
    # Fused views, in order: the rows of the first view come first, and the rows of the last view last
    num_parts = 3  # stretches of fused views are taken from the first and the last third of the rows
    if num_parts * _LENGTH <= count < views * grid.size:
        starts = np.unique(np.linspace(0, count // num_parts, _STRETCHES).astype(int)).tolist()
        first_view = [_Stretch(0, start, 1, low=start - _SLACK, high=grid.size) for start in starts]
        last_starts = [count - _LENGTH - start for start in starts]  # at the same distances from the last row
        last_view = [
            _Stretch(views - 1, last, 1, low=0, high=last - count + grid.size + _SLACK) for last in last_starts
        ]
        yield grid.reshape(-1), first_view + last_view


def _match_stretches(
    inputs: AlignmentInput, stretches: Sequence[_Stretch], pixels: np.ndarray
) -> tuple[Correspondences, np.ndarray]:
    """Search for stretches in the photos; return sampled rows of stretches that match, and the stretch of each row.

    A stretch matches if only one place in its photo has nearly the colours of its rows. The t sampled rows are returned
    with their pixels. The stretch of a row is its number among the stretches that match.
    """
    rows = np.array([stretch.start + stretch.step * np.arange(_LENGTH) for stretch in stretches])
    with np.errstate(invalid="ignore"):
        colors = np.nan_to_num(sh0_to_rgb(inputs.gaussians.sh0[:, 0])).clip(0, 1).astype(np.float32)
    # The best place of each stretch, the cost at this place, and the least cost elsewhere. A cost is the sum of squared
    # differences of colours. A place is elsewhere if it is more than two pixels from the best place
    found = []
    no_place = 1e9  # cost of a stretch that cannot be in its photo
    for stretch, stretch_rows in zip(stretches, rows, strict=True):
        low = max(0, stretch.low)
        high = min(len(pixels), stretch.high + _LENGTH)
        if high - low < _LENGTH:
            found.append((0, no_place, 0.0))
            continue
        shown = inputs.images[stretch.view].reshape(1, -1, 3)[:, pixels[low:high]]
        place_costs = cv2.matchTemplate(shown, colors[stretch_rows][None], cv2.TM_SQDIFF)[0]
        best = int(place_costs.argmin())
        elsewhere = np.concatenate([place_costs[: max(0, best - 2)], place_costs[best + 3 :]])
        found.append((low + best, float(place_costs[best]), float(elsewhere.min(initial=no_place))))
    places, costs, second_costs = np.array(found).T
    places = places.astype(int)
    # stretches that match
    max_cost = 9.0  # largest cost of a stretch that matches, divided by the lower quartile of all costs
    min_cost = 1e-3  # costs below this count as equal
    is_near = costs <= max_cost * max(min_cost, float(np.quantile(costs, 0.25)))
    min_ratio = 1.2  # least cost of a stretch at its second-best place, divided by the cost at its best place
    matched = np.flatnonzero(is_near & (second_costs > min_ratio * np.maximum(costs, min_cost)))
    per_stretch = 12  # rows of each stretch that the frame is solved from
    sample = np.linspace(0, _LENGTH - 1, per_stretch).astype(int)
    ids = rows[matched][:, sample].reshape(-1)
    matched_pixels = pixels[(places[matched, None] + sample).clip(max=len(pixels) - 1).reshape(-1)]
    y, x = np.divmod(matched_pixels, inputs.cameras.width)
    views = np.array([stretch.view for stretch in stretches])[matched].repeat(per_stretch)
    parts = np.arange(len(matched)).repeat(per_stretch)
    points = inputs.gaussians.means[ids].astype(np.float64)
    valid = inputs.valid[ids]
    return Correspondences(points, np.stack([x, y], 1) + 0.5, views).select(valid), parts[valid]


def _solve_agreed_frame(
    inputs: AlignmentInput, pairs: Correspondences, parts: np.ndarray, rotation: Similarity
) -> Similarity | None:
    """Solve for the scale and shift that most stretches agree on; None if too few stretches agree.

    ``parts [t]`` is the stretch of each pair of a row and a pixel.
    """
    stretches = np.unique(parts)
    views = np.array([pairs.views[parts == stretch][0] for stretch in stretches])
    # at least min_views views need min_stretches stretches that agree, and the share min_agreeing of all stretches must
    # agree
    min_views = 2
    min_stretches = 3
    min_agreeing = 0.25
    if len(np.unique(views)) < min_views:
        return None
    limit, rng = pixel_limit(inputs.cameras.width, inputs.cameras.height), np.random.default_rng(0)

    def solve(some_stretches: np.ndarray) -> Similarity | None:
        """Solve for the frame in which some stretches lie in their pixels."""
        selected = pairs.select(np.isin(parts, some_stretches))
        rays = ray_directions(selected, inputs.cameras)
        return solve_frame(selected.points, rays, rotation.rotation)

    def find_agreeing(frame: Similarity | None, limit: float) -> np.ndarray:
        """Return the stretches whose rows are nearer to their pixels than ``limit`` pixels in a frame."""
        if frame is None:
            return stretches[:0]
        errors = pixel_errors(pairs, frame.move_cameras(inputs.cameras))
        return stretches[[float(np.median(errors[parts == stretch])) < limit for stretch in stretches]]

    best = stretches[:0]
    num_pairs = 200  # pairs of stretches from which a frame is tried
    max_multiple = 3.0  # a stretch agrees with a tried frame if its error is below this multiple of the limit
    for _ in range(num_pairs):
        first = rng.choice(len(stretches))
        second = rng.choice(np.flatnonzero(views != views[first]))
        best = max(best, find_agreeing(solve(stretches[[first, second]]), max_multiple * limit), key=len)
    frame = None
    for _ in range(_ROUNDS):
        frame = solve(best) if len(best) else None
        best = find_agreeing(frame, limit)
    counts = np.bincount(views[np.isin(stretches, best)], minlength=1)
    if frame is None or (counts >= min_stretches).sum() < min_views or len(best) < min_agreeing * len(stretches):
        return None
    text = f"{rotation.description}, positions scaled by {frame.scale:.4g} and shifted"
    return replace(frame, description=text)
