"""Split and merge moves of superpixels against slow, obvious twins."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import pytest
from regions_of_noise import neighbours
from skimage.measure import label as connected_parts

from gsmerge.kernels import elementary
from gsmerge.kernels.superpixels import bass
from gsmerge.kernels.superpixels.regions import pad_labels

COUNT = 30
PRIOR = np.array([elementary.log(0.3), 4.0, 4.0 * 0.2**2, (0.5 / 0.2) ** 2])  # log α, a, b, v


@pytest.fixture
def colours() -> np.ndarray:
    """Noise on four tones."""
    rng = np.random.default_rng(4)
    tones = np.kron(rng.random((2, 2, 3)), np.ones((9, 12, 1)))[:17, :23]
    return (tones + 0.05 * rng.random((17, 23, 3))).astype(np.float32)


def log_student(freedom: float, t: float) -> float:
    """log of the density of Student's distribution."""
    norm = math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2) - elementary.log(freedom * math.pi) / 2
    return norm - (freedom + 1) / 2 * elementary.log1p(t * t / freedom)


def slow_evidence(points: np.ndarray) -> float:
    """log of Γ(n) n^-n times the likelihood of n colours: pixel by pixel, each given those before."""
    _, a, b, v = PRIOR
    value = math.lgamma(len(points)) - len(points) * elementary.log(len(points))
    for channel in points.T.astype(float):
        shape, scale, mean, precision = a, b, 0.0, 1 / v
        for colour in channel:
            width = math.sqrt(scale * (precision + 1) / (shape * precision))
            value += log_student(2 * shape, (colour - mean) / width) - elementary.log(width)
            scale += 0.5 * precision * (colour - mean) ** 2 / (precision + 1)
            mean = (precision * mean + colour) / (precision + 1)
            precision, shape = precision + 1, shape + 0.5
    return value


def sums_of(points: np.ndarray) -> np.ndarray:
    return np.concatenate([[len(points)], points.sum(0), (points.astype(float) ** 2).sum(0)])


@pytest.mark.parametrize("size", [1, 2, 7, 40])
def test_evidence_is_that_of_pixels_one_after_the_other(size: int) -> None:
    points = np.random.default_rng(size).random((size, 3))
    assert bass.log_evidence(sums_of(points), PRIOR) == pytest.approx(slow_evidence(points), rel=1e-9)


def test_sums_of_regions(colours: np.ndarray, labels: np.ndarray) -> None:
    marks = np.random.default_rng(1).random(labels.shape) < 0.5
    sums = bass.sum_regions(pad_labels(labels), colours, marks, COUNT)
    for k in range(COUNT):
        assert sums[k] == pytest.approx(sums_of(colours[(labels == k) & marks]), rel=1e-6)


def slow_half(region: np.ndarray, across: bool) -> np.ndarray:
    """Pixels nearer, in steps inside a region, to the middle of its last row or column than to that of its first."""
    places = list(zip(*np.nonzero(region), strict=True))
    axis = int(across)
    if len({p[axis] for p in places}) == 1:
        axis = 1 - axis
    middle = np.mean([p[1 - axis] for p in places])
    first = min(places, key=lambda p: (p[axis], abs(p[1 - axis] - middle), p))
    last = min(places, key=lambda p: (-p[axis], abs(p[1 - axis] - middle), p))
    half = np.zeros_like(region)
    if len(places) < 2:
        return half

    def steps(start: tuple[int, int]) -> dict[tuple[int, int], int]:
        reached, queue = {start: 0}, deque([start])
        while queue:
            y, x = queue.popleft()
            for place in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
                if place in places and place not in reached:
                    reached[place] = reached[(y, x)] + 1
                    queue.append(place)
        return reached

    from_first, from_last = steps(first), steps(last)
    for place in places:
        half[place] = from_last[place] < from_first[place]
    return half


@pytest.mark.parametrize("across", [False, True])
def test_halves(labels: np.ndarray, across: bool) -> None:
    labels = labels.copy()
    labels[labels == 7] = 8  # a longer region
    labels[0], labels[:, 0] = 7, COUNT  # a bent one of one row and one column, and one of a column
    labels[0, 0], labels[16, 1:] = 7, COUNT + 1  # and one of a row
    parts = connected_parts(labels, connectivity=1, background=-1) - 1
    labels, count = parts.astype(np.int32), parts.max() + 1
    marks = bass.mark_halves(pad_labels(labels), count, across)
    expected = sum(slow_half(labels == k, across) for k in range(count))
    assert np.array_equal(marks, expected > 0)
    for k in range(count):
        if np.count_nonzero(labels == k) == 1:
            continue
        for half in (marks, ~marks):
            assert connected_parts((labels == k) & half, connectivity=1).max() == 1


def test_a_single_pixel_has_no_second_half() -> None:
    labels = pad_labels(np.array([[0, 1], [1, 1]]))
    colours = np.random.default_rng(0).random((2, 2, 3), dtype=np.float32)
    marks = bass.mark_halves(labels, 2, False)
    assert not marks[0, 0]
    whole = bass.sum_regions(labels, colours, np.ones((2, 2), bool), 2)
    ratios = bass.weigh_splits(whole, bass.sum_regions(labels, colours, marks, 2), PRIOR)
    assert ratios[0] == -np.inf
    assert np.isfinite(ratios[1])


def ratio_of(first: np.ndarray, second: np.ndarray) -> float:
    """log H of splitting the two from each other."""
    both = slow_evidence(np.concatenate([first, second]))
    return float(PRIOR[0]) + slow_evidence(first) + slow_evidence(second) - both


@pytest.mark.parametrize("across", [False, True])
def test_split(colours: np.ndarray, labels: np.ndarray, across: bool) -> None:
    """Exactly the regions whose ratio is above one are split; halves share the expected area."""
    areas = np.linspace(5, 20, COUNT)
    ratios = []
    for k in range(COUNT):
        half = slow_half(labels == k, across)
        ratios.append(ratio_of(colours[(labels == k) & ~half], colours[half]))
    chosen = [k for k in range(COUNT) if ratios[k] > 0]
    assert 0 < len(chosen) < COUNT
    actual, new_areas = bass.split(pad_labels(labels), colours, areas, PRIOR, across, COUNT)
    assert len(new_areas) == COUNT + len(chosen)
    assert new_areas.sum() == pytest.approx(areas.sum())
    actual = actual[1:-1, 1:-1]
    for k in range(COUNT):
        parts = np.unique(actual[labels == k])
        assert len(parts) == 1 + (k in chosen)
        assert new_areas[parts] == pytest.approx(areas[k] / len(parts))
    order = sorted(chosen, key=lambda k: -ratios[k])
    fewer, _ = bass.split(pad_labels(labels), colours, areas, PRIOR, across, 2)
    assert set(labels[fewer[1:-1, 1:-1] >= COUNT]) == set(order[:2])
    same, _ = bass.split(pad_labels(labels), colours, areas, PRIOR, across, 0)
    assert np.array_equal(same, pad_labels(labels))


def test_merge(colours: np.ndarray, labels: np.ndarray) -> None:
    """Exactly the pairs that are each other's best and whose ratio is above one become one region."""
    areas = np.linspace(5, 20, COUNT)
    ratios = {(u, v): -ratio_of(colours[labels == u], colours[labels == v]) for u, v in neighbours(labels)}
    best = {k: max((p for p in ratios if k in p), key=ratios.__getitem__) for k in range(COUNT)}
    chosen = {p for p in best.values() if best[p[0]] == best[p[1]] and ratios[p] > 0}
    assert 2 < len(chosen) < COUNT // 2
    actual, new_areas = bass.merge(pad_labels(labels), colours, areas, PRIOR, COUNT)
    actual = actual[1:-1, 1:-1]
    assert np.array_equal(np.unique(actual), np.arange(COUNT - len(chosen)))
    for u, v in ratios:
        assert (len(np.unique(actual[(labels == u) | (labels == v)])) == 1) == ((u, v) in chosen)
    for k in range(COUNT):
        parts = [j for j in range(COUNT) if actual[labels == j][0] == actual[labels == k][0]]
        assert new_areas[actual[labels == k][0]] == pytest.approx(areas[parts].sum())
    fewer, _ = bass.merge(pad_labels(labels), colours, areas, PRIOR, 1)
    first = max(chosen, key=ratios.__getitem__)
    assert len(np.unique(fewer[1:-1, 1:-1])) == COUNT - 1
    assert len(np.unique(fewer[1:-1, 1:-1][(labels == first[0]) | (labels == first[1])])) == 1


def test_flat_regions_merge_and_edges_split() -> None:
    """Of the moves' own prior: one tone is one superpixel, two tones are not."""
    flat = np.full((8, 8, 3), 0.5, np.float32)
    tones = flat.copy()
    tones[:, 4:] += 0.1
    halves = pad_labels(np.arange(64).reshape(8, 8) % 8 // 4)
    whole, one = pad_labels(np.zeros((8, 8), int)), np.array([64.0])
    two, prior = np.array([32.0, 32.0]), bass.move_prior()
    assert len(bass.merge(halves, flat, two, prior, 9)[1]) == 1
    assert len(bass.merge(halves, tones, two, prior, 9)[1]) == 2
    assert len(bass.split(whole, flat, one, prior, True, 9)[1]) == 1
    assert np.array_equal(bass.split(whole, tones, one, prior, True, 9)[0], halves)
