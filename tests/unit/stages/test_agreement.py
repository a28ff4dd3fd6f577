"""The depths of other views make groups fainter, and set the share of superpixels."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
import unaligned_scenes
from motions import with_nearer_half

import gsmerge
from gsmerge import Scene
from gsmerge.geometry.pooling import scene_members
from gsmerge.plan import make_plan
from gsmerge.prepare.confirm_depths import FEWEST, MOST_PER_PIXEL, confirm_depths
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.runtime.record import record_run
from gsmerge.settings.compact import CompactOptions
from gsmerge.stages.encode import encode, weaken_contradicted
from gsmerge.types import Groups

AUTO = CompactOptions().with_settings({"superpixels": "auto"})


@pytest.fixture(scope="module")
def wall() -> Scene:
    return scenes.make_scene(scenes.wall(), scenes.arc(4, 48, 36))


def test_what_other_views_see_through_begins_fainter(wall: Scene) -> None:
    """One view's right half stands nearer than the wall that all others see; the wall itself stays as it is."""
    wrong = with_nearer_half(wall, [1])
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


def test_views_that_agree_get_more_superpixels(wall: Scene) -> None:
    shares = []
    for scene in (wall, with_nearer_half(wall, [1]), with_nearer_half(wall, [0, 2])):
        with record_run() as log:
            plan = make_plan(prepare(scene), AUTO)
        shares.append(plan.superpixels.options.share)
        agreement = confirm_depths(scene)
        assert log.choices["agreement"] == agreement.to_dict()
        assert shares[-1] == pytest.approx(agreement.share, rel=0.05)
        assert len(log.notes) == 1
        assert f"other views confirm {100 * agreement.confirmed:.0f} %" in log.notes[0]
    assert shares[0] == shares[1] == MOST_PER_PIXEL  # an eighth of the pixels is contradicted, then a quarter
    assert FEWEST <= shares[2] < MOST_PER_PIXEL


@pytest.mark.slow
def test_an_automatic_budget_is_the_share_that_the_depths_bear(wall: Scene) -> None:
    auto = CompactOptions().with_settings({"budget": "auto"})
    for scene in (wall, with_nearer_half(wall, [0, 2])):
        with record_run() as log:
            plan = make_plan(prepare(scene), auto)
        assert plan.limits.count == pytest.approx(confirm_depths(scene).share * len(scene.gaussians), rel=0.05)
        assert any(note.startswith("budget: ") and "confirm" in note for note in log.notes)
        assert not plan.auto_count
        assert plan.settings["budget"] == "auto"
    without_fit = make_plan(prepare(wall), auto.with_settings({"fit": "none"}))
    lone = make_plan(prepare(scenes.take_views(wall, [0])), auto)
    assert without_fit.auto_count
    assert lone.auto_count  # the curve decides: nothing can be compared


def test_scenes_whose_depths_cannot_be_compared_get_the_usual_share(wall: Scene) -> None:
    room = scenes.make_scene(scenes.room(), scenes.arc(4, 48, 36))
    for scene in (scenes.take_views(wall, [0]), unaligned_scenes.without_order(room)):
        with record_run() as log:
            assert make_plan(prepare(scene), AUTO).superpixels.options.share == CompactOptions().segment.share
        assert "compared" in log.notes[0]
        assert "agreement" not in log.choices


def test_run_reports_the_budget_it_chose(wall: Scene) -> None:
    auto, usual = (
        scenes.compacted(wall, superpixels=share, effort="draft", fit_steps=10, poses="fixed")
        for share in ("auto", "4.4%")
    )
    assert len(auto.gaussians) > 1.4 * len(usual.gaussians)
    assert auto.report.options["superpixels"] == "auto"
    assert any(note.startswith("superpixels: ") for note in auto.report.notes)
    with pytest.raises(ValueError, match="superpixels"):
        gsmerge.compact(wall, superpixels="some")
