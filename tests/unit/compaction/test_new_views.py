"""What a new viewpoint gains, as a report expects it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes

from gsmerge import Gaussians, Scene, compact, render
from gsmerge.compaction.new_views import LEAST_VIEWS, MOST_KEPT, NewViews, Trial, _covered, choose_views, shrink_scene
from gsmerge.facts.confirm_depths import Agreement
from gsmerge.facts.views import subset
from gsmerge.geometry import nearest_views
from gsmerge.io.formats.arrays import copied_comments, new_views_comment, read_new_views
from gsmerge.types import PicturedScene

QUICK = {"superpixels": 150, "fit_steps": 12, "checkpoint": "none", "poses": "fixed"}
TRIAL = Trial(own_before=20.0, before=18.0, after=24.0, views=3)


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(5), noise=0.02)


def pictured(scene: Scene) -> PicturedScene:
    return PicturedScene.of(scene, scene.images, scene.masks)


def test_gains_are_those_of_the_trial_up_to_the_share_of_confirmed_depth() -> None:
    assert TRIAL.predict(20, 40, Agreement(0.9, 0, 0)) == NewViews(18, 24, 3)
    assert TRIAL.predict(20, 30, Agreement(0.5, 0.5, 0)) == NewViews(18, 23, 3)
    assert TRIAL.predict(20, 30, Agreement(0, 1, 0)).gain == 0


def test_where_no_depth_is_confirmed_gains_have_a_bound_of_their_own() -> None:
    assert TRIAL.predict(20, 40, None).gain == 6
    assert TRIAL.predict(20, 24, None).gain == pytest.approx(MOST_KEPT * 4)


def test_gaps_that_small_pictures_hide_lower_what_the_input_shows() -> None:
    assert TRIAL.predict(17, 40, None) == NewViews(15, 24, 3)
    assert TRIAL.predict(23, 40, None).before == 18


def test_a_loss_stays_a_loss() -> None:
    worse = Trial(20, 18, 16.5, 2)
    for agreement in (None, Agreement(1, 0, 0), Agreement(0, 1, 0)):
        assert worse.predict(20, 30, agreement).gain == -1.5
        assert TRIAL.predict(20, 19, agreement).gain == 0  # own photos lose: no gain is expected


def test_four_views_say_what_new_ones_gain(room: Scene) -> None:
    report = compact(scenes.take_views(room, range(LEAST_VIEWS)), **QUICK).report
    assert report.new_views is not None
    assert 1 <= report.new_views.views <= LEAST_VIEWS
    most = report.choices["agreement"]["confirmed"] * max(0.0, report.psnr_after - report.psnr_before)
    assert report.new_views.gain <= most + 1e-3
    assert report.seconds["new views"] > 0


@pytest.mark.parametrize("settings", [{"effort": "draft"}, {"new_views": False}], ids=str)
def test_drafts_and_who_asks_for_none_get_none(settings: dict[str, object], room: Scene) -> None:
    report = compact(room, **QUICK, **settings).report
    assert report.new_views is None
    assert "new views" not in report.seconds


def test_a_draft_tells_who_asks(room: Scene) -> None:
    assert compact(room, **QUICK, effort="draft", new_views=True).report.new_views is not None


def test_too_few_photos_say_nothing(room: Scene) -> None:
    assert compact(scenes.take_views(room, range(LEAST_VIEWS - 1)), **QUICK).report.new_views is None
    assert compact(replace(room, images=None), **QUICK).report.new_views is None


def test_threads_change_nothing(room: Scene) -> None:
    one, two = (compact(room, **QUICK, threads=threads) for threads in (1, 2))
    assert one.report.new_views is not None
    assert one.report.new_views == two.report.new_views
    assert scenes.identical(one.gaussians, two.gaussians)


def test_a_trial_leaves_the_result_as_it_is(room: Scene) -> None:
    tried, without = (compact(room, **QUICK, new_views=wanted).gaussians for wanted in (True, False))
    assert scenes.identical(tried, without)


@pytest.mark.parametrize("aligned", [True, False])
def test_views_left_out_together_are_no_neighbours(aligned: bool) -> None:
    scene = scenes.make_scene(scenes.wall(), scenes.arc(18, 16, 12))
    scene = scene if aligned else replace(scene, pixel_ids=None)
    rounds = choose_views(pictured(scene), range(18))
    assert [len(views) for views in rounds] == [3, 3]
    assert len({*rounds[0], *rounds[1]}) == 6
    for views in rounds:
        near = {one: nearest_views(scene.cameras.centres, one)[:2].tolist() for one in views}
        assert not [one for one in views for other in views if one in near[other]]


def test_what_only_left_out_views_show_does_not_count() -> None:
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
        pixel_ids=None,
    )
    rest = subset(pictured(both), [0, 1])
    assert _covered(rest, subset(pictured(both), [2])).mean() > 0.9
    turned = subset(pictured(both), [3])
    assert render(both.gaussians, turned.cameras).alphas.mean() > 0.9
    assert _covered(rest, turned).mean() == 0


def test_only_views_that_show_the_scene_are_left_out() -> None:
    scene = scenes.make_scene(scenes.wall(), scenes.arc(12, 16, 12))
    chosen = {view for views in choose_views(pictured(scene), range(0, 12, 2)) for view in views}
    assert chosen
    assert chosen <= {*range(0, 12, 2)}


def test_small_scenes_keep_places_and_what_they_show(room: Scene) -> None:
    scene = pictured(room)
    small = shrink_scene(scene, 4)
    assert (small.cameras.width, small.cameras.height) == (12, 9)
    assert small.images.shape == (5, 9, 12, 3)
    assert len(small.gaussians) == 5 * 9 * 12
    assert small.images.mean() == pytest.approx(scene.images.mean(), abs=0.01)
    places, large = (each.gaussians.means.reshape(5, *size, 3) for each, size in ((small, (9, 12)), (scene, (36, 48))))
    assert (places == large[:, 2::4, 2::4]).all()
    assert shrink_scene(replace(scene, pixel_ids=None), 4).gaussians is scene.gaussians


@pytest.mark.parametrize(("before", "after"), [(17.25, 21.5), (-1.5, 0.0), (30.126, 29.994)])
def test_files_say_what_to_expect(before: float, after: float) -> None:
    comment = new_views_comment(before, after)
    assert read_new_views(["a comment", 3, comment]) == pytest.approx((before, after), abs=0.005)
    assert comment not in copied_comments([comment])  # a result of a result gets its own


@pytest.mark.parametrize(
    "comment", ["", "gsmerge new views: 17 to 20 dB", "gsmerge new views: 1e9.00 to 20.00 dB", None]
)
def test_other_comments_say_nothing(comment: object) -> None:
    assert read_new_views([comment]) is None
    assert read_new_views([]) is None
