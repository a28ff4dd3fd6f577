"""What merging keeps: coverage, brightness, detail with K (method reference, cases 47, 48, 55)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
import torch

from gsmerge import Gaussians, PixelScene

SCENES = {"wall": scenes.wall, "planes": scenes.two_planes, "room": scenes.room}


@pytest.fixture(scope="module", params=list(SCENES))
def scene(request: pytest.FixtureRequest) -> PixelScene:
    return scenes.make_scene(SCENES[request.param](), scenes.arc(3, 64, 48), noise=0.005)


def coverage(gaussians: Gaussians, scene: PixelScene) -> tuple[float, float]:
    """Mean alpha and luma over all views."""
    images, alphas = scenes.images_of(gaussians, scene.cameras)
    return float(alphas.mean()), float((images @ np.array([0.299, 0.587, 0.114])).mean())


# 47: more children, more detail


@pytest.mark.parametrize("settings", [{}, {"robust": False, "fit": "none"}], ids=str)
def test_more_children_show_more(scene: PixelScene, settings: dict) -> None:
    found = [scenes.compacted(scene, density=0.044, k=k, **settings).gaussians for k in (1, 2, 4, 8)]
    assert (np.diff([len(g) for g in found]) > 0).all()
    assert (np.diff([scenes.psnr_of(g, scene) for g in found]) > -0.05).all()


def test_more_superpixels_show_more(scene: PixelScene) -> None:
    found = [scenes.compacted(scene, density=density).gaussians for density in (0.01, 0.03, 0.1)]
    assert (np.diff([len(g) for g in found]) > 0).all()
    assert (np.diff([scenes.psnr_of(g, scene) for g in found]) > -0.05).all()


# 48: coverage and brightness


@pytest.mark.parametrize("settings", [{}, {"k": 4}, {"fit": "none"}], ids=str)
def test_photos_keep_coverage_and_brightness(scene: PixelScene, settings: dict) -> None:
    """With the choice among merges, within a hundredth; more coverage than the input's holes is no fault."""
    before = coverage(scene.gaussians, scene)
    after = coverage(scenes.compacted(scene, density=0.044, **settings).gaussians, scene)
    assert after[0] > before[0] - 0.01
    assert after[1] == pytest.approx(before[1], abs=0.02)


@pytest.mark.parametrize("views", [1, 3])
def test_plain_merging_keeps_coverage_and_brightness(scene: PixelScene, views: int) -> None:
    own = scenes.take_views(scene, list(range(views)))
    before = coverage(own.gaussians, own)
    after = coverage(scenes.plain(own, density=0.044), own)
    assert after[0] == pytest.approx(before[0], rel=0.01)
    assert after[1] == pytest.approx(before[1], rel=0.01)


def test_merging_across_views_keeps_coverage(scene: PixelScene) -> None:
    """A cluster stands for all its members: not thinner than one view alone."""
    alone = coverage(scenes.plain(scenes.take_views(scene, [0])), scenes.take_views(scene, [0]))
    together = coverage(scenes.plain(scene), scenes.take_views(scene, [0]))
    assert together[0] >= alone[0] - 0.01


# 55: glass


@pytest.mark.parametrize("settings", [{}, {"robust": False, "fit": "none"}, {"match": "none"}], ids=str)
def test_faint_scenes_are_not_pruned(scene: PixelScene, settings: dict) -> None:
    opacities = 0.05 * torch.ones_like(scene.gaussians.opacities)
    faint = replace(scene, gaussians=replace(scene.gaussians, opacities=opacities))
    usual = scenes.compacted(scene, density=0.044, **settings).gaussians
    found = scenes.compacted(faint, density=0.044, **settings).gaussians
    assert len(found) > 0.8 * len(usual)


@pytest.mark.parametrize("match", ["overlap", "none"])
def test_faint_scenes_keep_their_coverage(scene: PixelScene, match: str) -> None:
    """Where hardly anything is hidden, integrated optical depth is what is seen."""
    opacities = 0.01 * torch.ones_like(scene.gaussians.opacities)
    faint = replace(scene, gaussians=replace(scene.gaussians, opacities=opacities))
    before = coverage(faint.gaussians, faint)[0]
    after = coverage(scenes.plain(faint, match=match), faint)[0]
    assert after == pytest.approx(before, rel=0.1)
