"""Views from outside keep a fit from filling what is empty and from hiding what is seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Gaussians
from gsmerge.method.fit import FitJob, FitOptions, fit_gaussians, record_fit
from gsmerge.method.fit.full import fit_full
from gsmerge.method.fit.outside import (
    EMPTY_OPACITY,
    LEAST_FOG_WEIGHT,
    LEAST_WIDTH,
    RIM_SHARE,
    VEIL_WEIGHT,
    VEILED_LOSS,
    Outside,
    mark_empty,
    place_outside_views,
    score_fog,
    veil_gradients,
)
from gsmerge.method.fit.report import HAZE
from gsmerge.method.geometry.transforms import camera_centres
from gsmerge.method.raster import composite, make_splats, tile_view
from gsmerge.method.raster.photos import Photos, render_photos
from gsmerge.runtime.record import record_run
from gsmerge.settings.fit import Tuning

Pair = tuple[Photos, Photos]
OPTIONS = FitOptions(fit_steps=60, holdout=0.2)
LONG = FitOptions(fit_steps=160, holdout=0.2, tuning=Tuning(outside_every=4))


@pytest.fixture(scope="module")
def outside() -> Outside:
    scene, truth = scenes.self_made(0)
    return look(truth, scenes.pair_of(scene))


def look(reference: Gaussians, photos: Pair) -> Outside:
    """See how far views from outside look into Gaussians without pixels."""
    views = place_outside_views(scenes.bare(reference), reference, photos[1], OPTIONS)
    assert views is not None
    return views


def with_curtain(gaussians: Gaussians, opacity: float = 0.8) -> Gaussians:
    """Add a Gaussian in the middle of the others, that covers every picture."""
    last = gaussians[-1:]
    wide = np.full_like(last.scales, 5 * np.ptp(gaussians.means, 0).max())
    curtain = replace(
        last, means=gaussians.means.mean(0, keepdims=True), scales=wide, opacities=np.full_like(last.opacities, opacity)
    )
    return Gaussians.concat([gaussians, curtain])


def test_a_rim_beside_what_is_shown_does_not_count_as_empty() -> None:
    opacities = np.zeros((40, 100), np.float32)
    opacities[:, :10] = EMPTY_OPACITY + 0.01
    assert mark_empty(opacities)[20].tolist() == [column >= 10 + round(100 * RIM_SHARE) for column in range(100)]
    assert mark_empty(np.zeros((3, 4), np.float32)).all()
    assert not mark_empty(np.full((3, 4), 0.5, np.float32)).any()


def test_outside_views_stand_behind_and_around_the_cameras(outside: Outside, truth: Gaussians, photos: Pair) -> None:
    """Each looks at the middle of what its photo sees, from no nearer than the photo's camera."""
    views = outside.views
    assert views.weights.shape == (len(views), LEAST_WIDTH * photos[1].height // photos[1].width, LEAST_WIDTH)
    assert np.unique(views.weights) == pytest.approx([0, LEAST_FOG_WEIGHT, VEIL_WEIGHT * LEAST_FOG_WEIGHT])
    eyes, own = camera_centres(views.viewmats), camera_centres(photos[1].viewmats)
    assert np.linalg.norm(eyes - truth.means.mean(0), axis=1).min() > 0.8 * np.linalg.norm(own, axis=1).min()
    assert len(np.unique(views.viewmats.round(6), axis=0)) == len(views)
    ahead = views.viewmats[:, 2, :3]
    assert np.degrees(np.arccos(np.clip(ahead @ photos[1].viewmats[:, 2, :3].T, -1, 1)).min(1)).max() > 15


def test_a_scene_that_shows_nothing_has_no_outside_views(truth: Gaussians, photos: Pair) -> None:
    faint = replace(truth[:5], opacities=np.full(5, 0.3, np.float32), scales=np.full((5, 3), 1e3, np.float32))
    assert place_outside_views(scenes.bare(faint), truth, photos[1], OPTIONS) is None
    assert place_outside_views(scenes.bare(truth[:0]), faint, photos[1], OPTIONS) is None


def test_outside_views_see_as_far_as_the_scene_shows_something(outside: Outside, truth: Gaussians) -> None:
    """Against depths drawn from the same cameras, and nothing where it is empty."""
    for view in range(0, len(outside.views), 9):
        limits = outside.limits[view]
        drawn = composite(tile_view(make_splats(truth), **outside.views.camera(view)))
        assert drawn[1][np.isinf(limits)].min(initial=1) > 0.8
        solid = np.isfinite(limits) & (limits > 0)
        assert drawn[1][solid].max(initial=0) < 0.15
        depths = np.linalg.norm(truth.means - camera_centres(outside.views.viewmats)[view], axis=1)
        assert depths.min() < np.median(limits[solid]) < depths.max()


def test_points_in_front_of_a_limit_contradict_outside_views(outside: Outside) -> None:
    """In front of a surface and in an empty pixel, but neither behind the surface nor beside the picture."""
    views = outside.views
    shown = np.argwhere(np.isfinite(outside.limits[0]) & (outside.limits[0] > outside.near[0] / 0.8))
    empty = np.argwhere(np.isinf(outside.limits[0]))
    places = np.array([shown[0], shown[0], empty[0], [0, -5]])
    limit = outside.limits[0][tuple(shown[0])]
    depths = np.array([0.9 * limit, 1.1 * limit, limit, limit])
    pixels = np.column_stack([places[:, ::-1] + 0.5, np.ones(4)])
    local = depths[:, None] * (pixels @ np.linalg.inv(views.Ks[0]).T)
    pose = np.linalg.inv(views.viewmats[0])
    alone = replace(outside, views=views[[0]], limits=outside.limits[:1], near=outside.near[:1])
    assert alone.contradict(local @ pose[:3, :3].T + pose[:3, 3], 0.95).tolist() == [True, False, True, False]


@pytest.mark.parametrize("empty", [True, False])
def test_veil_gradients_are_those_of_the_light_that_is_hidden(outside: Outside, truth: Gaussians, empty: bool) -> None:
    """Against a central difference in the curtain's opacity: its own where the scene is empty, before a wall as well.

    The wall stands at four times its depth.
    """
    spoilt, step = with_curtain(truth, 0.3), 0.01
    depth = float((outside.views.viewmats[0, 2] * np.append(spoilt.means[-1], 1)).sum())
    far = np.full_like(outside.limits, 4 * depth)
    looked = replace(outside, limits=np.where(np.isinf(outside.limits), np.inf, 0) if empty else far)
    weights = np.full_like(far, 1) if not empty else np.where(np.isinf(looked.limits), np.float32(LEAST_FOG_WEIGHT), 0)
    looked = replace(looked, views=replace(outside.views, weights=weights.astype(np.float32)))
    g = veil_gradients(make_splats(spoilt[len(truth) :]), looked, 0)

    def loss(change: float) -> float:
        changed = replace(spoilt, opacities=np.append(spoilt.opacities[:-1], np.float32(0.3 + change)))[len(truth) :]
        tiled = tile_view(make_splats(changed), **outside.views.camera(0), near=outside.near[0])
        hidden = (1 - composite(tiled)[1]) * (1 if empty else 0.75)
        return float((weights[0] * hidden).mean(dtype=np.float64))

    assert g.ids.tolist() == [0]
    assert g.opacities[-1] == pytest.approx((loss(step) - loss(-step)) / (2 * step), rel=1e-3)
    assert not g.colors.any()


def test_veils_that_hide_little_or_stand_behind_have_no_gradient(outside: Outside, truth: Gaussians) -> None:
    curtain = with_curtain(truth, 0.3)[len(truth) :]
    depth = float((outside.views.viewmats[0, 2] * np.append(curtain.means[0], 1)).sum())
    for limit, count in ((depth / (1 - VEILED_LOSS), 0), (0.5 * depth, 0), (8 * depth, 1)):
        looked = replace(outside, limits=np.full_like(outside.limits, limit))
        assert len(veil_gradients(make_splats(curtain), looked, 0).ids) == count


def test_the_fog_score_is_the_opacity_where_outside_is_empty(outside: Outside, truth: Gaussians) -> None:
    assert score_fog(make_splats(truth), outside) == pytest.approx(0, abs=0.01)
    thick, thin = (score_fog(make_splats(with_curtain(truth, opacity)), outside) or 0 for opacity in (0.8, 0.2))
    assert 0.3 < 2 * thin < thick <= 0.81
    assert score_fog(make_splats(truth), replace(outside, limits=np.zeros_like(outside.limits))) is None


def test_a_fit_keeps_empty_what_outside_views_have_empty(truth: Gaussians, photos: Pair, outside: Outside) -> None:
    """Photos that a curtain stands in ask for one; from outside nobody wants it."""
    wanted = with_curtain(truth, 0.3)
    shown = tuple(replace(some, images=np.stack(render_photos(wanted, some)).clip(0, 1)) for some in photos)
    start = scenes.spoil(truth)
    whole = replace(outside, views=replace(outside.views, weights=np.isinf(outside.limits).astype(np.float32)))
    fitted, without = (fit_full(start, scenes.run_for(shown, LONG, outside=views))[0] for views in (whole, None))
    kept, grown = (score_fog(make_splats(one), outside) or 0 for one in (fitted, without))
    assert kept < 0.02
    assert grown > 4 * kept


def test_fog_left_by_a_fit_is_noted(truth: Gaussians, photos: Pair) -> None:
    _, report = fit_gaussians(scenes.spoil(truth), FitJob(photos, OPTIONS))
    for fog, count in ((HAZE, 0), (HAZE + 0.01, 1), (None, 0)):
        with record_run(None) as record:
            record_fit(replace(report, fog=fog))
        assert sum("haze" in note for note in record.notes) == count
