"""Gaussians and photos on a device, and what is drawn of them, are those of the renderer."""

from __future__ import annotations

import numpy as np
import pytest
import scenes
import torch
from gpu_runs import CPU, Pair, on_device

from gsmerge import Gaussians
from gsmerge.fit.gpu.device_photos import (
    draw_and_transpose,
    draw_gaussians,
    shape_of,
    to_device,
    upload_gaussians,
    view_peaks,
)
from gsmerge.raster import contributions, plan_view, prepare, splat_adjoint
from gsmerge.raster.photos import render_photos


def test_photos_and_cameras_arrive(photos: Pair) -> None:
    full, half = on_device(photos)
    assert (len(full), full.height, full.width) == (len(photos[0]), photos[0].height, photos[0].width)
    np.testing.assert_array_equal(half.images, photos[1].images)
    viewmat, K, width, height = half.camera(1)
    np.testing.assert_allclose(viewmat, photos[1].viewmats[1], rtol=1e-6)
    np.testing.assert_allclose(K, photos[1].Ks[1], rtol=1e-6)
    assert (width, height) == (half.width, half.height)
    ends = np.einsum("vij,vj->vi", photos[0].viewmats, np.pad(full.eyes, ((0, 0), (0, 1)), constant_values=1))
    np.testing.assert_allclose(ends[:, :3], 0, atol=1e-6)


def test_arrays_that_cannot_be_written_are_copied() -> None:
    """torch would warn, which is an error here; Gaussians keep their dtypes where float32 is not asked for."""
    array = np.arange(3.0)
    array.flags.writeable = False
    assert to_device(array, CPU).dtype == torch.float64
    assert to_device(array, CPU, torch.float32).dtype == torch.float32


@pytest.mark.parametrize("degree", [0, 2])
def test_renders_are_the_renderers(degree: int) -> None:
    scene, truth = scenes.self_made(degree)
    half = scenes.pair_of(scene)[1]
    resident, uploaded = on_device((half, half))[0], upload_gaussians(truth, CPU)
    for view, expected in enumerate(render_photos(truth, half)):
        np.testing.assert_allclose(draw_gaussians(uploaded, resident, view), expected, atol=2e-5)


def test_transposes_and_peaks_are_the_renderers(start: Gaussians, photos: Pair) -> None:
    half, uploaded = on_device(photos)[1], upload_gaussians(start, CPU)
    plan = plan_view(prepare(start), **photos[1].camera(1))
    values = np.random.default_rng(0).random((half.height, half.width, 3), np.float32)
    _, transpose, reached = draw_and_transpose(shape_of(uploaded), torch.ones(len(start), 3), half, 1)
    np.testing.assert_allclose(transpose(torch.from_numpy(values)), splat_adjoint(plan, values), rtol=1e-4, atol=1e-5)
    peaks = view_peaks(shape_of(uploaded), half, 1)
    np.testing.assert_allclose(peaks, contributions(plan)[1], rtol=1e-5, atol=1e-6)
    assert set(np.flatnonzero(reached)) == set(plan.ids)
