"""Notes say where files keep too few digits of positions."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
from messages import noted

from gsmerge.io.formats.splat_transform import VARIABLE
from gsmerge.io.formats.table import INDEX, OUTPUT_FORMATS
from gsmerge.io.formats.write import rounding_notes
from gsmerge.types import Gaussians

NAMES = ("lod-meta.json", "a.html", *(f"a{ending}" for ending in OUTPUT_FORMATS))


@pytest.fixture(autouse=True)
def program(monkeypatch: pytest.MonkeyPatch) -> None:
    """Name a program that exists; none is run."""
    monkeypatch.setenv(VARIABLE, sys.executable)


@pytest.fixture
def near() -> Gaussians:
    """Make Gaussians around the origin, in float64, with a sky a thousand times as far."""
    rng, n = np.random.default_rng(0), 200
    far = np.where(np.arange(n) < 150, 1.0, 1e3)[:, None]
    return Gaussians(
        means=rng.uniform(-3, 3, (n, 3)) * far,
        quats=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        scales=np.float32(rng.uniform(0.02, 0.05, (n, 3)) * far),
        opacities=np.full(n, 0.5, np.float32),
        sh0=np.zeros((n, 1, 3), np.float32),
        shN=np.zeros((n, 0, 3), np.float32),
    )


@pytest.mark.parametrize("name", NAMES)
def test_digits_lost_far_from_the_origin_are_noted(near: Gaussians, name: str) -> None:
    assert rounding_notes(name, near) == []
    far = replace(near, means=near.means + 3e6 * np.array([1, -1, 1]))
    assert noted(rounding_notes(name, far), "--translate=-3000000,3000000,-3000000")


def test_digits_lost_of_gaussians_far_apart_are_noted_for_a_spz_alone(near: Gaussians) -> None:
    factor = np.where(np.arange(len(near)) < 150, 1, 1e4)[:, None]
    apart = replace(near, means=near.means * factor, scales=near.scales * factor)
    assert noted(rounding_notes("a.spz", apart), "write a .ply")
    assert [rounding_notes(name, apart) for name in ("a.ply", INDEX)] == [[], []]
