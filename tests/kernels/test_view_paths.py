"""The path through the views against all paths, and against plain dynamic programming."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from messages import refuses

from gsmerge.kernels.view_paths import BACK, FAR, cheapest_views


def slow_cost(before: int, view_before: int, after: int, view: int) -> float:
    goes_on = before >= 0 and after >= 0 and (after, view) > (before, view_before)
    return min(float(after - before), FAR) if goes_on else BACK


def path_cost(pixels: np.ndarray, views: tuple[int, ...]) -> float:
    start = 0.0 if pixels[0, views[0]] >= 0 else BACK
    steps = itertools.pairwise(enumerate(views))
    return start + sum(slow_cost(pixels[i, u], u, pixels[j, v], v) for (i, u), (j, v) in steps)


def run(pixels: np.ndarray) -> tuple[np.ndarray, int]:
    chosen = np.empty(len(pixels), np.int64)
    back = cheapest_views(pixels, np.zeros(pixels.shape, np.int8), chosen)
    return chosen, back


@pytest.mark.parametrize("seed", range(8))
def test_no_path_is_cheaper(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixels = rng.integers(-1, 90, (7, 3)).astype(np.int32)
    chosen, back = run(pixels)
    best = min(path_cost(pixels, views) for views in itertools.product(range(3), repeat=7))
    assert path_cost(pixels, tuple(chosen)) == best
    assert back == sum(
        slow_cost(pixels[i, chosen[i]], chosen[i], pixels[i + 1, chosen[i + 1]], chosen[i + 1]) == BACK
        for i in range(6)
    )


def test_the_true_path_is_found() -> None:
    """Wrong views see each row somewhere near."""
    rng = np.random.default_rng(0)
    keys = np.sort(rng.choice(4 * 400, 1000, replace=False))
    pixel, view = np.divmod(keys, 4)
    pixels = (
        (pixel[:, None] + rng.integers(3, 30, (1000, 4)) * rng.choice([-1, 1], (1000, 4))).clip(-1).astype(np.int32)
    )
    pixels[np.arange(1000), view] = pixel
    chosen, back = run(pixels)
    assert back == 0
    assert (chosen == view).mean() > 0.97


@pytest.mark.parametrize("views", [1, 2, 16, 17, 127])
def test_the_path_is_the_same_on_every_processor(each_target, views: int) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(views)
    pixels = rng.integers(-1, 90, (40, views)).astype(np.int32)
    pixels[20] = 2**31 - 2

    def path() -> tuple[np.ndarray, ...]:
        came_from, chosen = np.zeros(pixels.shape, np.int8), np.empty(40, np.int64)
        return came_from, chosen, np.array(cheapest_views(pixels, came_from, chosen))

    _, chosen, back = each_target(path)
    steps = [
        slow_cost(int(pixels[i, chosen[i]]), chosen[i], int(pixels[i + 1, chosen[i + 1]]), chosen[i + 1])
        for i in range(39)
    ]
    assert back == sum(cost == BACK for cost in steps)


def test_few_rows_and_views() -> None:
    assert run(np.empty((0, 3), np.int32))[1] == 0
    assert [part.tolist() for part in map(np.asarray, run(np.array([[-1, 5]], np.int32)))] == [[1], 0]
    for views in (0, 128):
        with refuses(ValueError, "find_path", "indices"):
            run(np.zeros((3, views), np.int32))
    for pixel in (-2, 2**31 - 1):
        with refuses(ValueError, "find_path: pixels", "values"):
            run(np.full((3, 2), pixel, np.int32))
