"""Training draws views of a capture, and has a frozen backbone predict the Gaussians of these views alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import arc, make_scene, room
from training_runs import OPTIONS

from gsmerge import Cameras, Gaussians, Scene, Views
from gsmerge.method.geometry.pixel_gaussians import make_round_gaussians, pixel_rays
from gsmerge.method.geometry.transforms import camera_depths
from gsmerge.research.training import Capture, train


class DepthBackbone:
    """A stand-in for a network: it unprojects the depth of each pixel of the views that it is given."""

    def __init__(self, scene: Scene) -> None:
        self.seen: list[int] = []  # number of views of each call
        self.depths = {
            scene.cameras.viewmats[view].tobytes(): camera_depths(
                scene.gaussians.means[scene.get_pixels().fronts[view].reshape(-1)], scene.cameras.viewmats[view]
            )
            for view in range(len(scene))
        }

    def __call__(self, images: np.ndarray, cameras: Cameras) -> Gaussians:
        self.seen.append(len(images))
        every = np.ones(images.shape[1:3], bool)
        return Gaussians.concat([
            make_round_gaussians(
                cameras.centres[view],
                pixel_rays(every, cameras.Ks[view], viewmat),
                self.depths[viewmat.tobytes()],
                0.75 / cameras.Ks[view, 0, 0],
                images[view].reshape(-1, 3),
                0,
            )
            for view, viewmat in enumerate(cameras.viewmats)
        ])  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(room(), arc(6, 32, 24))


def capture_of(scene: Scene, backbone: DepthBackbone) -> Capture:
    return Capture(Views(scene.cameras, scene.images, scene.names), backbone, "room")


@pytest.mark.slow
def test_networks_train_on_what_a_backbone_predicts_for_drawn_views(scene: Scene, tmp_path: Path) -> None:
    backbone = DepthBackbone(scene)
    options = replace(OPTIONS, steps=2, save_every=2, random_views=(1, 12))
    result = train([capture_of(scene, backbone)], [], tmp_path / "one", options, threads=1)
    assert result.step == 2
    assert result.psnr_analytic > 15
    assert len(set(backbone.seen)) > 1
    assert set(backbone.seen) <= set(range(1, 7))
    again = train([capture_of(scene, DepthBackbone(scene))], [], tmp_path / "two", options, threads=2)
    assert again.last.read_bytes() == result.last.read_bytes()


def test_gaussians_are_predicted_from_the_drawn_views_and_scored_on_others(scene: Scene) -> None:
    rng = np.random.default_rng(0)
    for _ in range(4):
        example = capture_of(scene, DepthBackbone(scene)).draw(replace(OPTIONS, random_views=(2, 3)), rng)
        assert 2 <= len(example.cameras) <= 3
        assert len(example.members.means) == len(example.cameras) * 32 * 24
        assert len(example.photos) > len(example.cameras)


def test_a_backbone_of_another_number_of_gaussians_is_refused(scene: Scene) -> None:
    backbone = DepthBackbone(scene)
    capture = replace(capture_of(scene, backbone), backbone=lambda images, cameras: backbone(images, cameras)[:-1])
    with pytest.raises(ValueError, match="one for each pixel of 6 views of room, got 4,607"):
        capture.draw(replace(OPTIONS, random_views=(6, 6)), np.random.default_rng(0))
