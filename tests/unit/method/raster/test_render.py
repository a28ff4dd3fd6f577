"""The renderer draws what follows by hand, and refuses what does not fit."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from messages import refuse_all

from gsmerge import Cameras, Gaussians
from gsmerge.method.raster import (
    TiledView,
    composite,
    contributions,
    make_splats,
    render,
    render_in_batches,
    splat_adjoint,
    tile_view,
)
from gsmerge.method.raster.images import tile_views, tiles_near
from gsmerge.types import SH_C0

FOCAL = 100.0


def camera(width: int = 21, height: int = 11, count: int = 1) -> Cameras:
    """Return cameras at the origin that look along z; the principal point is the centre of the middle pixel."""
    K = np.array([[FOCAL, 0, width / 2], [0, FOCAL, height / 2], [0, 0, 1]])
    return Cameras(np.stack([np.eye(4)] * count), np.stack([K] * count), width, height)


def balls(*rows: tuple[float, float, float, float, float, float]) -> Gaussians:
    """Return round grey Gaussians: x, y, z, standard deviation, opacity, grey."""
    means, sizes, opacities, greys = np.split(np.array(rows, np.float32).reshape(-1, 6), [3, 4, 5], axis=1)
    n = len(means)
    quats, scales = np.eye(1, 4, dtype=np.float32).repeat(n, 0), sizes.repeat(3, 1)
    sh0 = ((greys - np.float32(0.5)) / np.float32(SH_C0)).repeat(3, 1)[:, None]
    return Gaussians(np.ascontiguousarray(means), quats, scales, opacities[:, 0], sh0, np.zeros((n, 0, 3), np.float32))


def value(image: np.ndarray, x: int, y: int) -> float:
    return float(image[0, y, x, 0])


def test_one_gaussian_has_the_values_computed_by_hand() -> None:
    # 0.02 wide, 1 away: 2 px; its centre is that of pixel (10, 5); dilation adds 0.3 px^2
    images = render(balls((0, 0, 1, 0.02, 0.8, 1.0)), camera()).images
    assert value(images, 10, 5) == pytest.approx(0.8, abs=1e-6)
    assert value(images, 13, 5) == pytest.approx(0.8 * math.exp(-0.5 * 9 / 4.3), abs=1e-6)
    assert value(images, 10, 3) == pytest.approx(0.8 * math.exp(-0.5 * 4 / 4.3), abs=1e-6)


def test_gaussians_at_any_depth_are_drawn() -> None:
    near, huge = (render(balls((0, 0, s, 0.02 * s, 0.8, 1.0)), camera(), near=0.01 * s) for s in (1, 4e13))
    np.testing.assert_allclose(huge.images, near.images, atol=1e-6)
    assert value(huge.images, 10, 5) > 0.7


def test_no_gaussians_leave_the_background() -> None:
    rendering = render(balls(), camera(count=2), 0.5, with_depths=True)
    assert rendering.images.shape == (2, 11, 21, 3)
    assert (rendering.images == 0.5).all()
    assert (rendering.alphas == 0).all()
    assert (rendering.depths == 0).all()


def test_gaussians_behind_the_camera_or_too_faint_are_not_drawn() -> None:
    gaussians = balls((0, 0, -1, 0.1, 1, 1), (0, 0, 0.01, 0.1, 1, 1), (0, 0, 1, 0.1, 1 / 256, 1), (9, 0, 1, 0.1, 1, 1))
    tiled = tile_view(make_splats(gaussians), np.eye(4), camera().Ks[0], 21, 11)
    assert len(tiled.ids) == 0
    assert len(tiled.flatten_ids) == 0


def test_negative_colours_are_clamped_but_given_ones_are_not() -> None:
    tiled = tile_view(make_splats(balls((0, 0, 1, 0.02, 0.8, -3.0))), np.eye(4), camera().Ks[0], 21, 11)
    assert composite(tiled)[0].max() == 0
    image, transmittance = composite(tiled, np.array([[-3.0, 0.0, 7.0]]))
    assert image[5, 10].tolist() == pytest.approx([-2.4, 0, 5.6], abs=1e-5)
    assert transmittance[5, 10] == pytest.approx(0.2, abs=1e-6)


def test_tiled_views_leave_out_gaussians_and_take_other_opacities() -> None:
    splats = make_splats(balls((0, 0, 1, 0.5, 0.5, 1), (0, 0, 2, 1.0, 0.5, 1)))
    alone = tile_view(splats, np.eye(4), camera().Ks[0], 21, 11, keep=np.array([False, True]))
    assert alone.ids.tolist() == [1]
    assert contributions(alone)[1].tolist() == pytest.approx([0, 0.5], abs=1e-5)
    fainter = tile_view(splats, np.eye(4), camera().Ks[0], 21, 11, opacities=np.array([0.25, 0.5]))
    assert contributions(fainter)[1].tolist() == pytest.approx([0.25, 0.375], abs=1e-5)


def test_arrays_are_not_copied_before_drawing(torch: Any) -> None:
    gaussians = balls((0, 0, 1, 0.02, 0.8, 1.0), (1, 1, 0, 0.02, 0.8, 1.0))
    for given in (gaussians, gaussians.to("cpu")):
        splats = make_splats(given)
        assert np.shares_memory(splats.means, gaussians.means)
        assert np.shares_memory(splats.sh0, gaussians.sh0)


@pytest.mark.parametrize("with_depths", [False, True])
@pytest.mark.parametrize("count", [0, 2])
def test_render_gives_tensors_where_an_input_is_one(with_depths: bool, count: int, torch: Any) -> None:
    """Of equal values, also where only the Gaussians or only the cameras are tensors."""
    gaussians, cameras = balls((0, 0, 1, 0.02, 0.8, 1.0), (0.01, 0, 1.2, 0.03, 0.5, 0.2)), camera(count=2)[:count]
    options = {"antialiased": True, "near": 0.1, "far": 5.0, "with_depths": with_depths}
    expected = render(gaussians, cameras, (0.1, 0.2, 0.3), **options)
    assert (expected.depths is not None) == with_depths
    under = torch.tensor([0.1, 0.2, 0.3])
    for some, seen in (
        (gaussians.to("cpu"), cameras.to("cpu")),
        (gaussians.to("cpu"), cameras),
        (gaussians, cameras.to("cpu")),
    ):
        actual = render(some, seen, under, **options)
        for name, one in vars(expected).items():
            tensor = getattr(actual, name)
            if one is None:
                assert tensor is None
                continue
            assert isinstance(one, np.ndarray)
            assert isinstance(tensor, torch.Tensor)
            assert one.dtype == np.float32
            assert tensor.dtype == torch.float32
            assert not tensor.requires_grad
            np.testing.assert_array_equal(tensor.numpy(), one)
    assert isinstance(render(gaussians, cameras, under).images, np.ndarray)


@pytest.mark.parametrize("gradients", [False, True])
def test_results_go_to_where_the_gaussians_are(gradients: bool, torch: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A device without memory stands for a GPU: what is copied to the CPU has to be given."""
    gaussians, cameras = balls((0, 0, 1, 0.02, 0.8, 1.0)).to("cpu"), camera().to("cpu")
    there = gaussians.to("meta")
    gaussians.means.requires_grad_(gradients)
    monkeypatch.setattr(Gaussians, "to", lambda *_: gaussians)
    drawn = render(there, cameras, with_depths=True)
    assert all(part.is_meta for part in vars(drawn).values())
    assert [part.requires_grad for part in vars(drawn).values()] == [gradients, gradients, False]


def test_every_view_has_its_own_image() -> None:
    gaussians, cameras = balls((0, 0, 1, 0.02, 0.8, 1.0)), camera(count=2)
    viewmats = cameras.viewmats.copy()
    viewmats[1, 0, 3] = 0.05  # 5 px to the right
    images = render(gaussians, Cameras(viewmats, cameras.Ks, 21, 11)).images
    np.testing.assert_allclose(images[1, :, 5:], images[0, :, :-5], atol=2e-3, rtol=0)
    assert np.abs(images[1] - images[0]).max() > 0.5


def test_render_refuses_arguments_that_do_not_fit() -> None:
    gaussians, splats, K = (
        balls((0, 0, 1, 0.02, 0.8, 1.0)),
        make_splats(balls((0, 0, 1, 0.02, 0.8, 1.0))),
        camera().Ks[0],
    )
    tiled = tile_view(splats, np.eye(4), K, 21, 11)
    refuse_all(ValueError, [
        (lambda: render(gaussians, camera(), (0.1, 0.2)), "", "background", (0.1, 0.2)),
        (lambda: render(gaussians, camera(), near=0), "", "near", 0),
        (lambda: render(gaussians, camera(), near=2, far=1), "", "near", 2, 1),
        (lambda: tile_view(splats, np.eye(3), K, 21, 11), "", "[4,4]", [3, 3]),
        (lambda: tile_view(splats, np.eye(4), K, 0, 11), "", "0 x 11"),
        (lambda: tile_view(splats, np.eye(4), -np.eye(3), 21, 11), "", "focal", -1.0),
        (lambda: tile_view(splats, np.eye(4), K, 21, 11, opacities=np.ones(2)), "", "1 opacities", "2 and 1"),
        (lambda: tile_view(splats, np.eye(4), K, 21, 11, keep=np.ones(2, bool)), "", "keep", "1 and 2"),
        (lambda: composite(tiled, np.ones((2, 3))), "colors", [1, 3], [2, 3]),
        (lambda: splat_adjoint(tiled, np.ones((11, 20, 3))), "image", [11, 20, 3]),
    ])  # fmt: skip


def many_balls() -> Gaussians:
    rng = np.random.default_rng(4)
    places = [rng.uniform(-1, 1, (300, 2)), rng.uniform(1, 4, (300, 1)), rng.uniform(0.01, 0.9, (300, 3))]
    return balls(*map(tuple, np.concatenate(places, 1)))


@pytest.mark.parametrize("at_once", [1, 2, 3, 8])
def test_many_views_are_drawn_in_turn_as_they_are_together(at_once: int) -> None:
    gaussians, cameras = many_balls(), camera(41, 31, 5)
    cameras.viewmats[:, 0, 3] = np.linspace(-0.3, 0.37, 5)
    images = list(render_in_batches(gaussians, cameras, 0.3, at_once=at_once))
    whole = render(gaussians, cameras, 0.3).images
    np.testing.assert_array_equal(images, whole)
    for left, right in ((0, 10), (10, 30), (20, 20)):
        some = list(render_in_batches(gaussians, cameras, 0.3, at_once=at_once, columns=[(left, right)] * 5))
        np.testing.assert_array_equal(np.stack(some)[:, :, left:right], whole[:, :, left:right])
        assert np.ptp(np.stack(some)[:, :, -(-right // 16) * 16 :]) == 0  # the background alone


@pytest.mark.parametrize("band", [1, 41 * 16, 41 * 40])
def test_bands_of_a_large_picture_are_those_of_the_whole(band: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsmerge.method.raster.images.BAND_PIXELS", band)
    gaussians, cameras, shapes = many_balls(), camera(41, 61, 2), []

    def convert(part: np.ndarray) -> np.ndarray:
        shapes.append(part.shape[0])
        return part * 2

    drawn = list(render_in_batches(gaussians, cameras, 0.3, at_once=2, convert=convert))
    np.testing.assert_array_equal(drawn, 2 * render(gaussians, cameras, 0.3).images)
    tall = max(1, band // (41 * 16)) * 16
    assert shapes == [*[tall] * (61 // tall), 61 % tall] * 2


def test_tile_lists_end_behind_gaussians_that_hide_the_tile(monkeypatch: pytest.MonkeyPatch) -> None:
    """So Gaussians that cover every pixel, and cannot be seen, take no memory; what is drawn stays."""
    huge = balls(*((0.01 * i, 0, 4 + 0.01 * i, 30 + i, 0.02 + 0.004 * i, 0.5) for i in range(200)))
    gaussians, cameras = Gaussians.concat([many_balls()[:40], huge]), camera(41, 61)

    def draw() -> tuple[list[np.ndarray], list[list[int]]]:
        tiled = tile_view(make_splats(gaussians), cameras.viewmats[0], cameras.Ks[0], 41, 61)
        lists = np.split(tiled.ids[tiled.flatten_ids], tiled.isect_offsets[1:-1])
        return [*composite(tiled), *contributions(tiled)], [part.tolist() for part in lists]

    whole, all_lists = draw()
    monkeypatch.setattr("gsmerge.method.raster.tiled_view.CROWDED", 0)
    monkeypatch.setattr("gsmerge.method.raster.tiled_view.CROWDED_EACH", 0)
    drawn, lists = draw()
    assert sum(map(len, lists)) < 0.6 * sum(map(len, all_lists))
    for part, every in zip(lists, all_lists, strict=True):
        assert part == every[: len(part)]
    for values, expected in zip(drawn, whole, strict=True):
        np.testing.assert_array_equal(values, expected)


def test_tiles_near_pixels_are_drawn_as_in_the_whole_picture() -> None:
    """With those within a distance of the pixels, and of each view that has none chosen all."""
    cameras = camera(90, 70, count=2)
    pixels = np.zeros((70, 90), bool)
    pixels[33, 50] = True
    tiles = tiles_near(pixels, 16)
    np.testing.assert_array_equal(np.argwhere(tiles), [(y, x) for y in (1, 2, 3) for x in (2, 3, 4)])
    gaussians = many_balls()
    whole = render(gaussians, cameras)
    drawn = np.empty((2, 70, 90, 3), np.float32)

    def draw(view: int, tiled: TiledView) -> None:
        drawn[view] = composite(tiled)[0]

    tile_views(gaussians, cameras, draw, tiles={1: tiles})
    np.testing.assert_array_equal(drawn[0], whole.images[0])
    part = tiles.repeat(16, 0)[:70].repeat(16, 1)[:, :90]
    assert part.sum() == 9 * 16 * 16
    np.testing.assert_array_equal(drawn[1][part], whole.images[1][part])
    assert not drawn[1][~part].any()
