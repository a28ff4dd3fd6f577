"""Cameras of a few views as capture and survey programs write them: GlobalSplat, OpenSfM, Polycam, Metashape."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import scenes
from tiny_scene import FLIP, save_json

from gsmerge.geometry import motion_vectors
from gsmerge.kernels.matrices import invert, matmul

VIEWS, WIDTH, HEIGHT = 3, 24, 16
C2W = invert(scenes.arc(VIEWS, WIDTH, HEIGHT).viewmats.astype(np.float64))
MOTIONS = motion_vectors(np.tile(np.eye(4), (VIEWS, 1, 1)), invert(C2W))
K = np.array([[40.0, 0, WIDTH / 2 + 1], [0, 42, HEIGHT / 2 - 2], [0, 0, 1]])
SIDE = max(WIDTH, HEIGHT)
SIZE = {"width": WIDTH, "height": HEIGHT}


def write_globalsplat(folder: Path, scale: tuple[float, float] = (1, 1)) -> Path:
    intrinsic = (K / [[scale[0]], [scale[1]], [1]]).tolist()
    views = [{"image": f"{i}.png", "intrinsic": intrinsic, "c2w": pose.tolist()} for i, pose in enumerate(C2W)]
    return save_json(folder / "cameras.json", {"image_shape": [HEIGHT, WIDTH], "views": views})


def write_globalsplat_divided(folder: Path) -> Path:
    return write_globalsplat(folder, (WIDTH, HEIGHT))


def write_opensfm(folder: Path, **lens: object) -> Path:
    camera = {
        "projection_type": "brown", **SIZE, "focal_x": K[0, 0] / SIDE, "focal_y": K[1, 1] / SIDE,
        "c_x": (K[0, 2] - WIDTH / 2) / SIDE, "c_y": (K[1, 2] - HEIGHT / 2) / SIDE, **lens,
    }  # fmt: skip
    shots = {
        f"{i}.png": {"rotation": motion[:3].tolist(), "translation": pose[:3, 3].tolist(), "camera": "v2"}
        for i, (pose, motion) in enumerate(zip(invert(C2W), MOTIONS, strict=True))
    }
    parts = [{"cameras": {}, "shots": {}}, {"cameras": {"v2": camera}, "shots": shots}]
    return save_json(folder / "reconstruction.json", parts)


def write_polycam(folder: Path) -> Path:
    place = folder / "keyframes" / "corrected_cameras"
    place.mkdir(parents=True)
    for i, pose in enumerate(matmul(C2W, FLIP)):
        values = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        values |= {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], **SIZE}
        save_json(place / f"{8 + i}.json", values)
    return place


def write_metashape(folder: Path, lens: str = "", kind: str = "frame") -> Path:
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    poses = [" ".join(map(repr, pose.ravel().tolist())) for pose in C2W]
    cameras = [
        f'<camera id="{i}" sensor_id="0" label="{i}"><transform>{pose}</transform></camera>'
        for i, pose in enumerate(poses)
    ]
    path = folder / "cameras.xml"
    path.write_text(
        f'<?xml version="1.0" encoding="UTF-8"?><document><chunk><sensors><sensor id="0" type="{kind}">{size}'
        f'<calibration class="adjusted">{size}<f>42</f><b1>-2</b1><cx>1</cx><cy>-2</cy>{lens}</calibration>'
        f'<calibration class="initial">{size}<f>1</f></calibration></sensor></sensors>'
        f'<cameras>{"".join(cameras)}<camera id="99" sensor_id="1" label="not placed"/></cameras></chunk></document>'
    )
    return path


def world_mirror(c2w: np.ndarray, K: np.ndarray) -> dict[str, Any]:
    """The document of WorldMirror's ``camera_params.json``."""
    poses = [{"camera_id": name, "matrix": pose.tolist()} for name, pose in zip(view_names(c2w), c2w, strict=True)]
    return {"extrinsics": poses, "intrinsics": [{**pose, "matrix": K.tolist()} for pose in poses]}


def long_lrm(c2w: np.ndarray, K: np.ndarray, size: tuple[int, int] = (WIDTH, HEIGHT)) -> dict[str, Any]:
    """The document of Long-LRM's cameras."""
    common = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": size[0], "h": size[1]}
    poses = zip(view_names(c2w), invert(c2w), strict=True)
    return {"frames": [{"file_path": name, "w2c": pose.tolist(), **common} for name, pose in poses]}


def view_names(c2w: np.ndarray) -> list[str]:
    return [f"view_{view:03d}" for view in range(len(c2w))]
