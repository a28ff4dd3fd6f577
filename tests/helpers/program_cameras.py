"""Camera files of each format with a declared layout have three views of the same poses and intrinsics."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scenes
from tiny_scene import FLIP

from gsmerge.method.geometry.transforms import motion_vectors
from gsmerge.method.kernels.matrices import invert, matmul

VIEWS, WIDTH, HEIGHT = 3, 24, 16
W2C = scenes.arc(VIEWS, WIDTH, HEIGHT).viewmats.astype(np.float64)
C2W = invert(W2C)
C2W_OPENGL = matmul(C2W, FLIP)
FX, FY, CX, CY = 40.0, 42.0, WIDTH / 2 + 1, HEIGHT / 2 - 2
K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
K_DIVIDED = K / [[WIDTH], [HEIGHT], [1]]  # by the size
NAMES = ("0.png", "1.png", "2.png")
POINT = {"fx": FX, "fy": FY, "cx": CX, "cy": CY}
SIZE = {"width": WIDTH, "height": HEIGHT}
NERFSTUDIO = {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT}


class CameraText(NamedTuple):
    """The files of a format.

    Args:
        place: What is read.
        files: Text by path.
        names: Of the views.
        size: (width, height) of the views.
    """

    place: str
    files: dict[str, str]
    names: tuple[str, ...] = NAMES
    size: tuple[int, int] = (WIDTH, HEIGHT)

    def write(self, folder: Path, old: str = "", new: str = "") -> Path:
        """Write the files into a folder, with a text replaced in the first; return what is read."""
        for i, (name, text) in enumerate(self.files.items()):
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            assert old in text
            path.write_text(text.replace(old, new) if old and i == 0 else text)
        return folder / self.place


def in_json(place: str, data: Any, **expected: Any) -> CameraText:
    """Make a format of one JSON file."""
    return CameraText(place, {place: json.dumps(data)}, **expected)


def each(of: Callable[[str, np.ndarray], Any], poses: np.ndarray = C2W) -> list[Any]:
    """List what a function returns for the name and pose of each view."""
    return [of(name, pose) for name, pose in zip(NAMES, poses, strict=True)]


def opensfm() -> list[dict[str, Any]]:
    side = max(WIDTH, HEIGHT)
    camera = {"projection_type": "brown", **SIZE, "focal_x": FX / side, "focal_y": FY / side,
              "c_x": (CX - WIDTH / 2) / side, "c_y": (CY - HEIGHT / 2) / side}  # fmt: skip
    motions = motion_vectors(np.tile(np.eye(4), (VIEWS, 1, 1)), W2C)
    shots = {
        name: {"rotation": motion[:3].tolist(), "translation": motion[3:].tolist(), "camera": "v2"}
        for name, motion in zip(NAMES, motions, strict=True)
    }
    return [{"cameras": {}, "shots": {}}, {"cameras": {"v2": camera}, "shots": shots}]


def polycam(pose: np.ndarray) -> str:
    entries = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
    return json.dumps({**entries, **POINT, **SIZE})


def isaac(pose: np.ndarray) -> str:
    """Write matrices by which row vectors are multiplied, as USD has them."""
    projection = np.zeros((4, 4))
    projection[0, 0] = 2 * FX / WIDTH
    projection[1, 1] = 2 * FY / HEIGHT
    projection[2, :2] = 1 - 2 * CX / WIDTH, 2 * CY / HEIGHT - 1
    projection[2, 3], projection[3, 2] = -1, 0.01
    return json.dumps(
        {
            "cameraModel": "pinhole",
            "cameraProjection": projection.reshape(-1).tolist(),
            "cameraViewTransform": pose.T.reshape(-1).tolist(),
            "renderProductResolution": [WIDTH, HEIGHT],
        }
    )


def metashape() -> str:
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    cameras = [
        f'<camera id="{i}" sensor_id="0" label="{name}"><transform>{" ".join(map(repr, pose))}</transform></camera>'
        for i, (name, pose) in enumerate(zip(NAMES, C2W.reshape(VIEWS, 16).tolist(), strict=True))
    ]
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><document><chunk><sensors><sensor id="0" type="frame">{size}'
        f'<calibration class="adjusted">{size}<f>42</f><b1>-2</b1><cx>1</cx><cy>-2</cy></calibration>'
        f'<calibration class="initial">{size}<f>1</f></calibration></sensor></sensors>'
        f'<cameras>{"".join(cameras)}<camera id="99" sensor_id="1" label="not placed"/></cameras></chunk></document>'
    )


FORMATS = {
    "transforms.json": in_json(
        "transforms.json",
        {
            **NERFSTUDIO,
            "frames": each(lambda name, pose: {"file_path": name, "transform_matrix": pose.tolist()}, C2W_OPENGL),
        },
    ),
    "frame list": in_json(
        "transforms.json",
        each(lambda name, pose: {"image_path": name, "transform_matrix": pose.tolist(), **NERFSTUDIO}),
    ),
    "Long-LRM": in_json(
        "scene.json",
        {
            "frames": each(
                lambda name, pose: {"file_path": name, "w2c": pose.tolist(), **POINT, "w": WIDTH, "h": HEIGHT}, W2C
            )
        },
    ),
    "INRIA cameras.json": in_json(
        "cameras.json",
        each(
            lambda name, pose: {
                "img_name": name,
                "rotation": pose[:3, :3].tolist(),
                "position": pose[:3, 3].tolist(),
                **POINT,
                **SIZE,
            }
        ),
    ),
    "GlobalSplat cameras.json": in_json(
        "cameras.json",
        {
            "image_shape": [HEIGHT, WIDTH],
            "views": each(lambda name, pose: {"image": name, "intrinsic": K.tolist(), "c2w": pose.tolist()}),
        },
    ),
    "ffgs cameras.json": in_json(
        "cameras.json",
        {
            "frame": "model",
            "image_shape": [HEIGHT, WIDTH],
            "views": each(lambda name, pose: {"file": name, "c2w": pose.tolist(), "k_normalized": K_DIVIDED.tolist()}),
        },
    ),
    "camera_params.json": in_json(
        "camera_params.json",
        {
            "extrinsics": each(lambda name, pose: {"camera_id": name, "matrix": pose.tolist()}),
            "intrinsics": each(lambda name, _: {"camera_id": name, "matrix": K.tolist()}),
        },
        size=(2 * int(CX), 2 * int(CY)),  # of which the principal point is the middle
    ),
    "OpenSfM": in_json("reconstruction.json", opensfm()),
    "Polycam": CameraText(
        "keyframes/corrected_cameras",
        {f"keyframes/corrected_cameras/{8 + i}.json": polycam(pose) for i, pose in enumerate(C2W_OPENGL)},
        names=("8", "9", "10"),
    ),
    "Isaac Sim": CameraText(
        "camera_params",
        {f"camera_params/camera_params_{8 + i:04d}.json": isaac(matmul(FLIP, pose)) for i, pose in enumerate(W2C)},
        names=("rgb_0008", "rgb_0009", "rgb_0010"),
    ),
    "Metashape": CameraText("cameras.xml", {"cameras.xml": metashape()}),
}
