"""A small room, spoilt, with its photos; and how close a run on a device comes to that of the CPU."""

from __future__ import annotations

import pytest
import scenes
from fake_gsplat import fake_gsplat

from gsmerge import Gaussians, Scene
from gsmerge.raster.photos import Photos

__all__ = ["fake_gsplat", "photos", "scene", "start"]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.self_made(0)[0]


@pytest.fixture(scope="module")
def start() -> Gaussians:
    return scenes.spoil(scenes.self_made(0)[1], seed=1)


@pytest.fixture(scope="module")
def photos(scene: Scene) -> tuple[Photos, Photos]:
    return scenes.pair_of(scene)
