"""A report says what gain to expect at a new viewpoint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Gaussians, Scene, compact, render
from gsmerge.io.formats.rows import ExpectedScores, copied_comments, new_views_comment, read_expected_scores
from gsmerge.method.facts.prepared import LEAST_VIEWS
from gsmerge.method.geometry.views import subset
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.results.left_out import choose_left_out, leave_out, mark_seen, mean_seen
from gsmerge.results.new_views import OWN_WEIGHT, SPREAD, Trial, shrink_scene
from gsmerge.results.report import NewViews
from gsmerge.settings.stages import PrepareOptions
from gsmerge.types import PicturedScene

QUICK = {"superpixels": 150, "fit_steps": 12, "checkpoint": "none", "poses": "fixed"}
TRIAL = Trial(own_before=20.0, before=18.0, after=24.0, views=3)


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(5), noise=0.02)


def pictured(scene: Scene) -> PicturedScene:
    return PicturedScene.with_pictures(scene, scene.images, scene.masks)


def test_the_expected_gain_lies_between_the_trial_and_own_photos_on_confirmed_depth() -> None:
    gain = OWN_WEIGHT * 0.9 * 20 + (1 - OWN_WEIGHT) * 6
    scores = (round(psnr, 2) for psnr in (18 + gain, 6 - SPREAD, 18 + SPREAD))  # between the trial and own photos
    assert TRIAL.predict(20, 40, 0.9) == NewViews(18, *scores, views=3)
    assert TRIAL.predict(20, 30, 0.5).gain == 5
    assert TRIAL.predict(20, 30, 0).gain == 0


def test_new_views_of_the_input_score_below_own_photos_by_what_the_trial_found() -> None:
    assert TRIAL.predict(17, 40, 1).before == 15
    assert TRIAL.predict(23, 40, 1).before == 21


def test_no_gain_is_expected_where_the_trial_or_own_photos_lose() -> None:
    worse = Trial(20, 18, 16.5, 2)
    assert worse.predict(20, 20, 1).gain == pytest.approx((1 - OWN_WEIGHT) * -1.5)
    assert worse.predict(20, 19, 0.5).high == SPREAD
    assert TRIAL.predict(20, 19, 1).gain == 0  # own photos lose: no gain is expected


def test_a_report_of_four_views_expects_a_gain_of_new_views(room: Scene) -> None:
    report = compact(scenes.take_views(room, range(LEAST_VIEWS)), **QUICK).report
    assert 1 <= report.new_views.views <= LEAST_VIEWS
    most = report.choices["agreement"]["confirmed"] * max(0.0, report.psnr_after - report.psnr_before)
    assert report.new_views.gain <= most + 0.01  # as rounded
    assert report.new_views.low < report.new_views.gain < report.new_views.high
    assert report.seconds["new views"] > 0


@pytest.mark.parametrize("settings", [{"effort": "draft"}, {"new_views": False}])
def test_new_views_are_not_tried_in_a_draft_or_when_switched_off(settings: dict[str, object], room: Scene) -> None:
    report = compact(room, **QUICK, **settings).report
    assert report.new_views is None
    assert "new views" not in report.seconds


def test_new_views_are_tried_in_a_draft_on_request(room: Scene) -> None:
    assert compact(room, **QUICK, effort="draft", new_views=True).report.new_views is not None


def test_new_views_are_not_tried_with_too_few_photos(room: Scene) -> None:
    assert compact(scenes.take_views(room, range(LEAST_VIEWS - 1)), **QUICK).report.new_views is None
    assert compact(replace(room, images=None), **QUICK).report.new_views is None


def test_the_number_of_threads_does_not_change_the_trial(room: Scene) -> None:
    one, two = (compact(room, **QUICK, threads=threads) for threads in (1, 2))
    assert one.report.new_views == two.report.new_views
    assert scenes.identical(one.gaussians, two.gaussians)


def test_a_trial_of_new_views_does_not_change_the_result(room: Scene) -> None:
    tried, without = (compact(room, **QUICK, new_views=wanted).gaussians for wanted in (True, False))
    assert scenes.identical(tried, without)


@pytest.mark.parametrize("count", [4, 7, 18, 60])
def test_views_left_out_together_are_no_neighbours(count: int) -> None:
    rounds = choose_left_out(range(0, 2 * count, 2))
    assert len(rounds[0]) == len(rounds[1]) == min(3, max(1, count // 6))
    assert len({*rounds[0], *rounds[1]}) == 2 * len(rounds[0])
    assert {*rounds[0], *rounds[1]} <= {*range(0, 2 * count, 2)}
    assert all(np.diff(views).min(initial=99) > 4 for views in rounds)


def test_the_rest_has_neither_photos_nor_rows_of_left_out_views(room: Scene) -> None:
    prepared = prepare(room, PrepareOptions(poses="fixed"))
    left_out = leave_out(prepared.scene, [1, 3], prepared)
    assert len(left_out.rest.scene) == 3
    assert left_out.rest.reference.score_views == (0, 1, 2)
    assert len(left_out.rows) == len(prepared.scene.gaussians) * 3 // 5
    assert (left_out.photos.images == prepared.scene.images[[1, 3]]).all()
    assert leave_out(prepared.scene, [], prepared) is None
    scores = left_out.score(left_out.rows)
    assert mean_seen(scores, left_out.shares) == pytest.approx(np.average(scores, weights=left_out.shares))


def test_pixels_that_only_left_out_views_show_do_not_count() -> None:
    """Rows without pixels do not say which view saw them: the others know nothing of a wall behind them."""
    scene = scenes.make_scene(scenes.wall(), scenes.arc(4))
    turn = np.diag([-1.0, 1, -1, 1])
    wall = scene.gaussians
    behind = replace(wall, means=(wall.means @ turn[:3, :3]).astype(np.float32))
    viewmats = scene.cameras.viewmats.copy()
    viewmats[3] = viewmats[3] @ turn
    both = replace(
        scene,
        gaussians=Gaussians.concat([wall, behind]),
        cameras=replace(scene.cameras, viewmats=viewmats),
        pixels=None,
    )
    rest = subset(pictured(both), [0, 1])
    assert mark_seen(rest, subset(pictured(both), [2])).mean() > 0.9
    turned = subset(pictured(both), [3])
    assert render(both.gaussians, turned.cameras).alphas.mean() > 0.9
    assert mark_seen(rest, turned).mean() == 0


def test_a_shrunk_scene_keeps_the_positions_of_its_gaussians(room: Scene) -> None:
    scene = pictured(room)
    small = shrink_scene(scene, 4)
    assert (small.cameras.width, small.cameras.height) == (12, 9)
    assert small.images.shape == (5, 9, 12, 3)
    assert len(small.gaussians) == 5 * 9 * 12
    assert small.images.mean() == pytest.approx(scene.images.mean(), abs=0.01)
    places, large = (each.gaussians.means.reshape(5, *size, 3) for each, size in ((small, (9, 12)), (scene, (36, 48))))
    assert (places == large[:, 2::4, 2::4]).all()


@pytest.mark.parametrize("scores", [(17.25, 21.5, 3.0, 5.5), (-1.5, 0.0, 0.2, 2.75), (30.12, 29.99, -1.4, 1.1)])
def test_expected_scores_are_read_back_from_a_comment(scores: tuple[float, ...]) -> None:
    comment = new_views_comment(ExpectedScores(*scores))
    assert read_expected_scores(["a comment", 3, comment]) == ExpectedScores(*scores)
    assert comment not in copied_comments([comment])  # a result of a result gets its own


@pytest.mark.parametrize(
    "comment",
    [
        "",
        None,
        "gsmerge new views: 17 to 20 dB, gain 1 to 4 dB",
        "gsmerge new views: 17.00 to 20.00 dB",
        "gsmerge new views: 1e9.00 to 20.00 dB, gain 1.75 to 4.25 dB",
    ],
)
def test_comments_of_another_form_have_no_expected_scores(comment: object) -> None:
    assert read_expected_scores([comment]) is None
    assert read_expected_scores([]) is None
