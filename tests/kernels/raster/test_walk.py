"""The rows of a tile in which a Gaussian of a batch shows match a look at all its pixels."""

from __future__ import annotations

import numpy as np
import pytest
from sweeps import sweep

from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.raster.blend import parts_of_tile
from gsmerge.method.kernels.raster.project import TILE

BATCH = 32  # Gaussians that the kernels take at once
LEFT, TOP = 32, 48  # the tile's first pixel
LN_CUT = np.float32(elementary.log(1 / 255))  # ln of the smallest weight that is drawn


def parts_of(conics: np.ndarray) -> np.ndarray:
    parts = np.empty((len(conics), 3), np.int32)
    parts_of_tile(conics, np.arange(len(conics), dtype=np.int32), LEFT, TOP, parts)
    return parts


def conics_of(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Return conics ``[BATCH,8]`` of Gaussians around the tile, their rows those of the whole image."""
    rows = np.zeros((BATCH, 8), np.float32)
    reach = {"near": 8, "far": 40, "huge": 3000}[kind]
    rows[:, 0] = LEFT + 8 + rng.uniform(-reach, reach, BATCH)
    rows[:, 1] = TOP + 8 + rng.uniform(-reach, reach, BATCH)
    sizes = 10 ** rng.uniform(-0.3, {"near": 1, "far": 1.7, "huge": 4}[kind], (2, BATCH))
    rows[:, 2], rows[:, 4] = 1 / (np.sqrt(2) * sizes[0]), 1 / (2 * sizes[1] ** 2)
    rows[:, 3] = rng.normal(size=BATCH) * rng.choice([0, 0.5, 5, 50], BATCH)
    rows[:, 5] = elementary.log(rng.uniform(1 / 255, 1, BATCH))
    rows[:, 6], rows[:, 7] = 0, 1000
    return rows


@pytest.mark.parametrize("kind", ["near", "far", "huge"])
@sweep("seed", range(20), often=4)
def test_rows_and_columns_of_a_gaussian_are_those_where_it_shows(kind: str, seed: int) -> None:
    """None that shows is left out, and at most one beside them is kept."""
    conics = conics_of(kind, np.random.default_rng(seed))
    parts = parts_of(conics)
    mx, my, rate, slope, decay, lnop = conics.T[:6].astype(np.float64)[..., None, None]
    mx, my = mx - LEFT - 0.5, my - TOP - 0.5
    y, x = np.mgrid[:TILE, :TILE].astype(np.float64)
    exponents = lnop - (rate * (x - mx - slope * (y - my))) ** 2 - decay * (y - my) ** 2
    # along a row without pixels between: what the bounds are of
    line = np.linspace(0, TILE - 1, 4096)
    for j in range(BATCH):
        first, last, column = parts[j]
        shows = np.flatnonzero((exponents[j] >= LN_CUT + 1e-5).any(1))
        if len(shows):
            assert first <= shows[0]
            assert last >= shows[-1]
        columns = np.flatnonzero((exponents[j] >= LN_CUT + 1e-5).any(0))
        if column >= 0 and len(columns):
            assert column <= columns[0]
            assert columns[-1] <= column + 7
        side = np.sqrt(max(lnop[j, 0, 0] - LN_CUT, 0) * (rate[j, 0, 0] ** -2 + slope[j, 0, 0] ** 2 / decay[j, 0, 0]))
        reach = np.clip(mx[j, 0, 0] + np.array([-side, side]) * 1.001 + (-0.05, 0.05), -1, TILE)
        assert (column < 0) <= (reach[1] - reach[0] >= 7)  # eight columns are enough where no more are reached
        dy = np.arange(TILE)[:, None] - my[j, 0, 0]
        along = (
            lnop[j, 0, 0] - (rate[j, 0, 0] * (line - mx[j, 0, 0] - slope[j, 0, 0] * dy)) ** 2 - decay[j, 0, 0] * dy**2
        )
        touched = np.flatnonzero((along >= LN_CUT - 0.05).any(1))
        if first <= last and len(touched):
            assert first >= touched[0] - 1
            assert last <= touched[-1] + 1


def test_a_gaussian_that_misses_the_tile_has_no_rows() -> None:
    conics = np.zeros((1, 8), np.float32)
    conics[0] = LEFT + 60, TOP + 8, 1, 0, 1, 0, 0, 1000
    first, last, _ = parts_of(conics)[0]
    assert first > last
