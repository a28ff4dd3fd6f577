"""Cameras of capture and survey programs are read: GlobalSplat's, OpenSfM's, Polycam's and Metashape's."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from messages import refuses
from program_cameras import (
    C2W,
    HEIGHT,
    VIEWS,
    WIDTH,
    K,
    write_globalsplat,
    write_globalsplat_divided,
    write_metashape,
    write_opensfm,
    write_polycam,
)
from tiny_scene import save_json

from gsmerge.errors import SceneError
from gsmerge.io import read_cameras
from gsmerge.io.cameras.dataparser import read_dataparser
from gsmerge.io.cameras.read import find_cameras, find_other_cameras

WRITERS = (write_globalsplat, write_globalsplat_divided, write_opensfm, write_polycam, write_metashape)


@pytest.mark.parametrize("write", WRITERS)
def test_poses_and_intrinsics_are_read(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    path = write(tmp_path)
    actual = read_cameras(path)
    np.testing.assert_allclose(actual.viewmats, np.linalg.inv(C2W), atol=1e-9)
    np.testing.assert_allclose(actual.Ks, np.stack([K] * VIEWS), atol=1e-9)
    assert set(actual.widths) == {WIDTH}
    assert [name.removesuffix(".png") for name in actual.names] == (
        ["8", "9", "10"] if write is write_polycam else ["0", "1", "2"]
    )
    assert find_cameras(tmp_path) == path
    assert not actual.lenses


def test_metashape_s_file_of_any_name(tmp_path: Path) -> None:
    path = write_metashape(tmp_path).rename(tmp_path / "Chunk 1.xml")
    (tmp_path / "other.xml").write_text("<a/>")
    assert find_cameras(tmp_path) is None
    assert find_other_cameras(tmp_path) == path


def test_lenses_are_read(tmp_path: Path) -> None:
    """Metashape's p1 and p2 are OpenCV's p2 and p1."""
    tags = "<k1>0.1</k1><k2>0.2</k2><k3>0.3</k3><p1>0.01</p1><p2>0.02</p2>"
    lens = read_cameras(write_metashape(tmp_path, tags)).lenses[0]
    assert lens is not None
    assert lens.coefficients == (0.1, 0.2, 0.02, 0.01, 0.3)
    lens = read_cameras(write_opensfm(tmp_path, k1=0.1, k2=0.2, k3=0.3, p1=0.01, p2=0.02)).lenses[0]
    assert lens is not None
    assert lens.coefficients == (0.1, 0.2, 0.01, 0.02, 0.3)
    for path in (
        write_opensfm(tmp_path, projection_type="fisheye", k1=0.1),
        write_metashape(tmp_path, "<k1>0.1</k1>", "fisheye"),
    ):
        lens = read_cameras(path).lenses[0]
        assert lens is not None
        assert (lens.model, lens.coefficients) == ("fisheye", (0.1, 0, 0, 0))


def test_a_focal_length_for_both_axes(tmp_path: Path) -> None:
    path = write_opensfm(tmp_path)
    parts = json.loads(path.read_text())
    camera = parts[1]["cameras"]["v2"]
    camera |= {"projection_type": "perspective", "focal": camera.pop("focal_x")}
    del camera["focal_y"], camera["c_x"], camera["c_y"]
    save_json(path, parts)
    middle = [[K[0, 0], 0, WIDTH / 2], [0, K[0, 0], HEIGHT / 2], [0, 0, 1]]
    np.testing.assert_allclose(read_cameras(path).Ks[0], middle, atol=1e-9)


MOVE = "<transform><rotation>0 -1 0 1 0 0 0 0 1</rotation><translation>2 4 6</translation><scale>2</scale></transform>"


@pytest.mark.parametrize("place", ["<chunk>", '<components><component id="1"/><component id="0">'])
def test_metashape_s_world_is_a_frame_of_its_largest_component(tmp_path: Path, place: str) -> None:
    """In it Metashape's other exports are, and at the scale of the cameras those of nerfstudio."""
    path = write_metashape(tmp_path)
    end = "</component></components>" if "id" in place else ""
    text = path.read_text().replace("<chunk>", f"<chunk>{place.replace('<chunk>', '')}{MOVE}{end}")
    path.write_text(text.replace("<camera id", '<camera component_id="0" id').replace('"0" id="0"', '"1" id="0"'))
    cameras, frames = read_cameras(path), read_dataparser(tmp_path / "a.ply", path)
    assert cameras.names == ("1", "2")
    np.testing.assert_allclose(cameras.viewmats, np.linalg.inv(C2W)[1:], atol=1e-9)
    assert [frame.scale for frame in frames] == [2, 1]
    np.testing.assert_allclose([frame.shift for frame in frames], [(2, 4, 6), (1, 2, 3)])
    np.testing.assert_allclose(frames[0].rotation @ (1, 0, 0), (0, 1, 0), atol=1e-9)
    assert read_dataparser(tmp_path / "a.ply", write_metashape(tmp_path)) == []


@pytest.mark.parametrize("value", ["1 0 0", "0 0 0 0 0 0 0 0 0", "nan nan nan nan nan nan nan nan nan", "a"])
def test_metashape_s_world_is_checked(tmp_path: Path, value: str) -> None:
    path = write_metashape(tmp_path)
    path.write_text(path.read_text().replace("<chunk>", f"<chunk>{MOVE}").replace("0 -1 0 1 0 0 0 0 1", value))
    with refuses(SceneError, "cameras.xml", "expected"):
        read_dataparser(tmp_path / "a.ply", path)


def replace_text(old: str, new: str) -> Callable[[Path], object]:
    def replace(path: Path) -> None:
        place = path / "8.json" if path.is_dir() else path
        place.write_text(place.read_text().replace(old, new))

    return replace


@pytest.mark.parametrize(
    ("write", "old", "new", "named"),
    [
        (write_globalsplat, "c2w", "w2c", ("cameras.json: view 0.png", "'c2w'")),
        (write_opensfm, "translation", "t", ("reconstruction.json", "translation")),
        (write_opensfm, "brown", "spherical", ("reconstruction.json: view 0.png", "SPHERICAL")),
        (write_opensfm, '"v2"', '"v3', ("reconstruction.json",)),
        (write_opensfm, '"cameras": {', '"cameras": [], "c": {', ("reconstruction.json", "'cameras'")),
        (write_polycam, "t_23", "t", ("8.json", "t_23")),
        (write_polycam, "{", "[", ("8.json",)),
        (write_metashape, "<document", "<!DOCTYPE a><document", ("cameras.xml", "DOCTYPE")),
        (write_metashape, "</document>", "", ("cameras.xml", "XML")),
        (write_metashape, "transform", "turn", ("cameras.xml", "at least one")),
        (write_metashape, "<calibration", "<c", ("cameras.xml", "mismatched")),
        (write_metashape, "<f>", "<k4>0.1</k4><f>", ("cameras.xml: view 0", "k4")),
        (write_metashape, "resolution", "r", ("cameras.xml", "sensors")),
        (write_metashape, 'sensor_id="0"', 'sensor_id="7"', ("cameras.xml", "'7'")),
        (write_metashape, "</transform>", " 1</transform>", ("cameras.xml", "17")),
        (write_metashape, 'type="frame"', 'type="spherical"', ("cameras.xml: view 0", "SPHERICAL")),
    ],
)
def test_what_is_wrong_is_named(
    tmp_path: Path, write: Callable[[Path], Path], old: str, new: str, named: tuple[str, ...]
) -> None:
    path = write(tmp_path)
    replace_text(old, new)(path)
    with refuses(SceneError, *named):
        read_cameras(path)


def test_many_elements_take_no_more_memory_than_allowed(tmp_path: Path) -> None:
    path = tmp_path / "cameras.xml"
    path.write_text("<a>" + "<b/>" * 2_000_000 + "</a>")
    with refuses(SceneError, "cameras.xml", "XML", "MB"):
        read_cameras(path)
