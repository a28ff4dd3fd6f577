"""Rows of a file become Gaussians of a scene in the order of their pixels."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from messages import noted
from plyfile import PlyData, PlyElement

from gsmerge import Gaussians, Scene
from gsmerge.io import write_ply
from gsmerge.io.formats.read_gaussians import GaussianFile, read_ply
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.reading.alignment import AlignmentResult
from gsmerge.reading.read_scene import load_scene
from gsmerge.reading.take_gaussians import take_gaussians


@pytest.fixture(scope="module")
def room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 24, 18))


def file_of(gaussians: Gaussians, folder: Path) -> GaussianFile:
    write_ply(folder / "a.ply", gaussians)
    return read_ply(folder / "a.ply")


def result_of(room: Scene, ids: np.ndarray | None) -> AlignmentResult:
    return AlignmentResult(ids, room.cameras, room.images, None)


def test_rows_come_in_the_order_of_their_pixels(room: Scene, tmp_path: Path) -> None:
    order = np.random.default_rng(0).permutation(len(room.gaussians))[:1000]
    gaussians, pixels = take_gaussians(file_of(room.gaussians[order], tmp_path), result_of(room, order))
    assert pixels.own
    assert np.array_equal(pixels.homes, np.sort(order))
    assert np.array_equal(gaussians.sh0, room.gaussians.sh0[pixels.homes])
    assert np.array_equal(pixels.fronts.reshape(-1)[pixels.homes], np.arange(1000))


def test_rows_that_are_in_the_order_of_their_pixels_are_not_copied(room: Scene, tmp_path: Path) -> None:
    file = file_of(room.gaussians[::2], tmp_path)
    gaussians, pixels = take_gaussians(file, result_of(room, np.arange(0, len(room.gaussians), 2)))
    assert gaussians is file.gaussians
    assert np.array_equal(pixels.homes, np.arange(0, len(room.gaussians), 2))


@pytest.mark.parametrize("wrong", [0, 3, 1294], ids=["first", "at the end of a block", "last"])
def test_two_exchanged_rows_are_put_in_order(
    wrong: int, room: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsmerge.reading.take_gaussians._BLOCK", 4)  # numbers that are compared at once
    order = np.arange(len(room.gaussians))
    order[[wrong, wrong + 1]] = order[[wrong + 1, wrong]]
    gaussians, pixels = take_gaussians(file_of(room.gaussians[order], tmp_path), result_of(room, order))
    assert pixels.shown.all()
    assert np.array_equal(gaussians.sh0, room.gaussians.sh0)


def test_nearest_of_several_rows_of_a_pixel_is_in_front(room: Scene, tmp_path: Path) -> None:
    """And all stay; a row that no view sees has no pixel."""
    g = room.gaussians[:100]
    near = replace(g, means=room.cameras.centres[0] + 0.5 * (g.means - room.cameras.centres[0]))
    ids = np.concatenate([np.arange(100), np.arange(100), [-1]])
    both = Gaussians.concat([g, near, g[:1]])
    gaussians, pixels = take_gaussians(file_of(both, tmp_path), replace(result_of(room, ids), recovery=None))
    assert len(gaussians) == 201
    assert (pixels.homes < 0).sum() == 1
    front = gaussians[pixels.fronts.reshape(-1)[:100]]
    np.testing.assert_allclose(front.means, near.means, rtol=1e-6)


def test_rows_too_faint_to_be_drawn_are_left_out(room: Scene, tmp_path: Path) -> None:
    opacities = room.gaussians.opacities.copy()
    opacities[::7] = 1 / 300
    faint = replace(room.gaussians, opacities=opacities)
    file = file_of(faint, tmp_path)
    gaussians, pixels = take_gaussians(file, result_of(room, np.arange(len(opacities))))
    assert np.array_equal(np.flatnonzero(~pixels.shown.reshape(-1)), np.arange(0, len(opacities), 7))
    assert len(gaussians) == pixels.shown.sum()
    assert len(take_gaussians(file, result_of(room, None))[0]) == len(gaussians)
    (tmp_path / "faint").mkdir()
    nothing = file_of(replace(room.gaussians, opacities=np.full_like(opacities, 1 / 300)), tmp_path / "faint")
    assert len(take_gaussians(nothing, result_of(room, None))[0]) == len(opacities)  # or there would be no scene


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_view_without_rows_keeps_its_photo(small_scene: Path, tmp_path: Path, value: float) -> None:
    folder = Path(shutil.copytree(small_scene, tmp_path / "scene"))
    rows = PlyData.read(str(folder / "scene.ply"), mmap=False)["vertex"].data
    one = len(rows) // 5
    for name in rows.dtype.names or ():
        rows[name][3 * one : 4 * one] = value
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(folder / "scene.ply"))
    loaded = load_scene(folder)
    assert len(loaded.scene.gaussians) == 4 * one
    assert loaded.scene.photo_views == list(range(5))
    assert loaded.scene.pixels.shown.any((1, 2)).tolist() == [True, True, True, False, True]
    assert noted(loaded.notes, f"{one:,}")
    assert prepare(loaded.scene).reference.score_views == tuple(range(5))
