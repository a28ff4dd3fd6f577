"""Notes say which values a format cannot hold, and scores are those of the file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from messages import noted

from gsmerge.errors import Doubt
from gsmerge.io import read_gaussians, write_gaussians
from gsmerge.io.formats.table import FILES, Held, output_format
from gsmerge.io.formats.write import round_as_written
from gsmerge.results.lost_values import describe_lost_values
from gsmerge.types import NO_CAMERAS, Gaussians, Scene

HOLDING = [(row.ending, name) for row in FILES for name in row.values if row.max_degree >= 0]


@pytest.fixture(scope="module")
def wall() -> Scene:
    return scenes.make_scene([scenes.plane(3.0, scenes.waves(0))], scenes.arc(3, 48, 32), opacity=(0.9, 0.9))


def with_values(gaussians: Gaussians, name: str, values: np.ndarray) -> Gaussians:
    """Give the first Gaussians other values of an attribute."""
    column = np.array(getattr(gaussians, name))
    if name == "shN":
        column = np.zeros((len(gaussians), 3, 3), np.float32)
    column[: len(values)] = values.reshape((-1,) + (1,) * (column.ndim - 1))
    return replace(gaussians, **{name: column})


@pytest.mark.parametrize(("ending", "name"), HOLDING)
def test_files_hold_the_values_of_the_table(ending: str, name: str, wall: Scene, tmp_path: Path) -> None:
    held: Held = output_format(f"a{ending}").values[name]
    inside = np.linspace(held.low, held.high, 100)
    if name == "scales":
        inside = np.geomspace(held.low, held.high, 100)
    values = np.float32([*inside, held.low - 9, held.high * 2 + 9]) if name in ("sh0", "shN") else np.float32(inside)
    write_gaussians(tmp_path / f"a{ending}", with_values(wall.gaussians, name, values))
    read = getattr(read_gaussians(tmp_path / f"a{ending}").gaussians, name).reshape(len(wall.gaussians), -1)
    nearest = values.clip(held.low, held.high)
    errors = np.abs(read[: len(values), 0] - nearest)
    np.testing.assert_array_less(
        errors, 0.51 * held.step * (nearest if name == "scales" else 1) + 1e-5 * nearest + 1e-6
    )


def test_colours_beyond_those_of_a_format_are_noted(wall: Scene) -> None:
    faint = replace(wall.gaussians, opacities=np.full(len(wall.gaussians), 0.05, np.float32))
    bright = with_values(faint, "sh0", np.full(len(faint) // 4, 20.0))
    (note,) = describe_lost_values("a.spz", bright, wall.cameras)
    assert isinstance(note, Doubt)
    assert noted([note], ".spz cannot hold", "colours", "dB from the scene's", ".ply, .sog or .glb")


@pytest.mark.parametrize("cameras", [True, False])
def test_a_sky_that_a_format_makes_smaller_is_noted(cameras: bool, wall: Scene) -> None:
    far = wall.gaussians[::100]
    sky = replace(far, means=far.means * 300, scales=np.full((len(far), 3), 600, np.float32))
    both = Gaussians.concat([wall.gaussians[::9], sky])
    assert noted(describe_lost_values("tileset.json", both, wall.cameras if cameras else NO_CAMERAS), "sizes above 379")


def test_sizes_of_a_scene_in_a_small_unit_are_noted(wall: Scene) -> None:
    """The near plane of the pictures follows the scene, or they would be empty and alike."""
    unit = np.float32(1e-3)
    small = replace(wall.gaussians, means=unit * wall.gaussians.means, scales=unit * wall.gaussians.scales)
    viewmats = np.array(wall.cameras.viewmats)
    viewmats[:, :3, 3] *= unit
    (note,) = describe_lost_values("a.spz", small, replace(wall.cameras, viewmats=viewmats))
    assert noted([note], "sizes below 4.5e-05")


def test_what_no_picture_shows_is_not_noted(wall: Scene) -> None:
    """Flat Gaussians, values within half a step, and formats that hold everything."""
    flat = with_values(wall.gaussians, "scales", wall.gaussians.scales[:, 0])
    flat.scales[:, 2] = 1e-9
    flat.sh0[0] = 3.34
    flat.sh0[1:] = np.clip(flat.sh0[1:], -1, 1)
    assert describe_lost_values("a.spz", flat, wall.cameras) == []
    hidden = with_values(wall.gaussians, "sh0", np.full(1, 50.0))
    hidden.opacities[0] = 0
    assert describe_lost_values("a.splat", hidden, wall.cameras) == []
    beyond = with_values(wall.gaussians, "sh0", np.full(99, 50.0))
    assert all(describe_lost_values(name, beyond, wall.cameras) == [] for name in ("a.ply", "a.sog", "a.glb", "a.html"))


@pytest.mark.parametrize("name", ["a.spz", "tileset.json", "a.splat"])
def test_scores_are_measured_on_what_is_read_back(name: str, wall: Scene) -> None:
    beyond = with_values(wall.gaussians, "sh0", np.full(99, 50.0))
    held = output_format(name).values["sh0"]
    assert round_as_written(name, beyond).sh0.max() == pytest.approx(held.high, rel=1e-3)


def test_harmonics_that_a_format_leaves_out_do_not_score(wall: Scene) -> None:
    degree_4 = replace(wall.gaussians, shN=np.ones((len(wall.gaussians), 24, 3), np.float32))
    assert [round_as_written(name, degree_4).sh_degree for name in ("a.ply", "a.html", "a.splat")] == [3, 3, 0]
