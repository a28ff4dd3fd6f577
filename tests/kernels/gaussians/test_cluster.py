"""Overlaps and clusters match slow, obvious numpy in float64."""

from __future__ import annotations

import numpy as np
import pytest
from messages import refuse_all
from scipy.sparse import coo_matrix, csgraph

from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.gaussians.cluster import (
    bhattacharyya,
    box_overlap,
    connected_components,
    edge_scores,
    leader_clusters,
)

Gaussian = tuple[np.ndarray, np.ndarray]


def random_gaussians(count: int, seed: int, spread: float = 0.5) -> list[Gaussian]:
    rng = np.random.default_rng(seed)
    halves = rng.normal(size=(count, 3, 3))
    return [(rng.normal(size=3) * spread, half @ half.T + 0.05 * np.eye(3)) for half in halves]


def upper(covar: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(covar[np.triu_indices(3)])


def overlap(a: Gaussian, b: Gaussian) -> float:
    return bhattacharyya(a[0], upper(a[1]), b[0], upper(b[1]))


def overlap_reference(a: Gaussian, b: Gaussian) -> float:
    """Return exp(-D_B), Bhattacharyya 1943."""
    middle, delta = (a[1] + b[1]) / 2, b[0] - a[0]
    distance = delta @ np.linalg.solve(middle, delta) / 8
    dets = [np.linalg.det(c) for c in (middle, a[1], b[1])]
    return float(elementary.exp(-distance - 0.5 * elementary.log(dets[0] / np.sqrt(dets[1] * dets[2]))))


def box_reference(a: Gaussian, b: Gaussian) -> float:
    sides = [np.sqrt(np.diag(c)) for c in (a[1], b[1])]
    low = np.maximum(a[0] - sides[0], b[0] - sides[1])
    high = np.minimum(a[0] + sides[0], b[0] + sides[1])
    shared = np.prod(np.maximum(high - low, 0))
    return float(shared / (np.prod(2 * sides[0]) + np.prod(2 * sides[1]) - shared))


def test_overlaps_match_the_formulas() -> None:
    gaussians = random_gaussians(40, 0)
    for a in gaussians[:20]:
        for b in gaussians[20:]:
            assert overlap(a, b) == pytest.approx(overlap_reference(a, b), rel=1e-9)
            assert overlap(a, b) == pytest.approx(overlap(b, a), rel=1e-12)
            box = box_overlap(a[0], upper(a[1]), b[0], upper(b[1]))
            assert box == pytest.approx(box_reference(a, b), rel=1e-9)


def test_overlap_is_one_for_equal_and_zero_for_far_gaussians() -> None:
    a = random_gaussians(1, 1)[0]
    far = (a[0] + 1e4, a[1])
    assert overlap(a, a) == pytest.approx(1)
    assert overlap(a, far) == 0
    assert box_overlap(a[0], upper(a[1]), a[0], upper(a[1])) == pytest.approx(1)
    assert box_overlap(a[0], upper(a[1]), far[0], upper(a[1])) == 0


def test_flat_gaussians_overlap_with_nothing() -> None:
    """Singular covariances overlap with nothing rather than with everything."""
    zero = (np.zeros(3), np.zeros((3, 3)))
    assert overlap(zero, zero) == 0
    assert box_overlap(zero[0], upper(zero[1]), zero[0], upper(zero[1])) == 0
    sheet = (np.zeros(3), np.diag([1.0, 1.0, 0.0]))
    assert overlap(sheet, sheet) == 0


@pytest.mark.parametrize("width", [0, 3])
@pytest.mark.parametrize("boxes", [True, False])
def test_edge_scores_match_the_formulas(boxes: bool, width: int) -> None:
    gaussians = random_gaussians(30, 5, 0.2)
    rng = np.random.default_rng(0)
    neighbors = rng.integers(-1, 30, (30, 6))
    colors, views = rng.uniform(0, 0.3, (30, 3)), rng.integers(-1, 3, 30)
    means, covars = np.stack([g[0] for g in gaussians]), np.stack([upper(g[1]) for g in gaussians])
    latents = rng.normal(size=(30, width)).astype(np.float32)
    latents /= np.maximum(np.linalg.norm(latents, axis=1, keepdims=True), 1e-9)
    scores = np.empty(neighbors.shape)
    edge_scores(neighbors, means, covars, colors, latents, views, 0.2, 0.3, boxes, scores)
    score = box_reference if boxes else overlap_reference
    for i, row in enumerate(neighbors):
        for k, j in enumerate(row):
            own = views[i] >= 0 and views[i] == views[j]
            unlike = latents[i] @ latents[j] < 0.3 if width else np.linalg.norm(colors[i] - colors[j]) > 0.2
            if j < 0 or own or unlike:
                assert scores[i, k] == -1
            else:
                assert scores[i, k] == pytest.approx(score(gaussians[i], gaussians[j]), rel=1e-9)


def leaders_reference(
    order: np.ndarray, neighbors: np.ndarray, scores: np.ndarray, views: np.ndarray, threshold: float, most: int
) -> list[set[int]]:
    free, clusters = set(range(len(order))), []
    for leader in order.tolist():
        if leader not in free:
            continue
        cluster = [leader]
        free.remove(leader)
        candidates = sorted(zip(-scores[leader], neighbors[leader].tolist(), strict=True), key=lambda pair: pair[0])
        for score, j in candidates:
            taken = views[j] >= 0 and views[j] in [views[m] for m in cluster[1:]]
            if -score >= threshold and j in free and not taken and len(cluster) < most:
                cluster.append(j)
                free.remove(j)
        clusters.append(set(cluster))
    return clusters


def as_sets(clusters: np.ndarray, count: int) -> list[set[int]]:
    assert sorted(set(clusters.tolist())) == list(range(count))
    return [set(np.nonzero(clusters == c)[0].tolist()) for c in range(count)]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("most", [1, 2, 4, 9])
def test_leader_clusters_match_a_slow_twin(seed: int, most: int) -> None:
    rng = np.random.default_rng(seed)
    n, k = 60, 8
    neighbors = np.stack([rng.permutation([j for j in range(n) if j != i])[:k] for i in range(n)])
    views = rng.integers(0, 5, n)
    scores = rng.uniform(0, 1, (n, k))
    scores[views[:, None] == views[neighbors]] = -1
    order = rng.permutation(n)
    actual = as_sets(*leader_clusters(order, neighbors, scores, views, 0.4, most))
    assert actual == leaders_reference(order, neighbors, scores, views, 0.4, most)
    for cluster in actual:
        assert len(cluster) <= most
        assert len({views[i] for i in cluster}) == len(cluster)


def test_leader_clusters_do_not_chain() -> None:
    """a - b - c with no edge a - c: led by a, c stays alone; led by b, all three are one."""
    neighbors = np.array([[1, -1], [0, 2], [1, -1]])
    scores, views = np.where(neighbors >= 0, 0.9, -1.0), np.arange(3)
    assert as_sets(*leader_clusters(np.array([0, 1, 2]), neighbors, scores, views, 0.5, 4)) == [{0, 1}, {2}]
    assert as_sets(*leader_clusters(np.array([1, 0, 2]), neighbors, scores, views, 0.5, 4)) == [{0, 1, 2}]


@pytest.mark.parametrize("seed", range(5))
def test_connected_components_match_scipy_s(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, k = 80, 3
    neighbors, scores = rng.integers(-1, n, (n, k)), rng.uniform(0, 1, (n, k))
    scores[neighbors < 0] = -1
    actual, count = connected_components(neighbors, scores, 0.7)
    rows, columns = np.nonzero(scores >= 0.7)
    edges = coo_matrix((np.ones(len(rows)), (rows, neighbors[rows, columns])), shape=(n, n))
    wanted_count, expected = csgraph.connected_components(edges, directed=False)
    assert count == wanted_count
    assert len(set(zip(actual.tolist(), expected.tolist(), strict=True))) == count


@pytest.mark.parametrize("width", [0, 3, 40])
def test_the_bits_are_the_same_on_every_processor(each_target, width: int) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(0)
    gaussians = random_gaussians(60, 5, 0.2)
    means, covars = np.stack([g[0] for g in gaussians]), np.stack([upper(g[1]) for g in gaussians])
    means[:3, 0], covars[3:6] = (np.nan, np.inf, 1e300), [[np.nan], [np.inf], [0.0]]
    neighbors, views, order = rng.integers(-1, 60, (60, 9)), rng.integers(-1, 4, 60), rng.permutation(60)
    latents = rng.normal(size=(60, width)).astype(np.float32)

    def clusters() -> list[np.ndarray]:
        scores = [np.empty(neighbors.shape) for _ in range(2)]
        for boxes in (False, True):
            edge_scores(neighbors, means, covars, means, latents, views, 1.0, 0.1, boxes, scores[boxes])
        stars = leader_clusters(order, neighbors, scores[0], views, 0.3, 4)
        return [*scores, *map(np.asarray, stars), *map(np.asarray, connected_components(neighbors, scores[1], 0.2))]

    results = each_target(clusters)
    assert 1 < results[3] < 60
    assert 1 < results[5] < 60


def test_nothing_has_no_clusters() -> None:
    none, scores, views = np.empty((0, 4), np.int64), np.empty((0, 4)), np.empty(0, np.int64)
    assert [
        len(leader_clusters(views, none, scores, views, 0.5, 3)[0]),
        connected_components(none, scores, 0.5)[1],
    ] == [0, 0]
    alone = np.full((1, 4), -1)
    assert leader_clusters(views[:0], alone, np.ones((1, 4)), np.zeros(1, np.int64), 0.5, 3)[1] == 0
    assert leader_clusters(np.zeros(1, np.int64), alone, np.ones((1, 4)), np.zeros(1, np.int64), 0.5, 3)[1] == 1
    assert connected_components(alone, np.ones((1, 4)), 0.5)[1] == 1


@pytest.mark.parametrize("neighbor", [2, 2**62])
def test_ids_of_neighbours_outside_are_refused(neighbor: int) -> None:
    neighbors, ones, views = np.array([[1], [neighbor]]), np.ones((2, 3)), np.array([0, 1])
    scores, order = np.ones((2, 1)), np.array([0, 1])
    latents, covars = np.empty((2, 0), np.float32), np.ones((2, 6))
    edges = neighbors, ones, covars, ones, latents, views, 1.0, 0.0, True, np.empty_like(scores)
    refuse_all(ValueError, [
        (lambda: edge_scores(*edges), "edge_scores", "indices"),
        (lambda: connected_components(neighbors, scores, 0.5), "find_components", "indices"),
        (lambda: leader_clusters(order[::-1].copy(), neighbors, scores, views, 0.5, 3), "find_stars", "indices"),
        (lambda: leader_clusters(order + 1, neighbors, scores, views, 0.5, 3), "find_stars: order", "below 2"),
    ])  # fmt: skip
