"""All kernels of superpixels give the same bits with every library, and take empty, odd or wrong inputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from messages import refuses

from gsmerge.method.kernels.superpixels import bass, merge_tree, regions, ward
from gsmerge.method.kernels.superpixels.regions import pad_labels

SPREAD = np.float32(0.01)
ONE = pad_labels(np.zeros((1, 1), int))


def make_picture(height: int, width: int) -> np.ndarray:
    """Make a picture of noise on a slope."""
    noise = np.random.default_rng(0).random((height, width, 3), dtype=np.float32)
    return 0.3 * noise + np.linspace(0, 0.7, width, dtype=np.float32)[:, None]


def all_of_them(height: int, width: int) -> list[np.ndarray]:
    """Return what every kernel makes of a picture, one from the other."""
    pixels, count = make_picture(height, width), max(1, height * width // 16)
    response = bass.corner_response(pixels)
    labels, num_regions = regions.split_rectangles(pixels, 2 * count, 8, 1e-5)
    merged = ward.merge_regions(labels, pixels, num_regions, count, SPREAD)
    refined = regions.refine(merged.copy(), pixels, count, 3, SPREAD)
    depths = (2 + response).astype(np.float32)
    rows = np.empty((2 * count, merge_tree.TREE_COLUMNS))
    error = merge_tree.region_sums(refined, pixels, depths, count, rows)
    tree = merge_tree.merge_order(ward.adjacent_pairs(refined), rows, 1.0, 1e-5, 9.0)
    cut = merge_tree.cut_labels(tree[0], np.arange(count - 1) < count // 2, count)
    places = bass.seeds_from_density(bass.seed_density(response, count), count)
    grown = pad_labels(bass.voronoi(places, height, width))
    found = bass.infer_labels(grown.copy(), pixels, count)
    fitted = bass.fit_regions(found, pixels, np.full(count, 16.0))
    return [
        response, labels, merged, refined, rows[: 2 * count - 1], np.array(error), *tree, cut, places, grown,
        found, fitted,
    ]  # fmt: skip


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (47, 61)])
def test_every_library_gives_the_same_bits(
    size: tuple[int, int], each_target: Callable[[Callable[[], Sequence[np.ndarray]]], Sequence[np.ndarray]]
) -> None:
    assert len(each_target(lambda: all_of_them(*size))) > 10


def test_every_kernel_takes_a_picture_without_pixels() -> None:
    labels, pixels, sums = np.full((2, 2), -1, np.int32), np.empty((0, 0, 3), np.float32), np.empty((0, 20))
    assert regions.region_rows(labels, pixels, 0, 2, SPREAD).tolist() == [[0] * 8] * 2
    assert regions.sweep(labels, pixels, np.empty((0, 8), np.float32), regions.CONNECTIVITY, SPREAD, False) == 0
    assert regions.integral_image(pixels).tolist() == [[0, 0, 0]]
    assert len(ward.adjacent_pairs(labels)) == 0
    assert merge_tree.region_sums(labels, pixels, np.empty((0, 0), np.float32), 0, sums) == 0
    assert [len(a) for a in merge_tree.merge_order(np.empty((0, 2), np.int32), sums, 1.0, 1.0, 1.0)] == [0, 0, 0]
    assert len(merge_tree.cut_labels(np.empty(0, np.int32), np.empty(0, bool), 0)) == 0
    assert bass.fit_regions(labels, pixels, np.empty(0)).shape == (0, 9)
    assert bass.dither(np.empty((0, 0))).shape == (0, 0)
    assert bass.voronoi(np.empty((0, 2), np.int64), 0, 0).shape == (0, 0)
    assert bass.voronoi(np.empty((0, 2), np.int64), 1, 2).tolist() == [[-1, -1]]


KERNELS: dict[str, Callable[[np.ndarray, np.ndarray], object]] = {
    "region_rows": lambda labels, pixels: regions.region_rows(labels, pixels, 2, 2, SPREAD),
    "sweep": lambda labels, pixels: regions.sweep(
        labels, pixels, np.ones((2, 8), np.float32), regions.CONNECTIVITY, SPREAD, False
    ),
    "region_sums": lambda labels, pixels: merge_tree.region_sums(
        labels, pixels, pixels[..., 0] + 1, 2, np.empty((4, 20))
    ),
    "fit_regions": lambda labels, pixels: bass.fit_regions(labels, pixels, np.ones(2)),
    "label_pass": lambda labels, pixels: bass.label_pass(
        labels, pixels, np.ones((2, 9), np.float32), bass.simple_point_table(), np.ones(256, np.float32), 1.0
    ),
}  # fmt: skip


@pytest.mark.parametrize(("place", "label"), [((1, 1), 2), ((2, 3), -1), ((1, 2), 2**31 - 1), ((0, 0), 0), ((4, 3), 1)])
@pytest.mark.parametrize("kernel", KERNELS)
def test_bad_labels_are_refused(kernel: str, place: tuple[int, int], label: int) -> None:
    """Regions that are not there, pixels without one, and frames that are none."""
    labels, pixels = pad_labels(np.arange(12).reshape(3, 4) // 6), make_picture(3, 4)
    KERNELS[kernel](labels.copy(), pixels)
    labels[place] = label
    with pytest.raises(ValueError, match="outside"):
        KERNELS[kernel](labels, pixels)


@pytest.mark.parametrize("kernel", KERNELS)
def test_labels_of_another_size_are_refused(kernel: str) -> None:
    with pytest.raises(ValueError, match="outside"):
        KERNELS[kernel](ONE.copy(), make_picture(3, 4))


def test_bad_indices_are_refused() -> None:
    rows, tree, integral = np.ones((4, 8), np.float32), np.ones((4, 20)), regions.integral_image(make_picture(3, 4))
    cut, ring, same = merge_tree.cut_labels, regions.ring_mask, np.array([[1, 1]], np.int32)
    outside = [
        *((cut, np.array(parents, np.int32), np.ones(1, bool), 2)
          for parents in ([-1, 0, -1], [1, -1, -1], [3, -1, -1], [2, 2, 2])),
        *((bass.voronoi, np.array([[0, 0], place]), 3, 4) for place in ([-1, 0], [0, 4], [3, 0])),
        *((ring, ONE, y, x, 0) for y, x in ((0, 1), (1, 0), (2, 1), (1, 2))),
        (cut, np.array([2, 2, -1], np.int32), np.ones(0, bool), 2),
        (regions.cut_gain, integral, 0, 4, 5, 4, 1.0, 0.0, np.empty(2)),
        (merge_tree.merge_order, same, tree, 1.0, 1.0, 1.0), (ward.merge_tree, same[:0], rows, 3, 1, np.float32(1)),
    ]  # fmt: skip
    far = np.array([[0, 4]], np.int32), np.empty(1, np.float32)
    high, pairs = [(merge_tree.merge_growth, tree, 4, 0, 1.0, 1.0, np.empty(2))], [(ward.merge_costs, rows, *far)]
    for pair in (np.array([[0, 2]], np.int32), np.array([[-1, 0]], np.int32)):
        pairs += [(ward.merge_tree, pair, rows, 2, 1, np.float32(1))]
        pairs += [(merge_tree.merge_order, pair, tree, 1.0, 1.0, 1.0)]
    for match, calls in (("outside", outside), ("below 4", high), ("pairs", pairs)):
        for call, *arguments in calls:
            with pytest.raises(ValueError, match=match):
                call(*arguments)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38])
def test_odd_colours_leave_labels_in_their_range(value: float) -> None:
    """Colours that no caller lets in: every kernel comes to an end, and labels stay in their range."""
    height, width, count = 9, 11, 6
    pixels = make_picture(height, width)
    pixels[4, 5] = pixels[0, 0, 1] = value
    labels = pad_labels(bass.voronoi(bass.hexagonal_seeds(height, width, count), height, width))
    rectangles, number = regions.split_rectangles(pixels, 20, 4, 1e-5)
    assert set(np.unique(rectangles)) == set(range(-1, number))
    assert set(np.unique(regions.refine(labels.copy(), pixels, count, 2, SPREAD))) == set(range(-1, count))
    assert set(np.unique(bass.infer_labels(labels.copy(), pixels, count))) == set(range(-1, count))
    rows = np.empty((2 * count, merge_tree.TREE_COLUMNS))
    merge_tree.region_sums(labels, pixels, pixels[..., 2].copy(), count, rows)
    parents, _, _ = merge_tree.merge_order(ward.adjacent_pairs(labels), rows, 1.0, 1e-5, 4.0)
    assert (parents[:-1] > np.arange(2 * count - 2)).all()
    if np.isnan(value):
        with refuses(ValueError, "", "finite", 6, 1):
            ward.merge_regions(labels, pixels, count, 1, SPREAD)


def test_last_of_equal_seeds_gets_the_pixels() -> None:
    assert bass.voronoi(np.zeros((9, 2), np.int64), 2, 2).tolist() == [[8, 8], [8, 8]]
