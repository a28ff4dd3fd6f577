"""Rows of which some or all lack the camera, or the order, that tells their pixels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from messages import names, noted
from tiny_scene import edited_json

from gsmerge.io.formats.read import read_ply
from gsmerge.io.formats.write import write_ply
from gsmerge.scene.read import load_scene

VIEWS, AREA = 5, 96 * 72


@pytest.fixture(scope="module")
def made(make_scene: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of which each row has its pixel. Read only."""
    folder: Path = make_scene(tmp_path_factory.mktemp("most") / "room", num_views=VIEWS, width=96, height=72)
    return folder


@pytest.mark.parametrize("images", [None, "none"])
@pytest.mark.parametrize("view", [0, 2, 4])
def test_a_camera_is_wrong(folder: Path, view: int, images: str | None) -> None:
    with edited_json(folder / "transforms.json") as data:
        for number, frame in enumerate(data["frames"]):
            frame |= {name: data[name] * (1 + (number == view)) for name in ("fl_x", "fl_y")}
        name = data["frames"][view]["file_path"]
    loaded = load_scene(folder, images=images)
    assert loaded.left_out is not None
    assert names(loaded.left_out, "camera of 1 of 5 views", name)
    assert "shows something else" not in loaded.left_out
    assert loaded.scene.has_own_pixels
    assert name not in loaded.scene.names
    assert len(loaded.scene) == VIEWS - 1
    assert loaded.scene.num_gaussians == VIEWS * AREA


@pytest.mark.parametrize("view", [0, 2, 4])
def test_a_camera_is_missing(folder: Path, view: int) -> None:
    with edited_json(folder / "transforms.json") as data:
        del data["frames"][view]
    loaded = load_scene(folder)
    assert loaded.left_out is not None
    assert names(loaded.left_out, "1 of 5 views")
    homes = loaded.pixel_scene().get_pixels().homes
    assert len(loaded.scene) == VIEWS - 1
    assert np.bincount(homes[homes >= 0] // AREA).tolist() == [AREA] * (VIEWS - 1)
    assert int((homes < 0).sum()) == AREA


def test_too_few_cameras_fit(folder: Path) -> None:
    """The cameras may be of another scene, so the rows keep none of them as pixels."""
    with edited_json(folder / "transforms.json") as data:
        for number, frame in enumerate(data["frames"]):
            frame |= {name: data[name] * (1 + (number > 2)) for name in ("fl_x", "fl_y")}
    loaded = load_scene(folder)
    assert loaded.left_out is not None
    assert names(loaded.left_out, "cameras of 2 of 5 views", "view_003.png", "view_004.png")
    assert not loaded.scene.has_own_pixels


def test_rows_in_no_order_are_noted(folder: Path) -> None:
    """Other numbers of rows are usual: merged and trained scenes have no pixels."""
    gaussians = read_ply(folder / "scene.ply").gaussians
    shuffled = gaussians[np.random.default_rng(0).permutation(len(gaussians))]
    write_ply(folder / "scene.ply", shuffled, overwrite=True)
    assert noted(load_scene(folder).notes, "34,560 rows", "in no known order")
    assert not noted(load_scene(folder, order="none").notes, "in no known order")
    write_ply(folder / "scene.ply", shuffled[:-7], overwrite=True)
    assert not noted(load_scene(folder).notes, "in no known order")
