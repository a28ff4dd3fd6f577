"""``dataparser_transforms.json``: how nerfstudio moved the cameras before it trained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.alignment.similarity import Similarity
from gsmerge.io.bounds import read_json
from gsmerge.io.cameras.camera_file import MAX_NUMBER
from gsmerge.io.scene_files import SceneFiles

NAME = "dataparser_transforms.json"
_TOLERANCE = 0.02  # of a rotation's columns, as for poses


def find_dataparser(files: SceneFiles) -> Path | None:
    """The file next to the ``.ply``, or next to the cameras."""
    folders = [files.ply.parent] + ([] if files.cameras is None else [files.cameras.parent])
    return next((folder / NAME for folder in folders if (folder / NAME).is_file()), None)


def read_dataparser(path: Path, cameras: Path | None) -> list[Similarity]:
    """Similarities that the file may mean: X' = scale (transform [X; 1]).

    ``transform`` starts from the capture's own world. The poses of a ``transforms.json`` with ``applied_transform``
    (and ``applied_scale``) are already moved by that, so it is undone; which of the two holds has to be measured.
    SceneError if there is no rotation, shift and positive scale in it.
    """
    data = read_json(path)
    try:
        moved = _square(data["transform"])
        scale = float(data["scale"])
    except (KeyError, TypeError, ValueError) as error:
        raise SceneError(path, f"expected 'transform' of 3x4 numbers and 'scale' ({error})") from error
    frames = [_similarity(path, moved, scale)]
    camera_data = read_json(cameras) if cameras is not None and cameras.suffix == ".json" and cameras.is_file() else {}
    if isinstance(camera_data, dict) and "applied_transform" in camera_data:
        try:
            applied, factor = _square(camera_data["applied_transform"]), float(camera_data.get("applied_scale") or 1)
            frames.append(_similarity(path, moved @ np.linalg.inv(applied), scale / factor))
        except (TypeError, ValueError, np.linalg.LinAlgError) as error:
            raise SceneError(cameras or path, f"expected 'applied_transform' of 3x4 numbers ({error})") from error
    return frames


def _square(values: Any) -> np.ndarray:
    matrix = np.asarray(values, np.float64)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.all(np.abs(matrix) < MAX_NUMBER):
        raise ValueError(f"found shape {list(matrix.shape)}, or numbers that are not finite")
    return np.concatenate([matrix[:3], [[0.0, 0, 0, 1]]])


def _similarity(path: Path, matrix: np.ndarray, scale: float) -> Similarity:
    R = matrix[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > _TOLERANCE or np.linalg.det(R) < 0 or not 0 < scale < MAX_NUMBER:
        raise SceneError(path, "expected 'transform' to rotate and shift and 'scale' to be positive, found another map")
    return Similarity(R, scale, scale * matrix[:3, 3], "moved as nerfstudio does", "other")
