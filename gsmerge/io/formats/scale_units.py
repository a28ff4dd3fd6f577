"""Judge from the size of the scene whether stored scales are logarithms, as in most files, or linear."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gsmerge.geometry.transforms import median, quantiles
from gsmerge.io.formats import arrays
from gsmerge.kernels.elementary import log
from gsmerge.runtime.memory import gather

MIN_JUDGED = 100  # least number of Gaussians for a judgement
LINEAR_NOTE = "scales are read as linear, since {}; if they are logarithms, use --hint scales=log"
SAMPLES = 20_000  # Gaussians whose scales and colours are judged


@dataclass(frozen=True)
class ScaleJudgement:
    """Whether the stored scales of a file are more likely linear or logarithms."""

    linear: bool  # False: logarithms
    why: str  # clause that says why scales are linear, or why logarithms seem wrong; "": nothing to say


def judge_scales(out: dict[str, np.ndarray]) -> ScaleJudgement:
    """Judge whether the scales of a file are linear, from ``scales [n,3]``, ``means [n,3]`` and ``valid [n]``.

    ``scales`` are the scales that result if the stored numbers are read as logarithms. The stored numbers are judged
    linear if, as logarithms, they give Gaussians too large for the scene, but as sizes fit the scene. In addition, with
    scales as logarithms, either all Gaussians must be about equally large, or half of them must be larger than a
    quarter of the scene's width.
    """
    valid = out["valid"]
    rows = range(len(valid)) if valid.all() else np.flatnonzero(valid)
    if len(rows) < MIN_JUDGED:
        return ScaleJudgement(linear=False, why="")
    sample = np.asarray(rows[:: max(1, len(rows) // SAMPLES)])
    points, sizes = gather(out["means"], sample).astype(np.float64), gather(out["scales"], sample)
    low, high = quantiles(points, (0.05, 0.95))
    width, median_size = float((high - low).max()), median(sizes.max(1))
    too_large = (
        f"half of the Gaussians have a standard deviation above {median_size:.3g} in a scene of width {width:.3g}"
    )
    spacing, stored = width / float(np.sqrt(len(rows))), log(sizes)
    max_width = 0.25  # scales are wrong if half of the standard deviations exceed this share of the scene's width
    median_stored, is_vast = float(log(median_size)), median_size > max_width * width
    # Bounds on the median standard deviation, in units of ``spacing``, which is the width of the scene divided by the
    # square root of the number of Gaussians. This median is 0.3 to 2 units in undamaged files, and 10 to 1,000 units if
    # linear scales are read as logarithms
    min_spacings, max_spacings = 0.01, 6.0
    fits_as_stored = min_spacings * spacing <= median_stored <= max_spacings * spacing < median_size
    if fits_as_stored and not arrays.are_logarithms(stored):
        if is_vast or _vary_little_as_logs(stored.max(1)):
            signs = f"they are hardly ever negative (median {median_stored:.3g})"
            return ScaleJudgement(linear=True, why=f"{signs}, and as logarithms {too_large}")
        advice = "if they are linear, use --hint scales=linear"
        return ScaleJudgement(False, f"scales, which are read as logarithms, seem too large: {too_large}; {advice}")
    problem = f"scales, which are stored as logarithms, seem too large: {too_large}"
    return ScaleJudgement(linear=False, why=problem if is_vast else "")


def _vary_little_as_logs(stored: np.ndarray) -> bool:
    """Return whether numbers ``stored [s]`` vary much as sizes, but hardly vary if they are logarithms of sizes."""
    low, high = (float(value) for value in quantiles(stored.astype(np.float64), (0.1, 0.9)))
    # Large sizes are at least 1.5 times the small sizes, so the logarithms of sizes differ by more than 0.4. Stored
    # sizes are small numbers, and differ by much less. Read as logarithms, they would stand for sizes that are all
    # close to 1
    min_variation, min_ratio = 0.4, 4.0
    return low > 0 and float(log(high / low)) > max(min_variation, min_ratio * (high - low))


def log_of_scales(rows: np.ndarray) -> np.ndarray:
    """Return a copy of a block of rows in which linear scales become logarithms; negative scales become NaN."""
    out: Any = rows.copy()
    with np.errstate(all="ignore"):
        for name in arrays.SCALES:
            if name in (rows.dtype.names or ()):
                out[name] = log(rows[name].astype(np.float64))
    return np.asarray(out)
