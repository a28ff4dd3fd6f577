"""Hostile but finite input causes no crash, no NaN and nothing outside its range."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from messages import refuses

from gsmerge import Cameras, Gaussians
from gsmerge.method.raster import composite, contributions, make_splats, render, splat_adjoint, tile_view

EXTREMES = [0.0, 1e-30, 1e-8, 0.01, 0.0100001, 0.5, 1.0, 3.0, 1e3, 1e8, 1e20, 1e30]


def camera(width: int, height: int) -> Cameras:
    K = np.array([[50.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]])
    return Cameras(np.eye(4)[None], K[None], width, height)


def make(means: object, quats: object, scales: object, opacities: object, degree: int = 0) -> Gaussians:
    columns = [np.asarray(x, np.float32) for x in (means, quats, scales, opacities)]
    sh = np.ones((len(columns[0]), (degree + 1) ** 2, 3), np.float32)
    return Gaussians(*columns, sh[:, :1], sh[:, 1:])


def assert_sane(gaussians: Gaussians, cameras: Cameras) -> None:
    for antialiased in (False, True):
        rendering = render(gaussians, cameras, 0.5, antialiased=antialiased, with_depths=True)
        assert rendering.depths is not None
        for drawn in (rendering.images, rendering.alphas, rendering.depths):
            assert np.isfinite(drawn).all()
        assert rendering.alphas.min() >= 0
        assert rendering.alphas.max() <= 1
    tiled = tile_view(make_splats(gaussians), cameras.viewmats[0], cameras.Ks[0], cameras.width, cameras.height)
    image, transmittance = composite(tiled, -np.ones((len(gaussians), 3), np.float32))
    assert np.isfinite(image).all()
    assert np.isfinite(transmittance).all()
    mass, peak = contributions(tiled)
    assert np.isfinite(mass).all()
    assert np.isfinite(peak).all()
    assert np.isfinite(splat_adjoint(tiled, image)).all()


signed = st.sampled_from(EXTREMES + [-x for x in EXTREMES])
row = st.tuples(
    st.tuples(signed, signed, signed),
    st.tuples(*[st.sampled_from([0.0, 1.0, -1.0, 1e-20, 1e15])] * 4),
    st.tuples(*[st.sampled_from(EXTREMES)] * 3),
    st.sampled_from([0.0, 1 / 255, 0.004, 0.5, 0.99, 1.0]),
)


@settings(max_examples=40, deadline=None)
@given(st.lists(row, min_size=1, max_size=6), st.sampled_from([(1, 1), (16, 16), (17, 33), (3, 40)]))
def test_extreme_gaussians_are_drawn_finite(rows: list[tuple[object, ...]], size: tuple[int, int]) -> None:
    assert_sane(make(*(list(column) for column in zip(*rows, strict=True)), degree=1), camera(*size))


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e30], ids="scale {:g}".format)
def test_gaussians_of_any_scale_are_drawn_finite(scale: float) -> None:
    gaussians = make([[0, 0, 1.0]] * 3, [[1, 0, 0, 0]] * 3, [[scale] * 3, [scale, 1, 1], [1, 1, scale]], [0.5] * 3)
    assert_sane(gaussians, camera(20, 20))
    assert render(gaussians, camera(21, 21)).alphas[0, 10, 10, 0] > 0.4


def test_gaussian_wider_than_the_world_fills_the_image() -> None:
    alphas = render(make([[0, 0, 1.0]], [[1, 0, 0, 0]], [[1e30] * 3], [0.5]), camera(40, 40)).alphas
    np.testing.assert_allclose(alphas, 0.5, atol=1e-4, rtol=0)


def test_a_zero_quaternion_counts_as_no_rotation() -> None:
    turned = make([[0, 0, 1.0]], [[0, 0, 0, 0]], [[0.1, 0.02, 0.02]], [0.5])
    upright = make([[0, 0, 1.0]], [[1, 0, 0, 0]], [[0.1, 0.02, 0.02]], [0.5])
    actual, expected = (render(gaussians, camera(30, 30)).images for gaussians in (turned, upright))
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_rows_that_are_not_finite_are_not_drawn() -> None:
    nan, inf = float("nan"), float("inf")
    clean = make([[0, 0, 1.0]] * 3, [[1, 0, 0, 0]] * 3, [[0.1] * 3] * 3, [0.5, 0.0, 0.0])
    dirty = make([[0, 0, 1.0], [nan] * 3, [inf] * 3], [[1, 0, 0, 0]] * 3, [[0.1] * 3] * 3, [0.5, 1.0, 1.0])
    actual, expected = (render(gaussians, camera(20, 20)).images for gaussians in (dirty, clean))
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_gaussians_of_one_depth_are_drawn_in_the_order_of_rows() -> None:
    n = 5000
    gaussians = make([[0, 0, 1.0]] * n, [[1, 0, 0, 0]] * n, [[0.05] * 3] * n, [0.3] * n)
    assert_sane(gaussians, camera(20, 20))
    # of equal depth: in the order of the rows, until the pixel stops
    peak = contributions(tile_view(make_splats(gaussians), np.eye(4), camera(1, 1).Ks[0], 1, 1))[1]
    np.testing.assert_allclose(peak[:20], 0.3 * 0.7 ** np.arange(20), rtol=1e-4)
    assert (peak[100:] == 0).all()


def test_image_of_more_tiles_than_sixteen_bits_count_is_drawn() -> None:
    width = height = 16 * 260
    K = np.array([[100.0, 0, 0], [0, 100.0, 0], [0, 0, 1]])
    last = (width - 8) / 100, (height - 8) / 100
    gaussians = make([[*last, 1.0], [0.08, 0.08, 1.0]], [[1, 0, 0, 0]] * 2, [[0.01] * 3] * 2, [0.5] * 2)
    tiled = tile_view(make_splats(gaussians), np.eye(4), K, width, height)
    assert len(tiled.isect_offsets) == 260 * 260 + 1
    assert tiled.flatten_ids[tiled.isect_offsets[-2] : tiled.isect_offsets[-1]].tolist() == [0]
    assert tiled.flatten_ids[: tiled.isect_offsets[1]].tolist() == [1]


def test_widest_image_is_drawn_to_its_edge_and_a_wider_one_is_refused() -> None:
    width = 32767 * 16
    K = np.array([[100.0, 0, 0], [0, 100.0, 0.5], [0, 0, 1]])
    gaussians = make([[(width - 0.5) / 100, 0, 1.0]], [[1, 0, 0, 0]], [[0.01] * 3], [0.5])
    tiled = tile_view(make_splats(gaussians), np.eye(4), K, width, 1)
    assert composite(tiled)[1][0, -1] == pytest.approx(0.5, abs=0.01)
    with refuses(ValueError, "", "524273 x 1"):
        tile_view(make_splats(gaussians), np.eye(4), K, width + 1, 1)
