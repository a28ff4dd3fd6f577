"""Judge from the size of the scene whether stored scales are logarithms, as in most files, or linear."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry.transforms import median, quantiles
from gsmerge.io.formats import rows as arrays
from gsmerge.kernels.elementary import log
from gsmerge.runtime.memory import gather
from gsmerge.settings.reading import ScaleChoice

MIN_JUDGED = 100  # least number of Gaussians for a judgement
LINEAR_NOTE = "scales are read as linear, since {}; if they are logarithms, use --hint scales=log"
SAMPLES = 20_000  # Gaussians whose scales and colours are judged


def are_scales_linear(
    path: Path, part: arrays.StoredRows, out: dict[str, np.ndarray], choice: ScaleChoice
) -> tuple[bool, str]:
    """Decide whether the stored scales of a file are linear; ``out`` has scales that were read as logarithms.

    Only the scales of a PLY file may be linear. Scales in a file of gsmerge are logarithms, unless the caller says
    otherwise. ``part``: the rows of the first file. Also return a clause that says why scales are linear, or why
    logarithms seem wrong; "" if there is nothing to say.
    """
    is_linear, why = _judge_scales(out)
    if isinstance(part.rows, arrays.PackedRows) or (choice == "auto" and part.encoding is not None):
        return False, "" if is_linear else why
    if choice == "linear":
        with np.errstate(all="ignore"):
            # ``out`` has the exponential of each stored number, which is below 1 if the number is negative
            negative = 100 * float(np.count_nonzero(out["scales"][out["valid"]] < 1)) / max(1, 3 * out["valid"].sum())
        if negative > 100 * arrays.MAX_STRAY:
            problem = f"expected scales of at least 0, as --hint scales=linear says, found {negative:.3g} % below"
            raise SceneError(path, f"{problem}, like logarithms", "leave out --hint scales=linear")
    if choice != "auto":
        return choice == "linear", ""
    columns = arrays.color_columns(part.rows.dtype.names)
    if columns == arrays.PLAIN_COLORS[1] and not arrays.are_logarithms(log(out["scales"][:, 0])):
        return True, "the columns are r, g and b and hardly any scale is negative"
    return is_linear, why


def _judge_scales(out: dict[str, np.ndarray]) -> tuple[bool, str]:
    """Judge whether the scales of a file are linear, from ``scales [n,3]``, ``means [n,3]`` and ``valid [n]``.

    ``scales`` are the scales that result if the stored numbers are read as logarithms. The stored numbers are judged
    linear if, as logarithms, they give Gaussians too large for the scene, but as sizes fit the scene. In addition, with
    scales as logarithms, either all Gaussians must be about equally large, or half of them must be larger than a
    quarter of the scene's width. The result is that of :func:`are_scales_linear`.
    """
    valid = out["valid"]
    rows = range(len(valid)) if valid.all() else np.flatnonzero(valid)
    if len(rows) < MIN_JUDGED:
        return False, ""
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
        # Large sizes are at least 1.5 times the small sizes, so the logarithms of sizes differ by more than 0.4. Stored
        # sizes are small numbers, and differ by much less. Read as logarithms, they would stand for sizes that are all
        # close to 1
        min_variation, min_ratio = 0.4, 4.0
        small, large = (float(value) for value in quantiles(stored.max(1).astype(np.float64), (0.1, 0.9)))
        if is_vast or (small > 0 and float(log(large / small)) > max(min_variation, min_ratio * (large - small))):
            signs = f"they are hardly ever negative (median {median_stored:.3g})"
            return True, f"{signs}, and as logarithms {too_large}"
        advice = "if they are linear, use --hint scales=linear"
        return False, f"scales, which are read as logarithms, seem too large: {too_large}; {advice}"
    problem = f"scales, which are stored as logarithms, seem too large: {too_large}"
    return False, problem if is_vast else ""


def with_linear_scales(part: arrays.StoredRows) -> arrays.StoredRows:
    """Return rows whose linear scales become logarithms when a block of rows is read; negative scales become NaN."""

    def adapt(rows: np.ndarray) -> np.ndarray:
        """Return a copy of a block of rows with logarithms as scales."""
        out: Any = rows.copy()
        with np.errstate(all="ignore"):
            for name in arrays.SCALES:
                if name in (rows.dtype.names or ()):
                    out[name] = log(rows[name].astype(np.float64))
        return np.asarray(out if part.adapt is None else part.adapt(out))

    return replace(part, adapt=adapt)
