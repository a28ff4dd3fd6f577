"""Judge from the values in the columns ``f_dc_*`` whether they are harmonics, as in most files, or RGB."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmerge.io.formats import ply
from gsmerge.io.formats import rows as arrays
from gsmerge.io.formats.scale_units import MIN_JUDGED, SAMPLES
from gsmerge.settings.reading import ColorChoice

RGB_NOTE = "f_dc_0 to f_dc_2 are read as {}, since {}; if they are harmonics, use --hint colors=sh"
_SAME_COLOR = 1.5 / 255  # largest difference of a float and a byte of the same colour, in shares of white


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
    rows = rows[:: max(1, len(rows) // SAMPLES)]
    stored, part_rows = out["sh0"][rows, 0], rows[rows < len(part.rows)]
    if choice == "rgb":
        return next((units for units in _UNITS if arrays.lie_in_unit_range(units.rgb(stored))), _UNITS[0]), "", None
    plain = None  # colours of the columns red, green and blue, if the file has these, too
    if all(name in names and part.rows.dtype[name] == np.uint8 for name in arrays.PLAIN_COLORS[0]):
        columns = ply.read_columns(part.rows, arrays.PLAIN_COLORS[0])[part_rows]
        plain = np.stack([columns[name] for name in arrays.PLAIN_COLORS[0]], 1) / np.float32(255)
    # RGB colours of a scene cover more than this part of the range from black to white. Harmonics lie in the range only
    # in scenes with little contrast, and cover a smaller part
    min_spread, few = 0.5, arrays.MAX_STRAY
    for units in _UNITS if len(part_rows) >= MIN_JUDGED else ():
        rgb = units.rgb(stored[: len(part_rows)])
        if plain is not None and (np.abs(rgb - plain) <= _SAME_COLOR).mean() > 1 - few:
            return units, RGB_NOTE.format(units.name, "the columns red, green and blue are the same"), units
        if arrays.lie_in_unit_range(rgb) and np.ptp(np.quantile(rgb, (few, 1 - few))) > min_spread:
            reason = f"all lie in [{units.black:g}, {units.white:g}]"
            return units, RGB_NOTE.format(units.name, reason), units
    inside_by_units = ((units, np.abs(units.rgb(stored) - 0.5) <= 0.5) for units in _UNITS)
    return None, "", next((units for units, is_inside in inside_by_units if is_inside.mean() > 1 - few), None)
