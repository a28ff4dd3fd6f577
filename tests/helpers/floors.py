"""Floors are least values of what depends on rounding: means over ten runs less three standard deviations.

Results are the same bytes on every processor, but any change of the code may round elsewhere, and a fit of hundreds of
steps makes tenths of a dB of that. So a floor is no figure that somebody once saw, but one that ``python
tests/measure_floors.py`` measured: ten runs, each from slightly other Gaussians. The number of runs, their mean, their
standard deviation and the floor are in ``floors.csv``, under the names of the tests.
"""

from __future__ import annotations

import csv
import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from gsmerge import Gaussians

TABLE = Path(__file__).parent.parent / "floors.csv"
COLUMNS = ("test", "n", "mean", "sd", "floor")
RECORD = "GSMERGE_FLOORS_RECORD"  # a file: values are written there instead of being compared
NUDGE = "GSMERGE_FLOORS_NUDGE"  # which of the runs
NUDGE_SIZE = 1e-3  # of a Gaussian's size: far below every error, far above rounding
LEAST_SD = 0.02  # what ten runs may not show of the spread; dB for most


def nudged(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians, in runs that measure floors moved by a thousandth of their size."""
    seed = int(os.environ.get(NUDGE, "0"))
    if seed == 0:
        return gaussians
    noise = np.random.default_rng(seed).normal(size=gaussians.means.shape) * NUDGE_SIZE
    means, sizes = gaussians.means, gaussians.scales.max(1, keepdims=True)
    return replace(gaussians, means=means + sizes * noise.astype(means.dtype))


def at_least_the_floor(test: str, value: float) -> None:
    """Compare with the table, or write down."""
    if RECORD in os.environ:
        with open(os.environ[RECORD], "a", encoding="utf-8") as file:
            file.write(f"{test}\t{value:.6f}\n")
        return
    assert test in _floors(), f"{test}: expected a row in {TABLE.name}; run python tests/measure_floors.py"
    assert value >= _floors()[test], f"{value:.3f} is below the floor of {TABLE.name}"


@cache
def _floors() -> dict[str, float]:
    with TABLE.open(encoding="utf-8", newline="") as file:
        return {row["test"]: float(row["floor"]) for row in csv.DictReader(file)}
