"""Projection errors and their derivatives match plain formulas."""

from __future__ import annotations

import numpy as np
import pytest

from gsmerge.geometry.transforms import motion_matrices, project_points
from gsmerge.kernels.elementary import exp
from gsmerge.kernels.reproject import follow_pixels, linearise, mark_pixels, pixel_errors, see_points

K = np.array([[300.0, 0, 150], [0, 310, 110], [0, 0, 1]])
STEP = 1e-6


def make_poses(count: int, rng: np.random.Generator) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    poses[:, :3, 3] = rng.normal(0, 2, (count, 3))
    return poses


@pytest.mark.parametrize("seed", range(5))
def test_projection_errors_match_the_formula_bit_for_bit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, poses = rng.normal(0, 3, (400, 3)), make_poses(7, rng)
    points[:3] = np.nan, np.inf, 1e300
    views, pixels = rng.integers(0, 7, 400), rng.uniform(0, 300, (400, 2))
    errors = np.empty(400)
    pixel_errors(points, views, poses, np.tile(K, (7, 1, 1)), pixels, errors)
    with np.errstate(all="ignore"):
        places, depths = project_points(points[:, None], poses[views], np.tile(K, (400, 1, 1)))
        expected = np.linalg.norm(places[:, 0] - pixels, axis=1)
    expected = np.where((depths[:, 0] > 0) & np.isfinite(expected), expected, np.inf)
    assert np.array_equal(errors, expected)
    assert 0.2 < np.isinf(errors).mean() < 0.8


@pytest.mark.parametrize("view", [-1, 2])
def test_a_view_that_is_not_there_is_refused(view: int) -> None:
    with pytest.raises(ValueError, match="pixel_errors"):
        pixel_errors(
            np.zeros((1, 3)), np.array([view]), np.zeros((2, 4, 4)), np.zeros((2, 3, 3)), np.zeros((1, 2)), np.zeros(1)
        )


def places_of(points: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where views show points, and whether, by the plain formula."""
    with np.errstate(all="ignore"):
        places, depths = project_points(points.astype(np.float64)[None], poses, np.tile(K, (len(poses), 1, 1)))
        x, y = np.moveaxis(places, -1, 0)
        return places, (depths > 0) & (x >= 0) & (x < 300) & (y >= 0) & (y < 220)


@pytest.mark.parametrize("near", [0.0, 2.5])
def test_marked_pixels_are_those_of_the_points_beyond_the_near_plane(near: float) -> None:
    rng = np.random.default_rng(0)
    points, pose = rng.normal(0, 3, (4000, 3)), make_poses(1, rng)
    points[:3] = np.nan, np.inf, 1e300
    hit, expected = np.zeros((220, 300), np.uint8), np.zeros((220, 300), np.uint8)
    hit[5, 7] = expected[5, 7] = 3
    mark_pixels(points, pose[0], K, near, hit)
    (places,), (shown,) = places_of(points, pose)
    shown &= project_points(points, pose[0], K)[1] > near
    column, row = places[shown].astype(np.int64).T
    expected[row, column] = 1
    assert np.array_equal(hit, expected)
    assert 100 < expected.sum() < 4000


@pytest.mark.parametrize("seed", range(3))
def test_projected_points_match_the_formula_bit_for_bit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, poses, Ks = rng.normal(0, 3, (400, 3)), make_poses(7, rng), np.tile(K, (7, 1, 1))
    points[:3] = np.nan, np.inf, 1e300
    depths, near, behind = rng.uniform(0, 9, (7, 5, 9)), 0.5, 1.1
    depths[::2, 1] = np.inf
    inside, seen = see_points(points, poses, Ks, depths, 300, 220, near, behind)
    with np.errstate(all="ignore"):
        places, z = project_points(points[None], poses, Ks)
        x, y = np.moveaxis(places, -1, 0)
        expected = (z > near) & (x > 0) & (x < 300) & (y > 0) & (y < 220)
    cells = np.where(expected[..., None], places * [9 / 300, 5 / 220], 0).astype(int)
    grid = depths[np.arange(7)[:, None], cells[..., 1], cells[..., 0]]
    assert np.array_equal(inside, expected)
    assert np.array_equal(seen, expected & (z <= behind * grid))
    assert 0.1 < seen.sum() / inside.sum() < 0.9
    assert 0.02 < inside.mean() < 0.5


def longest_series(choices: list[list[int]]) -> int:
    """Return how many of some lists may give one number each, so that the numbers ascend; for each last number."""
    lengths: dict[int, int] = {}
    for keys in choices:
        best = {key: 1 + max((n for last, n in lengths.items() if last < key), default=0) for key in keys}
        for key, length in best.items():
            lengths[key] = max(length, lengths.get(key, 0))
    return max(lengths.values(), default=0)


@pytest.mark.parametrize("mixed", [0, 1])
@pytest.mark.parametrize("seed", range(3))
def test_rows_follow_the_longest_series_of_pixels(seed: int, mixed: int) -> None:
    rng = np.random.default_rng(seed)
    points, poses = rng.normal(0, 3, (150, 3)).astype(np.float32), make_poses(3, rng)
    ids, tails, ends, before = (np.empty(n, t) for n, t in ((150, "i8"), (150, "i8"), (150, "i4"), (450, "i4")))
    scratch = ids, tails, ends, before, np.empty(3, np.int64), np.empty(3, np.int32)
    count = follow_pixels(points, poses, np.tile(K, (3, 1, 1)), *scratch, 300, 220, mixed)
    places, shown = places_of(points, poses)
    pixels = np.where(
        shown, np.floor(np.nan_to_num(places[..., 1])) * 300 + np.floor(np.nan_to_num(places[..., 0])), -1
    )
    views = np.arange(3)[:, None]
    keys = pixels * 3 + views if mixed else views * 66000 + pixels
    choices = [[int(key) for key in keys[shown[:, i], i]] for i in range(150)]
    assert count == (ids >= 0).sum() == longest_series(choices)
    view, pixel = np.divmod(ids[ids >= 0], 66000)
    chosen = pixel * 3 + view if mixed else ids[ids >= 0]
    assert (np.diff(chosen) > 0).all()
    assert all(key in choices[i] for key, i in zip(chosen.tolist(), np.flatnonzero(ids >= 0), strict=True))


def test_scratch_of_another_size_is_refused() -> None:
    scratch = [np.empty(n, t) for n, t in ((1, "i8"), (1, "i8"), (1, "i4"), (3, "i4"), (2, "i8"), (2, "i4"))]
    with pytest.raises(ValueError, match="follow_pixels"):
        follow_pixels(np.zeros((1, 3), np.float32), np.zeros((2, 4, 4)), np.zeros((2, 3, 3)), *scratch, 4, 4, 0)


def residuals_of(points: np.ndarray, pixels: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    places, _ = project_points(points, pose, intrinsics)
    return (places - pixels).T.ravel()


@pytest.mark.parametrize("free", [0, 1, 2, 4])
def test_derivatives_are_central_differences(free: int) -> None:
    rng = np.random.default_rng(free)
    points, pixels, pose = rng.normal(0, 1, (20, 3)), rng.uniform(0, 300, (20, 2)), make_poses(1, rng)[0]
    pose[:3, 3] = 0, 0, 6
    jacobian, residuals = np.empty((40, 6 + free)), np.empty(40)
    linearise(points, pixels, K, pose, jacobian, residuals)
    assert np.allclose(residuals, residuals_of(points, pixels, pose, K), rtol=0, atol=1e-10)
    for column in range(6 + free):
        ends = []
        for step in (STEP, -STEP):
            moved, intrinsics = pose, K.copy()
            if column < 6:
                moved = motion_matrices(step * np.eye(6)[[column]])[0] @ pose
            elif column - 6 >= 2:
                intrinsics[column - 8, 2] += step
            else:
                intrinsics[(0, 1) if free == 1 else column - 6, (0, 1) if free == 1 else column - 6] *= exp(step)
            ends.append(residuals_of(points, pixels, moved, intrinsics))
        assert np.allclose(jacobian[:, column], (ends[0] - ends[1]) / (2 * STEP), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(("rows", "size"), [(39, 6), (40, 5), (40, 11)])
def test_arrays_of_other_sizes_are_refused(rows: int, size: int) -> None:
    with pytest.raises(ValueError, match="linearise"):
        linearise(np.zeros((20, 3)), np.zeros((20, 2)), K, np.eye(4), np.empty((rows, size)), np.empty(rows))
