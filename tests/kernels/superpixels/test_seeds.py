"""Seeds of superpixels match slow, obvious twins."""

from __future__ import annotations

import numpy as np
import pytest

from gsmerge.kernels.superpixels import bass
from gsmerge.kernels.superpixels.bass import hexagonal_seeds, seed_density


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
