"""Superpixels do not depend on threads, stay exact in wide pictures, and describe real photos."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from segmentation_scores import DENSITIES, count_at, photos, proxy_psnr, splat_psnr

from gsmerge.method.kernels.superpixels.regions import pad_labels, refine, region_rows
from gsmerge.method.stages.segment import SegmentOptions, segment
from gsmerge.method.stages.superpixels import superpixels
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.stages import SEGMENTATIONS


@pytest.mark.parametrize("segmentation", SEGMENTATIONS)
def test_superpixels_are_the_same_on_any_number_of_threads(segmentation: str) -> None:
    noise = np.random.default_rng(1).random((5, 24, 32, 3), np.float32)
    images = np.stack([cv2.blur(image, (3, 3)) for image in noise])
    options = SegmentOptions(superpixels=60, segmentation=segmentation)
    alone = np.stack([superpixels(image, 60, segmentation) for image in images])
    for threads in (1, 3):
        with use_threads(threads):
            np.testing.assert_array_equal(segment(images, options).labels, alone)


def test_superpixels_of_wide_pictures_keep_exact_positions() -> None:
    width, spread = 9000, np.float32(1e-5**0.5)
    labels = np.repeat(np.arange(3), 3000)[None].repeat(2, 0)
    rows = region_rows(pad_labels(labels), np.zeros((2, width, 3), np.float32), 3, 3, spread)
    assert rows[:, 4] / spread == pytest.approx(np.array([1499.5, 4499.5, 7499.5]), abs=2e-3)
    tile = np.random.default_rng(0).random((12, 30, 3), dtype=np.float32)
    image = np.tile(tile, (1, width // 30, 1))
    start = np.arange(12 * 30).reshape(12, 30) // 30 // 3 * 5 + np.arange(30)[None] // 6  # blocks of 3 x 6
    start = np.concatenate([start + 20 * i for i in range(width // 30)], 1)
    actual = refine(pad_labels(start), image, 20 * width // 30, 2, np.float32(1e-3**0.5))[1:-1, 1:-1]
    near, far = actual[:, 300:330] - 20 * 10, actual[:, -600:-570] - 20 * (width // 30 - 20)
    assert np.count_nonzero(near != start[:, :30]) > 20
    assert np.array_equal(near, far)


@pytest.mark.slow
@pytest.mark.parametrize("density", DENSITIES, ids="{} superpixels".format)
def test_superpixels_of_real_photos_reach_the_floor(density: int, floor: Callable[..., None]) -> None:
    scores = []
    for image in photos().values():
        labels = superpixels(image, count_at(image, density))
        scores.append((proxy_psnr(image, labels), splat_psnr(image, labels)))
    mean = np.mean(scores, 0)
    floor(mean[0], "mean colours")
    floor(mean[1], "a Gaussian each")


@pytest.mark.slow
def test_methods_rank_as_published() -> None:
    """Saliency seeds beat the hexagonal grid, and this SLIC (paper, figure on segmentation); rdseg beats all."""
    image = photos()["coffee"]
    count = count_at(image, 12_000)
    scores = [proxy_psnr(image, superpixels(image, count, method)) for method in ("rdseg", "bass-st", "bass", "slic")]
    assert scores == sorted(scores, reverse=True)
    assert scores[0] > scores[1] + 2


def test_presets_trade_time_for_quality() -> None:
    image = photos()["china"]
    count = count_at(image, 12_000)
    scores = [
        proxy_psnr(image, superpixels(image, count, rectangles=r, early_sweeps=e)) for r, e in ((1, 0), (2, 0), (3, 1))
    ]
    assert scores == sorted(scores)
