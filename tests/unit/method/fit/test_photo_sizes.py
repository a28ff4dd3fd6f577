"""A fit chooses the size of its photos, reads them once, and looks at one size in each step."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import scenes
from messages import refuses

from gsmerge import Gaussians, Scene, compact
from gsmerge.method.fit import FitJob, FitOptions, fit_photos
from gsmerge.method.fit.full import fit_full
from gsmerge.method.fit.photo_sizes import large_photos, largest_scale, photo_scale, training_weights
from gsmerge.method.fit.schedule import DrawMode, prepare_fit
from gsmerge.method.geometry.transforms import project
from gsmerge.method.geometry.views import subset
from gsmerge.method.raster.photos import MASKED_WEIGHT, scene_photos, score_photos
from gsmerge.method.raster.tiled_view import EPS2D
from gsmerge.types import LargePhotos, PicturedScene

LONG = FitOptions(fit_steps=160, holdout=0.2)


def with_large(scene: Scene, scale: float, read: list[int] | None = None) -> PicturedScene:
    """Return the scene with enlarged photos of its own; ``read`` gets the number of every photo that is read."""
    width, height = (round(scale * side) for side in (scene.cameras.width, scene.cameras.height))
    images = [cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC) for image in scene.images]
    stored = [np.rint(255 * image.clip(0, 1)).astype(np.uint8) for image in images]

    def read_stored(photo: int) -> np.ndarray:
        if read is not None:
            read.append(photo)
        return stored[photo]

    shape = np.array([[width / scene.cameras.width], [height / scene.cameras.height], [1.0]])
    large = LargePhotos(scene.cameras.Ks * shape, width, height, tuple(range(len(scene))), read_stored)
    return PicturedScene.with_pictures(replace(scene, large_photos=large), scene.images, scene.masks)


# which size


SMALLER = "is 1.5: the photos are no larger"
SHORT = "is 1: larger photos need the full fit, with steps on photos of full size"


@pytest.mark.parametrize(
    ("larger", "auto", "settings", "expected", "reason"),
    [
        (4, True, {}, 2, None), (1.5, True, {}, 1.5, None), (1.2, True, {}, 1, None), (4, False, {}, 1, None),
        (4, True, {"fit": "none"}, 1, None), (4, True, {"fit_steps": 12}, 1, None),
        (4, True, {"photo_scale": 1}, 1, None), (4, True, {"photo_scale": 3}, 3, None),
        (4, False, {"photo_scale": 1.5}, 1.5, None), (1.2, True, {"photo_scale": 1.1}, 1.1, None),
        (1.5, True, {"photo_scale": 4}, 1.5, f"photo_scale 4 {SMALLER}"),
        (2, True, {"photo_scale": 2, "fit": "none"}, 1, f"photo_scale 2 {SHORT}"),
        (2, True, {"photo_scale": 2, "fit_steps": 12}, 1, f"photo_scale 2 {SHORT}"),
    ],
)  # fmt: skip
def test_the_photo_scale_is_that_of_photos_and_settings_or_smaller_for_a_reason(
    scene: Scene, larger: float, auto: bool, settings: dict[str, Any], expected: float, reason: str | None
) -> None:
    actual, problem = photo_scale(with_large(scene, larger), FitOptions(**settings), auto=auto)
    assert actual == pytest.approx(expected, rel=0.02)
    assert problem == reason


def test_photos_of_the_size_of_the_views_have_scale_1(scene: Scene) -> None:
    assert largest_scale(scene) == 1
    assert photo_scale(scene, FitOptions(), auto=True) == (1, None)
    assert photo_scale(scene, FitOptions(photo_scale=2), auto=True) == (
        1,
        "photo_scale 2 is 1: the photos are no larger",
    )
    with refuses(ValueError, "", "photos", "views"):
        large_photos(scene, 2)


@pytest.mark.parametrize("value", [0.5, 0, -1, float("inf"), float("nan"), "2", "large"])
def test_impossible_photo_scales_are_refused(value: Any) -> None:
    with refuses(ValueError, "photo_scale", 1, value):
        FitOptions(photo_scale=value)


# what is read


def test_large_photos_are_read_once_at_the_chosen_scale(scene: Scene) -> None:
    read: list[int] = []
    large = with_large(scene, 4, read)
    photos = large_photos(large, 2)
    assert sorted(read) == list(range(len(scene)))
    assert photos.images.dtype == np.uint8
    assert (photos.width, photos.height) == (2 * scene.cameras.width, 2 * scene.cameras.height)
    np.testing.assert_allclose(photos.Ks, scene.cameras.Ks * [[2], [2], [1]])
    assert photos.eps2d == EPS2D  # of a viewer at this size
    small = cv2.resize(large.large_photos.read(1), (photos.width, photos.height), interpolation=cv2.INTER_AREA)
    assert photos.image(1).dtype == np.float32
    np.testing.assert_allclose(photos.image(1), small / 255, atol=1e-6)


def test_masks_are_enlarged_to_weights_of_large_photos(scene: Scene) -> None:
    masks = np.ones(scene.pixels.shown.shape, bool)
    half = masks.shape[2] // 2
    masks[:, :, half:] = False
    weights = large_photos(replace(with_large(scene, 2), masks=masks), 2).weights
    assert (weights[:, :, : 2 * half] == 1).all()
    assert (weights[:, :, 2 * half :] == MASKED_WEIGHT).all()


def test_a_point_has_the_same_place_in_every_size(scene: Scene) -> None:
    photos = large_photos(with_large(scene, 3), 1.7)
    shape = np.array([photos.width / scene.cameras.width, photos.height / scene.cameras.height])
    places, _ = project(scene.gaussians.means[:50].astype(np.float64), scene.cameras)
    large = replace(scene.cameras, Ks=photos.Ks, width=photos.width, height=photos.height)
    np.testing.assert_allclose(project(scene.gaussians.means[:50].astype(np.float64), large)[0], places * shape)


def test_a_subset_of_views_has_the_large_photos_of_these_views(scene: Scene) -> None:
    read: list[int] = []
    large_photos(subset(with_large(scene, 2, read), [2, 0]), 2)
    assert sorted(read) == [0, 2]
    three = subset(with_large(scene, 2), [0, 1, 2])
    two = three.large_photos[[0, 1]]
    with refuses(ValueError, "", 3, 2):
        replace(three, large_photos=two)


# the steps


def test_steps_look_at_half_size_then_full_size_then_larger_photos(scene: Scene) -> None:
    options = FitOptions(fit_steps=200, photo_scale=2)
    run = prepare_fit(FitJob(fit_photos(with_large(scene, 2), options), options))
    modes = [run.draw_mode(step + 1, step / 200) for step in range(200)]
    assert [mode.stride for mode in modes] == [2] * 140 + [1] * 60
    assert set(modes[:140]) == {DrawMode(0, EPS2D, stride=2)}
    sizes = [mode.size for mode in modes[140:]]
    assert [sizes.count(size) for size in (1, 0, 2)] == [1, 35, 24]
    usual = prepare_fit(FitJob(scenes.pair_of(scene), options))
    sizes = [usual.draw_mode(step + 1, step / 200).size for step in range(200)]
    assert [sizes[140:].count(size) for size in (0, 1)] == [52, 8]


def test_a_share_of_half_size_steps_that_a_user_sets_stays(scene: Scene) -> None:
    options = FitOptions(half_res_share=0.8, photo_scale=2)
    assert prepare_fit(FitJob(fit_photos(with_large(scene, 2), options), options)).half_part == 0.8


def test_large_photos_count_in_every_pixel(scene: Scene) -> None:
    run = prepare_fit(FitJob(fit_photos(with_large(scene, 2), replace(LONG, photo_scale=2)), LONG))
    assert all((weight == 1).all() for weight in run.step_weights[2])


@pytest.mark.slow
def test_a_fit_to_larger_photos_shows_them_better(truth: Gaussians, scene: Scene) -> None:
    """Over three seeds, since by one the gain is .2 to .9 dB."""
    large, start = with_large(scene, 2), scenes.spoil(truth)
    near = large_photos(large, 2)
    near = replace(near, images=np.stack([near.image(view) for view in range(len(near))]))

    def fitted(scale: float, seed: int) -> Gaussians:
        run = scenes.run_for(fit_photos(large, replace(LONG, photo_scale=scale)), LONG)
        return fit_full(start, replace(run, job=replace(run.job, seed=seed)))[0]

    assert scenes.identical(fitted(1, 0), fit_full(start, scenes.run_for(scenes.pair_of(scene), LONG))[0])
    usual, sharp = (
        np.mean([score_photos(fitted(scale, seed), near, range(len(near))).psnr for seed in range(3)])
        for scale in (1, 2)
    )
    assert sharp > usual + 0.3


def test_a_run_notes_the_photo_scale(scene: Scene) -> None:
    report = compact(with_large(scene, 2), superpixels="10%", fit_steps=30).report
    assert report.choices["photo_scale"] == 2
    assert [note for note in report.notes if "--set photo_scale=1 " in note]
    report = compact(with_large(scene, 2), superpixels="10%", fit_steps=30, photo_scale=1).report
    assert "photo_scale" not in report.choices
    assert not [note for note in report.notes if "photo_scale" in note]


def test_held_out_patches_lie_where_photos_count(scene: Scene) -> None:
    """Of a small part, at least one patch of each view; none of what is to stay empty."""
    photos = scene_photos(scene)
    weights = np.full((len(photos), photos.height, photos.width), MASKED_WEIGHT, np.float32)
    weights[:, 16:28, 16:28] = 1
    empty = np.zeros_like(weights)
    empty[:, :, :20] = 1
    for seed in range(20):
        cut_out = replace(photos, weights=np.maximum(weights, empty), empty=empty)
        parts = (replace(photos, weights=weights), weights == 1), (cut_out, weights * (1 - empty) == 1)
        for part, counts in parts:
            for view, weight in enumerate(training_weights(part, 0.02, seed)):
                held_out = weight == 0
                assert 0 < (held_out & counts[view]).sum() < counts[view].sum()
