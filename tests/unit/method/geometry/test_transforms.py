from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsmerge.method.geometry.transforms import (
    SAMPLE_VALUES,
    camera_centres,
    clamp_inside,
    covariances,
    euler_to_rotmat,
    lies_inside,
    lower_median,
    median,
    medians,
    middle_depth,
    move_region,
    normalize,
    project,
    quantiles,
    quat_to_rotmat,
    rotmat_to_quat,
    step_outside,
)
from gsmerge.types import Cameras, Region

HALF = math.sqrt(0.5)


@pytest.mark.parametrize(
    ("quat", "image_of_x"),
    [
        ([1.0, 0, 0, 0], [1.0, 0, 0]),
        ([HALF, 0, 0, HALF], [0.0, 1, 0]),  # a quarter turn about z
        ([HALF, 0, HALF, 0], [0.0, 0, -1]),  # about y
        ([HALF, HALF, 0, 0], [1.0, 0, 0]),  # about x
        ([0.0, 0, 0, 1], [-1.0, 0, 0]),
    ],
)
def test_quarter_turns_rotate_the_x_axis_as_by_hand(quat: list[float], image_of_x: list[float]) -> None:
    rotmat = quat_to_rotmat(np.array(quat))
    assert np.allclose(rotmat[:, 0], image_of_x, atol=1e-12)


def test_quaternions_of_any_length_are_rotations() -> None:
    quats = np.random.default_rng(0).normal(size=(4, 50, 4))
    rotmats = quat_to_rotmat(quats)
    assert rotmats.shape == (4, 50, 3, 3)
    assert np.allclose(rotmats @ rotmats.swapaxes(-1, -2), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(rotmats), 1)
    for other in (-quats, 1e-3 * quats, 1e3 * quats):
        assert np.allclose(quat_to_rotmat(other), rotmats, atol=1e-12)


def test_a_covariance_is_as_by_hand() -> None:
    covar = covariances(np.array([HALF, 0, 0, HALF]), np.array([1.0, 2.0, 3.0]))
    assert np.allclose(covar, np.diag([4.0, 1.0, 9.0]), atol=1e-6)


def test_a_projection_is_as_by_hand() -> None:
    """Eye at (1, 0, 0), looking along x: the world's y is to the left and its z up, which is -y in the image."""
    viewmat = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, -1], [0, 0, 0, 1]])
    K = np.array([[10.0, 0, 8], [0, 20, 6], [0, 0, 1]])
    points = np.array([[3.0, 0, 0], [3, 1, 0], [3, 0, 1], [0, 0, 0]], np.float32)
    where, depths = project(points, Cameras(viewmat[None], K[None], 16, 12))
    assert where.shape == (1, 4, 2)
    assert where.dtype == depths.dtype == np.float64
    np.testing.assert_allclose(where[0, :3], [[8, 6], [3, 6], [8, -4]])
    np.testing.assert_allclose(depths[0], [2, 2, 2, -1])


def test_quaternions_are_read_back_from_their_rotations() -> None:
    """Half turns about every axis too, where a quaternion's first component is zero."""
    quats = np.concatenate([normalize(np.random.default_rng(3).normal(size=(64, 4))), np.eye(4)])
    actual = rotmat_to_quat(quat_to_rotmat(quats))
    np.testing.assert_allclose(np.abs((actual * quats).sum(1)), 1)
    assert (actual[np.arange(68), np.abs(actual).argmax(1)] > 0).all()


@pytest.mark.parametrize("count", [1, 2, 5, 1_000, 300_000, 300_001])
@pytest.mark.parametrize("kind", ["random", "ascending", "few values", "periodic"])
def test_the_median_of_any_number_of_values_is_that_of_numpy(count: int, kind: str) -> None:
    """Also if a sample at even steps says nothing about the median, as with periodic values."""
    values = np.random.default_rng(count).exponential(size=count)
    if kind == "ascending":
        values.sort()
    elif kind == "few values":
        values = np.round(values)
    elif kind == "periodic":
        values[:: max(1, count // SAMPLE_VALUES)] -= 100
    assert median(values) == np.median(values)
    values[count // 3] = np.nan
    assert math.isnan(median(values))


@pytest.mark.parametrize("count", [1, 2, 3, 10, 1001])
def test_medians_are_those_of_numpy(count: int) -> None:
    values = np.random.default_rng(count).normal(size=(count, 3))
    values[count // 2, 1] = np.nan
    assert np.array_equal(medians(values), np.median(values, axis=0), equal_nan=True)
    assert math.isnan(median(np.empty(0)))


@pytest.mark.parametrize("count", [1, 2, 3, 10, 1001])
def test_quantiles_are_those_of_numpy(count: int) -> None:
    values = np.random.default_rng(count).normal(size=(count, 3))
    shares = (0.0, 0.05, 0.5, 0.7, 1.0)
    assert np.array_equal(quantiles(values, shares), np.quantile(values, shares, axis=0))
    assert np.array_equal(
        quantiles(values[:, 0].astype(np.float32), shares), np.quantile(np.float32(values[:, 0]), shares)
    )


def test_lower_median_is_a_value_of_each_column() -> None:
    assert lower_median(np.array([4.0, 1.0, 3.0, 2.0])) == 2
    assert lower_median(np.array([[5.0, 0.0], [1.0, 9.0], [3.0, 8.0]])).tolist() == [3, 8]


def one_camera() -> Cameras:
    K = np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
    return Cameras(np.eye(4)[None], K[None], 100, 80)


def test_the_middle_depth_is_that_of_points_in_the_picture_alone() -> None:
    points = np.array([[0.0, 0, 4], [0, 0, 5], [0.1, 0, 6], [0, 0, -9], [900, 0, 9]])
    assert middle_depth(points, one_camera()) == 5
    assert middle_depth(points[3:], one_camera()) == middle_depth(points[:0], one_camera()) == 1


def test_a_camera_that_steps_outside_turns_about_what_it_sees() -> None:
    viewmat = one_camera().viewmats[0]
    assert camera_centres(step_outside(viewmat, 4, 0.5)) == pytest.approx([0, 0, -2])
    pivot = np.array([[0.0, 0, 4]])
    for azimuth, elevation in ((30, 0), (0, 20), (-75, 40)):
        outside = step_outside(viewmat, 4, 0.5, azimuth, elevation)
        assert pivot @ outside[:3, :3].T + outside[:3, 3] == pytest.approx(np.array([[0, 0, 6]]), abs=1e-9)
    assert camera_centres(step_outside(viewmat, 4, 0.5, azimuth=90)) == pytest.approx([6, 0, 4])  # on the right
    assert camera_centres(step_outside(viewmat, 4, 0.5, elevation=90)) == pytest.approx([0, -6, 4])  # above


@given(
    seed=st.integers(0, 2**32 - 1),
    is_sphere=st.booleans(),
    origin=st.floats(-1e3, 1e3),
    unit=st.sampled_from([0.25, 1.0, 8.0]),
)
def test_points_are_clamped_to_the_nearest_inside(seed: int, is_sphere: bool, origin: float, unit: float) -> None:
    """In any frame: no other point of the region is nearer, and what is inside stays."""
    rng = np.random.default_rng(seed)
    half = np.full(3, 1.5) if is_sphere else rng.uniform(0.5, 3, 3)
    axes = np.eye(3) if is_sphere else euler_to_rotmat(rng.uniform(-180, 180, 3))
    world = Region(rng.normal(size=3), half, axes, is_sphere)
    region, points = move_region(world, np.full(3, origin), unit), rng.normal(size=(40, 3)) * 4
    inside = lies_inside(world, points)
    local = (points - world.middle) @ axes.T
    np.testing.assert_array_equal(
        inside, np.linalg.norm(local, axis=1) <= 1.5 if is_sphere else (abs(local) <= half).all(1)
    )
    moved = (points - origin) / unit
    clamped = clamp_inside(region, moved).astype(np.float32)
    assert lies_inside(region, clamped).all()
    reach = 1e-6 * (1 + abs(moved).max() + abs(region.middle).max())
    np.testing.assert_allclose(clamped[inside], moved[inside], atol=reach)
    others = clamp_inside(region, moved + rng.normal(size=(60, *moved.shape)) / unit)
    nearest = np.linalg.norm(others - moved, axis=2).min(0)
    assert (np.linalg.norm(clamped - moved, axis=1) <= nearest + 4 * reach).all()
