"""Cameras are read as their file says, or in another way in which they fit the Gaussians."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import export_rows, save_export, smooth_scene
from messages import noted
from model_rows import merge_voxels
from tiny_scene import rotation

from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.reading import candidates
from gsmerge.reading.read_scene import load_scene

PAGE = Path(__file__).resolve().parents[3] / "docs" / "internals" / "adding.md"
SMOOTH = smooth_scene(56, 40)
VOXELS = export_rows(replace(SMOOTH, gaussians=merge_voxels(SMOOTH, 0.07)), np.arange(4027))  # of no pixels
WORLD = rotation(np.deg2rad(60), 0, 0)  # of the example


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the way of reading that the page shows."""
    block = re.search(r"```python\n(def tilt.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    assert block is not None
    ways: dict[str, object] = {}
    exec(block[1], {"WAYS": ways, "np": np, "replace": replace, "CameraFile": CameraFile})
    monkeypatch.setattr(candidates, "WAYS", ways)


def save(folder: Path, *, levelled: bool) -> Path:
    """Save a scene of voxels without photos, whose camera file may be levelled as that of the example."""
    c2w = SMOOTH.c2w.copy()
    if levelled:  # the world of the cameras is turned, and the Gaussians are not
        c2w[:, :3] = WORLD @ c2w[:, :3]
    save_export(folder, replace(SMOOTH, c2w=c2w), VOXELS)
    shutil.rmtree(folder / "images")  # their colours would be searched in other frames, which takes seconds
    return folder


@pytest.mark.usefixtures("example")
def test_the_example_of_the_page_reads_levelled_cameras(tmp_path: Path) -> None:
    load = load_scene(save(tmp_path, levelled=True))
    assert load.files.cameras == tmp_path / "transforms.json"
    assert np.allclose(load.scene.cameras.viewmats, SMOOTH.w2c, atol=1e-5)
    assert noted(load.notes, "transforms.json", "are read as levelled for the rig")


@pytest.mark.usefixtures("example")
def test_cameras_that_fit_as_they_are_are_read_so(tmp_path: Path) -> None:
    load = load_scene(save(tmp_path, levelled=False))
    assert not noted(load.notes, "are read as levelled")


def test_without_the_example_levelled_cameras_are_left_out(tmp_path: Path) -> None:
    load = load_scene(save(tmp_path, levelled=True))
    assert load.files.cameras is None
    assert noted(load.notes, "transforms.json", "left out")
