"""``dataparser_transforms.json``: how nerfstudio moved the cameras before it trained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from gsmerge.errors import SceneError
from gsmerge.io.alignment.poses import with_poses
from gsmerge.io.alignment.similarity import Frame
from gsmerge.io.alignment.unaligned import Sight, sight
from gsmerge.io.bounds import read_json
from gsmerge.io.scene_files import SceneFiles
from gsmerge.types import Cameras, Gaussians

NAME = "dataparser_transforms.json"
_TOLERANCE = 0.02  # of a rotation's columns, as for poses


def find_dataparser(files: SceneFiles) -> Path | None:
    """The file beside the ``.ply``, or beside the cameras."""
    folders = [files.ply.parent] + ([] if files.cameras is None else [files.cameras.parent])
    return next((folder / NAME for folder in folders if (folder / NAME).is_file()), None)


def read_dataparser(path: Path, cameras: Path | None) -> list[Frame]:
    """Frames that the file may mean: X' = scale (transform [X; 1]).

    ``transform`` starts from the capture's own world. The poses of a ``transforms.json`` with ``applied_transform``
    (and ``applied_scale``) are already moved by that, so it is taken back; which of the two holds has to be measured.

    Args:
        path: The file.
        cameras: The camera file, of which ``applied_transform`` is read where it has one.

    Raises:
        SceneError: If there is no rotation, shift and positive scale in it.
    """
    data = read_json(path)
    try:
        moved = _square(data["transform"])
        scale = float(data["scale"])
    except (KeyError, TypeError, ValueError) as error:
        raise SceneError(path, f"expected 'transform' of 3x4 numbers and 'scale' ({error})") from error
    frames = [_frame(path, moved, scale)]
    beside = read_json(cameras) if cameras is not None and cameras.suffix == ".json" and cameras.is_file() else {}
    if isinstance(beside, dict) and "applied_transform" in beside:
        try:
            applied, factor = _square(beside["applied_transform"]), float(beside.get("applied_scale") or 1)
            frames.append(_frame(path, moved @ np.linalg.inv(applied), scale / factor))
        except (TypeError, ValueError, np.linalg.LinAlgError) as error:
            raise SceneError(cameras or path, f"expected 'applied_transform' of 3x4 numbers ({error})") from error
    return frames


def seen_in_dataparser(
    files: SceneFiles, gaussians: Gaussians, valid: Tensor, cameras: Cameras, images: Tensor | None
) -> tuple[Cameras, Sight, str] | None:
    """The cameras moved into nerfstudio's frame, if they see the Gaussians better there than where they stand.

    Args:
        files: Where to look for the file.
        gaussians: n rows.
        valid: ``[n]`` bool.
        cameras: As their file has them.
        images: ``[c,h,w,3]``, or None.

    Returns:
        The cameras, what they see, and a note; None where there is no such file, or it does not help.
    """
    path = find_dataparser(files)
    if path is None:
        return None
    viewmats = cameras.viewmats.double().numpy()
    moved = [with_poses(cameras, frame.move_cameras(viewmats)) for frame in read_dataparser(path, files.cameras)]
    found = [(there, sight(gaussians, valid, there, images)) for there in moved]
    best, seen = max(found, key=lambda one: one[1].score)
    if not seen.ok or seen.score <= sight(gaussians, valid, cameras, images).score:
        return None
    return best, seen, f"the cameras are moved into the Gaussians' frame by {NAME}"


def _square(values: Any) -> np.ndarray:
    matrix = np.asarray(values, np.float64)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.isfinite(matrix).all():
        raise ValueError(f"found shape {list(matrix.shape)}")
    return np.concatenate([matrix[:3], [[0.0, 0, 0, 1]]])


def _frame(path: Path, matrix: np.ndarray, scale: float) -> Frame:
    turn = matrix[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > _TOLERANCE or np.linalg.det(turn) < 0 or not 0 < scale < np.inf:
        raise SceneError(path, "expected 'transform' to turn and shift and 'scale' to be positive, found another map")
    return Frame(turn, scale, scale * matrix[:3, 3], "moved as nerfstudio does", "other")
