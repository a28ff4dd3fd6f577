"""The image does not depend on threads, order of Gaussians and rows that are left out."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gsmerge import Cameras, Gaussians
from gsmerge.method.geometry.transforms import normalize
from gsmerge.method.kernels import elementary
from gsmerge.method.raster import composite, contributions, make_splats, render, splat_adjoint, tile_view
from gsmerge.method.raster.metrics import psnr
from gsmerge.runtime.threads import use_threads

WIDTH, HEIGHT = 70, 50

seeds = st.integers(0, 2**31)


def scene(n: int, seed: int, size: float = 0.05, degree: int = 0) -> tuple[Gaussians, Cameras]:
    rng = np.random.default_rng(seed)
    means = rng.normal((0, 0, 3), 0.7, (n, 3))
    quats = normalize(rng.normal(size=(n, 4)))
    scales = elementary.exp(rng.normal(0, 0.7, (n, 3))) * size
    opacities, sh0 = rng.random(n), rng.normal(size=(n, 1, 3))
    shN = rng.normal(0, 0.3, (n, (degree + 1) ** 2 - 1, 3))
    K = np.array([[60.0, 0, WIDTH / 2], [0, 60.0, HEIGHT / 2], [0, 0, 1]])
    cameras = Cameras(np.eye(4)[None], K[None], WIDTH, HEIGHT)
    arrays = means, quats, scales, opacities, sh0, shN
    return Gaussians(*(array.astype(np.float32) for array in arrays)), cameras


def test_threads_change_no_bit() -> None:
    gaussians, cameras = scene(150_000, 1, 0.004, degree=1)  # enough for several pieces of work
    cameras = cameras[[0] * 3]
    image = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 5))
    results = []
    for count in (1, 3):
        with use_threads(count):
            tiled = tile_view(make_splats(gaussians), cameras.viewmats[0], cameras.Ks[0], WIDTH, HEIGHT)
            rendering = render(gaussians, cameras, with_depths=True)
            results.append([
                tiled.ids, tiled.flatten_ids, tiled.isect_offsets, tiled.conics, rendering.images,
                rendering.alphas, rendering.depths, splat_adjoint(tiled, image), *contributions(tiled),
            ])  # fmt: skip
    assert len(results[0][1]) > 4 * 2**15
    for first, second in zip(*results, strict=True):
        np.testing.assert_array_equal(first, second)


@settings(max_examples=5, deadline=None)
@given(seeds)
def test_order_of_gaussians_does_not_matter(seed: int) -> None:
    gaussians, cameras = scene(300, seed)
    view = cameras.viewmats[0].astype(np.float64), cameras.Ks[0].astype(np.float64)
    depths = tile_view(make_splats(gaussians), *view, WIDTH, HEIGHT).depths
    assume(len(np.unique(depths)) == len(depths))  # of equal depths the first in order is in front
    shuffled = gaussians[np.random.default_rng(seed).permutation(300)]
    assert psnr(render(gaussians, cameras).images[0], render(shuffled, cameras).images[0]) > 90


@settings(max_examples=5, deadline=None)
@given(seeds)
def test_image_without_left_out_gaussians_is_that_without_their_rows(seed: int) -> None:
    gaussians, cameras = scene(300, seed, degree=2)
    keep = np.random.default_rng(seed).random(300) < 0.5
    view = cameras.viewmats[0], cameras.Ks[0], WIDTH, HEIGHT
    left, removed = tile_view(make_splats(gaussians), *view, keep=keep), tile_view(make_splats(gaussians[keep]), *view)
    np.testing.assert_array_equal(composite(left)[0], composite(removed)[0])
    np.testing.assert_array_equal(contributions(left)[0][keep], contributions(removed)[0])
    assert contributions(left)[0][~keep].max() == 0
