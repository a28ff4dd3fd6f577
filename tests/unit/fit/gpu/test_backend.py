"""The functions of a device, as the stage calls them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
import torch
from gpu_runs import ON_TORCH, QUICK, Pair, assert_close, gpu
from messages import noted

from gsmerge import Gaussians, Scene
from gsmerge.fit import ON_CPU, FitBackend, FitJob, FitOptions, FitReport, fit, run_on, visible_mask
from gsmerge.fit.gpu import choose_backend
from gsmerge.fit.gpu.engine import make_backend
from gsmerge.raster import photos as render_photos
from gsmerge.raster.photos import EPS2D, NEAR
from gsmerge.runtime.record import record_run


def test_failing_fit_falls_back_as_the_stage_does(start: Gaussians, photos: Pair) -> None:
    """Photos of noise: nothing that is learnt of one block holds in another."""
    noise = scenes.noise_for(photos)
    grey = replace(start, sh0=np.zeros_like(start.sh0))
    for steps in (8, 150):
        options = replace(QUICK, fit_steps=steps)
        actual, report = fit(grey, FitJob(noise, options, len(grey) + 9), ON_TORCH)
        expected, other = fit(grey, FitJob(noise, options, len(grey) + 9))
        assert (report.method, report.stopped) == (other.method, other.stopped)
        assert len(actual) == len(expected)


def test_nothing_is_fitted_where_nothing_is_asked_for(start: Gaussians, photos: Pair) -> None:
    same, report = fit(start, FitJob(photos, replace(QUICK, fit="none", min_contribution=0.0)), ON_TORCH)
    assert same is start
    assert report is None
    few, _ = fit(start[:0], FitJob(photos, QUICK), ON_TORCH)
    assert len(few) == 0


def test_larger_photos_are_fitted_to_on_the_cpu(start: Gaussians, photos: Pair) -> None:
    failing = replace(ON_TORCH, make_engine=None)
    fitted, report = fit(start, FitJob((*photos, photos[0]), QUICK), failing)
    assert report.device == "cpu"
    assert len(fitted) == len(start)


def test_cameras_are_moved_by_the_cpu(start: Gaussians, photos: Pair) -> None:
    failing = replace(ON_TORCH, make_engine=None)
    _, report = fit(start, FitJob(photos, replace(QUICK, move_cameras=True)), failing)
    assert report is not None
    assert report.device == "cpu"
    assert report.viewmats is not None


def test_what_no_photo_shows_is_left_out(start: Gaussians, photos: Pair) -> None:
    opacities = start.opacities.copy()
    opacities[::5] = 0.0045
    faint = replace(start, opacities=opacities)
    actual = scenes.engine_for(photos, QUICK, backend=ON_TORCH).survey(faint).visible(1 / 255)
    np.testing.assert_array_equal(actual, visible_mask(faint, photos[1], 1 / 255))
    assert 0 < int(actual.sum()) < len(faint)
    kept, report = fit(faint, FitJob(photos, replace(QUICK, fit="none")), ON_TORCH)
    assert (len(kept), report) == (int(actual.sum()), None)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (4.2e6, -1.7e5, 4.8e6)], ids=["here", "geographic"])
def test_scores_are_the_renderers(
    place: tuple[float, ...], start: Gaussians, photos: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(render_photos, "BLOCK", 1)  # so that these small views are divided, too
    full = render_photos.scene_photos(scenes.make_scene(scenes.room(), scenes.arc(2, 72, 66)))
    viewmats = full.viewmats.copy()
    viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ np.array(place)
    there, moved = replace(full, viewmats=viewmats), replace(start, means=start.means.astype(np.float64) + place)
    assert full.eps2d == EPS2D
    assert render_photos.scored_tiles(0, 72, 66) is not None
    for views, quarter in (([0, 1], True), ([1], False)):
        actual, expected = (
            score(moved, there, views, quarter=quarter, near=NEAR)
            for score in (ON_TORCH.score_photos, render_photos.score_photos)
        )
        assert actual.psnr == pytest.approx(expected.psnr, abs=1e-4)
        assert actual.covered_psnr == pytest.approx(expected.covered_psnr, abs=1e-2)
        assert actual.share == pytest.approx(expected.share, abs=1e-3)
    errors = [scenes.engine_for(photos, QUICK, backend=one).photo_error(start) for one in (ON_TORCH, ON_CPU)]
    assert errors[0] == pytest.approx(errors[1], rel=1e-4)


def test_fit_without_enough_memory_is_done_again_on_the_cpu(start: Gaussians, photos: Pair) -> None:
    """After some steps, as a GPU fails when Gaussians are added."""
    taken: list[int] = []

    def fail(step: int, *_: object) -> None:
        taken.append(step)
        if len(taken) == 2:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")

    options = replace(QUICK, fit_steps=60)
    with record_run() as record:
        actual, report = fit(start, FitJob(photos, options, progress=fail), ON_TORCH)
    expected, other = fit(start, FitJob(photos, options))
    assert taken[:3] == [20, 40, 1]
    assert scenes.identical(actual, expected)
    assert report == other
    assert noted(record.notes, "GPU", "fit", "CPU")


def test_other_errors_are_not_hidden(start: Gaussians, photos: Pair) -> None:
    def fail(*_: Any) -> Any:
        raise RuntimeError("a mistake of ours")

    for backend in (replace(ON_TORCH, make_engine=fail), replace(ON_CPU, make_engine=fail)):
        with pytest.raises(RuntimeError, match="a mistake of ours"):
            fit(start, FitJob(photos, QUICK), backend)


def test_scores_without_enough_memory_are_done_again_on_the_cpu() -> None:
    def work(backend: FitBackend) -> str:
        if backend is not ON_CPU:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
        return backend.device

    with record_run() as record:
        assert run_on(ON_TORCH, "scores", work) == "cpu"
    assert noted(record.notes, "GPU", "scores", "CPU")


@gpu
def test_mask_and_scores_of_a_gpu_are_the_cpus(scene: Scene, start: Gaussians, photos: Pair) -> None:
    cuda = torch.device("cuda")
    backends = make_backend(cuda), ON_CPU
    masks = [scenes.engine_for(photos, QUICK, backend=one).survey(start).visible(1 / 255) for one in backends]
    assert (masks[0] == masks[1]).mean() > 0.99
    scores = [one.score_photos(start, photos[0], [0, 2], near=NEAR).psnr for one in backends]
    assert scores[0] == pytest.approx(scores[1], abs=0.05)


def colored(start: Gaussians, photos: Pair, backend: FitBackend) -> tuple[Gaussians, FitReport]:
    return scenes.engine_for(photos, FitOptions(), backend=backend).fit_colors(start)


def test_colors_are_the_stages(start: Gaussians, photos: Pair) -> None:
    actual, report = colored(start, photos, ON_TORCH)
    expected, other = colored(start, photos, ON_CPU)
    assert_close(actual, expected, 1e-4)
    assert (report.method, report.accepted) == (other.method, other.accepted) == ("color", True)
    assert report.holdout_after == pytest.approx(other.holdout_after, abs=1e-4)


@gpu
def test_colors_of_a_gpu_are_the_stages(start: Gaussians, photos: Pair) -> None:
    actual, _ = colored(start, photos, choose_backend("cuda", 0)[0])
    assert_close(actual, colored(start, photos, ON_CPU)[0], 0.05)
