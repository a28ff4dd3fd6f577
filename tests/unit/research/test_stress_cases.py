"""Stress cases change what they say, and find a property that does not hold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from messages import refuses
from shared import make_once, write_small
from sweeps import sweep

from gsmerge.errors import SceneError
from gsmerge.method.geometry.transforms import project
from gsmerge.reading.held_out import read_held_out
from gsmerge.reading.read_scene import load_scene
from gsmerge.research import stress as module
from gsmerge.research.stress import CASES, StressScene, stress
from gsmerge.settings.compact import CompactOptions
from gsmerge.types import Scene, Views

FAST = CompactOptions().with_settings({"fit": "none"})


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24))


@pytest.fixture(scope="module")
def noisy() -> Scene:
    """Return a scene with the errors of an export, which runs of every case begin with."""
    return load_scene(make_once("small", write_small)).scene


def offsets(scene: Scene) -> float:
    """Return the largest distance (pixels) of a Gaussian from its pixel."""
    pixels, _ = project(scene.gaussians.means, scene.cameras)
    v, h, w = scene.pixels.shown.shape
    own = pixels.reshape(v, v, h * w, 2)[np.arange(v), np.arange(v)].reshape(v, h, w, 2)
    y, x = np.mgrid[:h, :w] + 0.5
    return float(np.abs(own - np.stack([x, y], -1)).max())


def pixel_scene(judged: StressScene) -> Scene:
    return judged.scene


@pytest.mark.parametrize("degrees", [0.2, 5.0])
def test_wrong_poses_keep_every_gaussian_on_its_pixel(degrees: float, scene: Scene) -> None:
    turned = pixel_scene(module.perturb_poses(StressScene(scene, None), degrees))
    assert offsets(turned) < 1e-3
    for old, new in zip(scene.cameras.viewmats, turned.cameras.viewmats, strict=True):
        cosine = (np.trace(new[:3, :3] @ old[:3, :3].T) - 1) / 2
        assert np.rad2deg(np.arccos(cosine)) == pytest.approx(degrees, rel=1e-3)
        np.testing.assert_allclose(np.linalg.inv(old)[:3, 3], np.linalg.inv(new)[:3, 3], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(("factor", "shift"), [(1e-4, (0, 0, 0)), (1e4, (0, 0, 0)), (1.0, (4e5, 5e6, 100))])
def test_moved_scenes_move_their_judges(factor: float, shift: tuple[float, ...], scene: Scene) -> None:
    views = Views(scene.cameras, scene.images, scene.names)
    move = module.scale_and_shift(StressScene(scene, views), factor, shift)
    assert offsets(pixel_scene(move)) < 1e-2
    np.testing.assert_allclose(move.views.cameras.viewmats, move.scene.cameras.viewmats)


def test_exposure_changes_photos_and_colours_alike(scene: Scene) -> None:
    changed = pixel_scene(module.change_exposure(StressScene(scene, None), 0.2))
    np.testing.assert_allclose(changed.images[0], 0.8 * scene.images[0], rtol=1e-5)
    colors = (0.5 + 0.28209479 * changed.gaussians.sh0[:, 0]).reshape(changed.images.shape)
    np.testing.assert_allclose(colors[1].clip(0, 1), changed.images[1], rtol=1e-5, atol=1e-5)


def test_break_rows_spoils_one_row_in_a_hundred(scene: Scene) -> None:
    scene_in, n = StressScene(scene, None), len(scene.gaussians)
    broken = pixel_scene(module.break_rows(scene_in))
    assert int((~broken.pixels.shown).sum()) == round(0.01 * n)
    assert len(broken.gaussians) == int(broken.pixels.shown.sum())
    unaligned = Scene(scene.gaussians, scene.cameras, scene.images, None, scene.names)
    assert len(module.break_rows(StressScene(unaligned, None)).scene.gaussians) == n - round(0.01 * n)


def test_cases_of_views_take_away_shuffle_or_repeat_them(scene: Scene) -> None:
    scene_in = StressScene(scene, None)
    names = {}
    for case in ("views-half", "views-3", "views-1", "order", "twice"):
        change = CASES[case].change
        assert change is not None
        names[case] = change(scene_in).scene.names
    assert [len(names[case]) for case in ("views-half", "views-3", "views-1")] == [1, 3, 1]
    assert sorted(names["order"]) == sorted(scene.names)
    assert names["twice"] == scene.names * 2


@pytest.mark.slow
def test_every_case_on_a_scene_with_held_out_views(made_scene: Path) -> None:
    load = load_scene(made_scene)
    read = read_held_out(load, made_scene / "targets")
    steps: list[tuple[str, int, int]] = []
    actual = stress(
        load.scene,
        CompactOptions().with_settings({"fit_steps": 30, "superpixels": "10%"}),
        targets=Views(read.cameras, read.images, read.names),
        progress=lambda *step: steps.append(step),
    )
    assert [outcome.case for outcome in actual] == list(CASES)
    failed = {o.case: o.found for o in actual if o.held is False}
    assert failed == {}
    assert [o.case for o in actual if o.held is None] == []
    assert steps[-1] == ("done", len(CASES), len(CASES))


def test_cases_that_need_pixels_are_skipped_for_scenes_in_no_order(noisy: Scene) -> None:
    unaligned = Scene(noisy.gaussians, noisy.cameras, noisy.images, None, noisy.names)
    actual = stress(unaligned, FAST, cases=["order", "views-3", "large"])
    assert [outcome.held for outcome in actual] == [None, None, True]


@pytest.mark.slow
def test_scenes_without_photos_are_judged_by_colours_of_pixels(noisy: Scene) -> None:
    bare = replace(noisy, images=None)
    actual = stress(bare, FAST, cases=["unchanged", "exposure", "utm"])
    assert [outcome.held for outcome in actual] == [True, None, True]
    assert "its input" in actual[0].found  # by the colours of the pixels


def spoilt(monkeypatch: pytest.MonkeyPatch, change: Any) -> None:
    """Let every run after the first one go wrong in some way."""
    genuine, runs = module.compact, []

    def compact(scene: Any, options: CompactOptions) -> Any:
        runs.append(scene)
        result = genuine(scene, options)
        return result if len(runs) == 1 else replace(result, gaussians=change(result.gaussians))

    monkeypatch.setattr(module, "compact", compact)


@pytest.mark.slow
@sweep(
    ("change", "words"),
    [
        (lambda g: replace(g, sh0=g.sh0 + 0.5), "unchanged"),
        (lambda g: g[::2], "unchanged"),
        (lambda g: replace(g, means=g.means * np.nan), "not finite"),
    ],
)
def test_property_that_does_not_hold_is_found(
    change: Any, words: str, noisy: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoilt(monkeypatch, change)
    outcome = stress(noisy, FAST, cases=["large"])[0]
    assert outcome.held is False
    assert words in outcome.found


def test_error_of_a_run_is_an_outcome_of_the_case(noisy: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> None:
        raise SceneError("scene.ply", "expected mercy")

    spoilt(monkeypatch, broken)
    outcome = stress(noisy, FAST, cases=["views-3"])[0]
    assert (outcome.held, outcome.found) == (False, "ended with: scene.ply: expected mercy")


def test_unknown_case_or_scene_without_views_is_refused(noisy: Scene) -> None:
    with refuses(ValueError, "cases", "unchanged"):
        stress(noisy, FAST, cases=["nonsense"])
    bare = Scene(noisy.gaussians, noisy.cameras[[]], None, None, ())
    with refuses(ValueError, "", "views", "none"):
        stress(bare, FAST)
