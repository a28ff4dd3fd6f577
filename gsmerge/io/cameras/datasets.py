"""Read the cameras of EasyVolcap and EasyMocap, and of Isaac Sim."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import read_json, read_text
from gsmerge.io.cameras.camera_file import StoredView, check_camera_count, make_lens
from gsmerge.io.cameras.camera_source import CameraSource, StoredCameras, number_errors
from gsmerge.io.cameras.foreign import ISAAC_FILES
from gsmerge.io.cameras.view_layout import Entry, rotation_of_vector
from gsmerge.io.image_names import list_images, natural_order

INTRI, EXTRI = "intri.yml", "extri.yml"
UNKNOWN = np.zeros(1)  # a side in pixels that a file does not have
# An entry of a file of OpenCV's FileStorage: a matrix, or a number
_YAML_MATRIX = re.compile(
    r"^(\w[\w.-]*):\s*!!opencv-matrix\s+rows:\s*(\d{1,4})\s+cols:\s*(\d{1,4})\s+dt:\s*\w+\s+"
    r"data:\s*\[([^\]]{0,4096})\]",
    re.MULTILINE,
)
_YAML_NUMBER = re.compile(r"^(\w[\w.-]*):[ \t]*([-+]?[\d.]+(?:[eE][-+]?\d+)?)[ \t]*\r?$", re.MULTILINE)


def is_easyvolcap(source: CameraSource) -> bool:
    """Return whether a file is one of the two in which EasyVolcap writes cameras, and the other lies beside it."""
    return source.path.name in (INTRI, EXTRI) and all((source.path.parent / name).is_file() for name in (INTRI, EXTRI))


def read_easyvolcap(source: CameraSource) -> StoredCameras:
    """Read the cameras of EasyVolcap or EasyMocap from their intrinsics and their poses.

    A camera NAME has ``K_NAME``, perhaps its size ``W_NAME`` and ``H_NAME`` and a lens ``D_NAME``, and a
    world-to-camera pose of ``Rot_NAME``, or its vector ``R_NAME``, and ``T_NAME``. Its photos lie in ``images/NAME``,
    of which the first counts. Raise SceneError if a camera lacks a pose.
    """
    folder = source.path.parent
    intri = _read_yaml(folder / INTRI)
    extri = _read_yaml(folder / EXTRI)
    names = [key.removeprefix("K_") for key in intri if key.startswith("K_")]
    check_camera_count(folder / INTRI, len(names))
    views = list[StoredView]()
    for name in names:
        if f"T_{name}" not in extri or not {f"Rot_{name}", f"R_{name}"} & extri.keys():
            problem = (
                f"camera {name}: expected Rot_{name} or R_{name}, and T_{name}, as {INTRI} has K_{name}, found none"
            )
            raise SceneError(folder / EXTRI, problem, f"add them, or take K_{name} out of {INTRI}")
        with number_errors(folder / EXTRI, f"camera {name}: expected Rot_{name} or R_{name}, and T_{name}"):
            stored = extri.get(f"Rot_{name}")
            rotation = rotation_of_vector(extri[f"R_{name}"]) if stored is None else stored.reshape(3, 3)
            pose = np.concatenate([rotation, extri[f"T_{name}"].reshape(3, 1)], 1)
        with number_errors(folder / INTRI, f"camera {name}: expected K_{name} of 3 x 3 numbers, and whole sizes"):
            K = intri[f"K_{name}"].reshape(3, 3)
            lens = intri.get(f"D_{name}", intri.get(f"dist_{name}", np.zeros(0))).reshape(-1)[:5].tolist()
            width, height = (round(float(intri.get(f"{side}_{name}", UNKNOWN)[0])) for side in "WH")
        photos = folder / "images" / name
        first = list_images(photos)[:1] if photos.is_dir() else []
        views.append(
            StoredView(
                f"{name}/{first[0].stem}" if first else name,
                pose,
                K,
                (width, height) if min(width, height) > 0 else (0, 0),
                make_lens("OPENCV", "perspective", lens),
            )
        )
    return StoredCameras(views)


def _read_yaml(path: Path) -> Mapping[str, np.ndarray]:
    """Read the matrices ``[r,c]`` and numbers ``[1]`` of a file that OpenCV's FileStorage wrote."""
    text = read_text(path)
    values = dict[str, np.ndarray]()
    for key, rows, columns, numbers in _YAML_MATRIX.findall(text):
        with number_errors(path, f"{key}: expected {rows} x {columns} numbers"):
            values[key] = np.array(numbers.replace(",", " ").split(), np.float64).reshape(int(rows), int(columns))
    with number_errors(path, "expected numbers"):
        values |= {key: np.array([float(number)]) for key, number in _YAML_NUMBER.findall(text)}
    return values


def list_isaac_cameras(source: CameraSource) -> list[Entry]:
    """List the views in a folder of Isaac Sim's BasicWriter, each with a file.

    Matrices are those of USD: a row vector times ``cameraViewTransform``, row by row, is a point in the camera's frame
    of OpenGL's axes, and times ``cameraProjection`` it is a place in the picture from -1 to 1, x to the right and y up.
    """
    paths = natural_order(source.path.glob(ISAAC_FILES))
    check_camera_count(source.path, len(paths))
    entries = list[Entry]()
    for path in paths:
        number = path.stem.rpartition("_")[2]
        keys = "cameraViewTransform, cameraProjection and renderProductResolution"
        with number_errors(path, f"view {number}: expected {keys}"):
            values: Mapping[str, Any] = read_json(path)
            pose = np.array(values["cameraViewTransform"], np.float64).reshape(4, 4).T
            projection = np.array(values["cameraProjection"], np.float64).reshape(4, 4)
            width, height = (float(side) for side in values["renderProductResolution"])
        model = values.get("cameraModel", "pinhole")
        if model not in ("pinhole", "opencvPinhole"):
            raise SceneError(path, f"view {number}: expected a pinhole camera, found {model!r}")
        view = {
            "transform": pose.tolist(),
            "fx": projection[0, 0] * width / 2,
            "fy": projection[1, 1] * height / 2,
            "cx": (1 - projection[2, 0]) * width / 2,
            "cy": (1 + projection[2, 1]) * height / 2,
            "width": width,
            "height": height,
        }
        entries.append(Entry(view, name=f"rgb_{number}", path=path))
    return entries
