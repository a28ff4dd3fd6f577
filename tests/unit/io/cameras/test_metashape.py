"""Cameras of Metashape: the slaves of a rig, the largest of several chunks, and the maps to the world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from messages import refuses
from program_cameras import C2W, FORMATS
from tiny_scene import rotation

from gsmerge.errors import SceneError
from gsmerge.io.cameras.metashape import list_metashape_frames
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


def test_the_maps_of_chunk_and_component_are_listed(tmp_path: Path) -> None:
    """nerfstudio applies that of the component without its scale."""
    move = f"<rotation>{words(TURN)}</rotation><translation>2 4 6</translation><scale locked='0'>2</scale>"
    region = "<region><center>9 9 9</center><R>1 0 0 0 1 0 0 0 1</R></region>"
    components = f'<components><component id="0">{region}<transform><scale>3</scale></transform></component>'
    components += f'<component id="1">{region}<transform>{move}</transform></component></components>'
    path = save(tmp_path, ("<chunk>", f"<chunk>{region}<transform><rotation>{words(TURN)}</rotation></transform>"))
    path.write_text(
        path.read_text().replace("<cameras>", f"{components}<cameras>").replace(" label=", ' component_id="1" label=')
    )
    chunk, _, component, unscaled = list_metashape_frames(path)
    assert (chunk.scale, component.scale, unscaled.scale) == (1, 2, 1)
    assert all(np.allclose(frame.rotation, TURN) for frame in (chunk, component, unscaled))
    assert component.shift.tolist() == [2, 4, 6]
    assert unscaled.shift.tolist() == [1, 2, 3]
    assert "component in cameras.xml" in component.description


@pytest.mark.parametrize(
    ("move", "found"),
    [
        ("<rotation>1 2</rotation>", "transform"),
        ("<translation>1 2 x</translation>", "transform"),
        ("<translation>1 2 3</translation><scale>0</scale>", "another map"),
        ("<rotation>1 0 0 0 1 0 0 0 9</rotation>", "another map"),
    ],
)
def test_a_damaged_map_is_refused(tmp_path: Path, move: str, found: str) -> None:
    path = save(tmp_path, ("<chunk>", f"<chunk><transform>{move}</transform>"))
    with refuses(SceneError, "cameras.xml", found):
        list_metashape_frames(path)
