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
    """The values of ``f_dc_*`` that stand for black and white."""

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
    """Judge a sample of stored colours ``[n,3]``; return their units and a clause that says why; None for harmonics.

    ``plain [n,3]`` are the bytes of the columns red, green and blue, if the file has these, too. Harmonics of a scene
    go far below zero, where colours are darker than grey. RGB ends at black and at white.
    """
    # RGB covers at least this part of the range from black to white. Harmonics of faint scenes cover less
    min_spread = 0.5
    for units in _UNITS if len(stored) >= MIN_JUDGED else ():
        rgb = units.rgb(stored)
        if plain is not None and (np.abs(rgb - plain / np.float32(255)) <= _SAME_COLOR).mean() > 1 - arrays.MAX_STRAY:
            return units, "the columns red, green and blue are the same"
        if arrays.are_shares(rgb) and np.ptp(np.quantile(rgb, (arrays.MAX_STRAY, 1 - arrays.MAX_STRAY))) > min_spread:
            return units, f"all lie in [{units.black:g}, {units.white:g}]"
    return None


def find_units(stored: np.ndarray) -> ColorUnits | None:
    """Return the units in which hardly any colour ``[n,3]`` lies outside black to white; None if there are none."""
    shares = ((units, np.abs(units.rgb(stored) - 0.5) <= 0.5) for units in _UNITS)
    return next((units for units, is_inside in shares if is_inside.mean() > 1 - arrays.MAX_STRAY), None)


def choose_units(stored: np.ndarray) -> ColorUnits:
    """Return the most likely units of colours ``[n,3]`` that the caller calls RGB; by default, RGB in [0, 1]."""
    return next((units for units in _UNITS if arrays.are_shares(units.rgb(stored))), _UNITS[0])
