"""Gaussians that nobody sees are not written."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Gaussians, Scene
from gsmerge.method.raster import contributions, make_splats, render, tile_view
from gsmerge.method.raster.photos import blank_photos
from gsmerge.method.stages.prune import COMPARED_LEVELS, ROUNDING, split_unseen

Made = tuple[Scene, Gaussians]


@pytest.fixture(scope="module")
def made() -> Made:
    return scenes.self_made(0)


def peaks_of(gaussians: Gaussians, scene: Scene) -> np.ndarray:
    photos, splats = blank_photos(scene.cameras, COMPARED_LEVELS[0]), make_splats(gaussians)
    views = [tile_view(splats, **photos.camera(view)) for view in range(len(scene))]
    return np.max([contributions(view)[1] for view in views], axis=0)


def change(before: Gaussians, after: Gaussians, scene: Scene) -> float:
    """Return the largest root mean square over the views of the change from one scene to another."""
    pictures = [render(gaussians, scene.cameras).images.clip(0, 1) for gaussians in (before, after)]
    return float(np.sqrt(((pictures[0] - pictures[1]) ** 2).mean((1, 2, 3)).max()))


def test_faint_and_hidden_gaussians_are_left_out(made: Made) -> None:
    scene, truth = made
    faint = replace(truth, opacities=np.full(len(truth), 0.004, np.float32))
    opaque = replace(truth, opacities=np.full(len(truth), 0.98, np.float32), scales=2 * truth.scales)
    hidden = replace(truth[:9], means=4 * truth.means[:9], scales=0.2 * truth.scales[:9])
    seen, unseen = split_unseen(Gaussians.concat([opaque, faint, hidden]), scene.cameras)
    assert len(seen) <= len(opaque)
    assert scenes.identical(seen, opaque[np.isin(opaque.means[:, 0], seen.means[:, 0])])
    assert len(seen) + len(unseen) == 2 * len(truth) + 9


def test_pictures_change_by_no_more_than_rounding(made: Made) -> None:
    scene, truth = made
    opacities = (truth.opacities * np.random.default_rng(2).random(len(truth)) ** 6).astype(np.float32)
    fading = Gaussians.concat([truth, replace(truth, opacities=opacities)])
    seen, unseen = split_unseen(fading, scene.cameras)
    assert len(unseen) > 0.1 * len(truth)
    assert change(fading, seen, scene) < 2 * ROUNDING  # full size; half-size pictures decided
    more = Gaussians.concat([seen, unseen])[: len(seen) // 2]
    assert change(fading, more, scene) > 4 * ROUNDING


def test_clearest_of_the_gaussians_left_out_come_first(made: Made) -> None:
    scene, truth = made
    opacities = (truth.opacities * np.random.default_rng(3).random(len(truth)) ** 6).astype(np.float32)
    fading = Gaussians.concat([truth, replace(truth, opacities=opacities)])
    seen, unseen = split_unseen(fading, scene.cameras)
    rows = [np.flatnonzero((fading.means == mean).all(1)) for mean in unseen.means]
    peaks = peaks_of(fading, scene)
    weakest = np.array([min(peaks[some]) for some in rows])
    assert (np.diff(weakest) <= 0).all()
    assert weakest.max() < peaks_of(seen, scene).max()


def test_gaussians_outside_all_pictures_stay(made: Made) -> None:
    scene, truth = made
    behind = replace(truth[:5], means=-truth.means[:5] - np.array([0, 0, 40], np.float32))
    seen, _ = split_unseen(Gaussians.concat([truth, behind]), scene.cameras)
    assert scenes.identical(seen[-5:], behind)


def test_pruning_no_gaussians_gives_none(made: Made) -> None:
    seen, unseen = split_unseen(made[1][:0], made[0].cameras)
    assert len(seen) == len(unseen) == 0
