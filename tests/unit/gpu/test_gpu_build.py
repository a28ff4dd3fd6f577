"""The whole pipeline on torch's CPU device next to the stages: the same choices, results as good."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import motions
import numpy as np
import pytest
import scenes
import torch

from gsmerge import CompactOptions, Gaussians, PixelScene, UnalignedScene, compact
from gsmerge.gpu import build as gpu_build
from gsmerge.gpu import match as gpu_match
from gsmerge.gpu.build import DeviceScene
from gsmerge.pipeline import begin, build, input_psnr
from gsmerge.render import cuda as cuda_module
from gsmerge.runtime.run_log import RunLog
from gsmerge.stages.prepare import PreparedScene, prepare

CPU = torch.device("cpu")
gpu = pytest.mark.skipif(
    not torch.cuda.is_available() or find_spec("gsplat") is None, reason="needs a CUDA device and gsplat"
)


@pytest.fixture(scope="module")
def scene() -> PixelScene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 48, 36), noise=0.01)


def prepared_scene(scene: Any, **settings: Any) -> PreparedScene:
    options = CompactOptions().with_settings({"superpixels": "8%", "checkpoint": "none", **settings})
    return prepare(scene, options, RunLog())


def both(scene: Any, **settings: Any) -> tuple[Gaussians, Gaussians, RunLog, RunLog]:
    """Canonical Gaussians of both ways, and their logs."""
    prepared, ours, theirs = prepared_scene(scene, **settings), RunLog(), RunLog()
    count = prepared.limits.count
    made = DeviceScene(prepared, "cpu", begin).build(prepared, count, ours)
    return made, build(prepared, count, theirs), ours, theirs


def psnr(gaussians: Gaussians, scene: PixelScene, **settings: Any) -> float:
    prepared = prepared_scene(scene, **settings)
    return scenes.psnr_of(prepared.frame.leave(gaussians), scene)


def test_whole_run_is_as_good(scene: PixelScene) -> None:
    ours, theirs, log, other = both(scene, fit_steps=150)
    assert psnr(ours, scene) > psnr(theirs, scene) - 0.3
    assert psnr(ours, scene) > 28
    assert len(ours) == pytest.approx(len(theirs), rel=0.03)
    assert list(log.seconds) == list(other.seconds) == ["segment", "encode", "match", "decode", "fit"]
    assert log.choices["fit"]["accepted"]
    assert log.choices["device"] == "cpu"
    assert "on_cpu" not in log.choices
    assert log.choices["groups"] == other.choices["groups"]
    assert log.choices["clusters"] == pytest.approx(other.choices["clusters"], rel=0.1)
    scenes.assert_invariants(prepared_scene(scene).frame.leave(ours), scene)


@pytest.mark.parametrize(
    "settings",
    [{"k": 3}, {"match": "none"}, {"fit": "color"}, {"effort": "draft"}, {"budget": 300, "fit": "none"}],
    ids=str,
)
def test_other_settings_are_as_good(scene: PixelScene, settings: dict[str, Any]) -> None:
    """Robust merging aside, which is the CPU's."""
    ours, theirs, log, other = both(scene, **{"fit": "none", "robust": False, **settings})
    assert psnr(ours, scene) > psnr(theirs, scene) - 0.3
    assert len(ours) == pytest.approx(len(theirs), rel=0.03)
    if "budget" in settings:
        assert log.choices["on_cpu"] == {"segment": "a number is cut from the region tree"}
        assert log.choices["clusters"] == other.choices["clusters"]
    else:
        assert "on_cpu" not in log.choices


@pytest.mark.parametrize(
    ("settings", "stage", "reason"),
    [
        ({"segmentation": "slic"}, "segment", "segmentation slic"),
        ({"match": "aabb"}, "match", "match aabb"),
        ({"k": "mixed"}, "decode", "k mixed"),
        ({"rule": "paper"}, "merging", "rule paper"),
        ({"robust": True}, "merging", "the photos choose the merge"),
        ({"checkpoint": "shipped"}, "merging", "networks correct the stages"),
    ],
)
def test_what_is_not_covered_is_the_stages(
    scene: PixelScene, settings: dict[str, Any], stage: str, reason: str
) -> None:
    ours, theirs, log, _ = both(scene, **{"fit": "none", "robust": False, **settings})
    assert log.choices["on_cpu"] == {stage: reason}
    if stage in ("segment", "merging"):  # the same superpixels
        assert psnr(ours, scene) == pytest.approx(psnr(theirs, scene), abs=0.01)
        assert len(ours) == len(theirs)
    else:
        assert psnr(ours, scene) > psnr(theirs, scene) - 0.3
        assert len(ours) == pytest.approx(len(theirs), rel=0.05)


def test_too_many_features_are_matched_by_the_tree(scene: PixelScene, monkeypatch: pytest.MonkeyPatch) -> None:
    first = both(scene, fit="none", robust=False)[0]
    monkeypatch.setattr(gpu_match, "MAX_FEATURES", 10)
    second, _, log, _ = both(scene, fit="none", robust=False)
    assert log.choices["on_cpu"]["match"].endswith(" Feature Gaussians")
    np.testing.assert_array_equal(first.means, second.means)


def test_unaligned_scenes_are_fitted(scene: PixelScene) -> None:
    loose = UnalignedScene(scene.gaussians, scene.cameras, scene.images, scene.names)
    ours, theirs, log, _ = both(loose, fit_steps=20)
    assert log.choices["on_cpu"] == {"merging": "the scene is unaligned"}
    assert log.choices["fit"]["accepted"]
    assert psnr(ours, scene) == pytest.approx(psnr(theirs, scene), abs=0.1)


def test_scenes_without_photos(scene: PixelScene) -> None:
    ours, theirs, log, _ = both(replace(scene, images=None))
    assert "fit" not in log.choices
    assert len(ours) == pytest.approx(len(theirs), rel=0.03)


def test_scores_are_the_pipelines(scene: PixelScene) -> None:
    missing = np.zeros_like(scene.valid)
    missing[:, 6:18, 8:24] = True
    repeated = scenes.take_views(scene, [0, 1, 2, 1])
    for given in (scene, replace(scene, missing=missing), repeated):
        prepared = prepared_scene(given)
        on_device = DeviceScene(prepared, CPU, begin)
        moved = prepared.with_cameras(motions.random_motions(3, 1.0, 0.1) @ prepared.scene.cameras.viewmats)
        moved = replace(moved, given=replace(given, cameras=moved.final_cameras()))  # as results are scored
        for gaussians in (given.file_gaussians, given.gaussians[::7]):
            for one in (prepared, moved):
                expected = input_psnr(gaussians, one)
                assert on_device.input_psnr(gaussians, one) == pytest.approx(expected, abs=1e-3)


def test_compact_builds_and_scores_on_the_device(scene: PixelScene, monkeypatch: pytest.MonkeyPatch) -> None:
    """On "cuda", and by "auto" where the scene is large enough; here the CPU does what a GPU would do."""
    made: list[tuple[str, int]] = []

    def stand_in(prepared: PreparedScene, device: str, begin: Any) -> DeviceScene:
        made.append((device, len(prepared.scene.gaussians)))
        return DeviceScene(prepared, CPU, begin)

    monkeypatch.setattr(cuda_module, "cuda_problem", lambda: None)
    monkeypatch.setattr(gpu_build, "DeviceScene", stand_in)
    settings: dict[str, Any] = {"superpixels": "8%", "fit_steps": 40, "checkpoint": "none"}
    result = compact(scene, device="cuda", **settings)
    report = result.report
    assert made == [("cuda", 3 * 48 * 36)]
    assert report.options["device"] == "cuda"
    assert report.choices["device"] == "cpu", "where the stand-in ran"
    assert report.psnr_after == pytest.approx(scenes.psnr_of(result.gaussians, scene), abs=0.2)
    assert isinstance(result.gaussians.means, np.ndarray)
    expected = compact(scene, **settings).report
    assert report.psnr_before == pytest.approx(expected.psnr_before, abs=1e-3)
    assert report.psnr_after > expected.psnr_after - 0.3
    assert compact(scene, device="auto", **settings).report.options["device"] == "cpu"
    assert len(made) == 1
    monkeypatch.setattr(cuda_module, "MIN_PIXELS", 1000)
    assert compact(scene, device="auto", **settings).report.options["device"] == "cuda"
    assert len(made) == 2


def test_nothing_of_it_is_loaded_without_a_gpu() -> None:
    code = "import gsmerge.pipeline, sys; print([m for m in sys.modules if m.startswith(('gsmerge.gpu', 'triton'))])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@gpu
def test_gpu_gives_the_same_again_before_the_fit(scene: PixelScene) -> None:
    first, second = (compact(scene, device="cuda", fit="none", robust=False, checkpoint="none") for _ in range(2))
    assert scenes.identical(first.gaussians, second.gaussians)
    expected = compact(scene, fit="none", robust=False, checkpoint="none")
    assert first.report.psnr_after == pytest.approx(expected.report.psnr_after, abs=0.5)


@gpu
def test_gpu_is_as_good(scene: PixelScene) -> None:
    ours, theirs = (compact(scene, device=device, superpixels="8%") for device in ("cuda", "cpu"))
    assert "on_cpu" not in ours.report.choices
    assert scenes.psnr_of(ours.gaussians, scene) > scenes.psnr_of(theirs.gaussians, scene) - 0.5
