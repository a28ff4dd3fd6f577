"""Files that dropped pixels, nobody knows which, in the frame of the cameras or at another scale."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import export_rows, save_export, smooth_scene

from gsmerge.io import load_scene


@pytest.mark.parametrize("size", [(96, 72), (64, 48)])
@pytest.mark.parametrize("dropped", [0.1, 0.3, 0.4])
@pytest.mark.parametrize("nested", [0.4, 1.0, 1.3])
def test_pixels_dropped_at_random(tmp_path: Path, nested: float, dropped: float, size: tuple[int, int]) -> None:
    """In the frame of the cameras, and in another scale: a wrong one can put rows near to wrong pixels."""
    tiny = smooth_scene(*size)
    kept = np.flatnonzero(np.random.default_rng(3).random(len(tiny.gaussians)) > dropped)
    c2w = tiny.c2w.copy()
    c2w[:, :3, 3] *= nested
    loaded = load_scene(save_export(tmp_path, replace(tiny, c2w=c2w), export_rows(tiny, kept)))
    assert loaded.recovery is not None
    assert loaded.recovery.best.frame.scale == pytest.approx(1 / nested, rel=2e-3)
    scene = loaded.pixel_scene()
    assert np.mean(np.flatnonzero(scene.valid.reshape(-1)) == kept) > 0.99
    right = np.abs((scene.gaussians.opacities - tiny.gaussians.opacities)[scene.valid.reshape(-1)]) < 1e-5
    assert float(right.mean()) > 0.99


def test_a_scale_that_cannot_be_measured_is_not_guessed(tmp_path: Path) -> None:
    """Gaussians anywhere in their pixels: of several scales that fit as well, none is taken."""
    tiny, rng = smooth_scene(64, 48), np.random.default_rng(2)
    means = tiny.gaussians.means + rng.normal(0, 0.02, tiny.gaussians.means.shape).astype(np.float32)
    tiny = replace(tiny, gaussians=replace(tiny.gaussians, means=means))
    c2w = tiny.c2w.copy()
    c2w[:, :3, 3] *= 1.5
    kept = np.flatnonzero(rng.random(len(means)) > 0.4)
    folder = save_export(tmp_path, replace(tiny, c2w=c2w), export_rows(tiny, kept))
    assert not load_scene(folder, order="view-major").scene.aligned
