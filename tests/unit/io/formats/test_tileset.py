"""A tileset for Cesium holds the Gaussians of a ``.spz``, and states where they lie."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from messages import noted, refuses

from gsmerge import Gaussians, read_gaussians, write_gaussians
from gsmerge.errors import SceneError
from gsmerge.io.formats.spz import spz_bytes
from gsmerge.io.formats.tileset import globe_matrix, most_bytes
from gsmerge.jobs.convert import ConvertOptions, convert_files
from gsmerge.results.outputs import Outputs, frame_notes, name_outputs
from gsmerge.settings.files import FileOptions
from gsmerge.types import NO_CAMERAS

POLAR_RADIUS = 6356752.314245  # metres, of WGS 84


@pytest.fixture(scope="module")
def room() -> Gaussians:
    """Make a room with one of its Gaussians far away."""
    gaussians = scenes.make_scene(scenes.room(), scenes.arc(3, 48, 36)).gaussians
    means = gaussians.means.copy()
    means[7] = 900, 0, 0
    return replace(gaussians, means=means)


def convert(gaussians: Gaussians, folder: Path, place: str | None = None) -> Path:
    """Write a tileset into a folder."""
    write_gaussians(folder / "a.ply", gaussians)
    out = folder / "web" / "tileset.json"
    convert_files(ConvertOptions([folder / "a.ply"], Outputs(out, options=FileOptions(place=place))))
    return out


def test_the_tile_holds_the_bytes_of_a_spz(room: Gaussians, tmp_path: Path) -> None:
    out = convert(room, tmp_path)
    assert spz_bytes(read_gaussians(tmp_path / "a.ply").gaussians) in out.with_name("tileset.glb").read_bytes()
    write_gaussians(tmp_path / "a.spz", read_gaussians(tmp_path / "a.ply").gaussians)
    expected = read_gaussians(tmp_path / "a.spz").gaussians
    for path in (out, out.with_name("tileset.glb")):
        for name, column in vars(read_gaussians(path).gaussians).items():
            np.testing.assert_array_equal(column, getattr(expected, name))


def test_a_far_gaussian_does_not_enlarge_the_bounds_of_a_tileset(room: Gaussians, tmp_path: Path) -> None:
    box = json.loads(convert(room, tmp_path).read_text())["root"]["boundingVolume"]["box"]
    centre, halves = np.array(box[:3]), np.reshape(box[3:], (3, 3))
    assert np.array_equal(halves, np.diag(np.diag(halves)))
    offsets = np.abs(room.means * (-1, 1, -1) @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]] - centre)  # glTF's axes, then z up
    inside = (offsets <= np.diag(halves)).all(1)
    assert 0.94 <= inside.mean() < 1
    assert not inside[7]
    assert halves.max() < 20


def test_a_place_on_the_globe_is_the_transform_of_a_tileset(room: Gaussians, tmp_path: Path) -> None:
    stored = json.loads(convert(room, tmp_path, "10,50,100").read_text())["root"]["transform"]
    matrix = np.reshape(stored, (4, 4)).T @ np.diag([-1, -1, 1, 1])  # half a turn, so that photos look north
    np.testing.assert_array_equal(matrix, globe_matrix("10,50,100"))
    unplaced = json.loads(convert(room, tmp_path / "b").read_text())["root"]["transform"]
    np.testing.assert_array_equal(unplaced, np.diag([-1, -1, 1, 1]).reshape(-1))
    again = convert_files(
        ConvertOptions([tmp_path / "web" / "tileset.json"], name_outputs(tmp_path / "copy" / "tileset.json"))
    )
    assert noted(again["notes"], "place", "kept")


@pytest.mark.parametrize("place", ["8.5,47.4", "200,47,0", "8,97,0", "8,47,inf", "a,b,c", ""])
def test_impossible_places_on_the_globe_are_refused(place: str) -> None:
    with refuses(ValueError, "place", "LON", repr(place)):
        FileOptions(place=place)


def test_a_scene_that_viewers_see_on_its_side_is_noted(room: Gaussians, tmp_path: Path) -> None:
    cameras = scenes.arc(2)
    turned = replace(cameras, viewmats=cameras.viewmats[:, [1, 0, 2, 3]])
    assert frame_notes(Outputs(tmp_path / "a.glb"), cameras) == []
    (note,) = frame_notes(Outputs(tmp_path / "a.glb"), turned)
    assert "--up -y" in note
    assert len(frame_notes(Outputs(tmp_path / "tileset.json"), turned)) == 2
    assert frame_notes(Outputs(tmp_path / "a.ply"), turned) == []


def test_the_size_of_a_tileset_is_at_most_what_a_budget_counts(room: Gaussians, tmp_path: Path) -> None:
    out = convert(room, tmp_path, "-179.123456,-89.123456,1234567.891")
    assert out.stat().st_size + out.with_name("tileset.glb").stat().st_size <= most_bytes(room, NO_CAMERAS, ())


@pytest.mark.parametrize(
    ("place", "position", "north"),
    [
        ("0,0,5", (6378142, 0, 0), (0, 0, 1)),
        ("90,0,0", (0, 6378137, 0), (0, 0, 1)),
        ("0,90,0", (0, 0, POLAR_RADIUS), (-1, 0, 0)),
        ("0,45,0", (4517590.8788, 0, 4487348.4088), (-(0.5**0.5), 0, 0.5**0.5)),  # as geodetic tables give it
    ],
)
def test_frames_on_the_globe_are_those_of_geodetic_tables(
    place: str, position: tuple[float, ...], north: tuple[float, ...]
) -> None:
    matrix = globe_matrix(place)
    np.testing.assert_allclose(matrix[:3, 3], position, atol=1e-3)
    np.testing.assert_allclose(matrix[:3, 1], north, atol=1e-12)
    np.testing.assert_allclose(np.cross(matrix[:3, 0], matrix[:3, 1]), matrix[:3, 2], atol=1e-12)


@pytest.mark.parametrize(
    "document",
    [
        [], {"root": {}}, {"root": {"content": {"uri": "a.b3dm"}}}, {"root": {"content": {"uri": "../a.glb"}}},
        {"root": {"content": {"uri": "a.glb"}, "children": [{}]}},
        {"root": {"content": {"uri": "a.glb"}, "transform": {}}},
        {"root": {"content": {"uri": "a.glb"}, "transform": 5}},
    ],
)  # fmt: skip
def test_other_tilesets_are_refused(tmp_path: Path, document: object) -> None:
    (tmp_path / "tileset.json").write_text(json.dumps(document))
    with refuses(SceneError, "tileset.json", "one", "tile"):
        read_gaussians(tmp_path / "tileset.json")


def test_tiles_with_transforms_of_their_own_are_counted(tmp_path: Path) -> None:
    tiles = [{"content": {"uri": f"{i}.glb"}, "transform": [1.0] * 16} for i in range(3)]
    (tmp_path / "tileset.json").write_text(json.dumps({"root": {"children": tiles}}))
    with refuses(SceneError, "tileset.json", "3", "transform", ".ply"):
        read_gaussians(tmp_path / "tileset.json")


def test_a_tile_that_states_bytes_it_lacks_is_refused(room: Gaussians, tmp_path: Path) -> None:
    tile = convert(room, tmp_path).with_name("tileset.glb")
    content = tile.read_bytes()
    length = str(len(spz_bytes(read_gaussians(tmp_path / "a.ply").gaussians))).encode()
    for wrong in (b"9" * len(length), b"-" + length[1:]):
        tile.write_bytes(content.replace(b'"byteLength":' + length, b'"byteLength":' + wrong, 1))
        with refuses(SceneError, "tileset.glb", "truncated"):
            read_gaussians(tile)
