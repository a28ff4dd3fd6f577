"""Scripts make captures and exports of a made scene; a function stands in for the depth network."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scripts import load_script
from shared import make_once, write_scene

import gsmerge
from gsmerge.reading.read_scene import load_scene

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module", autouse=True)
def _small_captures() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        patch.setattr(script("make_capture"), "SIDE", 128)
        yield


def script(name: str) -> ModuleType:
    return load_script(ROOT / "benchmarks" / f"{name}.py")


def make(place: Path) -> None:
    """Write a scene, and the capture that is made of it."""
    made = write_scene(place / "made", num_views=5, width=144, height=96)
    script("make_capture").make_capture(made, place / "scenes" / "eval" / "made", flat, 3)


@pytest.fixture(scope="module")
def capture() -> Path:
    return make_once("capture", make) / "scenes" / "eval" / "made"


def flat(views: list[Any], near: float, far: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a wall in the middle of the range."""
    shape = views[0].image.shape[:2]
    return np.full(shape, (near * far) ** 0.5), np.full(shape, 0.75)


def test_input_views_are_spread_with_held_out_views_midway() -> None:
    inputs, held_out = script("make_capture").pick_views(50, 12)
    assert inputs == [0, 4, 9, 13, 18, 22, 27, 31, 36, 40, 45, 49]  # of the capture fox
    assert held_out == [2, 6, 11, 15, 20, 24, 29, 33, 38, 42, 47]


def test_too_few_photos_for_the_views_are_refused() -> None:
    with pytest.raises(SystemExit, match="expected at least 7 photos for 4 views, found 6"):
        script("make_capture").pick_views(6, 4)


@pytest.mark.slow
def test_capture_is_exported_with_its_depths_and_context_views(capture: Path, tmp_path: Path) -> None:
    document = json.loads((capture / "transforms.json").read_text())
    roles = [frame["role"] for frame in document["frames"]]
    assert roles == ["context", "target", "context", "target", "context"]
    assert {(frame["w"], frame["h"]) for frame in document["frames"]} == {(128, 64)}

    views = script("captures").read_context(capture)
    assert [view["name"] for view in views] == ["00000.jpg", "00002.jpg", "00004.jpg"]
    own = gsmerge.read_scene(make_once("capture", make) / "made")
    frames = [frame for frame in document["frames"] if frame["role"] == "context"]
    for view, frame in zip(views, frames, strict=True):
        w2c = np.linalg.inv(view["c2w"])
        depths = own.gaussians.means @ w2c[2, :3] + w2c[2, 3]
        low, high = np.percentile(depths, (10, 60))
        assert frame["depth_near"] < low < high < frame["depth_far"]
        assert view["depth"] == pytest.approx((frame["depth_near"] * frame["depth_far"]) ** 0.5, rel=1e-3)
        assert view["conf"] == pytest.approx(0.75, abs=0.005)

    loaded = load_scene(script("captures").write_export(capture, tmp_path / "plain"))
    assert loaded.alignment.ok
    assert loaded.scene.num_gaussians == 3 * 128 * 64


@pytest.mark.parametrize("style", ["da3", "depthsplat", "anysplat"])
def test_export_in_every_style_is_read_as_a_scene(style: str, capture: Path, tmp_path: Path) -> None:
    loaded = load_scene(script("captures").write_export(capture, tmp_path / style, style))
    assert len(loaded.scene.cameras) == 3
    assert loaded.scene.has_own_pixels == (style != "anysplat")
