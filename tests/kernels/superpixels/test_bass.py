"""Seeds, sweeps, corners and the whole of the paper's BASS match slow, obvious twins."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from regions_of_noise import RING, SPREAD, ring_of, total_error
from skimage.measure import label as connected_parts

from gsmerge.method.kernels.elementary import log
from gsmerge.method.kernels.superpixels import bass, regions
from gsmerge.method.kernels.superpixels.bass import hexagonal_seeds, seed_density
from gsmerge.method.kernels.superpixels.regions import pad_labels, region_rows


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


SIZES = ((1, 1), (1, 2), (2, 1), (1, 9), (9, 1), (2, 2), (3, 3), (37, 53))


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(height).random((height, width, 3), dtype=np.float32)


@pytest.mark.parametrize("size", SIZES)
def test_corners_match_opencv_s(size: tuple[int, int]) -> None:
    pixels = noise(*size)
    expected = cv2.cornerMinEigenVal(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), 3, ksize=3)
    response = bass.corner_response(pixels)
    assert response == pytest.approx(np.maximum(expected, 0), abs=1e-6)
    assert (response >= 0).all()


def test_flat_pictures_have_no_corners() -> None:
    assert not bass.corner_response(np.full((7, 9, 3), 0.3, np.float32)).any()


@pytest.mark.parametrize("shape", [(0, 3), (3, 0), (0, 0)])
def test_picture_without_pixels_has_no_corners(shape: tuple[int, int]) -> None:
    assert bass.corner_response(np.empty((*shape, 3), np.float32)).shape == shape


def test_nan_changes_no_corner_far_from_it() -> None:
    pixels = noise(12, 12)
    pixels[6, 6] = np.nan
    clean, response = bass.corner_response(noise(12, 12)), bass.corner_response(pixels)
    assert np.array_equal(response[:4], clean[:4])


def test_voronoi_regions_hold_the_nearest_pixels() -> None:
    places = bass.hexagonal_seeds(13, 19, 11)
    labels = bass.voronoi(places, 13, 19)
    pixel = np.stack(np.mgrid[:13, :19], -1)
    steps = np.abs(pixel[:, :, None] - places).sum(-1)
    assert np.array_equal(np.take_along_axis(steps, labels[..., None].astype(int), 2)[..., 0], steps.min(-1))


def slow_dither(density: np.ndarray) -> np.ndarray:
    """Diffuse errors as Floyd and Steinberg do, serpentine, with the kernel's noise."""
    height, width = density.shape
    left, seeds_at, noise = density.copy(), np.zeros(density.shape, bool), 1
    for y in range(height):
        ahead = 1 if y % 2 == 0 else -1
        for x in range(width)[::ahead]:
            noise = (noise * 1664525 + 1013904223) % 2**32
            seeds_at[y, x] = left[y, x] > 0.5 + bass.JITTER * ((noise >> 8) / 2**24 - 0.5)
            error = left[y, x] - seeds_at[y, x]
            for v, u, share in ((0, ahead, 7), (1, -ahead, 3), (1, 0, 5), (1, ahead, 1)):
                if y + v < height and 0 <= x + u < width:
                    left[y + v, x + u] += error * share / 16
    return seeds_at


def test_dithered_seeds_match_a_slow_twin(pixels: np.ndarray) -> None:
    density = pixels[..., 0].astype(np.float64) ** 2
    actual = bass.dither(density)
    assert np.array_equal(actual, slow_dither(density))
    assert actual.sum() == pytest.approx(density.sum(), rel=0.1)


@pytest.mark.parametrize("count", [1, 5, 60, 117])
def test_seeds_follow_the_density_to_the_exact_count(count: int) -> None:
    density = bass.seed_density(np.random.default_rng(1).random((9, 13)), count)
    places = bass.seeds_from_density(density, count)
    assert len({(y, x) for y, x in places.tolist()}) == count


@pytest.mark.parametrize("count", [1, 20, 50, 99, 100])
def test_density_is_at_most_one_and_sums_to_the_count(count: int) -> None:
    response = np.zeros((10, 10), np.float32)
    response[3:5] = 100
    density = seed_density(response, count)
    assert density.max() <= 1
    assert density.min() >= 0
    assert density.sum() == pytest.approx(count)


@pytest.mark.parametrize(("height", "width"), [(1, 9), (9, 1), (3, 3), (7, 12), (30, 8)])
def test_hexagonal_seeds_are_distinct_pixels(height: int, width: int) -> None:
    for count in {1, 2, height * width // 3, height * width - 1, height * width}:
        seeds = hexagonal_seeds(height, width, count)
        assert len({(y, x) for y, x in seeds.tolist()}) == count
        assert (seeds >= 0).all()
        assert (seeds < [height, width]).all()


def test_every_second_row_of_hexagonal_seeds_is_shifted() -> None:
    seeds = hexagonal_seeds(26, 30, 30)  # rows of hexagons of 26 pixels are 4.75 apart
    rows = [seeds[seeds[:, 0] == y][:, 1] for y in np.unique(seeds[:, 0])]
    assert len(rows) == 5
    assert np.diff(rows[0]) == pytest.approx(5)
    assert rows[1][0] - rows[0][0] == pytest.approx(2.5, abs=0.6)


def test_ring_mask_reads_the_ring_in_order() -> None:
    for mask in range(256):
        assert regions.ring_mask(np.where(ring_of(mask), 5, 2).astype(np.int32), 1, 1, 5) == mask


def test_connectivity_table_matches_connected_components() -> None:
    table = regions.connectivity_table()
    for mask in range(256):
        parts = connected_parts(ring_of(mask), connectivity=1)
        touching = {int(parts[place]) for place in RING[::2]} - {0}
        assert table[mask] == (len(touching) == 1), f"{mask:08b}"


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
    labels = bass.voronoi(bass.hexagonal_seeds(9, 11, 12), 9, 11)
    padded = pad_labels(labels)
    rows = region_rows(padded, pixels, 12, 12, SPREAD)
    rows[:, regions.LEAVE], rows[:, regions.JOIN] = rows[:, 5] / (rows[:, 5] - 1), rows[:, 5] / (rows[:, 5] + 1)
    moved = regions.sweep(padded, pixels, rows, regions.CONNECTIVITY, SPREAD, backward)
    expected = slow_sweep(pixels, labels, backward)
    assert moved >= np.count_nonzero(expected != labels) > 10
    assert np.array_equal(padded[1:-1, 1:-1], expected)
    fresh = region_rows(padded, pixels, 12, 12, SPREAD)
    assert rows[:, :6] == pytest.approx(fresh[:, :6], abs=1e-5)  # the running means stay true
