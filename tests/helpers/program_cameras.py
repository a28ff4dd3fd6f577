"""Cameras of a few views as capture and survey programs write them: GlobalSplat, OpenSfM, Polycam, Metashape."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scenes
from hostile.case import HEIGHT, VIEWS, WIDTH
from tiny_scene import FLIP, save_json

from gsmerge.geometry import motion_vectors
from gsmerge.kernels.matrices import invert, matmul

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
