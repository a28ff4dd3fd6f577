from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from messages import refuses
from tiny_scene import Tiny, make_tiny

from gsmerge.io.cameras.camera_file import CONVENTIONS, FLIP, from_viewmats, to_viewmats
from gsmerge.reading.alignment import Alignment, check_pairs, explain_misalignment, sample_pixels
from gsmerge.reading.alignment.explain import misalignment_error
from gsmerge.types import Cameras, Gaussians


def cameras_of(tiny: Tiny, viewmats: np.ndarray | None = None) -> Cameras:
    return Cameras(tiny.w2c if viewmats is None else viewmats, np.tile(tiny.K, (3, 1, 1)), tiny.width, tiny.height)


def valid_of(tiny: Tiny) -> np.ndarray:
    return np.ones((3, tiny.height, tiny.width), bool)


def check_alignment(gaussians: Gaussians, cameras: Cameras, valid: np.ndarray) -> Alignment:
    return check_pairs(sample_pixels(gaussians, cameras, valid), cameras)


def test_a_scene_with_the_usual_jitter_is_aligned(tiny: Tiny) -> None:
    actual = check_alignment(tiny.gaussians, cameras_of(tiny), valid_of(tiny))
    assert actual.ok
    assert len(actual.median_px) == 3
    assert all(0.05 < m < 0.25 for m in actual.median_px)  # the jitter is 0.2 px along each axis
    assert actual.share_in_front == 1
    assert actual.share_within_1px == 1


def test_a_known_shift_of_one_view_is_measured(tiny: Tiny) -> None:
    moved = cameras_of(tiny)
    Ks = moved.Ks.copy()
    Ks[1, 0, 2] += 3
    actual = check_alignment(tiny.gaussians, replace(moved, Ks=Ks), valid_of(tiny))
    assert not actual.ok
    assert actual.median_px[1] == pytest.approx(3, abs=0.2)
    assert actual.worst_px == actual.median_px[1]
    assert actual.share_within_1px == pytest.approx(2 / 3, abs=0.01)


def test_rows_that_are_set_aside_do_not_count_in_the_alignment(tiny: Tiny) -> None:
    means, valid = tiny.gaussians.means.copy(), valid_of(tiny).reshape(-1)
    means[: len(means) // 2] += 100
    valid[: len(means) // 2] = False
    actual = check_alignment(replace(tiny.gaussians, means=means), cameras_of(tiny), valid)
    assert actual.ok
    assert np.isnan(actual.median_px[0])


def test_a_scene_behind_its_cameras_is_not_aligned(tiny: Tiny) -> None:
    behind = cameras_of(tiny, np.diag([-1.0, -1, -1, 1]) @ tiny.w2c)  # same pixels, but negative depth
    actual = check_alignment(tiny.gaussians, behind, valid_of(tiny))
    assert not actual.ok
    assert actual.share_in_front == 0
    assert actual.median_px == (np.inf,) * 3


def test_alignment_samples_all_columns_of_large_views() -> None:
    tiny = make_tiny(200, 250)
    actual = check_alignment(tiny.gaussians, cameras_of(tiny), valid_of(tiny))
    assert actual.ok
    means = tiny.gaussians.means.reshape(3, 250, 200, 3).copy()
    means[:, :, 1::2] += 50  # every other column: a step of two pixels would miss it
    odd = check_alignment(replace(tiny.gaussians, means=means.reshape(-1, 3)), cameras_of(tiny), valid_of(tiny))
    assert odd.share_within_1px == pytest.approx(0.5, abs=0.02)


def test_shuffled_rows_of_tiny_views_are_not_aligned(tiny: Tiny) -> None:
    small = make_tiny(6, 5)
    assert check_alignment(small.gaussians, cameras_of(small), valid_of(small)).ok
    shuffled = small.gaussians[np.random.default_rng(0).permutation(len(small.gaussians))]
    assert not check_alignment(shuffled, cameras_of(small), valid_of(small)).ok


def test_a_wrong_number_of_rows_is_refused(tiny: Tiny) -> None:
    with refuses(ValueError, "", "3 x 14 x 20", 839):
        check_alignment(tiny.gaussians[:-1], cameras_of(tiny), valid_of(tiny))


def test_viewmats_survive_a_conversion_to_every_convention(tiny: Tiny) -> None:
    for convention in CONVENTIONS:
        assert np.allclose(to_viewmats(from_viewmats(tiny.w2c, convention), convention), tiny.w2c)
    assert np.allclose(to_viewmats(tiny.c2w @ FLIP, ("camera-to-world", "OpenGL")), tiny.w2c)


def test_another_order_of_rows_is_named(tiny: Tiny) -> None:
    good, valid, n = cameras_of(tiny), valid_of(tiny), len(tiny.gaussians)

    def explain(rows: np.ndarray) -> str | None:
        assert not check_alignment(tiny.gaussians[rows], good, valid).ok
        return explain_misalignment(tiny.gaussians[rows], good, valid)

    rows = np.arange(n).reshape(3, tiny.height, tiny.width)
    assert "view fastest" in str(explain(rows.transpose(1, 2, 0).reshape(-1)))
    assert "column-major" in str(explain(rows.transpose(0, 2, 1).reshape(-1)))
    assert explain(np.random.default_rng(0).permutation(n)) is None


def test_the_message_has_the_share_in_front_where_it_explains_the_distance(tiny: Tiny) -> None:
    cameras = cameras_of(tiny)
    shifted = replace(cameras, Ks=cameras.Ks + np.array([[0, 0, 9.0], [0, 0, 0], [0, 0, 0]]))
    behind = cameras_of(tiny, np.diag([-1.0, -1, -1, 1]) @ tiny.w2c)
    for wrong, is_named in ((shifted, False), (behind, True)):
        error = misalignment_error("c.json", check_alignment(tiny.gaussians, wrong, valid_of(tiny)), None)
        assert ("0 % in front" in str(error)) == is_named
