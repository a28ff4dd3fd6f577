"""A camera draws samples of a photo's pixels as they are among the others."""

from __future__ import annotations

import numpy as np
import pytest
from made_gaussians import random_gaussians

from gsmerge.raster import composite, make_splats, tile_view
from gsmerge.raster.photos import Photos, Sample

WIDTH, HEIGHT = 45, 31
K = np.array([[40.0, 0, 21.3], [0, 38.0, 14.9], [0, 0, 1]])


@pytest.mark.parametrize("sample", [Sample(), Sample(2), Sample(2, 1, 0), Sample(2, 1, 1), Sample(3, 2, 1)])
def test_a_sample_shows_what_its_pixels_show(sample: Sample) -> None:
    rng = np.random.default_rng(0)
    images = rng.random((1, HEIGHT, WIDTH, 3), np.float32)
    photos = Photos(images, np.eye(4)[None], K[None], 0.3)
    splats = make_splats(random_gaussians(80, 0))
    whole, _ = composite(tile_view(splats, **photos.camera(0)))
    some, _ = composite(tile_view(splats, **photos.camera(0, sample)))
    assert (whole > 0.05).mean() > 0.2
    np.testing.assert_allclose(some, whole[sample.pixels], atol=2e-5)
    assert np.array_equal(photos.image(0, sample=sample), images[0][sample.pixels])
