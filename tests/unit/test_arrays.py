"""Pictures as Python code has them: of bytes, of numbers up to 255, beyond [0, 1]; their channels are reduced alike."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes

import gsmerge
from gsmerge import Scene
from gsmerge.arrays import as_pictures, max_columns, mean_columns
from gsmerge.types import Views

QUICK = {"effort": "draft", "fit": "none", "checkpoint": "none"}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24))


def test_pictures_of_bytes_are_scaled(scene: Scene) -> None:
    levels = np.round(scene.images * 255)
    assert as_pictures(levels.astype(np.uint8)).dtype == np.float32
    rounded, of_bytes = (
        gsmerge.compact(replace(scene, images=images), **QUICK)
        for images in ((levels / 255).astype(np.float32), levels.astype(np.uint8))
    )
    assert of_bytes.report.psnr_after == pytest.approx(rounded.report.psnr_after, abs=1e-3)
    assert not any("another look" in note for note in of_bytes.report.notes)


@pytest.mark.parametrize(("change", "remedy"), [
    (lambda images: images * 255, "divide them by 255"), (lambda images: images - 0.5, "clip them"),
    (lambda images: images * 3, "divide|clip"), (lambda images: images * np.float32(np.nan), "clip them"),
])  # fmt: skip
def test_pictures_beyond_their_range_are_refused_with_a_remedy(scene: Scene, change: Any, remedy: str) -> None:
    images = change(scene.images)
    with pytest.raises(ValueError, match=remedy):
        gsmerge.compact(replace(scene, images=images), **QUICK)
    views = Views(scene.cameras, images, scene.names)
    with pytest.raises(ValueError, match=remedy):
        gsmerge.evaluate(scene, {}, views)
    with pytest.raises(ValueError, match=remedy):
        gsmerge.evaluate(replace(scene, images=images), {"a": scene.gaussians})


def test_pictures_that_rounding_left_above_1_are_taken(scene: Scene) -> None:
    images = scene.images * np.float32(1.001)
    assert as_pictures(images) is images


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(7, 5, 3), (2, 7, 5, 3), (11, 2), (0, 3)])
def test_few_columns_are_reduced_with_the_bits_of_numpy(shape: tuple[int, ...], dtype: type[np.floating[Any]]) -> None:
    values = np.random.default_rng(0).normal(size=shape).astype(dtype)
    assert np.array_equal(mean_columns(values), values.mean(-1))
    assert mean_columns(values).dtype == dtype
    assert np.array_equal(max_columns(values), values.max(-1))
    assert np.array_equal(max_columns(values > 0), (values > 0).any(-1))
