"""Cameras as capture and survey programs write them: OpenSfM and WebODM, Polycam, Metashape.

Each reader makes the frames of a ``transforms.json`` from its file, which are then read as those.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from gsmerge.geometry import Similarity, motion_matrices
from gsmerge.io.bounds import read_json
from gsmerge.io.cameras.camera_file import check_count, make_similarity
from gsmerge.io.cameras.camera_format import CameraSource, StoredCameras, number_errors
from gsmerge.io.cameras.transforms import transforms_views
from gsmerge.io.image_names import natural_key
from gsmerge.io.xml_files import read_xml

_MODELS = {  # of OpenSfM, by names of lenses that mean the same
    "perspective": "OPENCV", "brown": "OPENCV", "simple_radial": "OPENCV", "radial": "OPENCV",
    "fisheye": "OPENCV_FISHEYE", "fisheye_opencv": "OPENCV_FISHEYE",
}  # fmt: skip
_SENSORS = {"frame": "OPENCV", "fisheye": "OPENCV_FISHEYE"}  # of Metashape
_MATRIX = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]  # keys of Polycam
_ATTRIBUTES = {"id", "type", "class", "width", "height", "sensor_id", "component_id", "label"}  # of Metashape


def read_opensfm(source: CameraSource) -> StoredCameras:
    """Read the cameras of the reconstruction with the most images; SceneError if a value is missing or no number."""
    path = source.path
    with number_errors(path, "expected reconstructions of 'cameras' and 'shots'"):
        largest = max(source.json, key=lambda entry: len(entry["shots"]))
        shots = dict(largest["shots"])
        check_count(path, len(shots))
        cameras = {name: _opensfm_camera(camera) for name, camera in largest["cameras"].items()}
        motions = np.array([[*shot["rotation"], *shot["translation"]] for shot in shots.values()], np.float64)
        poses = motion_matrices(motions.reshape(-1, 6))
        frames = [
            {"file_path": name, "transform_matrix": pose, **cameras[shot["camera"]]}
            for (name, shot), pose in zip(shots.items(), poses, strict=True)
        ]
    return StoredCameras(transforms_views(path, frames))


def _opensfm_camera(camera: Mapping[str, Any]) -> dict[str, Any]:
    """Return the intrinsics of a camera, which are divided by the larger side and count from the middle."""
    width, height = float(camera["width"]), float(camera["height"])
    side = max(width, height)
    fx = side * float(camera["focal_x"] if "focal_x" in camera else camera["focal"])
    fy = side * float(camera["focal_y"]) if "focal_y" in camera else fx
    cx, cy = width / 2 + side * float(camera.get("c_x", 0)), height / 2 + side * float(camera.get("c_y", 0))
    lens = {key: camera.get(key) for key in ("k1", "k2", "k3", "k4", "p1", "p2")}
    model = _MODELS.get(camera["projection_type"], camera["projection_type"])
    return {"w": width, "h": height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "camera_model": model, **lens}


def read_polycam(source: CameraSource) -> StoredCameras:
    """Read the cameras of a folder, a file each; SceneError if a value is missing or no number."""
    frames, paths = [], sorted(source.path.glob("*.json"), key=lambda path: natural_key(path.name))
    check_count(source.path, len(paths))
    for path in paths:
        values = read_json(path)
        with number_errors(path, "expected t_00 to t_23, fx, fy, cx, cy, width, height as numbers"):
            frame = {"fl_x": values["fx"], "fl_y": values["fy"], "w": values["width"], "h": values["height"]}
            pose = [[values[key] for key in row] for row in _MATRIX]
            frames.append(
                {"file_path": path.stem, "transform_matrix": pose, "cx": values["cx"], "cy": values["cy"]} | frame
            )
    return StoredCameras(transforms_views(source.path, frames))


def read_metashape(source: CameraSource) -> StoredCameras:
    """Read the cameras of Metashape's largest component; SceneError if a value is missing or no number."""
    path = source.path
    root, cameras = _metashape_cameras(path)
    with number_errors(path, "expected sensors with 'calibration', and cameras with 'transform'"):
        sensors = {sensor.get("id"): sensor for sensor in root.iter("sensor")}
        intrinsics = {
            name: _metashape_sensor(sensors[name]) for name in {camera.get("sensor_id") for camera in cameras}
        }
        frames = [
            {
                "file_path": camera.get("label"),
                "transform_matrix": np.array(camera.findtext("transform", "").split(), np.float64).reshape(4, 4),
                **intrinsics[camera.get("sensor_id")],
            }
            for camera in cameras
        ]
    return StoredCameras(transforms_views(path, frames))


def read_metashape_world(path: Path) -> Similarity | None:
    """Read how Metashape places the cameras in its world, in which it may have exported them otherwise; None if not."""
    root, cameras = _metashape_cameras(path)
    component = cameras[0].get("component_id") if cameras else None
    own = [each for each in root.iter("component") if each.get("id") == component]
    move = next((found for each in (*own, *root.iter("chunk")) if (found := each.find("transform")) is not None), None)
    if move is None:
        return None
    text = "expected rotation, translation and scale of 'transform' as numbers"
    with number_errors(path, text), np.errstate(all="ignore"):
        R, shift, scale = (
            np.array(move.findtext(tag, default).split(), np.float64)
            for tag, default in (("rotation", "1 0 0 0 1 0 0 0 1"), ("translation", "0 0 0"), ("scale", "1"))
        )
        return make_similarity(path, np.column_stack([R.reshape(3, 3), shift.reshape(3) / scale]), scale.item())


def _metashape_cameras(path: Path) -> tuple[ElementTree.Element, list[ElementTree.Element]]:
    """Parse a file, and list the cameras with a pose, of the component that has most of them."""
    root = read_xml(path, _ATTRIBUTES)
    cameras = [camera for camera in root.iter("camera") if camera.find("transform") is not None]
    check_count(path, len(cameras))
    largest = dict(Counter(camera.get("component_id") for camera in cameras).most_common(1))
    return root, [camera for camera in cameras if camera.get("component_id") in largest]


def _metashape_sensor(sensor: ElementTree.Element) -> dict[str, Any]:
    """Return the intrinsics of a sensor, whose principal point counts from the middle."""
    calibration = max(sensor.findall("calibration"), key=lambda entry: entry.get("class") == "adjusted")
    size = [*calibration.findall("resolution"), *sensor.findall("resolution")][0].attrib
    width, height = float(size["width"]), float(size["height"])
    numbers = {child.tag: float(child.text or "") for child in calibration if child.tag != "resolution"}
    focal = {"fl_x": numbers["f"] + numbers.get("b1", 0), "fl_y": numbers["f"]}
    centre = {"cx": numbers.get("cx", 0) + width / 2, "cy": numbers.get("cy", 0) + height / 2}
    # p1 and p2 are the other way round than OpenCV's
    lens = {
        "p1": numbers.get("p2"),
        "p2": numbers.get("p1"),
        **{key: numbers.get(key) for key in ("k1", "k2", "k3", "k4")},
    }
    model = _SENSORS.get(sensor.get("type", "frame"), sensor.get("type"))
    return {"w": width, "h": height, "camera_model": model, **focal, **centre, **lens}
