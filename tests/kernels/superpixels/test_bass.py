"""The paper's BASS matches slow, obvious twins."""

from __future__ import annotations

import numpy as np
import pytest
from regions_of_noise import RING, ring_of
from skimage.measure import label as connected_parts

from gsmerge.kernels.elementary import log
from gsmerge.kernels.superpixels import bass
from gsmerge.kernels.superpixels.regions import pad_labels


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


def slow_parameters(colours: np.ndarray, labels: np.ndarray, count: int) -> list[tuple]:
    """Return (mean colour, mean position, covariance) of every region, as the model's posterior has them."""
    area, actual = labels.size / count, []
    for k in range(count):
        y, x = np.nonzero(labels == k)
        places = np.stack([x, y], 1).astype(float)
        off = places - places.mean(0)
        covariance = (area**2 * np.eye(2) + off.T @ off) / (len(x) + 50 * area - 3)
        actual.append((colours[labels == k].mean(0), places.mean(0), covariance))
    return actual


def test_parameters_of_regions_match_a_slow_twin(pixels: np.ndarray, labels: np.ndarray) -> None:
    rows = bass.fit_regions(pad_labels(labels), pixels, np.full(30, labels.size / 30))
    for row, (colour, place, covariance) in zip(rows, slow_parameters(pixels, labels, 30), strict=True):
        inverse = np.linalg.inv(covariance)
        expected = [*colour, *place, inverse[0, 0], 2 * inverse[0, 1], inverse[1, 1], log(np.linalg.det(covariance))]
        assert row == pytest.approx(np.array(expected), rel=1e-4, abs=1e-5)


def slow_label_pass(colours: np.ndarray, labels: np.ndarray, count: int, deviation: float) -> np.ndarray:
    """Update labels under the constraint, pixel by pixel, with the parameters held."""
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
        return -fit - log(np.linalg.det(covariance)) - 0.5 * sum(k != other for other in ring)

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


def test_label_pass_matches_a_slow_twin(pixels: np.ndarray, labels: np.ndarray) -> None:
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
