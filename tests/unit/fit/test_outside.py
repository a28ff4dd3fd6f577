"""Views from outside: where the start is empty, and what shows there goes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Gaussians
from gsmerge.fit import FitJob, FitOptions, fit, record_fit
from gsmerge.fit.full import fit_full
from gsmerge.fit.outside import (
    LEAST_WIDTH,
    LIGHT,
    RIM,
    fog_gradients,
    mark_empty,
    outside_views,
    score_fog,
)
from gsmerge.fit.report import HAZE
from gsmerge.geometry import camera_centres
from gsmerge.raster import composite, prepare, tile_view
from gsmerge.raster.photos import Photos, render_photos
from gsmerge.runtime.record import record_run

Pair = tuple[Photos, Photos]
OPTIONS = FitOptions(fit_steps=60, holdout=0.2)
LONG = FitOptions(fit_steps=160, holdout=0.2)


@pytest.fixture(scope="module")
def outside(truth: Gaussians, photos: Pair) -> Photos:
    views = outside_views(prepare(truth), photos[1], OPTIONS)
    assert views is not None
    return views


def with_curtain(gaussians: Gaussians, opacity: float = 0.8) -> Gaussians:
    """One large Gaussian more, in the middle of the others."""
    last = gaussians[-1:]
    wide = np.full_like(last.scales, 5 * np.ptp(gaussians.means, 0).max())
    curtain = replace(
        last, means=gaussians.means.mean(0, keepdims=True), scales=wide, opacities=np.full_like(last.opacities, opacity)
    )
    return Gaussians.concat([gaussians, curtain])


def test_a_rim_beside_what_is_shown_does_not_count() -> None:
    opacities = np.zeros((40, 100), np.float32)
    opacities[:, :10] = 0.06
    assert mark_empty(opacities)[20].tolist() == [column >= 10 + round(100 * RIM) for column in range(100)]
    assert mark_empty(np.zeros((3, 4), np.float32)).all()
    assert not mark_empty(np.full((3, 4), 0.5, np.float32)).any()


def test_views_stand_behind_and_around(outside: Photos, truth: Gaussians, photos: Pair) -> None:
    """Each looks at the middle of what its photo sees, from no nearer than the photo's camera."""
    assert outside.weights is not None
    assert outside.weights.shape == (len(outside), LEAST_WIDTH * photos[1].height // photos[1].width, LEAST_WIDTH)
    assert np.unique(outside.weights).tolist() == [0, np.float32(LIGHT)]
    eyes, own = camera_centres(outside.viewmats), camera_centres(photos[1].viewmats)
    assert np.linalg.norm(eyes - truth.means.mean(0), axis=1).min() > 0.8 * np.linalg.norm(own, axis=1).min()
    assert len(np.unique(outside.viewmats.round(6), axis=0)) == len(outside)
    ahead = outside.viewmats[:, 2, :3]
    assert np.degrees(np.arccos(np.clip(ahead @ photos[1].viewmats[:, 2, :3].T, -1, 1)).min(1)).max() > 15


def test_a_start_that_fills_every_view_has_none(truth: Gaussians, photos: Pair) -> None:
    assert outside_views(prepare(with_curtain(truth)), photos[1], OPTIONS) is None


def test_gradients_are_those_of_the_weighted_opacity(outside: Photos, truth: Gaussians) -> None:
    """Against a central difference in the curtain's opacity."""
    assert outside.weights is not None
    spoilt, view, step = with_curtain(truth, 0.3), 0, 0.01
    g = fog_gradients(prepare(spoilt), outside, view)

    def loss(change: float) -> float:
        changed = replace(spoilt, opacities=np.append(spoilt.opacities[:-1], np.float32(0.3 + change)))
        tiled = tile_view(prepare(changed), **outside.camera(view))
        return float((outside.weights[view] * (1 - composite(tiled)[1])).mean(dtype=np.float64))

    assert g.ids[-1] == len(truth)
    assert g.opacities[-1] == pytest.approx((loss(step) - loss(-step)) / (2 * step), rel=1e-3)
    assert not g.colors.any()
    assert len(fog_gradients(prepare(truth), outside, view).ids) < len(g.ids)


def test_fog_is_the_opacity_far_outside(outside: Photos, truth: Gaussians) -> None:
    assert score_fog(prepare(truth), outside) == pytest.approx(0, abs=0.01)
    thick = score_fog(prepare(with_curtain(truth, 0.8)), outside)
    thin = score_fog(prepare(with_curtain(truth, 0.2)), outside)
    assert 0.3 < 2 * thin < thick <= 0.81


def test_a_fit_keeps_empty_what_its_start_has_empty(truth: Gaussians, photos: Pair, outside: Photos) -> None:
    """Photos that a curtain stands in ask for one; from outside nobody wants it."""
    wanted = with_curtain(truth, 0.3)
    shown = tuple(replace(some, images=np.stack(render_photos(wanted, some)).clip(0, 1)) for some in photos)
    start = scenes.spoil(truth)
    whole = replace(outside, weights=np.sign(outside.weights))
    fitted, without = (fit_full(start, scenes.run_for(shown, LONG, outside=views))[0] for views in (whole, None))
    kept, grown = score_fog(prepare(fitted), outside), score_fog(prepare(without), outside)
    assert kept < 0.02
    assert grown > 4 * kept


def test_a_note_says_where_fog_is_left(truth: Gaussians, photos: Pair) -> None:
    _, report = fit(scenes.spoil(truth), FitJob(photos, OPTIONS))
    for fog, count in ((HAZE, 0), (HAZE + 0.01, 1), (None, 0)):
        with record_run(None) as record:
            record_fit(replace(report, fog=fog))
        assert sum("haze" in note for note in record.notes) == count
