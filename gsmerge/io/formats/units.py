"""Judge in which units a file stores its scales and colours.

The size of the scene shows whether scales are logarithms, as in most files, or linear. The values in the columns
``f_dc_*`` show whether they are harmonics, as in most files, or RGB.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, replace
from gsmerge.io.formats import ply
from gsmerge.io.formats import rows as arrays
from gsmerge.method.geometry.transforms import median, quantiles
from gsmerge.method.kernels.elementary import log
from gsmerge.runtime.memory import gather
from gsmerge.settings.reading import ColorChoice, ScaleChoice

_MIN_JUDGED = 100  # least number of Gaussians for a judgement
LINEAR_NOTE = "scales are read as linear, since {}; if they are logarithms, use --hint scales=log"
_SAMPLES = 20_000  # Gaussians whose scales and colours are judged
RGB_NOTE = "f_dc_0 to f_dc_2 are read as {}, since {}; if they are harmonics, use --hint colors=sh"
_SAME_COLOR = 1.5 / 255  # largest difference of a float and a byte of the same colour, in shares of white


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
    if len(rows) < _MIN_JUDGED:
        return False, ""
    sample = np.asarray(rows[:: max(1, len(rows) // _SAMPLES)])
    points = gather(out["means"], sample).astype(np.float64)
    sizes = gather(out["scales"], sample)
    low, high = quantiles(points, (0.05, 0.95))
    width = float((high - low).max())
    median_size = median(sizes.max(1))
    too_large = (
        f"half of the Gaussians have a standard deviation above {median_size:.3g} in a scene of width {width:.3g}"
    )
    spacing = width / float(np.sqrt(len(rows)))
    stored = log(sizes)
    max_width = 0.25  # scales are wrong if half of the standard deviations exceed this share of the scene's width
    median_stored = float(log(median_size))
    is_vast = median_size > max_width * width
    # Bounds on the median standard deviation, in units of ``spacing``, which is the width of the scene divided by the
    # square root of the number of Gaussians. This median is 0.3 to 2 units in undamaged files, and 10 to 1,000 units if
    # linear scales are read as logarithms
    min_spacings = 0.01
    max_spacings = 6.0
    fits_as_stored = min_spacings * spacing <= median_stored <= max_spacings * spacing < median_size
    if fits_as_stored and not arrays.are_logarithms(stored):
        # Large sizes are at least 1.5 times the small sizes, so the logarithms of sizes differ by more than 0.4. Stored
        # sizes are small numbers, and differ by much less. Read as logarithms, they would stand for sizes that are all
        # close to 1
        min_variation = 0.4
        min_ratio = 4.0
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


@dataclass(frozen=True)
class ColorUnits:
    """Units of RGB in the columns ``f_dc_*``: the numbers that stand for black and for white."""

    black: float
    white: float
    name: str  # in notes

    def rgb(self, stored: np.ndarray) -> np.ndarray:
        """Return stored values as RGB in [0, 1]."""
        return (stored - np.float32(self.black)) / np.float32(self.white - self.black)


_UNITS = (
    ColorUnits(0, 1, "RGB in [0, 1]"),
    ColorUnits(-0.5, 0.5, "RGB less a half"),
    ColorUnits(0, 255, "RGB in [0, 255]"),
)


def choose_colors(
    part: arrays.StoredRows, out: dict[str, np.ndarray], choice: ColorChoice
) -> tuple[ColorUnits | None, str, ColorUnits | None]:
    """Choose the units of stored colours: those of RGB, or None for harmonics of degree 0.

    Also return a note if the units are guessed. The third result is units of RGB to choose if photos confirm them. Only
    a PLY file may have RGB. Colours in a file of gsmerge are harmonics, unless the caller says otherwise. ``part``: the
    rows of the first file.

    Many harmonics are far below zero, since they stand for colours darker than grey. No value of RGB is below black or
    above white.
    """
    names = part.rows.dtype.names or ()
    is_stated = choice == "sh" or (choice == "auto" and part.encoding is not None)
    if is_stated or isinstance(part.rows, arrays.PackedRows) or arrays.color_columns(names) != arrays.SH0:
        return None, "", None
    rows = np.flatnonzero(out["valid"])
    rows = rows[:: max(1, len(rows) // _SAMPLES)]
    stored = out["sh0"][rows, 0]
    part_rows = rows[rows < len(part.rows)]
    if choice == "rgb":
        return next((units for units in _UNITS if arrays.lie_in_unit_range(units.rgb(stored))), _UNITS[0]), "", None
    plain = None  # colours of the columns red, green and blue, if the file has these, too
    if all(name in names and part.rows.dtype[name] == np.uint8 for name in arrays.PLAIN_COLORS[0]):
        columns = ply.read_columns(part.rows, arrays.PLAIN_COLORS[0])[part_rows]
        plain = np.stack([columns[name] for name in arrays.PLAIN_COLORS[0]], 1) / np.float32(255)
    # RGB colours of a scene cover more than this part of the range from black to white. Harmonics lie in the range only
    # in scenes with little contrast, and cover a smaller part
    min_spread = 0.5
    few = arrays.MAX_STRAY
    for units in _UNITS if len(part_rows) >= _MIN_JUDGED else ():
        rgb = units.rgb(stored[: len(part_rows)])
        if plain is not None and (np.abs(rgb - plain) <= _SAME_COLOR).mean() > 1 - few:
            return units, RGB_NOTE.format(units.name, "the columns red, green and blue are the same"), units
        if arrays.lie_in_unit_range(rgb) and np.ptp(np.quantile(rgb, (few, 1 - few))) > min_spread:
            reason = f"all lie in [{units.black:g}, {units.white:g}]"
            return units, RGB_NOTE.format(units.name, reason), units
    inside_by_units = ((units, np.abs(units.rgb(stored) - 0.5) <= 0.5) for units in _UNITS)
    return None, "", next((units for units, is_inside in inside_by_units if is_inside.mean() > 1 - few), None)
