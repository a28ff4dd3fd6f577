"""The networks that come with the package gain where nothing is fitted."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import pytest
from scripts import load_script
from sweeps import sweep

import gsmerge
from gsmerge.networks.checkpoint import SHIPPED
from gsmerge.scene.held_out import read_held_out
from gsmerge.scene.read import load_scene

LEAST_GAIN = 1.0  # dB on photos that the scene was not made from


def test_shipped_networks_gain(
    make_scene: Callable[..., Path], target_psnr: Callable[[Path, Path], float], tmp_path: Path
) -> None:
    """Over the analytic stages, on a scene that nobody trained on."""
    made = make_scene(tmp_path / "scene", num_views=4, width=128, height=96, seed=123)
    scene, psnr = gsmerge.read_scene(made), {}
    for checkpoint in ("none", str(SHIPPED)):
        result = gsmerge.compact(scene, fit="none", checkpoint=checkpoint)
        gsmerge.write_ply(tmp_path / "small.ply", result.gaussians, overwrite=True)
        psnr[checkpoint] = target_psnr(made / "targets", tmp_path / "small.ply")
    assert psnr[str(SHIPPED)] > psnr["none"] + LEAST_GAIN


@pytest.mark.slow
@sweep("k", [1, 2, 4])
def test_a_budget_is_met_with_networks_and_without(make_scene: Callable[..., Path], tmp_path: Path, k: int) -> None:
    """Without one, what networks make more opaque is left out less often as too faint."""
    scene = gsmerge.read_scene(make_scene(tmp_path / "scene", num_views=3, width=96, height=72, seed=123))
    faint, budget = {"fit": "none", "min_opacity": 0.5}, 600
    counts = {}
    for checkpoint in ("none", str(SHIPPED)):
        given = gsmerge.compact(scene, checkpoint=checkpoint, k=k, budget=budget, **faint)
        assert len(given.gaussians) == budget
        unpruned = gsmerge.compact(scene, checkpoint=checkpoint, k=k, min_contribution=0, **faint)
        counts[checkpoint] = len(unpruned.gaussians)
    assert counts["none"] < counts[str(SHIPPED)]


@pytest.mark.slow
def test_the_benchmark_compares_at_equal_count(
    make_scene: Callable[..., Path], tmp_path: Path, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(root / "benchmarks"))
    benchmark = load_script(root / "benchmarks" / "networks.py")
    made = make_scene(tmp_path / "scene", num_views=3, width=96, height=72, seed=123)
    load = load_scene(made)
    monkeypatch.setattr(benchmark, "export", lambda folder, cache: load.files.ply)
    monkeypatch.setattr(benchmark, "read_held_out", lambda folder: read_held_out(load, made / "targets"))
    store = benchmark.Store(tmp_path / "runs.jsonl")
    args = argparse.Namespace(checkpoint=SHIPPED, lpips=False, cache=tmp_path, store=store)
    condition = benchmark.Condition("no fit", {"fit": "none", "min_opacity": 0.5, "min_contribution": 0, "k": 2})
    own = {learned: benchmark.run(made, condition, args, learned=learned) for learned in (False, True)}
    before, after = benchmark.at_equal_count(made, condition, args)
    assert own[False]["count"] < own[True]["count"]
    assert before == own[False]
    assert after["count"] == before["count"]
    assert after["psnr"] != own[True]["psnr"]
    assert len(store.runs) == len(benchmark.Store(store.path).runs) == 3
    assert "| no fit |" in benchmark.table([made, made], (condition,), args)


@pytest.mark.slow
def test_the_papers_method_beats_its_moment_matching(
    make_scene: Callable[..., Path], target_psnr: Callable[[Path, Path], float], tmp_path: Path
) -> None:
    """With the networks of absolute outputs that ship, on a scene that nobody trained on."""
    made = make_scene(tmp_path / "scene", num_views=4, width=128, height=96, seed=123)
    scene, psnr = gsmerge.read_scene(made), {}
    for name, settings in {"networks": {"recipe": "paper"}, "moments": {"method": "moment-matching"}}.items():
        gsmerge.write_ply(tmp_path / "small.ply", gsmerge.compact(scene, **settings).gaussians, overwrite=True)
        psnr[name] = target_psnr(made / "targets", tmp_path / "small.ply")
    assert psnr["networks"] > psnr["moments"] + LEAST_GAIN
