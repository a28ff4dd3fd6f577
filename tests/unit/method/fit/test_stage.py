"""The fit stage prunes, fits, and refuses a fit that shows the photos worse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scenes

from gsmerge import Gaussians
from gsmerge.method.fit import FitJob, FitOptions, fit_gaussians
from gsmerge.method.fit.fit_state import start_state
from gsmerge.method.fit.full import fit_full
from gsmerge.method.fit.outside import place_outside_views, score_fog
from gsmerge.method.fit.schedule import prepare_fit
from gsmerge.method.fit.survey import (
    MOST_SCORED,
    choose_photos,
    choose_scored_photos,
    peak_weights,
    score_images,
    survey_photos,
)
from gsmerge.method.raster import composite, contributions, make_splats, tile_view
from gsmerge.method.raster.photos import Photos

Pair = tuple[Photos, Photos]
QUICK = FitOptions(fit_steps=30, holdout=0.2)
LONG = FitOptions(fit_steps=160, holdout=0.2)


def visible(gaussians: Gaussians, photos: Photos) -> np.ndarray:
    """Mark Gaussians with a weight of 1/255 in some photo, or outside all of them."""
    peaks, inside = peak_weights(gaussians, photos)
    return ~inside | (peaks >= 1 / 255)


def test_the_fit_stage_gives_the_result_of_the_full_fit(truth: Gaussians, photos: Pair) -> None:
    start = scenes.spoil(truth)
    outside = place_outside_views(scenes.bare(truth), start, photos[1], QUICK)
    assert outside is not None
    result, report = fit_gaussians(start, FitJob(photos, QUICK, seed=4, outside=outside))
    expected, own = fit_full(start, scenes.run_for(photos, QUICK, seed=4, outside=outside))
    assert report == replace(own, fog=score_fog(make_splats(result), outside))
    assert scenes.identical(result, expected)


def test_the_fit_stage_prunes_hidden_gaussians_first(truth: Gaussians, photos: Pair) -> None:
    opaque = replace(truth, opacities=np.full_like(truth.opacities, 0.98), scales=2 * truth.scales)
    hidden = replace(truth[:3], means=4 * truth.means[:3], scales=0.2 * truth.scales[:3])
    alone, both = (fit_gaussians(g, FitJob(photos, QUICK))[0] for g in (opaque, Gaussians.concat([opaque, hidden])))
    assert len(both) == len(alone)


def test_a_fit_that_shows_the_photos_worse_is_refused(truth: Gaussians, photos: Pair) -> None:
    result, report = fit_gaussians(truth, FitJob(photos, LONG))  # of a perfect start
    assert (report.method, report.accepted) == ("none", False)
    assert "worse" in report.stopped
    assert scenes.identical(result, truth[visible(truth, photos[1])])


def test_a_fit_is_taken_though_held_out_patches_get_worse(truth: Gaussians, photos: Pair) -> None:
    """As they do where few views see a place: the photos as a whole decide."""
    start, half = scenes.spoil(truth), photos[1]
    state, images = start_state(start), half.images.copy()
    for view, weight in enumerate(prepare_fit(FitJob(photos, LONG)).score_weights):
        drawn = composite(tile_view(state.splats, **half.camera(view)), state.colors)[0]
        images[view][weight == 0] = drawn.clip(0, 1)[weight == 0]  # patches show the start
    _, report = fit_gaussians(start, FitJob((photos[0], replace(half, images=images)), LONG))
    assert report.holdout_after < report.holdout_before
    assert report.accepted


def test_fitting_no_gaussians_gives_none(truth: Gaussians, photos: Pair) -> None:
    result, _ = fit_gaussians(truth[:0], FitJob(photos, QUICK))
    assert len(result) == 0


def test_a_survey_of_photos_is_that_of_its_parts_one_by_one(truth: Gaussians, photos: Pair) -> None:
    run, pictures = scenes.run_for(photos, QUICK), list[np.ndarray]()
    survey = survey_photos(truth, run)
    half, state = photos[1], start_state(truth)
    np.testing.assert_array_equal(survey.visible(1 / 255), visible(truth, half))
    sums = np.zeros((len(half), len(truth)))
    for view in range(len(half)):
        drawn = tile_view(state.splats, **half.camera(view))
        pictures.append(composite(drawn, state.colors)[0])
        sums[view] = contributions(drawn)[0]
    assert survey.score == score_images(pictures, run, half)
    np.testing.assert_array_equal(survey.sums, sums.sum(0))
    np.testing.assert_array_equal(survey.squares, (sums**2).sum(0))
    rows = np.arange(0, len(truth), 3)
    np.testing.assert_array_equal(survey[rows].peaks, survey.peaks[rows])


def test_gaussians_in_sight_or_outside_all_photos_are_visible(photos: Pair) -> None:
    """In sight, hidden behind an opaque sheet, and outside all photos."""
    sheet = [[x, y, 2.0] for x in np.linspace(-2, 2, 41) for y in np.linspace(-2, 2, 41)]
    means = np.array([*sheet, [0.0, 0, 2.5], [0, 0, -5], [0, 0, 1.0]], np.float32)
    n = len(means)
    made = Gaussians(
        means, np.tile(np.eye(1, 4, dtype=np.float32), (n, 1)), np.full((n, 3), 0.1, np.float32),
        np.full(n, 0.99, np.float32), np.zeros((n, 1, 3), np.float32), np.zeros((n, 0, 3), np.float32),
    )  # fmt: skip
    made.scales[-3:] = 0.02
    assert visible(made, photos[1])[-3:].tolist() == [False, True, True]


def test_some_of_many_photos_are_surveyed_if_they_look_everywhere(truth: Gaussians) -> None:
    def photos_of(shifts: np.ndarray) -> Photos:
        viewmats = np.tile(np.eye(4), (len(shifts), 1, 1))
        viewmats[:, 0, 3] = -shifts
        K = np.array([[20.0, 0, 10], [0, 20, 10], [0, 0, 1]])
        return Photos(np.zeros((len(shifts), 20, 20, 3), np.float32), viewmats, np.tile(K, (len(shifts), 1, 1)), 0.3)

    places = np.zeros((500, 3), np.float32)
    places[:, 0], places[:, 2] = np.linspace(-0.4, 40, 500), 2
    points = replace(truth[np.zeros(500, int)], means=places)
    assert choose_photos(points, photos_of(np.zeros(9))) == list(range(9))
    near = choose_photos(points, photos_of(np.linspace(0, 0.001, 40)))
    assert near == choose_scored_photos(40)
    assert len(near) == MOST_SCORED
    assert np.diff(near).max() <= 8
    assert choose_photos(points, photos_of(np.arange(40.0))) == list(range(40))  # each surface is in two
