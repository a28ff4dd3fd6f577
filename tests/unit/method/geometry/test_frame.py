from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from messages import refuses

from gsmerge import Scene
from gsmerge.method.geometry.frame import canonicalise, scene_frame
from gsmerge.method.geometry.transforms import project


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(2, 32, 24))


def moved(scene: Scene, factor: float, shift: list[float]) -> Scene:
    return scenes.move(scene, np.eye(3), factor, np.array(shift))


@pytest.mark.parametrize("factor", [1e-4, 1.0, 3.0, 1e4])
def test_unit_is_a_power_of_two_near_the_median_depth(factor: float, scene: Scene) -> None:
    large = moved(scene, factor, [0, 0, 0])
    unit = scene_frame(large).unit
    depths = project(large.gaussians.means, large.cameras)[1]
    own = np.concatenate([depths[0, : scene.pixels_per_view], depths[1, scene.pixels_per_view :]])
    assert np.log2(unit) % 1 == 0
    assert 2**-0.51 < float(np.median(own)) / unit < 2**0.51


def test_leaving_the_frame_undoes_entering_it(scene: Scene) -> None:
    far = moved(scene, 7.0, [4e5, 5e6, 100])
    canonical, frame = canonicalise(far)
    assert canonical.gaussians.means.dtype == np.float32
    assert np.abs(canonical.gaussians.means).max() < 10
    back = frame.leave(canonical.gaussians)
    assert back.means.dtype == np.float64
    assert np.abs(back.means - far.gaussians.means).max() < 1e-5
    assert np.array_equal(back.scales, far.gaussians.scales)  # a power of two changes no bit
    for name in ("quats", "opacities", "sh0", "shN"):
        assert np.array_equal(getattr(back, name), getattr(far.gaussians, name))


def test_projections_do_not_change_in_the_canonical_frame(scene: Scene) -> None:
    far = moved(scene, 0.01, [4e5, 5e6, 100])
    canonical, frame = canonicalise(far)
    before, after = project(far.gaussians.means, far.cameras), project(canonical.gaussians.means, canonical.cameras)
    assert np.abs(before[0] - after[0]).max() < 1e-2  # pixels; 5e6 and 0.03 share 15 digits
    np.testing.assert_allclose(after[1] * frame.unit, before[1], rtol=1e-4)


def test_flyaways_and_invalid_rows_do_not_move_the_frame(scene: Scene) -> None:
    means, valid = scene.gaussians.means.copy(), scene.pixels.shown.copy()
    means[::100] = 1e8
    valid.reshape(-1)[50::100] = False
    frame = scene_frame(scenes.shown_in(replace(scene, gaussians=replace(scene.gaussians, means=means)), valid))
    assert frame.unit == scene_frame(scene).unit
    assert np.abs(frame.origin - scene_frame(scene).origin).max() < 0.3


def test_the_frame_of_one_valid_row_has_its_origin_there(scene: Scene) -> None:
    mask = np.zeros_like(scene.pixels.shown)
    mask.reshape(-1)[7] = True
    frame = scene_frame(scenes.shown_in(scene, mask))
    assert np.allclose(frame.origin, scene.gaussians.means[7])
    assert frame.unit > 0


def test_the_frame_of_a_large_scene_is_that_of_its_valid_rows() -> None:
    """Only some rows are looked at; they must be valid ones."""
    large = scenes.make_scene(scenes.wall(), scenes.arc(1, 512, 256))
    mask = np.zeros_like(large.pixels.shown)
    mask.reshape(-1)[1::2] = True
    frame = scene_frame(scenes.shown_in(large, mask))
    assert np.abs(frame.origin - scene_frame(large).origin).max() < 0.1


def test_a_frame_without_a_valid_row_is_refused(scene: Scene) -> None:
    with refuses(ValueError, "", "Gaussians", 0):
        scene_frame(scenes.shown_in(scene, np.zeros_like(scene.pixels.shown)))


def test_gaussians_in_the_cameras_plane_have_a_unit() -> None:
    flat = scenes.make_scene(scenes.wall(), scenes.arc(1, 8, 6))
    still = replace(flat, gaussians=replace(flat.gaussians, means=flat.cameras.centres.repeat(48, 0)))
    assert scene_frame(still).unit == 1.0
