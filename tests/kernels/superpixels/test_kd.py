"""Splitting rectangles matches slow, obvious twins."""

from __future__ import annotations

import heapq

import numpy as np
import pytest
from regions_of_noise import COMPACTNESS, features, squared_error, total_error

from gsmerge.method.kernels.superpixels import regions


def test_integral_image_sums_the_pixels_above_and_left(pixels: np.ndarray) -> None:
    expected = np.zeros((18, 24, 3))
    expected[1:, 1:] = pixels.astype(np.float64).cumsum(0).cumsum(1)
    assert regions.integral_image(pixels) == pytest.approx(expected.reshape(-1, 3))


def brute_cuts(pixels: np.ndarray, y0: int, x0: int, y1: int, x1: int) -> list[tuple[float, int, int]]:
    """Return (gain, axis, cut) of every straight cut of a rectangle."""
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
    integral, near = regions.integral_image(pixels), y0 * 24 + x0
    size = float((y1 - y0) * (x1 - x0))
    for axis, (far, step, side) in enumerate([(near + x1 - x0, 24, y1 - y0), (near + 24 * (y1 - y0), 1, x1 - x0)]):
        found = np.empty(2)
        regions.cut_gain(integral, near, far, step, side, size, COMPACTNESS, found)
        gain, cut = float(found[0]), int(found[1])
        candidates = [(g, c) for g, a, c in brute_cuts(pixels, *box) if a == axis]
        if candidates:
            assert gain == pytest.approx(max(candidates)[0], rel=1e-5)
            assert cut == max(candidates)[1]
        else:
            assert gain < 0


def greedy_rectangles(pixels: np.ndarray, count: int) -> np.ndarray:
    """Make the best cut of all, again and again."""
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
def test_rectangles_have_nearly_the_error_of_greedy_cuts(pixels: np.ndarray, count: int) -> None:
    padded, num_regions = regions.split_rectangles(pixels, count, 32, COMPACTNESS)
    actual = padded[1:-1, 1:-1]
    assert num_regions == count == len(np.unique(actual))
    for k in range(count):
        y, x = np.nonzero(actual == k)
        assert len(y) == (np.ptp(y) + 1) * (np.ptp(x) + 1)  # a full rectangle
    # Cuts within an eighth of an octave of each other may come in any order.
    assert total_error(pixels, actual) == pytest.approx(total_error(pixels, greedy_rectangles(pixels, count)), rel=0.01)


def test_rectangles_start_from_blocks(pixels: np.ndarray) -> None:
    padded, num_regions = regions.split_rectangles(pixels, 1, 8, COMPACTNESS)
    assert num_regions == 4  # 17 x 23 pixels hold 2 x 2 blocks of at least 8
    assert np.bincount(padded[1:-1, 1:-1].reshape(-1)).tolist() == [8 * 11, 8 * 12, 9 * 11, 9 * 12]
