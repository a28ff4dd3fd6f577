"""The views of a scene confirm or contradict each other's depth, which sets the share of superpixels."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, inf

import numpy as np
import pytest
import scenes
import unaligned_scenes
from motions import with_nearer_half
from sweeps import sweep

import gsmerge
from gsmerge import Cameras, Scene
from gsmerge.method.facts.agreement import FEWEST, MOST_PER_PIXEL, Agreement
from gsmerge.method.geometry.pooling import scene_members
from gsmerge.method.kernels.elementary import log
from gsmerge.method.stages.encode import encode, weaken_contradicted
from gsmerge.plan.make_plan import make_plan
from gsmerge.prepare.confirm_depths import AGREEMENT_PIXELS, AGREEMENT_SHARE, SAME_LOG_DEPTH, confirm_depths
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.runtime.record import record_run
from gsmerge.settings.compact import CompactOptions
from gsmerge.types import Groups

VIEWS, WIDTH, HEIGHT = 4, 48, 36


@pytest.fixture(scope="module")
def wall() -> Scene:
    return scenes.make_scene(scenes.wall(), scenes.arc(VIEWS, WIDTH, HEIGHT))


def turned_away(scene: Scene, view: int) -> Scene:
    """Turn one view with all that it sees half around the vertical axis through its eye."""
    eye, half = scene.cameras.centres[view], np.diag([-1.0, 1.0, -1.0])
    viewmats = scene.cameras.viewmats.copy()
    viewmats[view, :3, :3] = viewmats[view, :3, :3] @ half
    viewmats[view, :3, 3] = -viewmats[view, :3, :3] @ eye
    means = scene.gaussians.means.reshape(VIEWS, -1, 3).copy()
    means[view] = eye + (means[view] - eye) @ half
    gaussians = replace(scene.gaussians, means=means.reshape(-1, 3))
    return replace(scene, gaussians=gaussians, cameras=replace(scene.cameras, viewmats=viewmats))


def look_at(point: list[float], viewmat: list[list[float]], K: list[list[float]]) -> tuple[float, float, float]:
    """Return where a view shows a point, pixels, and how far ahead it is."""
    x, y, z = (sum(a * b for a, b in zip(row, (*point, 1.0), strict=True)) for row in viewmat[:3])
    return K[0][0] * x / z + K[0][2], K[1][1] * y / z + K[1][2], z


def confirm_slowly(scene: Scene) -> Agreement:
    """Look up each pixel in each other view, one after the other, in the words of the definition."""
    means = scene.gaussians.means.reshape(VIEWS, HEIGHT, WIDTH, 3).tolist()
    lenses = list(zip(scene.cameras.viewmats.tolist(), scene.cameras.Ks.tolist(), strict=True))
    reach = max(AGREEMENT_PIXELS, AGREEMENT_SHARE * WIDTH)
    counts = [0, 0, 0]
    for view in range(VIEWS):
        for row in range(HEIGHT):
            for column in range(WIDTH):
                same, through, seen = 0, 0, False
                for other in {*range(VIEWS)} - {view}:
                    x, y, depth = look_at(means[view][row][column], *lenses[other])
                    if depth <= 0 or not (0 < x < WIDTH and 0 < y < HEIGHT):
                        continue
                    seen = True
                    surface = means[other][int(y)][int(x)]
                    back_x, back_y, ahead = look_at(surface, *lenses[view])
                    there = look_at(surface, *lenses[other])[2]
                    away = hypot(back_x - column - 0.5, back_y - row - 0.5) / reach if ahead > 0 else inf
                    behind = float(log(depth / there))
                    if away < 1 and abs(behind) < SAME_LOG_DEPTH:
                        same += 1
                    elif behind < -2 * SAME_LOG_DEPTH or (behind < 0 and away > 2):
                        through += 1
                counts[0] += same > 0 and same >= through
                counts[1] += through > same
                counts[2] += not seen
    return Agreement(*(count / (VIEWS * HEIGHT * WIDTH) for count in counts))


def test_a_wall_that_all_views_see_is_confirmed(wall: Scene) -> None:
    agreement = confirm_depths(wall)
    assert agreement.confirmed > 0.97
    assert agreement.contradicted < 0.01
    assert agreement.advice is None
    assert agreement.share == MOST_PER_PIXEL


def test_gaussians_in_front_of_what_other_views_see_are_contradicted(wall: Scene) -> None:
    """A half of one view, then of two: an eighth and a quarter of all pixels."""
    one, two = (confirm_depths(with_nearer_half(wall, views)) for views in ([1], [0, 2]))
    assert one.contradicted == pytest.approx(1 / 8, abs=0.05)
    assert two.contradicted == pytest.approx(1 / 4, abs=0.08)
    assert two.confirmed < one.confirmed < confirm_depths(wall).confirmed


def test_pixels_of_a_view_that_looks_elsewhere_are_alone(wall: Scene) -> None:
    agreement = confirm_depths(turned_away(wall, 2))
    assert agreement.alone == pytest.approx(1 / VIEWS + confirm_depths(wall).alone, abs=0.05)
    assert agreement.confirmed > 0.7


@sweep("spoilt", [[0, 2], [1], []])
def test_shares_of_agreement_are_those_of_a_plain_loop(spoilt: list[int], wall: Scene) -> None:
    """But for the pixels that are drawn."""
    scene = with_nearer_half(wall, spoilt)
    actual, expected = confirm_depths(scene).to_dict(), confirm_slowly(scene).to_dict()
    assert actual == pytest.approx(expected, abs=0.03)


def test_pixels_without_a_gaussian_do_not_count_in_the_agreement(wall: Scene) -> None:
    valid = wall.pixels.shown.copy()
    valid[:, :, WIDTH // 2 :] = False
    half = scenes.shown_in(with_nearer_half(wall, [0, 1, 2, 3]), valid)
    assert confirm_depths(half).contradicted < 0.02
    assert confirm_depths(scenes.shown_in(wall, np.zeros_like(wall.pixels.shown))) is None


def test_scenes_in_which_nothing_can_be_compared_have_no_agreement(wall: Scene) -> None:
    assert confirm_depths(scenes.take_views(wall, [0])) is None
    assert confirm_depths(unaligned_scenes.without_order(wall)) is None
    none = Cameras(np.empty((0, 4, 4)), np.empty((0, 3, 3)), 1, 1)
    assert confirm_depths(Scene(wall.gaussians[:0], none, None, None, ())) is None


def test_the_part_of_the_views_that_is_contradicted_most_is_named(wall: Scene) -> None:
    """The right half of two views; of a view that is alone all is, which no part says."""
    agreement = confirm_depths(with_nearer_half(wall, [0, 2]))
    assert (agreement.contradicted_part, agreement.alone_part) == (f"right third of 2 of {VIEWS} views", "")
    assert confirm_depths(turned_away(wall, 2)).alone_part == ""
    assert confirm_depths(wall).contradicted_part == ""
    wrong = replace(agreement, confirmed=0.4).advice
    assert "the depth is wrong (right third of 2 of 4 views)" in wrong


def test_the_share_of_gaussians_falls_with_the_confirmed_share() -> None:
    shares = [Agreement(confirmed, 0, 0).share for confirmed in (1, 0.75, 0.7, 0.65, 0.6, 0.1)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] == shares[1] == MOST_PER_PIXEL
    assert shares[1] > shares[2] > shares[3] > shares[4] == shares[5] == FEWEST


def test_advice_on_a_poor_scene_says_why_it_is_poor() -> None:
    assert Agreement(0.5, 0.5, 0.0).advice is None
    lonely, wrong = Agreement(0.24, 0.14, 0.34).advice, Agreement(0.34, 0.41, 0.07).advice
    assert all(word in lonely for word in ("24 %", "34 %", "too few or too far apart"))
    assert all(word in wrong for word in ("34 %", "depth is wrong"))


def test_advice_on_photos_from_one_point_names_a_panorama(wall: Scene) -> None:
    """Whatever their depths say of one another."""
    cameras = wall.cameras
    centre = cameras.centres[0]
    turned = cameras.viewmats.copy()
    turned[:, :3, 3] = -turned[:, :3, :3] @ centre
    agreement = confirm_depths(replace(wall, cameras=replace(cameras, viewmats=turned)))
    assert agreement.from_one_point
    assert "panorama" in agreement.advice
    whole = confirm_depths(wall)
    assert not whole.from_one_point


def test_pixels_beyond_a_crop_contradict_nothing(wall: Scene) -> None:
    """Pixels without a Gaussian say nothing, and few pixels too little."""
    whole, pixels = confirm_depths(wall), wall.get_pixels()
    middle = np.linalg.norm(wall.gaussians.means - wall.gaussians.means.mean(0), axis=1)
    for share in (0.2, 0.02):
        inside = middle < np.quantile(middle, share)
        cropped = replace(wall, pixels=replace(pixels, fronts=np.where(inside[pixels.fronts], pixels.fronts, -1)))
        agreement = confirm_depths(cropped)
        assert agreement.confirmed > whole.confirmed - 0.1
        assert agreement.advice is None
    assert Agreement(0.1, 0.1, 0.0, num_pixels=8).advice is None


AUTO = CompactOptions().with_settings({"superpixels": "auto"})


@pytest.fixture(scope="module")
def flat() -> Scene:
    return scenes.make_scene(scenes.wall(), scenes.arc(4, 48, 36))


def test_what_other_views_see_through_begins_fainter(flat: Scene) -> None:
    """One view's right half stands nearer than the flat that all others see; the flat itself stays as it is."""
    wrong = with_nearer_half(flat, [1])
    labels = np.arange(48 * 36, dtype=np.int32).reshape(36, 48) // 6
    groups = Groups(np.broadcast_to(labels, (4, 36, 48)).copy(), (288,) * 4)
    features = encode(wrong, scene_members(wrong), groups)
    thin = weaken_contradicted(features, scene_members(wrong), wrong.cameras)
    moved = (features.views == 1) & (np.arange(len(features)) % 8 >= 4)
    factors = thin.gains / features.gains
    assert set(np.unique(factors.round(2))) <= {np.float32(0.15), np.float32(0.39), np.float32(1)}
    assert (factors[moved] < 1).mean() > 0.9
    assert (factors[~moved] == 1).mean() > 0.95
    np.testing.assert_array_equal(thin.means, features.means)


def test_views_that_agree_get_more_superpixels(flat: Scene) -> None:
    shares = []
    for scene in (flat, with_nearer_half(flat, [1]), with_nearer_half(flat, [0, 2])):
        with record_run() as log:
            plan = make_plan(prepare(scene), AUTO)
        shares.append(plan.merge.superpixels.options.share)
        agreement = confirm_depths(scene)
        assert log.choices["agreement"] == agreement.to_dict()
        assert shares[-1] == pytest.approx(agreement.share, rel=0.05)
        assert len(log.notes) == 1
        assert f"other views confirm {100 * agreement.confirmed:.0f} %" in log.notes[0]
    assert shares[0] == shares[1] == MOST_PER_PIXEL  # an eighth of the pixels is contradicted, then a quarter
    assert FEWEST <= shares[2] < MOST_PER_PIXEL


@pytest.mark.slow
def test_an_automatic_budget_is_the_share_that_the_depths_bear(flat: Scene) -> None:
    auto = CompactOptions().with_settings({"budget": "auto"})
    for scene in (flat, with_nearer_half(flat, [0, 2])):
        with record_run() as log:
            plan = make_plan(prepare(scene), auto)
        assert plan.count.limits.count == pytest.approx(confirm_depths(scene).share * len(scene.gaussians), rel=0.05)
        assert any(note.startswith("budget: ") and "confirm" in note for note in log.notes)
        assert not plan.count.auto_count
        assert plan.settings["budget"] == "auto"
    without_fit = make_plan(prepare(flat), auto.with_settings({"fit": "none"}))
    lone = make_plan(prepare(scenes.take_views(flat, [0])), auto)
    assert without_fit.count.auto_count
    assert lone.count.auto_count  # the curve decides: nothing can be compared


def test_scenes_whose_depths_cannot_be_compared_get_the_usual_share(flat: Scene) -> None:
    room = scenes.make_scene(scenes.room(), scenes.arc(4, 48, 36))
    for scene in (scenes.take_views(flat, [0]), unaligned_scenes.without_order(room)):
        with record_run() as log:
            assert make_plan(prepare(scene), AUTO).merge.superpixels.options.share == CompactOptions().segment.share
        assert "compared" in log.notes[0]
        assert "agreement" not in log.choices


def test_run_reports_the_budget_it_chose(flat: Scene) -> None:
    auto, usual = (
        scenes.compacted(flat, superpixels=share, effort="draft", fit_steps=10, poses="fixed")
        for share in ("auto", "4.4%")
    )
    assert len(auto.gaussians) > 1.4 * len(usual.gaussians)
    assert auto.report.options["superpixels"] == "auto"
    assert any(note.startswith("superpixels: ") for note in auto.report.notes)
    with pytest.raises(ValueError, match="superpixels"):
        gsmerge.compact(flat, superpixels="some")
