"""Samples of a photo's pixels are drawn as among the others, and scores of some tiles are those of all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from made_gaussians import random_gaussians

from gsmerge import Scene
from gsmerge.method.raster.composite import composite
from gsmerge.method.raster.metrics import MAX_PSNR, psnr_words
from gsmerge.method.raster.photos import (
    NEAR_PLANE,
    Photos,
    Sample,
    render_photos,
    scene_photos,
    score_photos,
    scored_tiles,
)
from gsmerge.method.raster.tiled_view import make_splats, tile_view

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


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(4, 160, 128), noise=0.05)


def test_wanted_tiles_have_the_same_bits_as_in_the_whole_picture(scene: Scene) -> None:
    """Bit for bit, with Gaussians of all sizes, from fewer of them."""
    rng, splats = np.random.default_rng(0), make_splats(scene.gaussians)
    scales = splats.scales * rng.choice([0.2, 1, 30], (len(splats), 1)).astype(np.float32)
    splats = type(splats)(**{**vars(splats), "scales": scales})
    photos = scene_photos(scene)
    whole = tile_view(splats, **photos.camera(1))
    for tiles in (rng.random((8, 10)) < 0.2, np.zeros((8, 10), bool), np.ones((8, 10), bool)):
        part = tile_view(splats, **photos.camera(1), tiles=tiles)
        pixels = tiles.repeat(16, 0).repeat(16, 1)
        for expected, actual in zip(composite(whole), composite(part), strict=True):
            np.testing.assert_array_equal(actual[pixels], expected[pixels])
        assert (len(part.ids) == len(whole.ids)) is bool(tiles.all())
    with pytest.raises(ValueError, match="tiles"):
        tile_view(splats, **photos.camera(1), tiles=np.ones((8, 8), bool))


@pytest.mark.parametrize("every", [2, 3, 4, 6, 7, 9, 10])
def test_as_many_views_as_the_sampling_rate_score_every_tile_once(every: int) -> None:
    """And no two neighbouring tiles of a view."""
    tiles = np.stack([scored_tiles(view, 16 * 3 * 4 * 7, 16 * 5 * 9 * 2, every) for view in range(every)])
    assert (tiles.sum(0) == 1).all()
    assert tiles.mean((1, 2)) == pytest.approx(1 / every, rel=0.01)
    assert not (tiles[:, 1:] & tiles[:, :-1]).any()
    assert not (tiles[..., 1:] & tiles[..., :-1]).any()


def test_small_views_are_scored_whole() -> None:
    assert scored_tiles(0, 160, 304, 10) is None
    assert scored_tiles(0, 640, 480, 1) is None


@pytest.mark.parametrize(("width", "height"), [(160, 320), (256, 480), (504, 280), (518, 518), (1920, 1080)])
def test_a_sample_has_a_hundred_tiles(width: int, height: int) -> None:
    tiles = scored_tiles(0, width, height, 10)
    assert tiles.sum() >= 99
    assert tiles.mean() >= 0.099


@pytest.mark.parametrize(("width", "height"), [(403, 330), (231, 900), (1000, 197)])
def test_odd_sizes_have_about_their_share(width: int, height: int) -> None:
    for view in range(4):
        tiles = scored_tiles(view, width, height, 4)
        assert tiles.shape == (-(-height // 16), -(-width // 16))
        assert tiles.mean() == pytest.approx(0.25, abs=0.1)


def test_score_of_a_sample_is_near_that_of_the_whole() -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(2, 320, 320), noise=0.05)
    photos, views = scene_photos(scene), range(len(scene))
    whole, sample = (
        score_photos(scene.gaussians, photos, views, near=NEAR_PLANE, every=every).psnr for every in (1, 4)
    )
    assert sample == pytest.approx(whole, abs=0.5)
    assert sample != whole


def test_a_view_of_equal_pictures_hides_no_other(scene: Scene) -> None:
    """Its PSNR is infinite, and would be the mean's."""
    photos = scene_photos(scene)
    drawn = render_photos(scene.gaussians, photos, near=NEAR_PLANE)
    photos = replace(photos, images=np.stack([drawn[0].clip(0, 1), *photos.images[1:]]))
    views = [score_photos(scene.gaussians, photos, [view], near=NEAR_PLANE).psnr for view in range(2)]
    assert psnr_words(views[0]) == "no difference"
    assert psnr_words(views[1]) == f"{views[1]:.1f} dB" < "60"
    assert score_photos(scene.gaussians, photos, range(2), near=NEAR_PLANE).psnr == (MAX_PSNR + views[1]) / 2
