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
    """The more likely meaning of stored scales."""

    linear: bool  # False: logarithms
    why: str  # clause that says why scales are linear, or why logarithms seem wrong; "": nothing to say


def judge_scales(out: dict[str, np.ndarray]) -> ScaleJudgement:
    """Judge ``scales [n,3]`` that were read as logarithms, by ``means [n,3]`` and ``valid [n]``.

    Scales are linear if they would be too large for the scene as logarithms, but not as they are stored, and if one of
    two signs confirms it: as logarithms all Gaussians would be about equally large, or half of them nearly as large as
    the scene.
    """
    valid = out["valid"]
    rows = range(len(valid)) if valid.all() else np.flatnonzero(valid)
    if len(rows) < MIN_JUDGED:
        return ScaleJudgement(False, "")
    sample = np.asarray(rows[:: max(1, len(rows) // SAMPLES)])
    points, sizes = gather(out["means"], sample).astype(np.float64), gather(out["scales"], sample)
    low, high = quantiles(points, (0.05, 0.95))
    width, size = float((high - low).max()), median(sizes.max(1))
    text = f"half of the Gaussians have a standard deviation above {size:.3g} in a scene of width {width:.3g}"
    spacing, stored = width / float(np.sqrt(len(rows))), log(sizes)
    max_width = 0.25  # scales are wrong if half of the standard deviations exceed this share of the scene's width
    typical, is_vast = float(log(size)), size > max_width * width
    # Bounds on the median standard deviation, in units of the scene's width divided by the square root of the number of
    # Gaussians. In sound files it is 0.3 to 2. Where linear scales are read as logarithms, it is 10 to 1,000.
    min_spacings, max_spacings = 0.01, 6.0
    is_likely = min_spacings * spacing <= typical <= max_spacings * spacing < size
    if is_likely and not arrays.are_logarithms(stored):
        if is_vast or _vary_little_as_logs(stored.max(1)):
            signs = f"they are hardly ever negative (median {typical:.3g})"
            return ScaleJudgement(True, f"{signs}, and as logarithms {text}")
        advice = "if they are linear, use --hint scales=linear"
        return ScaleJudgement(False, f"scales, which are read as logarithms, seem too large: {text}; {advice}")
    return ScaleJudgement(False, f"scales, which are stored as logarithms, seem too large: {text}" if is_vast else "")


def _vary_little_as_logs(stored: np.ndarray) -> bool:
    """Return whether numbers ``stored [s]`` are positive, and vary much as sizes, but hardly as logarithms of sizes."""
    low, high = (float(value) for value in quantiles(stored.astype(np.float64), (0.1, 0.9)))
    # The natural logarithm of large sizes divided by small ones is at least the first number, and at least the second
    # number times the difference of the stored values. Sizes in a file vary by 1.5:1 and more. Linear scales that are
    # read as logarithms are all close to 1
    min_variation, min_slope = 0.4, 4.0
    return low > 0 and float(log(high / low)) > max(min_variation, min_slope * (high - low))


def log_of_scales(rows: np.ndarray) -> np.ndarray:
    """Return a copy of a block of rows with logarithms of its linear scales; negative scales become NaN."""
    out: Any = rows.copy()
    with np.errstate(all="ignore"):
        for name in arrays.SCALES:
            if name in (rows.dtype.names or ()):
                out[name] = log(rows[name].astype(np.float64))
    return np.asarray(out)
