"""Read the cameras of Metashape's ``.xml``, within a budget of memory."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.frozen import replace
from gsmerge.io.bounds import read_budget, read_text
from gsmerge.io.cameras.camera_file import check_camera_count, make_similarity
from gsmerge.io.cameras.camera_source import CameraSource, number_errors
from gsmerge.io.cameras.view_layout import Entry
from gsmerge.method.geometry.transforms import Similarity
from gsmerge.method.kernels.matrices import matmul

_ATTRIBUTES = {"id", "type", "class", "width", "height", "sensor_id", "component_id", "master_id", "label"}


def list_metashape_cameras(source: CameraSource) -> list[Entry]:
    """List the cameras of the component with the most cameras, each with the values of its sensor.

    Of the cameras of a rig only the master has a pose. The others stand where their sensors do in the master's axes,
    and are left out if the sensor has no place there.
    """
    path = source.path
    chunk, placed = _read_component(path)
    sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
    values: dict[str | None, dict[str, Any]] = {}  # id of a sensor -> its values
    entries = []
    for camera, master in placed:
        name = camera.get("label") or ""
        sensor_id = camera.get("sensor_id")
        if sensor_id not in sensors:
            raise SceneError(path, f"view {name}: expected the id of one of the sensors, found {sensor_id!r}")
        sensor = sensors[sensor_id]
        if camera is not master and sensor.find("rotation") is None and sensor.find("location") is None:
            continue
        if sensor_id not in values:
            expected = "expected a 'calibration' with a 'resolution' and the number 'f'"
            with number_errors(path, f"sensor {sensor_id}: {expected}"):
                values[sensor_id] = _sensor_values(sensor)
        with number_errors(path, f"view {name}: expected 16 numbers in 'transform'"):
            pose = np.array(master.findtext("transform", "").split(), np.float64).reshape(4, 4)
        if camera is not master:
            pose = matmul(pose, _read_motion(path, sensor, "location"))
        entries.append(Entry({"transform": pose}, values[sensor_id], name))
    return entries


def list_metashape_frames(path: Path) -> list[Similarity]:
    """List the maps from the axes of a chunk's cameras to the world, of the chunk and of the component.

    nerfstudio applies the component's map without its scale, so each is listed without it, too.
    """
    chunk, placed = _read_component(path)
    component_id = placed[0][1].get("component_id") if placed else None
    components = [one for one in chunk.iter("component") if one.get("id") == component_id][:1]
    frames = list[Similarity]()
    for element in (chunk, *components):
        transform = element.find("transform")
        if transform is None:
            continue
        motion = _read_motion(path, transform, "translation")
        with number_errors(path, f"{element.tag}: expected the number 'scale'"), np.errstate(all="ignore"):
            scale = float(transform.findtext("scale", "1"))
            motion[:3, 3] /= scale
        name = f"moved by the transform of the {element.tag} in {path.name}"
        for factor, words in ((scale, name), (1.0, f"{name} without its scale")):
            frames.append(replace(make_similarity(path, motion, factor), description=words))
    return frames


def _read_component(path: Path) -> tuple[Element, list[tuple[Element, Element]]]:
    """Read the component with the most placed cameras of all chunks: its chunk, and each camera with its master.

    The master of a camera that has a pose is the camera itself.
    """
    root = _read_xml(path, _ATTRIBUTES)
    components: dict[tuple[int, str | None], tuple[Element, list[tuple[Element, Element]]]] = {}
    for i, chunk in enumerate(root.findall("chunk") or [root]):
        cameras = {camera.get("id"): camera for camera in chunk.iter("camera")}
        for camera in chunk.iter("camera"):
            has_pose = camera.find("transform") is not None
            master = camera if has_pose else cameras.get(camera.get("master_id"))
            if master is not None and master.find("transform") is not None:
                component = components.setdefault((i, master.get("component_id")), (chunk, []))
                component[1].append((camera, master))
    largest = max(components.values(), key=lambda component: len(component[1]), default=(root, []))
    check_camera_count(path, len(largest[1]))
    return largest


def _read_motion(path: Path, element: Element, shift: str) -> np.ndarray:
    """Read a motion ``[4,4]`` of a ``rotation``, row by row, and a ``shift``; one that is missing changes nothing."""
    motion = np.eye(4)
    with number_errors(path, f"{element.tag}: expected 9 numbers in 'rotation' and 3 in {shift!r}"):
        motion[:3, :3] = np.array(element.findtext("rotation", "1 0 0 0 1 0 0 0 1").split(), np.float64).reshape(3, 3)
        motion[:3, 3] = np.array(element.findtext(shift, "0 0 0").split(), np.float64).reshape(3)
    return motion


def _sensor_values(sensor: Element) -> dict[str, Any]:
    """Return a sensor's size, intrinsics and lens by key, such as "fx"; an adjusted calibration is preferred."""
    calibrations = sensor.findall("calibration")
    if not calibrations:
        raise ValueError("no calibration")
    calibration = max(calibrations, key=lambda entry: entry.get("class") == "adjusted")  # else the first
    sizes = [*calibration.findall("resolution"), *sensor.findall("resolution")]
    if not sizes:
        raise ValueError("no resolution")
    size = sizes[0].attrib
    numbers = {child.tag: float(child.text or "") for child in calibration if child.tag != "resolution"}
    values: dict[str, Any] = {key: numbers[key] for key in ("cx", "cy", "k1", "k2", "k3", "k4") if key in numbers}
    # Metashape's p1 is OpenCV's p2, and its p2 is OpenCV's p1
    values |= {opencv: numbers[key] for key, opencv in (("p1", "p2"), ("p2", "p1")) if key in numbers}
    fx = numbers["f"] + numbers.get("b1", 0)
    fy = numbers["f"]
    values |= {"width": float(size["width"]), "height": float(size["height"]), "fx": fx, "fy": fy}
    return values | {"type": sensor.get("type", "frame")}


def _read_xml(path: Path, attributes: Collection[str]) -> Element:
    """Read an XML file. Its elements keep only ``attributes``, and names keep the prefixes of their namespaces.

    The parser of Python's library may take far more memory than the file has bytes. The parser copies the address of a
    namespace into the name of each tag, and needs thirty times the bytes of a tag with a million attributes.

    Raise SceneError if the file is no XML or too large. Also raise SceneError if the file has a document type, since
    entities in a document type could make a short text endless.
    """
    text, builder, parser = read_text(path), TreeBuilder(), expat.ParserCreate()
    budget = read_budget(path)
    # most bytes of memory for each "<" and "=" of a file
    element_bytes = 200
    attribute_bytes = 330
    budget.check_memory(element_bytes * text.count("<") + attribute_bytes * text.count("="), "XML")

    def start(tag: str, stored: Mapping[str, str]) -> None:
        builder.start(tag, {name: stored[name] for name in attributes if name in stored})

    def refuse(*_: object) -> None:
        raise SceneError(path, "expected XML without a document type, found <!DOCTYPE", "remove that line")

    parser.StartElementHandler, parser.EndElementHandler = start, builder.end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = refuse
    parser.buffer_text = True
    try:
        parser.Parse(text, True)
        return builder.close()
    except (expat.ExpatError, AssertionError, LookupError, ValueError) as error:
        raise SceneError(path, f"expected XML, found other text ({error})") from error
