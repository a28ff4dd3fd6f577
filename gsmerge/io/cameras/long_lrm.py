"""Move Long-LRM's cameras into the world of its Gaussians, by the files that it writes beside these."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry.transforms import mean_pose_frame
from gsmerge.io.bounds import MAX_VIEWS, read_text
from gsmerge.io.cameras.camera_file import StoredView
from gsmerge.io.cameras.camera_source import CameraSource, number_errors
from gsmerge.kernels.matrices import invert, matmul

# Which frames the model took, and how it moved the world
FRAMES_FILE, POSE_FILE, SCALE_FILE = "input_frame_idx.txt", "pos_avg_inv.txt", "scene_scale.txt"


def is_long_lrm(source: CameraSource) -> bool:
    """Return whether a JSON file has ``frames`` with ``w2c``, which only Long-LRM writes."""
    frames = source.object.get("frames")
    return bool(frames) and isinstance(frames, list) and all(isinstance(f, dict) and "w2c" in f for f in frames)


def move_to_gaussians(source: CameraSource, views: list[StoredView]) -> list[StoredView]:
    """Select the frames that the model took, and move them into the Gaussians' world.

    ``input_frame_idx.txt`` lists the frames. ``scene_scale.txt`` and ``pos_avg_inv.txt`` have the map X' = scene_scale
    (pos_avg_inv X) from the cameras' world to the Gaussians' world. The files are beside the Gaussians, or were copied
    beside the cameras. Some versions write only the list of frames; the map is then computed from the frames.
    SceneError if a file has wrong numbers, or a frame does not exist.
    """
    folder = source.path.parent
    if source.folder is not None and not (folder / FRAMES_FILE).is_file() and (source.folder / FRAMES_FILE).is_file():
        folder = source.folder
    ids = _frame_ids(folder / FRAMES_FILE, len(views))
    selected = views if ids is None else [views[i] for i in ids]
    poses = np.array([view.pose for view in selected]).reshape(-1, 4, 4)
    to_mean_pose, scale = _numbers(folder / POSE_FILE), _numbers(folder / SCALE_FILE)
    if ids is not None and selected and to_mean_pose is None and scale is None:
        with np.errstate(all="ignore"):  # the check of the cameras refuses overflows
            poses = mean_pose_frame(poses).move_viewmats(poses)
    if scale is not None and (scale.size != 1 or not scale[0] > 0):
        raise SceneError(folder / SCALE_FILE, "expected one positive number")
    if to_mean_pose is not None and to_mean_pose.size != 16:
        raise SceneError(folder / POSE_FILE, f"expected 16 numbers, found {to_mean_pose.size}")
    try:
        with np.errstate(all="ignore"):  # the check of the cameras refuses overflows
            if to_mean_pose is not None:
                poses = matmul(poses, invert(to_mean_pose.reshape(4, 4)))
            poses[:, :3, 3] *= 1.0 if scale is None else scale[0]
    except np.linalg.LinAlgError as error:
        raise SceneError(folder / POSE_FILE, "expected a matrix that can be inverted") from error
    return [view._replace(pose=pose) for view, pose in zip(selected, poses, strict=True)]


def _frame_ids(path: Path, count: int) -> Sequence[int] | None:
    """Read which of ``count`` frames the model took; None without the file."""
    numbers = _numbers(path)
    if numbers is None:
        return None
    ids = [round(number) for number in numbers]
    outside = next((i for i in ids if not 0 <= i < count), None)
    if outside is not None:
        raise SceneError(path, f"expected frames 0 to {count - 1}, found {outside:.6g}")
    return ids


def _numbers(path: Path) -> np.ndarray | None:
    """Read all numbers of a text file; None where there is no file."""
    if not path.is_file():
        return None
    words = read_text(path).replace(",", " ").split(maxsplit=MAX_VIEWS)
    if len(words) > MAX_VIEWS:
        raise SceneError(path, f"expected at most {MAX_VIEWS} numbers, found more")
    with number_errors(path, "expected numbers"):
        values = np.array(words, np.float64)
    if not np.isfinite(values).all():
        raise SceneError(path, "expected finite numbers, found NaN or inf")
    return values
