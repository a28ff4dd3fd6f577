"""A result that is far from its input is recognised, and the run goes on in another way."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import scenes
from messages import refuses

import gsmerge
from gsmerge import Gaussians, Scene, compact, render
from gsmerge.errors import TargetError
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.geometry.views import resize_cameras
from gsmerge.method.pipelines import pixel_rows
from gsmerge.method.raster.metrics import decibels
from gsmerge.method.viewpoints.place_cameras import between_cameras
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.results.distance import (
    DISTANCE_BLUR,
    DISTANCE_PIXELS,
    TWICE_DB,
    WRONG_DB,
    describe_clear_loss,
    is_clearly_worse,
)


def make_room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 80, 60), noise=0.2)


@pytest.fixture(scope="module")
def room() -> Scene:
    return make_room()


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    return prepare(make_room())


def nearly_nothing(gaussians: Gaussians) -> Gaussians:
    """Return points in place of surfaces: nearly nothing is drawn."""
    return replace(gaussians[::40], opacities=gaussians.opacities[::40] * np.float32(0.1))


def slow_psnr(a: np.ndarray, b: np.ndarray, covered: np.ndarray) -> float:
    """Return the PSNR over the covered pixels of all pictures, blurred by OpenCV."""
    blurred = [
        np.stack([cv2.GaussianBlur(p.clip(0, 1), (0, 0), DISTANCE_BLUR) for p in pictures]) for pictures in (a, b)
    ]
    return decibels(float(((blurred[0] - blurred[1]) ** 2)[covered].mean()))


def test_distances_are_those_of_a_slow_reference(prepared: Prepared) -> None:
    scene = prepared.scene
    result = nearly_nothing(scene.gaussians)
    cameras = resize_cameras(
        scene.cameras, DISTANCE_PIXELS, round(DISTANCE_PIXELS * scene.cameras.height / scene.cameras.width)
    )
    own, between = render(scene.gaussians, cameras[[0, 2]]), between_cameras(cameras)
    inputs, results = (render(gaussians, between) for gaussians in (scene.gaussians, result))
    error = slow_psnr(own.images, scene.images[[0, 2]], own.alphas[..., 0] > 0.5)
    distance = slow_psnr(inputs.images, results.images, inputs.alphas[..., 0] > 0.5)
    assert distance < error - TWICE_DB
    text = describe_clear_loss(result, prepared)
    assert text is not None
    assert [float(value) for value in re.findall(r"([\d.]+) dB", text)] == pytest.approx([distance, error], abs=0.3)


def test_the_input_and_usual_results_are_not_clearly_worse(room: Scene, prepared: Prepared) -> None:
    assert describe_clear_loss(prepared.scene.gaussians, prepared) is None
    for settings in ({}, {"fit": "none"}, {"superpixels": "1%"}):
        assert not compact(room, effort="draft", **settings).report.is_far


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [(20, 20 - TWICE_DB - 0.1, True), (20, 20 - TWICE_DB + 0.1, False), (60, WRONG_DB + 0.1, False), (None, 3, False),
     (20, None, False), (float("nan"), 3, False)],
)  # fmt: skip
def test_clearly_worse_is_twice_the_error(before: float | None, after: float | None, expected: bool) -> None:
    assert is_clearly_worse(before, after) == expected


def spoil_fits(monkeypatch: pytest.MonkeyPatch, *, merges: bool) -> None:
    """Let every fit end in nearly nothing, and with ``merges`` the merge without a fit as well."""
    fit_scene = pixel_rows.fit_scene

    def spoilt(start: Any, scene: Any, options: Any, seed: int, **rest: Any) -> Any:
        fitted = fit_scene(start, scene, options, seed, **rest)
        is_kept = options.fit == "none" and not merges
        return fitted if is_kept else replace(fitted, gaussians=nearly_nothing(fitted.gaussians))

    monkeypatch.setattr(pixel_rows, "fit_scene", spoilt)


def test_a_run_is_made_again_without_the_fit_that_spoiled_it(room: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    spoil_fits(monkeypatch, merges=False)
    report = compact(room, effort="draft").report
    assert not report.is_far
    assert report.options["fit"] == "none"
    again = [note for note in report.notes if "made again" in note]
    assert len(again) == 1
    assert "without a fit" in again[0]


@pytest.mark.slow
def test_a_run_is_refused_where_every_way_ends_far_from_the_input(room: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    spoil_fits(monkeypatch, merges=True)
    with refuses(TargetError, "expected a result as good as its input, found none", "--budget"):
        compact(room, effort="draft")
    with pytest.warns(gsmerge.DoubtWarning, match="than the input"):
        compact(room, effort="draft", budget=100)
