"""Poses and a focal length are found from points and their pixels, as OpenCV finds them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsmerge.method.geometry.transforms import motion_matrices
from gsmerge.reading.alignment.resection import (
    ALL_INTRINSICS,
    ONE_FOCAL,
    focal_uncertainty,
    projection_errors,
    projective_error,
    refine_poses,
    start_pose,
)

K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
TRUE = motion_matrices(np.array([[0.1, 0.2, -0.1, 0.1, 0, 6], [-0.2, 0.1, 0.4, 0.5, 0.3, 7], [0, 0, 0, 0, 0, 5.0]]))


def points_and_pixels(noise: float, seed: int = 0) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return points of three views, and the pixels that show them."""
    rng = np.random.default_rng(seed)
    points = [rng.normal(size=(80, 3)) for _ in TRUE]
    pixels = []
    for one, pose in zip(points, TRUE, strict=True):
        places = (one @ pose[:3, :3].T + pose[:3, 3]) @ K.T
        pixels.append(places[:, :2] / places[:, 2:] + noise * rng.normal(size=(80, 2)))
    return points, pixels


@pytest.mark.parametrize(
    ("guess", "free"), [(K, 0), (K * [[1.4, 1, 1], [1, 1.4, 1], [1, 1, 1]], ONE_FOCAL),
                        (np.array([[330.0, 0, 150], [0, 280, 126], [0, 0, 1]]), ALL_INTRINSICS)],
)  # fmt: skip
def test_exact_pixels_give_poses_and_intrinsics(guess: np.ndarray, free: int):
    points, pixels = points_and_pixels(0.0)
    starts = np.stack([start_pose(p, q, guess) for p, q in zip(points, pixels, strict=True)])
    near_K, poses = refine_poses(points, pixels, guess, starts, free=free)
    np.testing.assert_allclose(near_K, K, atol=1e-5)
    np.testing.assert_allclose(poses, TRUE, atol=1e-6)


def test_focal_length_is_uncertain_before_a_plane_seen_head_on():
    points, pixels = points_and_pixels(0.0)
    Ks = np.tile(K, (3, 1, 1))
    assert focal_uncertainty(points, pixels, Ks, TRUE) < 0.01
    wall = points[0] * [1, 1, 0]
    ahead = np.eye(4)[None].copy()
    ahead[0, 2, 3] = 5
    places = (wall + ahead[0, :3, 3]) @ K.T
    assert focal_uncertainty([wall], [places[:, :2] / places[:, 2:]], Ks[:1], ahead) > 1


@pytest.mark.parametrize("seed", range(3))
def test_poses_from_noisy_pixels_are_those_of_opencv(seed):
    points, pixels = points_and_pixels(1.0, seed)
    for p, q in zip(points, pixels, strict=True):
        start = start_pose(p, q, K)
        _, (pose,) = refine_poses([p], [q], K, start[None])
        rotation, shift = cv2.solvePnPRefineLM(p, q, K, None, cv2.Rodrigues(start[:3, :3])[0], start[:3, 3:])
        np.testing.assert_allclose(pose[:3, :3], cv2.Rodrigues(rotation)[0], atol=1e-5)
        np.testing.assert_allclose(pose[:3, 3:], shift, atol=1e-4)


def test_refined_cameras_have_the_least_projection_error():
    points, pixels = points_and_pixels(1.0)
    near_K, poses = refine_poses(points, pixels, K, TRUE, free=ONE_FOCAL)

    def error(K: np.ndarray, poses: np.ndarray) -> float:
        views = zip(points, pixels, poses, strict=True)
        return sum(float((projection_errors(p, q, K, pose) ** 2).sum()) for p, q, pose in views)

    least = error(near_K, poses)
    for sign in (-1, 1):
        for axis in range(6):
            motion = np.zeros((1, 6))
            motion[0, axis] = 1e-3 * sign
            assert error(near_K, motion_matrices(motion) @ poses) > least
        assert error(near_K * np.array([[1 + 1e-3 * sign] * 2 + [1]]), poses) > least


def test_refining_poses_ends_for_points_in_one_place():
    points, pixels = np.zeros((10, 3)), np.full((10, 2), 5.0)
    assert np.isfinite(refine_poses([points], [pixels], K, TRUE[:1])[1]).all()


def test_refining_poses_without_points_is_an_error():
    with pytest.raises(np.linalg.LinAlgError):
        refine_poses([np.zeros((0, 3))], [np.zeros((0, 2))], K, TRUE[:1])


def test_refining_poses_from_behind_the_points_ends_with_finite_ones():
    points, pixels = points_and_pixels(1.0)
    behind = TRUE.copy()
    behind[:, 2, 3] = 0.5  # points lie in front of the camera, beside it and behind
    near_K, poses = refine_poses(points, pixels, K, behind, free=ONE_FOCAL)
    assert np.isfinite(near_K).all()
    assert np.isfinite(poses).all()


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("wrong", [0.0, 0.25])
def test_projective_error_is_small_where_a_camera_shows_the_points(flat: bool, wrong: float):
    points, pixels = points_and_pixels(0.3)
    rng = np.random.default_rng(1)
    for one, where in zip(points, pixels, strict=True):
        if flat:
            one[:, 2] = 0.2 * one[:, 0] - 0.5
            places = (one @ TRUE[0][:3, :3].T + TRUE[0][:3, 3]) @ K.T
            where[:] = places[:, :2] / places[:, 2:]
        some = rng.random(len(one)) < wrong
        where[some] = rng.permutation(where[some])
        assert projective_error(one, where) < 1  # pixel, of which the noise is 0.3
        assert projective_error(1e4 * one + 50, where) < 1


def test_projective_error_is_large_for_shuffled_pixels():
    rng = np.random.default_rng(1)
    points, pixels = points_and_pixels(0.0)
    assert min(projective_error(p, rng.permutation(q)) for p, q in zip(points, pixels, strict=True)) > 20


def test_projective_error_of_too_few_points_is_zero():
    rng = np.random.default_rng(1)
    assert projective_error(rng.normal(size=(10, 3)), rng.uniform(0, 100, (10, 2))) == 0


def test_projective_error_of_points_in_one_place_is_not_small():
    error = projective_error(np.ones((50, 3)), np.random.default_rng(1).uniform(0, 100, (50, 2)))
    assert not error < 10


def test_refined_poses_stay_finite_where_a_step_would_overflow():
    points, pixels = points_and_pixels(1.0)
    _, poses = refine_poses([p * [1, 1, 1e58] for p in points], pixels, K, TRUE)
    assert np.isfinite(poses).all()
