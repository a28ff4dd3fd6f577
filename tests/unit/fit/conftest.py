"""A small room whose photos show exactly the Gaussians that are known."""

from __future__ import annotations

import pytest
import scenes

from gsmerge import Gaussians, Scene
from gsmerge.raster.photos import Photos


@pytest.fixture(scope="session")
def made() -> tuple[Scene, Gaussians]:
    return scenes.self_made(0)


@pytest.fixture(scope="session")
def scene(made: tuple[Scene, Gaussians]) -> Scene:
    return made[0]


@pytest.fixture(scope="session")
def truth(made: tuple[Scene, Gaussians]) -> Gaussians:
    return made[1]


@pytest.fixture(scope="session")
def photos(scene: Scene) -> tuple[Photos, Photos]:
    return scenes.pair_of(scene)


@pytest.fixture(scope="session")
def noise(photos: tuple[Photos, Photos]) -> tuple[Photos, Photos]:
    return scenes.noise_for(photos)
