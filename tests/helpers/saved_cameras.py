"""These functions write cameras as ``transforms.json``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.io.cameras.camera_file import C2W_OPENGL, from_viewmats
from gsmerge.types import Cameras


def transforms_document(cameras: Cameras, names: Sequence[str]) -> dict[str, Any]:
    """Return Nerfstudio's ``transforms.json`` with all intrinsics."""
    frames = [
        {
            "file_path": name, "w": cameras.width, "h": cameras.height, "fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]),
            "cx": float(K[0, 2]), "cy": float(K[1, 2]), "transform_matrix": pose.tolist(),
        }
        for name, K, pose in zip(
            names, cameras.Ks, from_viewmats(cameras.viewmats.astype(np.float64), C2W_OPENGL), strict=True
        )
    ]  # fmt: skip
    return {"camera_model": "PINHOLE", "frames": frames}


def write_transforms(path: Path, cameras: Cameras, names: Sequence[str]) -> None:
    path.write_text(json.dumps(transforms_document(cameras, names)), encoding="utf-8")
