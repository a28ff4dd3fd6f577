"""Scenes are prepared with photos, colours of rows or renders; placed views judge those of which no view is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
import unaligned_scenes
from messages import noted

from gsmerge import Gaussians, Scene, compact, render
from gsmerge.method.facts.pictures import PHOTOS, ROW_COLORS
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.fit import FitOptions, fit_photos, fit_scene
from gsmerge.method.geometry.transforms import project
from gsmerge.method.raster.photos import MASKED_WEIGHT, scene_pictures
from gsmerge.method.stages.fit_pairs import merge_scene
from gsmerge.method.viewpoints.place_cameras import HELD_OUT
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.reading.make_scene import without_photo
from gsmerge.runtime.record import record_part, record_run
from gsmerge.types import NO_CAMERAS, make_scene


def test_renders_stand_in_for_photos_only_where_no_pixels_are_known() -> None:
    """A fit to renders of one Gaussian per pixel would keep its errors: its pixels' own colours are taken."""
    bare = replace(scenes.make_scene(scenes.room(), scenes.arc(2, 32, 24)), images=None)
    aligned, unaligned = prepare(bare), prepare(replace(bare, pixels=None))
    np.testing.assert_allclose(aligned.scene.images, scene_pictures(bare), atol=1e-6)
    assert aligned.input_scene.images is not None
    assert aligned.reference.name == ROW_COLORS
    assert unaligned.scene.images is not None
    assert unaligned.input_scene.images is None
    with record_part(silent=True) as record:
        prepare(replace(bare, pixels=None))
    assert noted(record.notes, "no photos", "the rows are not the pixels of the views", "--images")


@pytest.mark.parametrize("own", [True, False], ids=["rows are pixels", "rows are no pixels"])
def test_views_without_a_photo_take_part_in_a_fit(own: bool) -> None:
    """Colours of the view's own Gaussians count as a photo, and drawings as what masks leave out."""
    room = scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24))
    prepared = prepare(without_photo(room if own else unaligned_scenes.without_order(room), [1]))
    reference, scene = prepared.reference, prepared.scene
    assert (reference.name, reference.score_views) == (PHOTOS, (0, 2))
    weights = fit_photos(scene, FitOptions())[0].weights
    if own:
        assert scene.masks is None
        assert weights is None
    else:
        np.testing.assert_array_equal(scene.masks.all((1, 2)), [True, False, True])
        np.testing.assert_array_equal(weights[:, 0, 0], [1, MASKED_WEIGHT, 1])
        np.testing.assert_array_equal(scene.images[1], render(scene.gaussians, scene.cameras[[1]]).images[0].clip(0, 1))


def make_bare() -> Scene:
    room = scenes.make_scene(scenes.room(), scenes.arc(3), noise=0.01)
    return make_scene(room.gaussians, NO_CAMERAS)


@pytest.fixture(scope="module")
def bare() -> Scene:
    return make_bare()


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    return prepare(make_bare())


def test_views_placed_for_a_bare_scene_are_renders_of_it(prepared: Prepared) -> None:
    scene, reference = prepared.scene, prepared.reference
    assert reference.placed
    assert reference.score_views == tuple(range(len(scene) // HELD_OUT))
    drawn = render(scene.gaussians, scene.cameras)
    np.testing.assert_array_equal(scene.images, drawn.images.clip(0, 1))
    np.testing.assert_array_equal(scene.empty, 1 - drawn.alphas[..., 0])
    assert scene.images.std() > 0.05


def test_a_fit_does_not_depend_on_the_views_that_judge_it(prepared: Prepared) -> None:
    """Whatever these show, the fitted Gaussians are the same."""
    pictures = prepared.scene.images.copy()
    pictures[list(prepared.reference.score_views)] = 0.5
    other = replace(prepared, scene=replace(prepared.scene, images=pictures))
    options = FitOptions(fit_steps=20, scored=False, beyond=True)
    a, b = (fit_scene_alone(each, options) for each in (prepared, other))
    for before, after in zip(vars(a).values(), vars(b).values(), strict=True):
        np.testing.assert_array_equal(before, after)


def fit_scene_alone(prepared: Prepared, options: FitOptions) -> Gaussians:
    held_out = prepared.reference.score_views
    start = merge_scene(300, 1.0, prepared)
    views = [view for view in range(len(prepared.scene)) if view not in held_out]
    fitted = fit_scene(start, prepared.scene, options, 0, views=views, num_scored=len(views))
    assert fitted.report.steps == 20
    return fitted.gaussians


def test_placed_views_together_see_most_of_the_scene(prepared: Prepared) -> None:
    cameras = prepared.scene.cameras
    pixels, depths = project(prepared.scene.gaussians.means.astype(np.float64), cameras)
    seen = (depths > 0) & ((pixels > 0) & (pixels < (cameras.width, cameras.height))).all(-1)
    assert seen.any(0).mean() > 0.95


@pytest.mark.slow
def test_placed_views_judge_fog_or_holes_as_worse(bare: Scene) -> None:
    """A result that lacks a part, or has a cloud beside the scene, is judged worse than one that has neither.

    Nothing is fitted, which takes seconds: the result would be the same, since the fit makes it no better.
    """
    result = compact(bare, budget="30%", fit="none")
    judged = result.report.choices["fidelity"]["psnr"]
    g = bare.gaussians
    half = make_scene(g[g.means[:, 0] < np.median(g.means[:, 0])], NO_CAMERAS)
    for spoilt in (_with_fog(result.gaussians), compact(half, budget="30%", fit="none").gaussians):
        prepared = prepare(bare)
        shown = render(prepared.frame.enter(spoilt), prepared.scene.cameras).images.clip(0, 1)
        error = np.square(shown - prepared.scene.images).mean((1, 2, 3))
        assert -10 * np.log10(error).mean() < judged - 3


def _with_fog(gaussians: Gaussians) -> Gaussians:
    middle, spread = np.median(gaussians.means, 0), np.ptp(gaussians.means, 0).max()
    one = gaussians[:1]
    fog = replace(
        one,
        means=(middle + np.array([0, spread / 2, 0]))[None].astype(one.means.dtype),
        scales=np.full((1, 3), spread / 4, np.float32),
        opacities=np.full(1, 0.7, np.float32),
        sh0=np.full((1, 1, 3), 1.5, np.float32),
    )
    return Gaussians.concat([gaussians, fog])


def test_a_scene_without_cameras_gets_one_note(bare: Scene) -> None:
    with record_run() as record:
        prepare(bare)
    assert len(record.notes) == 1
    assert noted(record.notes, "no cameras", "--cameras", "--images")


@pytest.mark.slow
def test_gaussians_far_behind_all_placed_views_take_part(bare: Scene) -> None:
    """Also what lies behind all views takes part."""
    far = unaligned_scenes.far_behind(bare.gaussians, 40)
    result = compact(replace(bare, gaussians=Gaussians.concat([bare.gaussians, far])), budget="20%")
    middle = far.means.mean(0)
    assert (np.abs(result.gaussians.means - middle) < np.ptp(far.means, 0) + 1).all(1).any()
