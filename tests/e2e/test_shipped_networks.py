"""The networks that come with the package gain where nothing is fitted."""

from __future__ import annotations

from pathlib import Path

import pytest
from scripts import target_psnr
from shared import write_scene
from sweeps import sweep

import gsmerge
from gsmerge.method.networks.checkpoint import SHIPPED

LEAST_GAIN = 1.0  # dB on photos that the scene was not made from


@pytest.mark.slow
def test_shipped_networks_gain_without_a_fit(tmp_path: Path) -> None:
    """Over the analytic stages, on a scene that nobody trained on."""
    made = write_scene(tmp_path / "scene", num_views=4, width=128, height=96, seed=123)
    scene, psnr = gsmerge.read_scene(made), {}
    for checkpoint in ("none", str(SHIPPED)):
        result = gsmerge.compact(scene, fit="none", checkpoint=checkpoint)
        gsmerge.write_ply(tmp_path / "small.ply", result.gaussians, overwrite=True)
        psnr[checkpoint] = target_psnr(made / "targets", tmp_path / "small.ply")
    assert psnr[str(SHIPPED)] > psnr["none"] + LEAST_GAIN


@pytest.mark.slow
@sweep("k", [1, 2, 4])
def test_budget_is_met_with_or_without_networks(tmp_path: Path, k: int) -> None:
    """Without one, what networks make more opaque is left out less often as too faint."""
    scene = gsmerge.read_scene(write_scene(tmp_path / "scene", num_views=3, width=96, height=72, seed=123))
    faint, budget = {"fit": "none", "min_opacity": 0.5}, 600
    counts = {}
    for checkpoint in ("none", str(SHIPPED)):
        given = gsmerge.compact(scene, checkpoint=checkpoint, k=k, budget=budget, **faint)
        assert len(given.gaussians) == budget
        unpruned = gsmerge.compact(scene, checkpoint=checkpoint, k=k, min_contribution=0, **faint)
        counts[checkpoint] = len(unpruned.gaussians)
    assert counts["none"] < counts[str(SHIPPED)]


@pytest.mark.slow
def test_the_papers_method_beats_its_moment_matching(tmp_path: Path) -> None:
    """With the networks of absolute outputs that ship, on a scene that nobody trained on."""
    made = write_scene(tmp_path / "scene", num_views=4, width=128, height=96, seed=123)
    scene, psnr = gsmerge.read_scene(made), {}
    for name, settings in {"networks": {"recipe": "paper"}, "moments": {"method": "moment-matching"}}.items():
        gsmerge.write_ply(tmp_path / "small.ply", gsmerge.compact(scene, **settings).gaussians, overwrite=True)
        psnr[name] = target_psnr(made / "targets", tmp_path / "small.ply")
    assert psnr["networks"] > psnr["moments"] + LEAST_GAIN
