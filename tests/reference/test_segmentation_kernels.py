"""Segmentation kernels against slow, obvious twins."""

from __future__ import annotations

import heapq

import numpy as np
import pytest
from skimage.measure import label as connected_parts

from gsmerge.kernels.superpixels import bass, kd, seeds, sweeps, ward
from gsmerge.kernels.superpixels.regions import pad_labels, region_rows

RING = ((0, 1), (0, 2), (1, 2), (2, 2), (2, 1), (2, 0), (1, 0), (0, 0))  # N, NE, E, SE, S, SW, W, NW of 3 x 3
COMPACTNESS = 1e-3
SPREAD = np.float32(COMPACTNESS**0.5)


@pytest.fixture
def pixels() -> np.ndarray:
    return np.random.default_rng(3).random((17, 23, 3), dtype=np.float32)


@pytest.fixture
def labels(pixels: np.ndarray) -> np.ndarray:
    """30 connected regions of the picture, not padded."""
    height, width, _ = pixels.shape
    return seeds.voronoi(seeds.hexagonal_seeds(height, width, 30), height, width)


def features(pixels: np.ndarray) -> np.ndarray:
    """``[n,5]`` float64: colours and weighted positions."""
    y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]] * float(SPREAD)
    return np.concatenate([pixels.reshape(-1, 3).astype(np.float64), y.reshape(-1, 1), x.reshape(-1, 1)], 1)


def squared_error(points: np.ndarray) -> float:
    return float(((points - points.mean(0)) ** 2).sum()) if len(points) else 0.0


def total_error(pixels: np.ndarray, labels: np.ndarray) -> float:
    points, flat = features(pixels), labels.reshape(-1)
    return sum(squared_error(points[flat == k]) for k in np.unique(flat))


def ring_of(mask: int) -> np.ndarray:
    cells = np.zeros((3, 3), int)
    for bit, place in enumerate(RING):
        cells[place] = mask >> bit & 1
    return cells


def test_ring_mask_reads_the_ring_in_order() -> None:
    for mask in range(256):
        assert sweeps.ring_mask(np.where(ring_of(mask), 5, 2).astype(np.int32), 1, 1, 5) == mask


def test_connectivity_table_is_what_components_say() -> None:
    table = sweeps.connectivity_table()
    for mask in range(256):
        parts = connected_parts(ring_of(mask), connectivity=1)
        touching = {int(parts[place]) for place in RING[::2]} - {0}
        assert table[mask] == (len(touching) == 1), f"{mask:08b}"


def test_simple_points_do_not_change_the_parts_of_either_side() -> None:
    table = bass.simple_point_table()
    assert table.sum() == 48
    for mask in range(256):
        arcs = sum((mask >> i & 1) != (mask >> (i + 1) % 8 & 1) for i in range(8)) // 2
        edges = [mask >> i & 1 for i in (0, 2, 4, 6)]
        assert table[mask] == (arcs == 1 and 0 < sum(edges) < 4), f"{mask:08b}"
        if table[mask]:
            with_pixel, without = ring_of(mask), ring_of(mask)
            with_pixel[1, 1] = 1
            for value in (0, 1):
                before = connected_parts(with_pixel == value, connectivity=1).max()
                assert before == connected_parts(without == value, connectivity=1).max() == 1


def test_integral_image(pixels: np.ndarray) -> None:
    expected = np.zeros((18, 24, 3))
    expected[1:, 1:] = pixels.astype(np.float64).cumsum(0).cumsum(1)
    assert kd.integral_image(pixels) == pytest.approx(expected.reshape(-1, 3))


def brute_cuts(pixels: np.ndarray, y0: int, x0: int, y1: int, x1: int) -> list[tuple[float, int, int]]:
    """(gain, axis, cut) of every straight cut of a rectangle."""
    points = features(pixels).reshape(*pixels.shape[:2], 5)[y0:y1, x0:x1]
    whole, gains = squared_error(points.reshape(-1, 5)), []
    for axis in (0, 1):
        for cut in range(1, points.shape[axis]):
            parts = np.split(points, [cut], axis)
            gains.append((whole - sum(squared_error(part.reshape(-1, 5)) for part in parts), axis, cut))
    return gains


@pytest.mark.parametrize("box", [(0, 0, 17, 23), (3, 5, 9, 6), (4, 4, 5, 12), (10, 2, 12, 4), (6, 6, 7, 7)])
def test_best_cut_is_the_largest_fall_of_the_error(pixels: np.ndarray, box: tuple[int, int, int, int]) -> None:
    y0, x0, y1, x1 = box
    integral, near = kd.integral_image(pixels), y0 * 24 + x0
    size = float((y1 - y0) * (x1 - x0))
    for axis, (far, step, side) in enumerate([(near + x1 - x0, 24, y1 - y0), (near + 24 * (y1 - y0), 1, x1 - x0)]):
        gain, cut = kd.cut_gain(integral, near, far, step, side, size, COMPACTNESS)
        candidates = [(g, c) for g, a, c in brute_cuts(pixels, *box) if a == axis]
        if candidates:
            assert gain == pytest.approx(max(candidates)[0], rel=1e-5)
            assert cut == max(candidates)[1]
        else:
            assert gain < 0


def greedy_rectangles(pixels: np.ndarray, count: int) -> np.ndarray:
    """The best cut of all, again and again."""
    labels = np.zeros(pixels.shape[:2], int)
    heap: list[tuple] = []

    def offer(node: int, box: tuple[int, int, int, int]) -> None:
        cuts = brute_cuts(pixels, *box)
        if cuts:
            gain, axis, cut = max(cuts)
            heapq.heappush(heap, (-gain, node, box, axis, cut))

    offer(0, (0, 0, *labels.shape))
    for new in range(1, count):
        _, node, (y0, x0, y1, x1), axis, cut = heapq.heappop(heap)
        first = (y0, x0, y0 + cut, x1) if axis == 0 else (y0, x0, y1, x0 + cut)
        second = (y0 + cut, x0, y1, x1) if axis == 0 else (y0, x0 + cut, y1, x1)
        labels[second[0] : y1, second[1] : x1] = new
        offer(node, first)
        offer(new, second)
    return labels


@pytest.mark.parametrize("count", [1, 2, 3, 20, 200, 391])
def test_rectangles_are_nearly_the_greedy_ones(pixels: np.ndarray, count: int) -> None:
    padded, num_regions = kd.split_rectangles(pixels, count, 32, COMPACTNESS)
    actual = padded[1:-1, 1:-1]
    assert num_regions == count == len(np.unique(actual))
    for k in range(count):
        y, x = np.nonzero(actual == k)
        assert len(y) == (np.ptp(y) + 1) * (np.ptp(x) + 1)  # a full rectangle
    # Cuts within an eighth of an octave of each other may come in any order.
    assert total_error(pixels, actual) == pytest.approx(total_error(pixels, greedy_rectangles(pixels, count)), rel=0.01)


def test_rectangles_start_from_blocks(pixels: np.ndarray) -> None:
    padded, num_regions = kd.split_rectangles(pixels, 1, 8, COMPACTNESS)
    assert num_regions == 4  # 17 x 23 pixels hold 2 x 2 blocks of at least 8
    assert np.bincount(padded[1:-1, 1:-1].reshape(-1)).tolist() == [8 * 11, 8 * 12, 9 * 11, 9 * 12]


def test_region_rows_are_means(pixels: np.ndarray, labels: np.ndarray) -> None:
    rows = region_rows(pad_labels(labels), pixels, 30, 33, SPREAD)
    assert rows.shape == (33, 8)
    for k in range(30):
        members = features(pixels)[labels.reshape(-1) == k]
        assert rows[k, :5] == pytest.approx(members.mean(0), abs=1e-6)
        assert rows[k, 5] == len(members)


def test_merge_cost_is_the_growth_of_the_error(pixels: np.ndarray, labels: np.ndarray) -> None:
    rows, points, flat = region_rows(pad_labels(labels), pixels, 30, 30, SPREAD), features(pixels), labels.reshape(-1)
    rows[:, ward.INVERSE] = 1 / rows[:, 5]
    for u, v in [(0, 1), (4, 20), (7, 29)]:
        apart = squared_error(points[flat == u]) + squared_error(points[flat == v])
        together = squared_error(points[(flat == u) | (flat == v)])
        assert ward.merge_cost(rows, u, v) == pytest.approx(together - apart, rel=1e-3)


def neighbours(labels: np.ndarray) -> set[tuple[int, int]]:
    pairs = np.concatenate(
        [
            np.stack([labels[:, :-1].reshape(-1), labels[:, 1:].reshape(-1)], 1),
            np.stack([labels[:-1].reshape(-1), labels[1:].reshape(-1)], 1),
        ]
    )
    return {(int(min(p)), int(max(p))) for p in pairs if p[0] != p[1]}


def test_adjacent_pairs_are_all_neighbours(labels: np.ndarray) -> None:
    pairs = ward.adjacent_pairs(pad_labels(labels))
    assert {(int(min(p)), int(max(p))) for p in pairs} == neighbours(labels)
    assert len(ward.adjacent_pairs(pad_labels(np.zeros((3, 4), int)))) == 0


def greedy_merge(pixels: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """The cheapest pair of neighbours, again and again."""
    labels, points = labels.copy(), features(pixels)

    def cost(pair: tuple[int, int]) -> float:
        u, v = (points[labels.reshape(-1) == k] for k in pair)
        return len(u) * len(v) / (len(u) + len(v)) * float(((u.mean(0) - v.mean(0)) ** 2).sum())

    while len(np.unique(labels)) > count:
        u, v = min(neighbours(labels), key=cost)
        labels[labels == v] = u
    return labels


@pytest.mark.parametrize("count", [1, 2, 8, 15, 29, 30])
def test_merging_is_nearly_greedy(pixels: np.ndarray, labels: np.ndarray, count: int) -> None:
    merged = ward.merge_regions(pad_labels(labels), pixels, 30, count, SPREAD)[1:-1, 1:-1]
    assert len(np.unique(merged)) == merged.max() + 1 == count
    for k in range(30):
        assert len(np.unique(merged[labels == k])) == 1  # regions merge whole
    expected = total_error(pixels, greedy_merge(pixels, labels, count))
    assert total_error(pixels, merged) == pytest.approx(expected, rel=0.01)


def test_merging_from_a_low_ceiling_gives_the_same(pixels: np.ndarray, labels: np.ndarray) -> None:
    """Parked edges come back: where the ceiling starts changes the work, not the heights of the lowest merges."""
    heights = []
    for ceiling in (1e-6, 1e9):
        rows = region_rows(pad_labels(labels), pixels, 30, 60, SPREAD)
        rows[:30, ward.INVERSE] = 1 / rows[:30, 5]
        _, num_nodes = ward.merge_tree(ward.adjacent_pairs(pad_labels(labels)), rows, 30, 15, np.float32(ceiling))
        assert num_nodes >= 45
        heights.append(np.sort(rows[30:num_nodes, ward.HEIGHT])[:15])
    assert heights[0] == pytest.approx(heights[1], rel=0.02)


def slow_sweep(pixels: np.ndarray, labels: np.ndarray, backward: bool) -> np.ndarray:
    """Move every border pixel to where the total error is lowest, if its region stays in one piece."""
    labels, (height, width) = labels.copy(), labels.shape
    for place in sorted(np.ndindex(height, width), reverse=backward):
        y, x = place
        own = labels[place]
        rest = (labels == own) & ~((np.arange(height)[:, None] == y) & (np.arange(width) == x))
        window = rest[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2].copy()
        parts = connected_parts(window, connectivity=1)
        around = [(y - 1, x), (y, x + 1), (y + 1, x), (y, x - 1)]
        around = [(v, u) for v, u in around if 0 <= v < height and 0 <= u < width]
        touching = {int(parts[v - max(0, y - 1), u - max(0, x - 1)]) for v, u in around} - {0}
        if len(touching) != 1:
            continue
        errors = {}
        for label in dict.fromkeys([own, *(labels[p] for p in around)]):
            labels[place] = label
            errors[label] = total_error(pixels, labels)
        labels[place] = min(errors, key=errors.__getitem__)
    return labels


@pytest.mark.parametrize("backward", [False, True])
def test_sweep_makes_the_moves_that_lower_the_error(backward: bool) -> None:
    pixels = np.random.default_rng(5).random((9, 11, 3), dtype=np.float32)
    labels = seeds.voronoi(seeds.hexagonal_seeds(9, 11, 12), 9, 11)
    padded = pad_labels(labels)
    rows = region_rows(padded, pixels, 12, 12, SPREAD)
    rows[:, sweeps.LEAVE], rows[:, sweeps.JOIN] = rows[:, 5] / (rows[:, 5] - 1), rows[:, 5] / (rows[:, 5] + 1)
    moved = sweeps.sweep(padded, pixels, rows, sweeps.CONNECTIVITY, SPREAD, backward)
    expected = slow_sweep(pixels, labels, backward)
    assert moved >= np.count_nonzero(expected != labels) > 10
    assert np.array_equal(padded[1:-1, 1:-1], expected)
    fresh = region_rows(padded, pixels, 12, 12, SPREAD)
    assert rows[:, :6] == pytest.approx(fresh[:, :6], abs=1e-5)  # the running means stay true


def slow_parameters(colours: np.ndarray, labels: np.ndarray, count: int) -> list[tuple]:
    """(mean colour, mean position, covariance) of every region, as the model's posterior has them."""
    area, actual = labels.size / count, []
    for k in range(count):
        y, x = np.nonzero(labels == k)
        places = np.stack([x, y], 1).astype(float)
        off = places - places.mean(0)
        covariance = (area**2 * np.eye(2) + off.T @ off) / (len(x) + 50 * area - 3)
        actual.append((colours[labels == k].mean(0), places.mean(0), covariance))
    return actual


def test_bass_parameters(pixels: np.ndarray, labels: np.ndarray) -> None:
    rows = bass.fit_regions(pad_labels(labels), pixels, np.full(30, labels.size / 30))
    for row, (colour, place, covariance) in zip(rows, slow_parameters(pixels, labels, 30), strict=True):
        inverse = np.linalg.inv(covariance)
        expected = [*colour, *place, inverse[0, 0], 2 * inverse[0, 1], inverse[1, 1], np.log(np.linalg.det(covariance))]
        assert row == pytest.approx(np.array(expected), rel=1e-4, abs=1e-5)


def slow_label_pass(colours: np.ndarray, labels: np.ndarray, count: int, deviation: float) -> np.ndarray:
    """The constrained label update, pixel by pixel, with the parameters held."""
    (height, width), parameters, table = (
        labels.shape,
        slow_parameters(colours, labels, count),
        bass.simple_point_table(),
    )
    padded = pad_labels(labels)

    def score(y: int, x: int, k: int) -> float:
        colour, place, covariance = parameters[k]
        off = np.array([x, y]) - place
        ring = [padded[y + v, x + u] for v, u in RING]
        fit = ((colours[y, x] - colour) ** 2).sum() / deviation**2 + off @ np.linalg.solve(covariance, off)
        return -fit - np.log(np.linalg.det(covariance)) - 0.5 * sum(k != other for other in ring)

    for oy, ox in ((0, 0), (0, 1), (1, 0), (1, 1)):
        for y in range(oy, height, 2):
            for x in range(ox, width, 2):
                ring = [padded[y + v, x + u] for v, u in RING]
                around = {int(ring[i]) for i in (0, 2, 4, 6)} - {-1}
                own = int(padded[y + 1, x + 1])
                masks = [sum((label == k) << i for i, label in enumerate(ring)) for k in around | {own}]
                if around != {own} and all(table[mask] for mask in masks):
                    padded[y + 1, x + 1] = max(sorted(around), key=lambda k: score(y, x, k))
    return padded[1:-1, 1:-1]


def test_bass_label_pass(pixels: np.ndarray, labels: np.ndarray) -> None:
    padded, deviation = pad_labels(labels), 0.2
    foreign = np.array([8 - mask.bit_count() for mask in range(256)], np.float32)
    rows = bass.fit_regions(padded, pixels, np.full(30, labels.size / 30))
    precision = np.float32(1 / deviation**2)
    changed = bass.label_pass(padded, pixels, rows, bass.simple_point_table(), foreign, precision)
    expected = slow_label_pass(pixels, labels, 30, deviation)
    assert changed == np.count_nonzero(expected != labels) > 20
    assert np.array_equal(padded[1:-1, 1:-1], expected)


@pytest.mark.parametrize(("corner", "expected"), [(1, 1), (2, 0)])
def test_bass_leaves_a_pixel_that_would_part_a_rival(corner: int, expected: int) -> None:
    """The middle pixel looks like region 1 north of it; with region 2 on both sides of that, it may not go there."""
    labels = np.array([[corner, 1, 2], [0, 0, 2], [0, 0, 0]])
    colours = np.repeat(np.array([0.5, 1.0, 0.0], np.float32)[labels][..., None], 3, 2)
    colours[1, 1] = 1
    padded, foreign = pad_labels(labels), np.array([8 - mask.bit_count() for mask in range(256)], np.float32)
    rows = bass.fit_regions(padded, colours, np.full(3, 3.0))
    bass.label_pass(padded, colours, rows, bass.simple_point_table(), foreign, np.float32(100))
    assert padded[2, 2] == expected
    assert np.array_equal(padded[1:-1, 1:-1], slow_label_pass(colours, labels, 3, 0.1))


def test_voronoi_regions_hold_the_nearest_pixels() -> None:
    places = seeds.hexagonal_seeds(13, 19, 11)
    labels = seeds.voronoi(places, 13, 19)
    pixel = np.stack(np.mgrid[:13, :19], -1)
    steps = np.abs(pixel[:, :, None] - places).sum(-1)
    assert np.array_equal(np.take_along_axis(steps, labels[..., None].astype(int), 2)[..., 0], steps.min(-1))


def slow_dither(density: np.ndarray) -> np.ndarray:
    """Floyd-Steinberg error diffusion, serpentine, with the kernel's noise."""
    height, width = density.shape
    left, seeds_at, noise = density.copy(), np.zeros(density.shape, bool), 1
    for y in range(height):
        ahead = 1 if y % 2 == 0 else -1
        for x in range(width)[::ahead]:
            noise = (noise * 1664525 + 1013904223) % 2**32
            seeds_at[y, x] = left[y, x] > 0.5 + seeds.JITTER * ((noise >> 8) / 2**24 - 0.5)
            error = left[y, x] - seeds_at[y, x]
            for v, u, share in ((0, ahead, 7), (1, -ahead, 3), (1, 0, 5), (1, ahead, 1)):
                if y + v < height and 0 <= x + u < width:
                    left[y + v, x + u] += error * share / 16
    return seeds_at


def test_dither(pixels: np.ndarray) -> None:
    density = pixels[..., 0].astype(np.float64) ** 2
    actual = seeds.dither(density)
    assert np.array_equal(actual, slow_dither(density))
    assert actual.sum() == pytest.approx(density.sum(), rel=0.1)


@pytest.mark.parametrize("count", [1, 5, 60, 117])
def test_seeds_follow_the_density_to_the_exact_count(count: int) -> None:
    density = seeds.seed_density(np.random.default_rng(1).random((9, 13)), count)
    places = seeds.seeds_from_density(density, count)
    assert len({(y, x) for y, x in places.tolist()}) == count
