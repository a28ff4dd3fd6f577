"""Fitted results show no fog where the input is empty, and no holes where it is solid, from outside."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scenes
from sweeps import sweep

from gsmerge import Gaussians, Scene
from gsmerge.method.geometry.views import concat_cameras
from gsmerge.scoring.fog import HAZE, measure_fog
from gsmerge.types import Pixels

SIZE = (112, 84)


def room(num_views: int = 4) -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(num_views, *SIZE), noise=0.01)


def two_layers() -> Scene:
    """Put a fainter Gaussian behind that of each pixel, as a view of its own with the same camera and photo."""
    front = room(2)
    eyes = np.repeat(front.cameras.centres, front.pixels_per_view, 0)
    g = front.gaussians
    behind = replace(g, means=eyes + 1.3 * (g.means - eyes), scales=1.3 * g.scales, opacities=0.5 * g.opacities)
    return Scene(
        Gaussians.concat([g, behind]), concat_cameras(front.cameras, front.cameras), np.concatenate([front.images] * 2),
        Pixels.of_grid(np.ones((4, SIZE[1], SIZE[0]), bool)), scenes.names(4),
    )  # fmt: skip


def letterbox() -> Scene:
    """Put black bars above and below in the photos and the colours of their Gaussians."""
    scene = room()
    images, sh0 = scene.images.copy(), scene.gaussians.sh0.copy()
    bars = np.zeros(images.shape[:3], bool)
    bars[:, :6] = bars[:, -6:] = True
    images[bars], sh0[bars.ravel()] = 0, -0.5 / 0.28209479
    return replace(scene, images=images, gaussians=replace(scene.gaussians, sh0=sh0))


def masked() -> Scene:
    """Mask the ball's side of each photo."""
    scene = room()
    masks = np.ones(scene.images.shape[:3], bool)
    masks[:, :, SIZE[0] // 2 :] = False
    return replace(scene, masks=masks)


def outliers() -> Scene:
    """Move every fiftieth pixel to a third to three times its depth."""
    scene, rng = room(), np.random.default_rng(0)
    eyes = np.repeat(scene.cameras.centres, scene.pixels_per_view, 0)
    factors = np.ones(scene.num_gaussians)
    factors[::50] = 3.0 ** rng.uniform(-1, 1, len(factors[::50]))
    g = scene.gaussians
    return replace(scene, gaussians=replace(g, means=eyes + factors[:, None] * (g.means - eyes)))


def sky() -> Scene:
    """Put half of each photo thirty times as far away, in one colour."""
    surfaces = [scenes.plane(2.2, scenes.waves(1), right=0.0), scenes.plane(60.0, scenes.flat(0.7, 0.8, 0.95))]
    return scenes.make_scene(surfaces, scenes.arc(4, *SIZE))


SCENES: dict[str, Callable[[], Scene]] = {
    "wall": lambda: scenes.make_scene(scenes.wall(), scenes.arc(4, *SIZE), noise=0.01),
    "room": room,
    "one photo": lambda: room(1),
    "two layers": two_layers,
    "letterbox": letterbox,
    "masks": masked,
    "outliers of depth": outliers,
    "sky": sky,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_default_fit_leaves_no_fog_and_no_holes(name: str, floor: Callable[..., None]) -> None:
    """After the default fit; the floor is of the share of emptiness that is left, far from the outline."""
    scene = SCENES[name]()
    result = scenes.compacted(scene)
    assert result.report.choices["fit"]["accepted"]
    fog = measure_fog(scene.gaussians, {"result": result.gaussians}, scene.cameras)["result"]["all"]
    assert fog.fog_far < HAZE
    assert fog.holes < 0.02
    floor(1 - fog.fog_far)
    assert (result.gaussians.opacities >= 1 / 255).all()


@sweep("settings", [{"effort": "draft"}, {"effort": "fast"}, {"k": 4}, {"budget": "20%"}])
def test_no_effort_or_size_leaves_fog_or_holes(settings: dict[str, object]) -> None:
    scene = room()
    result = scenes.compacted(scene, **settings)
    fog = measure_fog(scene.gaussians, {"result": result.gaussians}, scene.cameras)["result"]["all"]
    assert fog.fog_far < HAZE
    assert fog.holes < 0.02
