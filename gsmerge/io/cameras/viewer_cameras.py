"""Write cameras beside a result, for viewers: as INRIA's ``cameras.json``."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsmerge.io.cameras.camera_file import CENTRED_PX
from gsmerge.types import Cameras

ENDING = ".cameras.json"
_MAX_NAME = 255  # bytes of a file's name


def viewer_cameras_path(output: Path) -> Path:
    """Return the path of the camera file for viewers: ``out.ply`` -> ``out.cameras.json``."""
    name = output.name
    stem = name[: -len(".compressed.ply")] if name.lower().endswith(".compressed.ply") else output.stem
    stem = os.fsencode(stem)[: _MAX_NAME - len(ENDING)].decode("utf-8", "ignore")
    return output.with_name(stem + ENDING)


def viewer_cameras(cameras: Cameras, names: Sequence[str]) -> str:
    """Return the text of cameras as INRIA's ``cameras.json``, for SuperSplat and other viewers.

    :func:`gsmerge.read_cameras` reads it. Viewers assume that the principal point is in the middle; one that is not is
    written as ``cx`` and ``cy``, which viewers ignore.
    """

    def principal_point(K: np.ndarray) -> dict[str, float]:
        centred = np.allclose(2 * K[:2, 2], (cameras.width, cameras.height), rtol=0, atol=CENTRED_PX)
        return {} if centred else {"cx": float(K[0, 2]), "cy": float(K[1, 2])}

    rotations, centres = cameras.viewmats[:, :3, :3].transpose(0, 2, 1), cameras.centres
    entries = [
        {
            "id": i, "img_name": name, "width": cameras.width, "height": cameras.height,
            "position": centres[i].tolist(), "rotation": rotations[i].tolist(),
            "fy": float(cameras.Ks[i, 1, 1]), "fx": float(cameras.Ks[i, 0, 0]), **principal_point(cameras.Ks[i]),
        }
        for i, name in enumerate(names)
    ]  # fmt: skip
    return json.dumps(entries) + "\n"
