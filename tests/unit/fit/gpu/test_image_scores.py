"""Losses, exposures and scores of images on a device are those of the stage."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gpu_runs import Pair

from gsmerge.fit import photo_sizes as fit_photos
from gsmerge.fit.gpu.image_scores import loss_gradient, match_exposures, photo_means, score_blocks
from gsmerge.fit.loss import image_gradient


@pytest.mark.parametrize("size", [(20, 17), (7, 7), (3, 5), (1, 9)])
@pytest.mark.parametrize(("ssim_lambda", "edge_weight"), [(0.0, 0.0), (0.2, 0.0), (0.2, 1.2), (1.0, 1.2)])
def test_loss_is_the_kernels(size: tuple[int, int], ssim_lambda: float, edge_weight: float) -> None:
    rng = np.random.default_rng(0)
    photos = rng.uniform(0, 1, (2, *size, 3)).astype(np.float32)
    image = photos[1] + 0.2 * rng.normal(size=photos[1].shape).astype(np.float32)
    weight = (rng.random(size) > 0.2).astype(np.float32)
    tensors = [torch.from_numpy(array) for array in (image, photos[1], weight)]
    means = photo_means(torch.from_numpy(photos))
    actual, error = loss_gradient(*tensors[:2], means[1], tensors[2], ssim_lambda, edge_weight)
    expected, squares = image_gradient(image, photos[1], weight, ssim_lambda, edge_weight)
    assert np.linalg.norm(actual.numpy() - expected) <= 1e-3 * np.linalg.norm(expected)
    assert float(error) == pytest.approx(squares, rel=1e-5)


def test_exposures_and_held_out_blocks_are_the_stages(photos: Pair) -> None:
    rng = np.random.default_rng(0)
    images = (photos[1].images * np.array([1.5, 1.0, 0.9])[:, None, None, None]).astype(np.float32)
    images += rng.normal(size=images.shape).astype(np.float32) * 0.05
    weights = fit_photos.training_weights(photos[1], 0.3, 0)
    tensors = [torch.from_numpy(array) for array in (images, photos[1].images, np.stack(weights))]
    for min_gain in (1.15, 3.0):
        expected = fit_photos.exposure_gains(list(images), photos[1].images, weights, min_gain)
        np.testing.assert_allclose(match_exposures(*tensors, min_gain), expected, rtol=1e-5)
        score = fit_photos.holdout_psnr(list(images), photos[1], weights, min_gain)
        assert score_blocks(*tensors, min_gain) == pytest.approx(score, abs=1e-4)
