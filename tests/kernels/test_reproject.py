"""Comparisons of views, errors of projection and their derivatives match plain formulas."""

from __future__ import annotations

import numpy as np
import pytest

from gsmerge.method.geometry.transforms import camera_depths, motion_matrices, project_points
from gsmerge.method.kernels.elementary import exp, log, log1p
from gsmerge.method.kernels.matrices import matmul
from gsmerge.method.kernels.pictures import sample_bilinear
from gsmerge.method.kernels.reproject import (
    SCRATCH_COLUMNS,
    add_differences,
    compare_views,
    find_surfaces,
    follow_pixels,
    linearise,
    mark_pixels,
    pixel_errors,
    see_points,
)

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
    scratch = ids, tails, ends, before, np.empty(3, np.int64), np.empty(3, np.int32), np.empty(3, np.int64)
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
    scratch = [np.empty(n, t) for n, t in ((1, "i8"), (1, "i8"), (1, "i4"), (3, "i4"), (2, "i8"), (2, "i4"), (2, "i8"))]
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


NEAR, BORDER, SCALE = 0.1, 2, 3.0
MIN_SEEN, SAME_DEPTH, DOUBT, MIN_DOUBT, CLEAR = 50, 0.15, 1.5, 0.01, 0.03
HEIGHT, WIDTH, VIEWS, POINTS = 30, 40, 4, 300
PAIRS = np.array([[0, 1], [1, 0], [2, 0], [3, 1], [1, 3]])


class Views:
    """Random pixels of views that stand close to each other; the last one has few."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.K = np.array([[35.0, 0, 20], [0, 36, 15], [0, 0, 1]])
        self.Ks = np.tile(self.K, (VIEWS, 1, 1))
        self.given = motion_matrices(rng.normal(0, 0.03, (VIEWS, 6)))
        self.viewmats = matmul(self.given, motion_matrices(rng.normal(0, 0.01, (VIEWS, 6))))
        counts = [POINTS, POINTS - 1, POINTS // 2, 40]
        self.starts = np.cumsum([0, *counts])
        pixels = rng.uniform((0, 0), (WIDTH, HEIGHT), (sum(counts), 2))
        rays = np.concatenate([(pixels - self.K[:2, 2]) / self.K[[0, 1], [0, 1]], np.ones((len(pixels), 1))], 1)
        self.points = rays * rng.uniform(1.7, 2.3, (len(pixels), 1))
        self.greys = rng.random((len(PAIRS), POINTS), np.float32)
        self.pictures = rng.random((VIEWS, HEIGHT, WIDTH, 3), np.float32)
        self.depths = rng.uniform(1.8, 2.2, (VIEWS, HEIGHT, WIDTH))
        self.depths[:, 3] = np.nan

    def places(self, viewmats: np.ndarray, a: int, b: int) -> tuple[np.ndarray, ...]:
        points = self.points[self.starts[a] : self.starts[a + 1]]
        world = matmul(points - viewmats[a, :3, 3], viewmats[a, :3, :3])
        x, y, z = (matmul(world, viewmats[b, :3, :3].T) + viewmats[b, :3, 3]).T
        z, K = np.maximum(z, NEAR), self.K
        return x / z, y / z, z, K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2], world

    def compared(self, pair: int) -> tuple[np.ndarray, np.ndarray, float, float]:
        """Return curvature, slope, cost and flow of one pair, by arrays."""
        a, b = PAIRS[pair]
        x, y, z, u, v, world = self.places(self.viewmats, a, b)
        inside = (z > NEAR) & (u > BORDER) & (u < WIDTH - BORDER) & (v > BORDER) & (v < HEIGHT - BORDER)
        rows, columns = v.clip(0, HEIGHT - 1).astype(int), u.clip(0, WIDTH - 1).astype(int)
        inside &= np.abs(log(self.depths[b, rows, columns] / z)) < SAME_DEPTH
        if inside.sum() < MIN_SEEN:
            return np.zeros((6, 6)), np.zeros(6), 0.0, 0.0
        first = self.places(self.given, a, b)
        flow = SCALE * float(np.median(np.sqrt((u - first[3]) ** 2 + (v - first[4]) ** 2)[inside]))
        x, y, z, u, v, world = (values[inside] for values in (x, y, z, u, v, world))
        grey, right, down = sample_bilinear(self.pictures[b], u - 0.5, v - 0.5).T.astype(np.float64)
        residual = grey - self.greys[pair, : len(inside)][inside]
        residual -= np.median(residual)
        doubt = max(MIN_DOUBT, DOUBT * float(np.median(np.abs(residual))))
        weights = 1 / (doubt**2 + residual**2)
        right, down = right * self.K[0, 0] / z, down * self.K[1, 1] / z
        slopes = matmul(np.stack([right, down, -(right * x + down * y)], 1), self.viewmats[b, :3, :3])
        ways = np.concatenate([np.cross(world, slopes), slopes], 1)
        weighted = ways * weights[:, None]
        cost = float(log1p((residual / CLEAR) ** 2).mean())
        return matmul(weighted.T, ways), matmul(weighted.T, residual), cost, flow

    def compare(self, pairs: np.ndarray = PAIRS, room: int = POINTS) -> list[np.ndarray]:
        count, greys = len(pairs), np.resize(self.greys, (len(pairs), room))
        out = [np.full((count, 6, 6), np.nan), np.full((count, 6), np.nan), *np.full((2, count), np.nan)]
        for first, last in ((0, 2), (2, count)):
            compare_views(
                self.points, greys, self.starts, pairs, self.viewmats, self.given, self.Ks, self.pictures,
                self.depths, NEAR, BORDER, SCALE, first, last, np.empty((SCRATCH_COLUMNS, room)),
                np.empty(room, np.int64), *out,
            )  # fmt: skip
        return out


@pytest.mark.parametrize("seed", range(4, 9))
def test_comparisons_of_pairs_match_the_formula_bit_for_bit(seed: int) -> None:
    views = Views(seed)
    curvatures, slopes, costs, flows = views.compare()
    for row, (a, _) in enumerate(PAIRS):
        curvature, slope, cost, flow = views.compared(row)
        assert np.array_equal(curvatures[row], curvature)
        assert np.array_equal(slopes[row], slope)
        assert flows[row] == flow
        assert costs[row] == pytest.approx(cost, rel=1e-12)  # NumPy adds in another order
        assert (flow == 0) == (a == 3)  # too few pixels


def test_missing_view_or_too_little_room_is_refused() -> None:
    views = Views(0)
    with pytest.raises(ValueError, match="compare_views"):
        views.compare(np.array([[0, 1], [1, VIEWS]]))
    with pytest.raises(ValueError, match="compare_views"):
        views.compare(room=POINTS - 1)


@pytest.mark.parametrize("seed", range(5))
def test_surfaces_of_views_match_the_formula(seed: int) -> None:
    rng, pixels = np.random.default_rng(seed), HEIGHT * WIDTH
    means, others = (rng.uniform((-1.5, -1, 1.8), (1.5, 1, 2.4), (pixels, 3)).astype(np.float32) for _ in range(2))
    means[:2], valid = np.nan, rng.random(pixels) < 0.8
    viewmat, K = motion_matrices(rng.normal(0, 0.1, (1, 6)))[0], np.array([[35.0, 0, 20], [0, 36, 15], [0, 0, 1]])
    rows = rng.permutation(pixels)[: pixels // 2]
    ids, places = find_surfaces(means, rows, others, valid, viewmat, K, WIDTH, NEAR, 0.05)
    with np.errstate(all="ignore"):
        at, depths = project_points(means[rows].astype(np.float64), viewmat, K)
    inside = (depths > NEAR) & (at >= 0).all(1) & (at < (WIDTH, HEIGHT)).all(1)
    x, y = np.where(inside[:, None], at, 0).astype(int).T
    there = y * WIDTH + x
    apart = np.abs(log(np.maximum(depths, NEAR) / np.maximum(camera_depths(others[there], viewmat), NEAR)))
    expected = np.flatnonzero(inside & valid[there] & (apart < 0.05))
    assert np.array_equal(ids, expected)
    assert np.array_equal(places, there[expected])
    assert 20 < len(ids) < pixels // 3
    with pytest.raises(ValueError, match="find_surfaces"):
        find_surfaces(means, rows + pixels, others, valid, viewmat, K, WIDTH, NEAR, 0.05)


@pytest.mark.parametrize("seed", range(3))
def test_differences_of_views_match_the_formula_bit_for_bit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    picture, colors = rng.random((HEIGHT, WIDTH, 3), np.float32), rng.random((POINTS, 3), np.float32)
    pixels = rng.permutation(HEIGHT * WIDTH)[:POINTS]
    along, start = rng.normal((0, 0, 1), (9, 7, 0.5), (POINTS, 3)).T.copy(), np.array([20.0, 15, 0.3])
    depths, before = rng.uniform(0.5, 2, POINTS), rng.random((HEIGHT, WIDTH, 2), np.float32)
    before.reshape(-1, 2)[pixels[:9]] = np.nan
    sums = before.copy()
    add_differences(picture, along, start, depths, colors, pixels, sums)
    x, y, z = along * depths + start[:, None]
    column, row = np.floor(x / z), np.floor(y / z)
    seen = (z > 0) & (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
    apart = np.abs(picture[row[seen].astype(int), column[seen].astype(int)] - colors[seen])
    expected = before.copy()
    expected.reshape(-1, 2)[pixels[seen], 0] += (apart[:, 0] + apart[:, 1] + apart[:, 2]) / 3
    expected.reshape(-1, 2)[pixels[seen], 1] += 1
    assert np.array_equal(sums, expected, equal_nan=True)
    assert 50 < seen.sum() < POINTS - 50
    with pytest.raises(ValueError, match="add_differences"):
        add_differences(picture, along, start, depths, colors, pixels + HEIGHT * WIDTH, sums)
