"""The dataset file that Long-LRM reads, and the two files that say how it moved the world."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import read_text
from gsmerge.io.cameras.camera_file import W2C_OPENCV, CameraFile, make_camera_file

FRAMES_FILE, POSE_FILE, SCALE_FILE = "input_frame_idx.txt", "pos_avg_inv.txt", "scene_scale.txt"


def read_long_lrm(path: Path, data: Mapping[str, Any]) -> CameraFile:
    """Cameras of a parsed dataset file: ``frames`` of ``fx fy cx cy w h`` and ``w2c``.

    Next to it Long-LRM writes which frames it took (``input_frame_idx.txt``) and how the Gaussians' world lies in the
    cameras': X = scene_scale (pos_avg_inv X_cameras). The cameras are brought into the Gaussians' world.

    Raises:
        SceneError: If an entry is missing or no number, or a frame is named that is not there.
    """
    poses, Ks, sizes, names = [], [], [], []
    for i, frame in enumerate(data["frames"]):
        name = str(frame.get("file_path") or frame.get("image_path") or f"view {i}")
        try:
            poses.append(np.array(frame["w2c"], np.float64).reshape(4, 4))
            fx, fy, cx, cy = (float(frame[key]) for key in ("fx", "fy", "cx", "cy"))
            sizes.append((round(float(frame["w"])), round(float(frame["h"]))))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise SceneError(path, f"view {name}: expected w2c, fx, fy, cx, cy, w, h as numbers ({error})") from error
        Ks.append(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
        names.append(name)
    frame_ids = _numbers(path.with_name(FRAMES_FILE))
    ids = range(len(names)) if frame_ids is None else [round(value) for value in frame_ids.reshape(-1)]
    odd = next((i for i in ids if not 0 <= i < len(names)), None)
    if odd is not None:
        raise SceneError(path.with_name(FRAMES_FILE), f"expected frames 0 to {len(names) - 1}, found {odd:.6g}")
    with np.errstate(all="ignore"):  # what overflows is refused with the cameras
        moved = _moved(path, np.array([poses[i] for i in ids]).reshape(-1, 4, 4))
    return make_camera_file(
        path, "Long-LRM", W2C_OPENCV, moved, [Ks[i] for i in ids], [sizes[i] for i in ids], [names[i] for i in ids]
    )


def _moved(path: Path, viewmats: np.ndarray) -> np.ndarray:
    """World-to-camera matrices of the Gaussians' world: with X' = s (A X), the rotation is R inv(A), the shift s t'."""
    move, scale = _numbers(path.with_name(POSE_FILE)), _numbers(path.with_name(SCALE_FILE))
    if move is not None:
        if move.size != 16:
            raise SceneError(path.with_name(POSE_FILE), f"expected 16 numbers, found {move.size}")
        try:
            viewmats = viewmats @ np.linalg.inv(move.reshape(4, 4))
        except np.linalg.LinAlgError as error:
            raise SceneError(path.with_name(POSE_FILE), "expected a matrix that can be inverted") from error
    if scale is not None:
        if scale.size != 1 or not scale.reshape(-1)[0] > 0:
            raise SceneError(path.with_name(SCALE_FILE), "expected one positive number")
        viewmats[:, :3, 3] *= scale.reshape(-1)[0]
    return viewmats


def _numbers(path: Path) -> np.ndarray | None:
    """All numbers of a text file; None where there is no such file."""
    if not path.is_file():
        return None
    try:
        values = np.array(read_text(path).replace(",", " ").split(), np.float64)
    except ValueError as error:
        raise SceneError(path, f"expected numbers ({error})") from error
    if not np.isfinite(values).all():
        raise SceneError(path, "expected finite numbers, found NaN or inf")
    return values
