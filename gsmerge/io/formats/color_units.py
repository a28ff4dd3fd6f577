"""Judge from the values in the columns ``f_dc_*`` whether they are harmonics, as in most files, or RGB."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmerge.io.formats import arrays
from gsmerge.io.formats.scale_units import MIN_JUDGED

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


def judge_colors(stored: np.ndarray, plain: np.ndarray | None) -> tuple[ColorUnits, str] | None:
    """Judge a sample of stored colours ``[n,3]``; return units of RGB and a clause with the reason; None for harmonics.

    ``plain [n,3]`` are the bytes of the columns red, green and blue if the file has these columns, too. Many harmonics
    are far below zero, since they stand for colours darker than grey. No value of RGB is below black or above white.
    """
    # RGB colours of a scene cover more than this part of the range from black to white. Harmonics lie in the range only
    # in scenes with little contrast, and cover a smaller part
    min_spread = 0.5
    for units in _UNITS if len(stored) >= MIN_JUDGED else ():
        rgb = units.rgb(stored)
        if plain is not None and (np.abs(rgb - plain / np.float32(255)) <= _SAME_COLOR).mean() > 1 - arrays.MAX_STRAY:
            return units, "the columns red, green and blue are the same"
        if (
            arrays.lie_in_unit_range(rgb)
            and np.ptp(np.quantile(rgb, (arrays.MAX_STRAY, 1 - arrays.MAX_STRAY))) > min_spread
        ):
            return units, f"all lie in [{units.black:g}, {units.white:g}]"
    return None


def find_units(stored: np.ndarray) -> ColorUnits | None:
    """Return the units of RGB in which hardly any of the colours ``[n,3]`` is impossible; None if there are none."""
    inside_by_units = ((units, np.abs(units.rgb(stored) - 0.5) <= 0.5) for units in _UNITS)
    return next((units for units, is_inside in inside_by_units if is_inside.mean() > 1 - arrays.MAX_STRAY), None)


def choose_units(stored: np.ndarray) -> ColorUnits:
    """Return the most likely units of colours ``[n,3]`` of which the caller says that they are RGB."""
    return next((units for units in _UNITS if arrays.lie_in_unit_range(units.rgb(stored))), _UNITS[0])
