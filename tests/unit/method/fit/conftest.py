"""Fixtures of a small room whose photos show exactly the Gaussians that are known."""

from __future__ import annotations

import pytest
import scenes

from gsmerge import Gaussians, Scene
from gsmerge.method.raster.photos import Photos


@pytest.fixture(scope="session")
def scene() -> Scene:
    return scenes.self_made(0)[0]


@pytest.fixture(scope="session")
def truth() -> Gaussians:
    return scenes.self_made(0)[1]


@pytest.fixture(scope="session")
def photos() -> tuple[Photos, Photos]:
    return scenes.pair_of(scenes.self_made(0)[0])
