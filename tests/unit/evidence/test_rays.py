"""Photos whose colours Gaussians have on their rays, wherever along these they lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
import unaligned_scenes

from gsmerge import Scene
from gsmerge.evidence.rays import find_on_rays, measure_on_rays
from gsmerge.frame import canonicalise

VIEWS = 4


@pytest.fixture(scope="module")
def noisy() -> Scene:
    """Rows in any order, each at .6 to 1.5 times its depth."""
    room = scenes.make_scene(scenes.room(), scenes.arc(VIEWS, 96, 72))
    eyes = np.repeat(room.cameras.centres, room.pixels_per_view, 0)
    factors = np.random.default_rng(0).uniform(0.6, 1.5, (len(eyes), 1))
    moved = replace(room, gaussians=replace(room.gaussians, means=eyes + factors * (room.gaussians.means - eyes)))
    return canonicalise(unaligned_scenes.shuffled(moved))[0]


def right(scene: Scene, photos: np.ndarray) -> list[bool]:
    return find_on_rays(scene, range(VIEWS), list(photos)).tolist()


def test_right_photos_have_colours_on_their_rays(noisy: Scene) -> None:
    shares = measure_on_rays(noisy, range(VIEWS), list(noisy.images))
    assert np.diag(shares).min() > 0.9
    assert shares[~np.eye(VIEWS, dtype=bool)].max() < 0.6
    assert right(noisy, noisy.images) == [True] * VIEWS


def test_shares_are_those_of_a_plain_loop(noisy: Scene) -> None:
    """Of all pixels, as these are fewer than are sampled of larger views."""
    few = replace(noisy, gaussians=noisy.gaussians[::40])
    (actual,) = measure_on_rays(few, [1], [noisy.images[1]])
    camera, hits = few.cameras, np.zeros((72, 96, 2), bool)
    for mean, sh0 in zip(few.gaussians.means, few.gaussians.sh0[:, 0], strict=True):
        x, y, z = camera.viewmats[1, :3, :3] @ mean + camera.viewmats[1, :3, 3]
        if z > 0.01:
            column, row = int(camera.Ks[1, 0, 0] * x / z + 48), int(camera.Ks[1, 1, 1] * y / z + 36)
            if 0 <= column < 96 and 0 <= row < 72:
                color = (0.5 + 0.28209479177387814 * sh0).clip(0, 1)
                alike = np.abs(color - noisy.images[1, row, column]).max() <= 3 / 255
                hits[row, column] |= [True, alike]
    expected = hits[..., 1].sum() / hits[..., 0].sum()
    assert actual[0] == pytest.approx(expected, abs=0.05)  # 4,096 of 6,912 pixels


def test_exchanged_and_foreign_photos_have_none(noisy: Scene) -> None:
    exchanged = noisy.images[[1, 0, 2, 3]]
    assert right(noisy, exchanged) == [False, False, True, True]
    foreign = noisy.images.copy()
    foreign[2] = noisy.images[2, ::-1, ::-1]
    assert right(noisy, foreign) == [True, True, False, True]
    assert right(noisy, noisy.images[:, ::-1]) == [False] * VIEWS
    assert right(noisy, noisy.images[[1, 2, 3, 0]]) == [False] * VIEWS


def test_one_photo_has_none_to_be_compared_with(noisy: Scene) -> None:
    assert find_on_rays(noisy, [0], [noisy.images[0]]).tolist() == [False]
