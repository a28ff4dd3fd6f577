"""Files that dropped pixels and have the views of one pixel side by side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from exports import Smooth, export_rows, save_export, smooth_scene

from gsmerge.io import load_scene


@pytest.fixture(scope="module")
def smooth() -> Smooth:
    return smooth_scene(48, 36)


def view_fastest(smooth: Smooth, dropped: float, seed: int = 0) -> np.ndarray:
    """Grid rows by pixel, then view, without a share of them."""
    cells = smooth.height * smooth.width
    every = np.arange(3 * cells).reshape(3, cells).T.reshape(-1)
    return every[np.random.default_rng(seed).random(len(every)) >= dropped]


@pytest.mark.parametrize("dropped", [0.1, 0.4])
def test_nearly_every_row_comes_to_its_pixel(tmp_path: Path, smooth: Smooth, dropped: float) -> None:
    """All but one in a hundred: in pictures so small, two views can see a row equally near to where it should be."""
    kept = view_fastest(smooth, dropped)
    loaded = load_scene(save_export(tmp_path, smooth, export_rows(smooth, kept)))
    scene = loaded.pixel_scene()
    assert loaded.recovery is not None
    assert loaded.recovery.best.layout.order == "view-fastest"
    actual = np.flatnonzero(scene.valid.reshape(-1))
    wrong = np.setxor1d(actual, kept)
    assert len(wrong) <= 0.02 * len(kept)  # a row in a wrong place is missing in another
    same = np.intersect1d(actual, kept)
    right = np.abs((scene.gaussians.opacities - smooth.gaussians.opacities)[same]) < 1e-5
    assert float(right.mean()) > 0.985
    assert any("view-fastest" in note for note in loaded.notes)


def test_rows_in_no_order_stay_unaligned(tmp_path: Path, smooth: Smooth) -> None:
    kept = np.random.default_rng(1).permutation(view_fastest(smooth, 0.3))
    assert not load_scene(save_export(tmp_path, smooth, export_rows(smooth, kept))).scene.aligned
