"""Alignment of renders with photos: what was changed is found back, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import scenes

from gsmerge import Cameras, Gaussians, render
from gsmerge.measure.align import _curvature, _moved, _slope, _Target, fit_colors, refine_pose
from gsmerge.raster import prepare
from gsmerge.runtime.threads import use_threads

CENTRE = np.array([0.0, 0.0, 3.0])
AFFINE = np.array([[0.8, 0.1, 0.0], [0.0, 0.7, 0.05], [0.1, 0.0, 0.75], [0.05, 0.02, 0.01]])
SETTINGS = {"centre": CENTRE, "near": 0.03}


def moved(camera: Cameras, degrees: float, shift: float) -> Cameras:
    """The camera after a turn about its own centre and a shift of it, world units."""
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.radians(degrees) * np.array([0.36, 0.8, 0.48]))[0]
    turn[:3, 3] = shift * np.array([0.6, -0.64, 0.48])
    return replace(camera, viewmats=turn @ camera.viewmats)


def pose_error(actual: Cameras, expected: Cameras) -> tuple[float, float]:
    """Degrees, and world units between the centres."""
    turn = actual.viewmats[0, :3, :3] @ expected.viewmats[0, :3, :3].T
    angle = np.degrees(np.linalg.norm(cv2.Rodrigues(turn)[0]))
    return float(angle), float(np.linalg.norm(actual.centres - expected.centres))


@pytest.fixture(scope="module", params=[0, 1], ids="degree {}".format)
def known(request: pytest.FixtureRequest) -> tuple[Gaussians, Cameras, np.ndarray]:
    """Gaussians, a camera of 160 x 120 pixels, and its photo."""
    scene = scenes.make_scene(scenes.room(), scenes.arc(2, 160, 120), degree=request.param)
    return scene.gaussians, scene.cameras[[0]], render(scene.gaussians, scene.cameras[[0]]).images[0].clip(0, 1)


def everywhere(photo: np.ndarray) -> np.ndarray:
    return np.ones(photo.shape[:2], bool)


def test_an_affine_colour_is_undone() -> None:
    image = np.random.default_rng(0).random((20, 30, 3)).astype(np.float32)
    photo = (image @ AFFINE[:3] + AFFINE[3]).astype(np.float32)
    mask = np.random.default_rng(1).random((20, 30)) < 0.3
    spoiled = np.where(mask[..., None], photo, 0)  # what nobody has seen does not count
    np.testing.assert_allclose(fit_colors(image, spoiled, mask), photo, atol=1e-6)


def test_colours_without_pixels_or_contrast() -> None:
    image = np.full((4, 5, 3), 0.25, np.float32)
    assert fit_colors(image, 1 - image, np.zeros((4, 5), bool)) is image
    np.testing.assert_allclose(fit_colors(image, 1 - image, np.ones((4, 5), bool)), 0.75, atol=1e-6)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize(("degrees", "shift"), [(1.0, 0.0), (0.0, 0.06), (1.0, 0.06)])  # 0.06: 2 % of the depth
def test_a_moved_camera_is_moved_back(
    known: tuple[Gaussians, Cameras, np.ndarray], degrees: float, shift: float, antialiased: bool
) -> None:
    gaussians, camera, _ = known
    photo = render(gaussians, camera, antialiased=antialiased).images[0].clip(0, 1)
    start = moved(camera, degrees, shift)
    actual, change = refine_pose(
        prepare(gaussians), start, photo, everywhere(photo), **SETTINGS, antialiased=antialiased
    )  # fmt: skip
    before, after = pose_error(start, camera), pose_error(actual, camera)
    assert after[0] <= 0.1 * max(before[0], 1.0)
    assert after[1] <= 0.1 * max(before[1], 0.06)
    assert change.degrees == pytest.approx(before[0], abs=0.1)
    assert change.shift == pytest.approx(before[1] / 3, rel=0.2, abs=0.002)


@pytest.mark.parametrize("factor", [1e-4, 1e4])
def test_units_and_far_origins_change_nothing(known: tuple[Gaussians, Cameras, np.ndarray], factor: float) -> None:
    gaussians, camera, photo = known
    away = np.array([1e5, -2e5, 3e4]) * factor
    splats = prepare(scenes.move_gaussians(gaussians, np.eye(3), factor, away))
    start = moved(camera, 1.0, 0.06)
    viewmats = start.viewmats.copy()
    viewmats[:, :3, 3] = factor * viewmats[:, :3, 3] - viewmats[:, :3, :3] @ away
    _, change = refine_pose(
        splats, replace(start, viewmats=viewmats), photo, everywhere(photo),
        centre=factor * CENTRE + away, near=factor * 0.03,
    )  # fmt: skip
    _, usual = refine_pose(prepare(gaussians), start, photo, everywhere(photo), **SETTINGS)
    assert change.degrees == pytest.approx(usual.degrees, abs=0.05)
    assert change.shift == pytest.approx(usual.shift, rel=0.1)


def test_a_flaw_of_the_scene_moves_no_camera(known: tuple[Gaussians, Cameras, np.ndarray]) -> None:
    gaussians, camera, photo = known
    flawed = photo.copy()
    flawed[:40, :50] = 1
    actual, _ = refine_pose(prepare(gaussians), moved(camera, 1.0, 0.0), flawed, everywhere(photo), **SETTINGS)
    assert pose_error(actual, camera)[0] < 0.2  # of 1 degree


def test_a_camera_stays_where_nothing_is_gained(known: tuple[Gaussians, Cameras, np.ndarray]) -> None:
    gaussians, camera, photo = known
    nothing = np.zeros(photo.shape[:2], bool)
    for one, mask in ((gaussians, nothing), (gaussians[:0], ~nothing), (gaussians, ~nothing)):
        actual, change = refine_pose(prepare(one), camera, photo, mask, **SETTINGS)
        np.testing.assert_allclose(actual.viewmats, camera.viewmats, atol=1e-6)
        assert change.degrees < 1e-4
    flat = np.zeros_like(photo)
    refine_pose(prepare(replace(gaussians, sh0=0 * gaussians.sh0 - 9)), camera, flat, ~nothing, **SETTINGS)


def test_threads_do_not_matter(known: tuple[Gaussians, Cameras, np.ndarray]) -> None:
    gaussians, camera, photo = known
    actual = []
    for threads in (1, 3):
        with use_threads(threads):
            start = moved(camera, 0.5, 0.0)
            actual.append(refine_pose(prepare(gaussians), start, photo, everywhere(photo), **SETTINGS)[0])
    np.testing.assert_array_equal(actual[0].viewmats, actual[1].viewmats)


def test_slope_and_curvature_are_those_of_the_error(known: tuple[Gaussians, Cameras, np.ndarray]) -> None:
    gaussians, camera, photo = known
    mask = everywhere(photo)
    mask[:30] = False
    target = _Target(prepare(gaussians), photo, mask, camera.Ks[0], 0.3, 0.03, False, CENTRE)
    trial = target.try_pose(moved(camera, 0.2, 0.01).viewmats[0])
    slope, curvature, unit = _slope(target, trial, 3.0, 0.05), _curvature(target, trial, 3.0, 0.05), 3.0
    expected = []
    for i in range(6):
        step = 1e-3 * np.eye(6)[i]
        ends = (target.try_pose(_moved(trial.viewmat, way * step, target, unit)).error(0.05) for way in (1, -1))
        expected.append((next(ends) - next(ends)) / 2e-3)
    # weights that cross a threshold, and the picture's border, have no gradient
    assert np.linalg.norm(slope - expected) < 0.06 * np.linalg.norm(expected)
    newton = -np.linalg.solve(curvature, slope)
    assert target.try_pose(_moved(trial.viewmat, newton, target, unit)).error(0.05) < 0.3 * trial.error(0.05)
