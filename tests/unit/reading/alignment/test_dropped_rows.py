"""The grid of files that lack pixels is found, with cameras or without."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from exports import da3_rows, export_rows, of_pixels, save_export, smooth_scene
from sweeps import sweep

from gsmerge.reading.alignment.dropped_rows import find_dropped_grid
from gsmerge.reading.read_scene import load_scene


@sweep("size", [(64, 48), (96, 72)])
@sweep("dropped", ["far", 0.1, "faint", 0.2], often=2)
def test_pixels_of_a_file_with_dropped_rows_are_found(
    tmp_path: Path, dropped: float | str, size: tuple[int, int]
) -> None:
    """At random, or by a rule."""
    tiny = smooth_scene(*size)
    if dropped == "far":
        kept = da3_rows(tiny)
    elif dropped == "faint":
        kept = np.flatnonzero(tiny.gaussians.opacities > 0.1)
    else:
        kept = np.flatnonzero(np.random.default_rng(3).random(len(tiny.gaussians)) > float(dropped))
    scene = load_scene(save_export(tmp_path, tiny, export_rows(tiny, kept))).scene
    actual = np.flatnonzero(scene.pixels.shown.reshape(-1))
    assert len(np.setxor1d(actual, kept)) < 0.01 * len(kept)
    same = np.intersect1d(actual, kept)
    right = np.abs((of_pixels(scene, "opacities") - tiny.gaussians.opacities)[same]) < 1e-5
    assert float(right.mean()) > 0.99


def test_a_grid_with_dropped_rows_is_found_wherever_gaussians_are_in_their_pixels() -> None:
    """Half a pixel to each side, with the jitter of the scene."""
    tiny, rng = smooth_scene(96, 72), np.random.default_rng(1)
    views = np.arange(len(tiny.gaussians)) // (96 * 72)
    points = tiny.gaussians.means.astype(np.float64)
    depths = ((points - tiny.c2w[views, :3, 3]) * tiny.c2w[views, :3, 2]).sum(1)
    steps = rng.uniform(-0.3, 0.3, (len(points), 2)) * depths[:, None] / tiny.K[0, 0]
    points += (tiny.c2w[views, :3, :2] * steps[:, None]).sum(2)
    kept = da3_rows(tiny)
    grid = find_dropped_grid(points[kept].astype(np.float32), np.ones(len(kept), bool))
    assert grid is not None
    layout, cameras = grid
    assert (layout.width, layout.height) == (90, 68)
    rows = np.flatnonzero(layout.pixel_ids() >= 0)
    y, x = np.divmod(layout.pixel_ids()[rows] % (layout.width * layout.height), layout.width)
    true_y, true_x = np.divmod(kept[rows] % (96 * 72), 96)
    assert len(rows) >= 0.99 * len(kept)
    assert np.mean((x + 3 == true_x) & (y + 2 == true_y)) > 0.99
    assert np.allclose(cameras.Ks[:, 0, 0], tiny.K[0, 0], rtol=0.03)


@pytest.mark.parametrize("index", ["shuffled", "sorted", "voxels"])
def test_rows_in_no_order_are_no_grid(index: str) -> None:
    tiny, rng = smooth_scene(96, 72), np.random.default_rng(0)
    means = tiny.gaussians.means
    order = {"shuffled": rng.permutation(len(means)), "sorted": np.lexsort(means.T)}
    _, voxels = np.unique(np.floor(means / 0.03).astype(int), axis=0, return_index=True)
    means = means[order.get(index, voxels)]
    assert find_dropped_grid(means, np.ones(len(means), bool)) is None
