"""What an earlier result shows right is taken over; what has changed comes from the scene itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
from messages import noted

from gsmerge import CompactOptions, Gaussians, Scene, compact
from gsmerge.raster import contributions, plan_view, prepare, render
from gsmerge.raster.photos import NEAR
from gsmerge.runtime.record import record_run
from gsmerge.stages.take_over import LOST, find_changes, measure_flicker, sum_weights, take_over
from gsmerge.types import Decoded

SQUARE = (slice(None), slice(10, 26), slice(20, 40))  # of all views, that a test paints


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Whose photos are what its own Gaussians show: nothing is wrong anywhere."""
    made = scenes.make_scene(scenes.room(), scenes.arc(3, 64, 48), noise=0.0)
    return replace(made, images=render(made.gaussians, made.cameras, near=NEAR).images.clip(0, 1))


def painted(scene: Scene) -> Scene:
    assert scene.images is not None
    images = scene.images.copy()
    images[SQUARE] = (1, 0, 1)
    return replace(scene, images=images)


def start_of(scene: Scene, step: int = 7) -> Decoded:
    some = scene.gaussians[::step]
    return Decoded(some, len(scene.gaussians) + 50, exact=False)


def test_nothing_has_changed(scene: Scene) -> None:
    with record_run(None) as record:
        taken = take_over(scene.gaussians, start_of(scene), scene, range(len(scene)))
    assert taken is not None
    assert np.array_equal(taken.gaussians.means, scene.gaussians.means)
    assert record.choices["taken_over"] == {"kept": len(scene.gaussians), "new": 0, "changed": 0.0}
    assert measure_flicker(scene.gaussians, scene.gaussians, scene, range(len(scene))) == 0


def test_what_has_changed_is_new(scene: Scene) -> None:
    now, start = painted(scene), start_of(scene)
    changed = find_changes(scene.gaussians, now, range(len(now)))
    assert changed[SQUARE].all()
    far = np.ones(changed.shape, np.bool_)
    far[:, 4:32, 14:46] = False
    assert not changed[far].any()
    taken = take_over(scene.gaussians, start, now, range(len(now)))
    assert taken is not None
    old, new = (sum_weights(g, now.cameras, changed) for g in (scene.gaussians, start.gaussians))
    kept = scene.gaussians.means[old[1] <= 0.5 * old[0]]
    added = start.gaussians.means[(new[1] > 0.5 * new[0]) & (new[0] > 0)]
    assert 0 < len(added) < len(kept)
    assert np.array_equal(taken.gaussians.means, np.concatenate([kept, added]))


def test_weights_are_those_of_the_rasterizer(scene: Scene) -> None:
    changed = np.random.default_rng(0).random((len(scene), 48, 64)) < 0.3
    total, inside = sum_weights(scene.gaussians, scene.cameras, changed)
    expected, splats = np.zeros(len(scene.gaussians)), prepare(scene.gaussians)
    for viewmat, K in zip(scene.cameras.viewmats, scene.cameras.Ks, strict=True):
        expected += contributions(plan_view(splats, viewmat, K, 64, 48, near=NEAR))[0]
    assert np.allclose(total, expected, rtol=1e-4, atol=1e-4)
    assert (inside <= total * (1 + 1e-5) + 1e-6).all()
    assert inside.sum() == pytest.approx(0.3 * total.sum(), rel=0.05)


def test_masked_pixels_have_not_changed(scene: Scene) -> None:
    masks = np.ones((len(scene), 48, 64), np.bool_)
    masks[SQUARE] = False
    assert not find_changes(scene.gaussians, replace(painted(scene), masks=masks), range(len(scene))).any()


def test_no_more_than_were_decoded_for(scene: Scene) -> None:
    start = replace(start_of(scene), count=1500)
    taken = take_over(scene.gaussians, start, scene, range(len(scene)))
    assert taken is not None
    weights, _ = sum_weights(scene.gaussians, scene.cameras, np.zeros((len(scene), 48, 64), np.bool_))
    assert len(taken.gaussians) == 1500
    assert np.array_equal(
        taken.gaussians.means, scene.gaussians.means[np.sort(np.argsort(-weights, kind="stable")[:1500])]
    )


def test_what_has_changed_goes_before_what_stays(scene: Scene) -> None:
    """Without room for both: an earlier result that fills the budget alone would leave holes where things moved."""
    now, start = painted(scene), start_of(scene)
    with record_run(None) as record:
        whole = take_over(scene.gaussians, start, now, range(len(now)))
        room = replace(start, count=len(start.gaussians))
        tight = take_over(scene.gaussians, room, now, range(len(now)))
    assert whole is not None
    assert tight is not None
    new = record.choices["taken_over"]["new"]
    assert 0 < new < len(tight.gaussians) == room.count < len(whole.gaussians)
    assert np.array_equal(tight.gaussians.means[-new:], whole.gaussians.means[-new:])


def test_far_too_many_are_of_no_use(scene: Scene) -> None:
    """Such as all Gaussians of a scene: what is left of them has holes."""
    with record_run(None) as record:
        start = replace(start_of(scene), count=len(scene.gaussians) // 9)
        assert take_over(scene.gaussians, start, scene, range(len(scene))) is None
    assert noted(record.notes, f"{len(scene.gaussians):,}", "nothing is taken over")


def test_another_place_is_of_no_use(scene: Scene) -> None:
    assert scene.images is not None
    other = replace(scene, images=1 - scene.images)
    with record_run(None) as record:
        assert take_over(scene.gaussians, start_of(scene), other, range(len(scene))) is None
    assert any("nothing is taken over" in note for note in record.notes)
    assert float(find_changes(scene.gaussians, other, range(len(scene))).mean()) > LOST


@pytest.mark.parametrize("count", [0, 3, 8])
def test_harmonics_become_those_of_the_scene(scene: Scene, count: int) -> None:
    def widened(gaussians: Gaussians, number: int) -> Gaussians:
        return replace(gaussians, shN=np.zeros((len(gaussians), number, 3), np.float32))

    start = start_of(scene)
    start = replace(start, gaussians=widened(start.gaussians, count))
    taken = take_over(widened(scene.gaussians, 3), start, scene, range(len(scene)))
    assert taken is not None
    assert taken.gaussians.shN.shape[1] == count


def test_compact_goes_on_from_an_earlier_result(scene: Scene) -> None:
    """In half the steps, and where there is nothing to go on from with a note."""
    settings: dict[str, Any] = {"budget": 300, "fit_steps": 40, "seed": 1}
    first = compact(scene, **settings)
    second = compact(scene, earlier=first.gaussians, **settings)
    assert second.report.choices["fit"]["steps"] == 20
    assert np.isnan(second.report.choices["fit"]["holdout_after"])  # nothing is held out
    assert second.report.choices["taken_over"]["kept"] > 250
    assert second.report.choices["flicker"] < 0.02
    assert len(second.gaussians) <= 300
    alone = compact(scene, CompactOptions(), earlier=first.gaussians, fit="none", budget=300)
    assert any("not used" in note for note in alone.report.notes)
    assert "taken_over" not in alone.report.choices
