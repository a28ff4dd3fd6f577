"""Find the grid of a file's rows from the rows alone: the period of its lines, and where views begin.

Steps between neighbouring pixels are similar in neighbouring lines, so the steps between rows repeat after one line.
This gives the length of a line. Lines belong to one view as long as one projective camera shows them in their pixels,
of any pose and focal length.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from gsmerge.alignment.calibration import Calibration, calibrate
from gsmerge.alignment.layouts import PER_PIXEL, Layout, full_layouts, some_views
from gsmerge.alignment.resection import MIN_POINTS, projective_error
from gsmerge.alignment.score import find_correspondences, is_as_near, pixel_limit
from gsmerge.types import Gaussians

_MIN_SIDE = 16  # pixels of a grid
_MAX_FASTEST = 512  # most rows from one pixel to the next, if the views and layers of a pixel follow each other
_STEPS = 2000  # steps that are measured for each distance in rows
_AS_SHORT = 1.5  # median length of steps between neighbouring pixels, at most this multiple of the shortest median
_SEGMENT, _SEGMENTS = 1 << 17, 8  # rows of a part of the file whose steps are correlated, and number of parts
_MAX_STEP = 8.0  # times the median; longer steps, at the edges of things, are clipped
_MIN_PEAK = 8.0  # times the median correlation of steps; a period has a higher peak
_SHARE = 0.25  # of the highest peak; periods of lines may have lower peaks than periods of views
_MAX_PERIODS = 6  # number of periods that are tried
_SAMPLE_GAUSSIANS = 200  # Gaussians of a view from which a projective camera is solved
_MIN_GAUSSIANS, _MAX_GAUSSIANS = 60, 10_000  # Gaussians for a calibration: at least per view, and at most in all views
_PLACES = tuple(number * 0.6180339887498949 % 1 for number in range(9))  # of the sampled views, as shares of the file
_RECURRENCE = 0.7548776662466927, 0.5698402909980532  # powers of the inverse of the plastic number

_GREEN = 1  # colour channel whose steps are measured

_Size = tuple[int, int, int]  # rows from pixel to pixel, pixels of a line, lines of a view


def find_grid(gaussians: Gaussians, valid: np.ndarray) -> tuple[Layout, Calibration] | None:
    """Find the grid whose pixels are the rows, and the cameras of its views; None if the rows form no grid.

    ``valid [n]`` bool. Pixels that an exporter trimmed are not part of the grid.
    """
    rounds = (_calibrate_layouts(gaussians.means, valid, layouts) for layouts in _shown_layouts(gaussians, valid))
    fits = next(filter(None, rounds), [])
    nearest = min((calibration.worst_px for _, calibration in fits), default=0.0)
    nearest_fits = [fit for fit in fits if is_as_near(fit[1].worst_px, nearest)]
    return min(nearest_fits, key=lambda fit: len(set(fit[0].views)), default=None)


def find_layouts(gaussians: Gaussians, valid: np.ndarray) -> list[Layout]:
    """Find the layouts of the grid whose pixels are the rows; the order of views and layers may remain ambiguous."""
    return next(filter(None, map(list, _shown_layouts(gaussians, valid))), [])


def _shown_layouts(gaussians: Gaussians, valid: np.ndarray) -> Iterator[Iterator[Layout]]:
    """Yield the layouts in which projective cameras show the rows in their pixels: line by line, then by columns."""
    size = _find_size(gaussians, valid)
    if size is None:
        return
    _, width, height = size
    for layouts in (_layouts(len(valid), width, height, False), _layouts(len(valid), height, width, True)):
        yield (layout for layout in layouts if _shows_pixels(gaussians.means, valid, layout))


def _calibrate_layouts(
    means: np.ndarray, valid: np.ndarray, layouts: Iterable[Layout]
) -> list[tuple[Layout, Calibration]]:
    """Calibrate the cameras of each layout; leave out layouts that fit no cameras."""
    fits = []
    for layout in layouts:
        samples = max(_MIN_GAUSSIANS, min(_MAX_GAUSSIANS // len(layout.views), _MAX_GAUSSIANS // 10))
        pairs = find_correspondences(means, valid, _thin(layout, samples))
        calibration = calibrate(pairs, layout.width, layout.height)
        fits += [] if calibration is None else [(layout, calibration)]
    return fits


def _shows_pixels(means: np.ndarray, valid: np.ndarray, layout: Layout) -> bool:
    """Return True if projective cameras show the rows of the first, the middle and the last view in their pixels."""
    for view in some_views(layout):
        pairs = find_correspondences(means, valid, _thin(layout.select(view), _SAMPLE_GAUSSIANS))
        if not projective_error(pairs.points, pairs.pixels) <= pixel_limit(layout.width, layout.height):
            return False
    return True


def _thin(layout: Layout, samples: int) -> Layout:
    """Thin a layout of all pixels to about ``samples`` pixels of each part."""
    pixels = _spread(samples, layout.width, layout.height)
    rows = tuple(part_rows.flat[pixels] for part_rows in layout.rows)
    return replace(layout, rows=rows, pixels=(pixels,) * len(rows))


def _spread(count: int, width: int, height: int) -> np.ndarray:
    """Choose about ``count`` pixels ``y·W + x`` evenly, by the additive recurrence of the plastic number."""
    shares = (np.arange(1, count + 1)[:, None] * _RECURRENCE) % 1  # of the width and the height
    x, y = (shares * (width, height)).astype(np.int64).T
    return np.unique(y * width + x)


def _layouts(count: int, width: int, height: int, by_column: bool) -> Iterator[Layout]:
    """Yield the layouts of ``count`` rows as all pixels of views of one size, line by line or ``by_column``."""
    num_parts = count // (width * height)
    for per_pixel in PER_PIXEL:
        if num_parts % per_pixel == 0:
            layouts = full_layouts(num_parts // per_pixel, per_pixel, width, height)
            yield from (layout for layout in layouts if by_column == (layout.order == "column-major"))


def _find_size(gaussians: Gaussians, valid: np.ndarray) -> _Size | None:
    """Find the size of the grid; None if the rows have no period, or no camera shows them in their pixels."""
    fastest, periods = _find_periods(gaussians, valid)
    sizes: list[tuple[float, _Size]] = []
    for period in periods:
        for step in sorted({*PER_PIXEL, *(fastest * layers for layers in PER_PIXEL)}):
            width, remainder = divmod(period, step)
            if remainder == 0 and width >= _MIN_SIDE:
                sizes += _find_height(gaussians.means, valid, step, width)
        if sizes:
            break
    return min(sizes, default=(0, None))[1]


def _find_height(means: np.ndarray, valid: np.ndarray, step: int, width: int) -> list[tuple[float, _Size]]:
    """Find the largest height of views so that a projective camera shows each sampled view in its pixels.

    Returns at most one size, with a score that is lower for better sizes. The score is the largest error times
    ``step``. The factor keeps a grid of every other pixel from winning, whose errors are smaller in its wider pixels.
    """
    lines = len(means) // (step * width)
    for views in _divisors(lines):
        height = lines // views
        if height < _MIN_SIDE:
            break
        limit, errors = pixel_limit(width, height), []
        for view, layer in dict.fromkeys((int(share * views), int(share * step)) for share in _PLACES):
            pixels = _spread(_SAMPLE_GAUSSIANS, width, height)
            rows = (view * width * height + pixels) * step + layer
            rows, pixels = rows[valid[rows]], pixels[valid[rows]]
            if len(rows) >= MIN_POINTS:
                y, x = np.divmod(pixels, width)
                errors.append(projective_error(means[rows].astype(np.float64), np.stack([x, y], 1) + 0.5))
                if not errors[-1] <= limit:
                    break
        if errors and errors[-1] <= limit:
            return [(step * max(errors), (step, width, height))]
    return []


def _divisors(number: int) -> list[int]:
    small = [divisor for divisor in range(1, int(number**0.5) + 1) if number % divisor == 0]
    return sorted({*small, *(number // divisor for divisor in small)})


def _find_periods(gaussians: Gaussians, valid: np.ndarray) -> tuple[int, list[int]]:
    """Find the step in rows between neighbouring pixels, and the periods of steps, which divide the number of rows."""
    count = len(gaussians)
    longest = min(_MAX_FASTEST, count // _MIN_SIDE**2)
    if longest < 1:
        return 1, []
    fastest = _find_pixel_step(gaussians.means, valid, longest)
    correlation = _correlate_steps(gaussians, fastest)
    peaks = np.zeros(len(correlation))
    neighbours = (correlation[: -2 * fastest] + correlation[2 * fastest :]) / 2
    peaks[fastest:-fastest] = correlation[fastest:-fastest] - neighbours
    likely = [lag for lag in _divisors(count) if _MIN_SIDE <= lag < len(peaks)]
    lowest = _MIN_PEAK * float(np.median(np.abs(peaks)))
    lowest = max([lowest, *(_SHARE * peaks[lag] for lag in likely)])
    return fastest, [lag for lag in likely if peaks[lag] >= lowest > 0][:_MAX_PERIODS]


def _find_pixel_step(means: np.ndarray, valid: np.ndarray, longest: int) -> int:
    """Find the step in rows, up to ``longest``, between neighbouring pixels: the first with short distances."""
    lags = np.arange(1, longest + 1)
    starts = np.linspace(0, len(means) - longest - 1, _STEPS).astype(int)
    starts = starts[valid[starts]]
    ends = starts + lags[:, None]
    right, down, ahead = (np.abs(values[ends].astype(np.float64) - values[starts]) for values in means.T)
    steps = right + down + ahead
    lengths = np.median(steps, 1) if np.isfinite(steps).all() else np.array(list(map(_median, steps)))
    return int(lags[np.argmax(lengths <= _AS_SHORT * lengths.min())])


def _correlate_steps(gaussians: Gaussians, fastest: int) -> np.ndarray:
    """Correlate the steps between neighbouring pixels, ``fastest`` rows apart, by their distance in rows.

    Steps of positions and of a colour are measured in segments of the file. Returns the correlation at distances from 0
    to half a segment.
    """
    means, count = gaussians.means, len(gaussians)
    segment = 1 << min(_SEGMENT, count - fastest).bit_length() - 1
    starts = np.linspace(0, count - fastest - segment, min(_SEGMENTS, -(-count // segment))).astype(int)
    power = np.zeros(segment + 1)
    for start in starts:
        for values in (*means.T, gaussians.sh0[:, 0, _GREEN]):
            power += _power(values[start : start + segment + fastest], fastest)
    correlation = np.fft.irfft(power)[:segment] / np.arange(segment, 0, -1)
    return correlation[: segment // 2 + fastest]


def _power(values: np.ndarray, lag: int) -> np.ndarray:
    """Compute the normalised power spectrum of differences over ``lag`` rows; ``values [n]`` may be NaN."""
    values = values.astype(np.float64)
    with np.errstate(invalid="ignore"):
        steps = np.nan_to_num(values[lag:] - values[:-lag], posinf=0.0, neginf=0.0)
    longest = _MAX_STEP * _median(np.abs(steps))
    steps = steps.clip(-longest, longest)
    spectrum = np.fft.rfft(steps - steps.mean(), 2 * len(steps))
    power = spectrum.real**2 + spectrum.imag**2
    return np.asarray(power / max(power.sum(), np.finfo(float).tiny))


def _median(values: np.ndarray) -> float:
    """Return the median of the finite values; 0 if there is none."""
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else 0.0
