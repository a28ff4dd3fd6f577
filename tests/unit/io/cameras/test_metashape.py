"""Cameras of Metashape: the slaves of a rig, and the largest of several chunks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from program_cameras import C2W, FORMATS
from tiny_scene import rotation

from gsmerge.io.cameras.read_cameras import read_cameras
from gsmerge.method.kernels.matrices import invert

TURN = rotation(0.2, -0.4, 0.1)
PLACE = np.array([0.5, -0.25, 2.0])


def words(numbers: np.ndarray) -> str:
    return " ".join(map(repr, numbers.reshape(-1).tolist()))


def save(folder: Path, *changes: tuple[str, str]) -> Path:
    path = FORMATS["Metashape"].write(folder)
    text = path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text)
    return path


@pytest.mark.parametrize("is_first", [False, True], ids=["behind its master", "before its master"])
@pytest.mark.parametrize("has_place", [True, False], ids=["location", "rotation alone"])
def test_slaves_of_a_rig_stand_where_their_sensor_does_in_the_axes_of_the_master(
    tmp_path: Path, is_first: bool, has_place: bool
) -> None:
    location = f"<location locked='1'>{words(PLACE)}</location><location_covariance>1</location_covariance>"
    parts = f"<rotation>{words(TURN)}</rotation><rotation_covariance>1 2</rotation_covariance>"
    text = FORMATS["Metashape"].files["cameras.xml"]
    sensor = text[text.index("<sensor ") : text.index("</sensors>")].replace('id="0"', 'id="1" master_id="0"')
    sensor = sensor.replace("</sensor>", parts + location * has_place + "</sensor>")
    slave = '<camera id="7" sensor_id="1" master_id="1" label="slave"/>'
    beside = ("<cameras>", f"<cameras>{slave}") if is_first else ("</cameras>", f"{slave}</cameras>")
    cameras = read_cameras(save(tmp_path, ("</sensors>", f"{sensor}</sensors>"), beside))
    view = cameras.names.index("slave")
    assert len(cameras) == 4
    assert view == (0 if is_first else 3)
    pose = invert(cameras.viewmats)[view]
    assert np.allclose(pose[:3, :3], C2W[1, :3, :3] @ TURN)
    assert np.allclose(pose[:3, 3], C2W[1, :3, 3] + has_place * C2W[1, :3, :3] @ PLACE)


def test_slaves_without_a_place_in_the_rig_have_no_camera(tmp_path: Path) -> None:
    slave = '<camera id="7" sensor_id="0" master_id="1" label="slave"/>'
    assert len(read_cameras(save(tmp_path, ("</cameras>", f"{slave}</cameras>")))) == 3


def test_the_chunk_with_the_most_cameras_is_read(tmp_path: Path) -> None:
    """Chunks number their sensors and cameras alike."""
    text = FORMATS["Metashape"].files["cameras.xml"]
    other = text[text.index("<chunk>") : text.index("</chunk>")].replace("<f>42", "<f>77")
    other = other.replace("<transform>", "<t>", 1).replace("</transform>", "</t>", 1)
    path = save(tmp_path, ("<chunk>", f"{other}</chunk><chunk>"))
    assert read_cameras(path).names == ("0.png", "1.png", "2.png")
    assert (read_cameras(path).Ks[:, 1, 1] == 42).all()
