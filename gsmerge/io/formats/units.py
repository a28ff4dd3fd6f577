"""Judge in which units a file stores its scales, opacities and colours, whatever its format is.

The values show it: the size of the scene, whether scales are logarithms, as in most files, or linear; the range of
opacities, whether they are logits; and the columns ``f_dc_*``, whether they hold harmonics, as in most files, or RGB. A
format's own rule holds, unless values contradict it. Hints of the caller go before all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, replace
from gsmerge.io.formats import rows as arrays
from gsmerge.method.geometry.transforms import median, quantiles, sh0_to_rgb
from gsmerge.method.kernels.elementary import exp, log
from gsmerge.runtime.memory import gather
from gsmerge.settings.reading import ColorChoice, OpacityChoice, ScaleChoice

MAX_LOGIT = 16.0  # from 16.6 on, the sigmoid rounds to 1 in float32, and the logit of 1 is infinite
_MIN_JUDGED = 100  # least number of Gaussians for a judgement
_LINEAR_NOTE = "scales are read as linear, since {}; if they are logarithms, use --hint scales=log"
_LOG_NOTE = "scales are read as logarithms, since {:.3g} % are below 0, which no size is"
_RAW_NOTE = "opacities lie in [0, 1] and are read as such; if they are logits, use --hint opacity=logit"
_LOGIT_NOTE = "opacities are read as logits, since they lie beyond [0, 1]; if they are not, export them as opacities"
_NARROW_NOTE = (
    "opacities lie in [-1, 1] with both signs and are read as logits, so that all are half transparent; --hint"
    " opacity=logit says that this is right, else export them as logits"
)
_SAMPLES = 20_000  # Gaussians whose scales and colours are judged
RGB_NOTE = "f_dc_0 to f_dc_2 are read as {}, since {}; if they are harmonics, use --hint colors=sh"
_SAME_COLOR = 1.5 / 255  # largest difference of a float and a byte of the same colour, in shares of white
_UNIT_ROUNDING = 0.01  # rounding to half floats may move values this far outside [0, 1]


def lie_in_unit_range(values: np.ndarray) -> bool:
    """Return whether stored values are opacities or colours in [0, 1], rather than logits or harmonics.

    Rounding and damage may put a few opacities or colours outside of [0, 1]. Of logits and harmonics, about as many lie
    just outside of this range as just inside. Therefore the function returns True if hardly any value lies outside of
    it, and fewer lie outside than just inside.
    """
    excess = np.abs(values[np.isfinite(values)] - 0.5) - 0.5  # distance outside [0, 1]; negative inside
    num_outside = int(np.count_nonzero(excess > 0))
    num_close = int(np.count_nonzero((excess <= 0) & (excess > -_UNIT_ROUNDING)))
    are_few = num_outside < num_close and num_outside < arrays.MAX_STRAY * len(excess)
    return bool(len(excess)) and (are_few or num_outside == 0)


def are_bytes(colors: np.ndarray) -> bool:
    """Return whether the float colours of a column lie in 0 to 255 rather than in [0, 1]."""
    return bool(np.nanmedian(colors) > 1)


def choose_opacities(
    paths: Sequence[Path], parts: Sequence[arrays.StoredRows], opacities: np.ndarray, choice: OpacityChoice
) -> tuple[str, bool, str]:
    """Choose how opacities are stored: "logit" or "raw". Also return whether that is a guess, and a note on it.

    ``opacities``: as stored, NaN for rows that only pad the file. Raise SceneError if the values contradict the
    caller's choice "raw", or if the files have different encodings.
    """
    path = paths[0]
    is_open = parts[0].is_open
    if isinstance(parts[0].rows, arrays.PackedRows) and not is_open:
        choice = "auto"  # other packed formats hold no logits
    finite = opacities[np.isfinite(opacities)]
    few = arrays.MAX_STRAY * len(finite)
    if choice == "raw":
        num_outside = np.count_nonzero(np.abs(finite - 0.5) > 0.5 + _UNIT_ROUNDING)
        if num_outside > few:
            found = f"found {100 * num_outside / len(finite):.3g} % outside, like logits"
            problem = f"expected opacities in [0, 1], as --hint opacity=raw says, {found}"
            raise SceneError(path, problem, "leave out --hint opacity=raw")
    if choice != "auto":
        return choice, False, ""
    # A file that declares no encoding, but has at least 100 values, is compared with the others by a guess
    # encoding -> name of the first part that has it
    start = 0
    part_names = dict[str, str]()
    for part_path, part in zip(paths, parts, strict=True):
        values = opacities[start : start + len(part.rows)]
        start += len(values)
        encoding = part.encoding
        if encoding is None and len(parts) > 1 and np.isfinite(values).sum() >= _MIN_JUDGED:
            encoding = "raw" if lie_in_unit_range(values) else "logit"
        if encoding is not None:
            part_names.setdefault(encoding, part_path.name)
        if len(part_names) > 1:
            (other, name), _ = part_names.items()
            problem = f"expected {other} opacities as in {name}, found {encoding} opacities"
            remedy = "export all parts alike; if all are logits, use --hint opacity=logit"
            raise SceneError(part_path, problem, remedy)
    declared = next((part.encoding for part in parts if part.encoding is not None), None)
    if declared is not None and not is_open:
        return declared, False, ""
    if len(finite) and finite.min() >= 0 and finite.max() <= 255:
        num_high = np.count_nonzero(finite > MAX_LOGIT)
        if num_high > few:
            found = f"found 0 to 255: {100 * num_high / len(finite):.3g} % are above any logit"
            problem = f"expected opacities as logits or in [0, 1], {found}"
            raise SceneError(path, problem, "divide them by 255, or for logits use --hint opacity=logit")
    if lie_in_unit_range(finite):
        return "raw", not is_open, "" if is_open else _RAW_NOTE
    is_narrow = len(finite) >= _MIN_JUDGED and np.count_nonzero(np.abs(finite) > 1) <= few
    if is_narrow and np.count_nonzero(finite < 0) > few:
        return "logit", True, _NARROW_NOTE
    return "logit", True, _LOGIT_NOTE if is_open else ""


def choose_scales(
    path: Path, part: arrays.StoredRows, out: dict[str, np.ndarray], choice: ScaleChoice
) -> tuple[Callable[[arrays.StoredRows], arrays.StoredRows] | None, str, str]:
    """Choose the units of stored scales, from ``out``, whose scales were read as the format says.

    Of a PLY file, scales may be linear in place of logarithms; of a format of linear floats, such as ``.glb``,
    logarithms. Scales in a file of gsmerge are as the format says, unless the caller says otherwise. ``part``: the rows
    of the first file. Return a function that makes the rows to read instead, or None; a note on a guess; and a clause
    that says why scales seem wrong, "" if they do not. Raise SceneError if negative scales contradict the caller.
    """
    is_packed = isinstance(part.rows, arrays.PackedRows)
    unpack_logs = part.rows.parts[0].unpack_logs if isinstance(part.rows, arrays.PackedRows) else None
    negative = 0.0  # percent of stored scales
    if unpack_logs is not None and not out["valid"].all():
        negative = _negative_percent(unpack_logs(slice(0, _SAMPLES)).log_scales)
    elif choice == "linear" and not is_packed:
        with np.errstate(all="ignore"):
            negative = _negative_percent(log(out["scales"][out["valid"]]))
    if choice == "linear" and negative > 100 * arrays.MAX_STRAY:
        problem = f"expected scales of at least 0, as --hint scales=linear says, found {negative:.3g} % below"
        raise SceneError(path, f"{problem}, like logarithms", "leave out --hint scales=linear")
    if unpack_logs is not None and (choice == "log" or negative > 100 * arrays.MAX_STRAY):
        return _with_log_scales, "" if choice == "log" else _LOG_NOTE.format(negative), ""
    if choice != "auto" and (unpack_logs is not None or not is_packed):
        return with_linear_scales if choice == "linear" and not is_packed else None, "", ""
    is_linear, why = _judge_scales(out)
    if is_packed or part.encoding is not None:
        return None, "", "" if is_linear else why
    columns = arrays.color_columns(part.rows.dtype.names)
    if columns == arrays.PLAIN_COLORS[1] and _negative_percent(log(out["scales"][:, 0])) <= 100 * arrays.MAX_STRAY:
        is_linear, why = True, "the columns are r, g and b and hardly any scale is negative"
    return (with_linear_scales, _LINEAR_NOTE.format(why), "") if is_linear else (None, "", why)


def _negative_percent(scales: np.ndarray) -> float:
    """Return how many percent of stored scales are negative: often of logarithms, of sizes only by damage."""
    return 100 * float(np.count_nonzero(scales < 0)) / max(1, scales.size)


def _with_log_scales(part: arrays.StoredRows) -> arrays.StoredRows:
    """Return packed rows whose scales are unpacked as logarithms."""
    if not isinstance(part.rows, arrays.PackedRows):
        return part
    packs = [replace(pack, unpack=pack.unpack_logs or pack.unpack) for pack in part.rows.parts]
    return replace(part, rows=replace(part.rows, parts=packs))


def _judge_scales(out: dict[str, np.ndarray]) -> tuple[bool, str]:
    """Judge whether the scales of a file are linear, from ``scales [n,3]``, ``means [n,3]`` and ``valid [n]``.

    ``scales`` are the scales that result if the stored numbers are read as logarithms. The stored numbers are judged
    linear if, as logarithms, they give Gaussians too large for the scene, but as sizes fit the scene. In addition, with
    scales as logarithms, either all Gaussians must be about equally large, or half of them must be larger than a
    quarter of the scene's width. Also return a clause on why scales are linear or seem too large, "" without one.
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
    if fits_as_stored and _negative_percent(stored) <= 100 * arrays.MAX_STRAY:
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
    are_logits: bool = False  # True: the sigmoid of the numbers is RGB in [0, 1]

    def rgb(self, stored: np.ndarray) -> np.ndarray:
        """Return stored values as RGB in [0, 1]."""
        if self.are_logits:
            return np.asarray(1 / (1 + exp(-stored)))
        return (stored - np.float32(self.black)) / np.float32(self.white - self.black)

    def stored(self, rgb: np.ndarray) -> np.ndarray:
        """Return RGB in [0, 1] as stored values; not of logits."""
        return np.asarray(self.black + (self.white - self.black) * rgb)


_UNITS = (
    ColorUnits(0, 1, "RGB in [0, 1]"),
    ColorUnits(-0.5, 0.5, "RGB less a half"),
    ColorUnits(0, 255, "RGB in [0, 255]"),
)
_LOGITS = ColorUnits(-inf, inf, "logits of RGB", are_logits=True)


def choose_colors(
    part: arrays.StoredRows, out: dict[str, np.ndarray], choice: ColorChoice
) -> tuple[ColorUnits | None, str, ColorUnits | None]:
    """Choose the units of stored colours: those of RGB, or None for harmonics of degree 0.

    Also return a note if the units are guessed. The third result is units of RGB to choose if photos confirm them. Only
    a PLY file or a format of floats may have RGB. Colours in a file of gsmerge are harmonics, unless the caller says
    otherwise. ``part``: the rows of the first file.

    Many harmonics are far below zero, since they stand for colours darker than grey. No value of RGB is below black or
    above white. Logits of RGB look like harmonics of bright and dark colours, so only other columns or photos tell.
    """
    names = part.rows.dtype.names or ()
    is_stated = choice == "sh" or (choice == "auto" and part.encoding is not None and not part.is_open)
    is_closed = isinstance(part.rows, arrays.PackedRows) and not part.is_open
    if is_stated or is_closed or arrays.color_columns(names) != arrays.SH0:
        return None, "", None
    if choice == "logit":
        return _LOGITS, "", None
    rows = np.flatnonzero(out["valid"])
    rows = rows[:: max(1, len(rows) // _SAMPLES)]
    stored = out["sh0"][rows, 0]
    part_rows = rows[rows < len(part.rows)]
    if choice == "rgb":
        return next((units for units in _UNITS if lie_in_unit_range(units.rgb(stored))), _UNITS[0]), "", None
    plain = None  # colours of the columns red, green and blue, if the file has these, too
    if all(name in names and part.rows.dtype[name] == np.uint8 for name in arrays.PLAIN_COLORS[0]):
        columns = arrays.read_columns(part.rows, arrays.PLAIN_COLORS[0])[part_rows]
        plain = np.stack([columns[name] for name in arrays.PLAIN_COLORS[0]], 1) / np.float32(255)
    # RGB colours of a scene cover more than this part of the range from black to white. Harmonics lie in the range only
    # in scenes with little contrast, and cover a smaller part
    min_spread = 0.5
    few = arrays.MAX_STRAY
    shown = stored[: len(part_rows)]
    if plain is not None and (np.abs(_LOGITS.rgb(shown) - plain) <= _SAME_COLOR).mean() > 1 - few:
        return _LOGITS, RGB_NOTE.format(_LOGITS.name, "the columns red, green and blue show it"), None
    for units in _UNITS if len(part_rows) >= _MIN_JUDGED else ():
        rgb = units.rgb(shown)
        if plain is not None and (np.abs(rgb - plain) <= _SAME_COLOR).mean() > 1 - few:
            return units, RGB_NOTE.format(units.name, "the columns red, green and blue are the same"), units
        if lie_in_unit_range(rgb) and np.ptp(np.quantile(rgb, (few, 1 - few))) > min_spread:
            reason = f"all lie in [{units.black:g}, {units.white:g}]"
            return units, RGB_NOTE.format(units.name, reason), units
    inside_by_units = ((units, np.abs(units.rgb(stored) - 0.5) <= 0.5) for units in _UNITS)
    open_units = next((units for units, is_inside in inside_by_units if is_inside.mean() > 1 - few), None)
    # Photos are asked about logits if the harmonics of many Gaussians are far beyond black and white
    max_beyond = 0.05
    are_beyond = np.abs(sh0_to_rgb(stored) - 0.5) > 0.5 + _UNIT_ROUNDING
    return None, "", _LOGITS if open_units is None and are_beyond.mean() > max_beyond else open_units
