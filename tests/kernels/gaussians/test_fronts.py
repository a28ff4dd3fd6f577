"""Pixels of Gaussians, and what pixels show, match a loop over Gaussians in order of depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_gaussians import random_gaussians

from gsmerge.method.geometry.transforms import project
from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.gaussians.fronts import project_centres, weigh_centres
from gsmerge.method.kernels.raster.binning import depth_order
from gsmerge.prepare import true_pixels as pixels_module
from gsmerge.prepare.true_pixels import find_pixels
from gsmerge.types import Cameras, Gaussians, Scene

WIDTH, HEIGHT, NEAR = 23, 17, 0.01
K = np.array([[20.0, 0.5, 11.3], [0, 21.0, 8.1], [0, 0, 1]])
CAMERAS = Cameras(np.stack([np.eye(4)] * 3), np.stack([K] * 3), WIDTH, HEIGHT)
CAMERAS.viewmats[1, 0, 3], CAMERAS.viewmats[2, 2, 3] = 0.7, 1.0
CASES = [(400, 0, 0.5, -3.5), (150, 1, 3.0, -1.5), (60, 2, 0.1, -0.5), (0, 3, 0.5, -3.0), (1, 4, 0.5, -3.0)]


def slowly(gaussians: Gaussians, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return weights ``[n]``, pixels ``[n]`` and fronts ``[h,w]`` of a view."""
    places, depths = project(gaussians.means.astype(np.float64), CAMERAS[[view]])
    weights, pixels = np.zeros(len(gaussians)), np.full(len(gaussians), -1)
    passing, most, fronts = np.ones((HEIGHT, WIDTH)), np.zeros((HEIGHT, WIDTH)), np.full((HEIGHT, WIDTH), -1)
    for i in np.argsort(depths[0], kind="stable"):
        (x, y), z = places[0, i], depths[0, i]
        if z <= NEAR:
            continue
        per_unit = np.sqrt(K[0, 0] * K[1, 1]) / z
        _short, middle, long = np.sort(gaussians.scales[i].astype(np.float64)) * per_unit
        away = (x - np.clip(x, 0, WIDTH)) ** 2 + (y - np.clip(y, 0, HEIGHT)) ** 2
        radius2 = long**2 + 0.3
        if away > 11.1 * radius2:
            continue
        row, column = int(np.clip(y, 0, HEIGHT - 1)), int(np.clip(x, 0, WIDTH - 1))
        weight = gaussians.opacities[i] * passing[row, column]
        weights[i] = weight * (middle * long + 0.3) * elementary.exp(-away / radius2 / 2)
        pixels[i] = row * WIDTH + column
        if away > 0:
            continue
        if weight > most[row, column]:
            most[row, column], fronts[row, column] = weight, i
        passing[row, column] *= 1 - min(gaussians.opacities[i], 0.99)
    return weights, pixels, fronts


def weigh(gaussians: Gaussians, view: int) -> tuple[np.ndarray, ...]:
    """Return the kernel's rows, pixels, weights and fronts."""
    fronts = np.empty((HEIGHT, WIDTH), np.int32)
    columns = (np.ascontiguousarray(column, np.float32) for column in (gaussians.means, gaussians.scales))
    opacities = gaussians.opacities.astype(np.float32)
    ids, pixels, depths, areas = project_centres(*columns, CAMERAS.viewmats[view], K, WIDTH, HEIGHT, NEAR)
    return ids, pixels, weigh_centres(depth_order(depths), ids, pixels, areas, opacities, fronts), fronts


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("view", [0, 1, 2])
def test_weights_pixels_and_fronts_match_a_loop(case: tuple[int, int, float, float], view: int) -> None:
    n, seed, opacity, size = case
    gaussians = random_gaussians(n, seed, opacity=opacity, size=size)
    ids, pixels, weights, fronts = weigh(gaussians, view)
    expected, places, shown = slowly(gaussians, view)
    assert ids.tolist() == np.flatnonzero(places >= 0).tolist()
    assert pixels.tolist() == places[ids].tolist()
    np.testing.assert_allclose(weights, expected[ids], rtol=2e-4, atol=1e-7)
    np.testing.assert_array_equal(fronts, shown)


@pytest.mark.parametrize("seed", [0, 1])
def test_pixel_is_in_the_view_of_largest_weight(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pixels_module, "choose_level", lambda *_: 0)  # cells of one pixel
    gaussians = random_gaussians(300, seed, size=-2.5)
    pixels = find_pixels(Scene(gaussians, CAMERAS, None, None, tuple("abc"))).homes
    weights, places, _ = (np.stack(columns) for columns in zip(*(slowly(gaussians, v) for v in range(3)), strict=True))
    best, rows = weights.argmax(0), np.arange(len(gaussians))
    expected = np.where(places[best, rows] >= 0, best * WIDTH * HEIGHT + places[best, rows], -1)
    assert pixels.tolist() == expected.tolist()
    assert len(np.unique(best)) == 3


def test_of_equal_views_the_first_and_of_equal_depths_the_first_row() -> None:
    gaussians = random_gaussians(100, 3, size=-3.5)
    cameras = CAMERAS[[0, 0, 0, 0]]
    pixels = find_pixels(Scene(gaussians, cameras, None, None, tuple("abcd"))).homes
    assert (pixels < WIDTH * HEIGHT).all()
    twice = Gaussians.concat([gaussians[:1]] * 2)
    twice = replace(twice, means=np.array([[0.0, 0, 3]] * 2), opacities=np.full(2, 0.6))
    ids, pixels, weights, fronts = weigh(twice, 0)
    assert ids.tolist() == [0, 1]
    assert weights[1] == pytest.approx(0.4 * weights[0])
    assert fronts.reshape(-1)[pixels].tolist() == [0, 0]


def test_gaussian_behind_the_camera_has_no_pixel() -> None:
    gaussians = random_gaussians(50, 0)
    behind = replace(gaussians, means=-np.abs(gaussians.means))
    ids, _, _, fronts = weigh(behind, 0)
    assert len(ids) == 0
    assert (fronts == -1).all()


def test_the_bits_are_the_same_on_every_processor(each_target) -> None:  # type: ignore[no-untyped-def]
    (weights, fronts) = each_target(lambda: weigh(random_gaussians(400, 0, size=-1.5), 1)[2:])
    assert len(weights) > 300
    assert (fronts >= 0).any()
