"""Move Long-LRM's cameras into the world of its Gaussians, by the list of frames that Long-LRM writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry.transforms import mean_pose_frame
from gsmerge.io.bounds import MAX_VIEWS, read_text
from gsmerge.io.cameras.camera_file import StoredView
from gsmerge.io.cameras.camera_source import CameraSource, number_errors

FRAMES_FILE = "input_frame_idx.txt"  # lists the frames that the model saw


def is_long_lrm(source: CameraSource) -> bool:
    """Return whether a JSON file has ``frames`` with ``w2c``, which only Long-LRM writes."""
    frames = source.object.get("frames")
    return bool(frames) and isinstance(frames, list) and all(isinstance(f, dict) and "w2c" in f for f in frames)


def move_to_gaussians(source: CameraSource, views: list[StoredView]) -> list[StoredView]:
    """Select the views that the model saw, and move them into the Gaussians' world: the frame of the views' mean pose.

    ``input_frame_idx.txt``, in the folder of the Gaussians or in that of the cameras, lists the views that the model
    saw. Without this file, all views are returned unchanged. Raise SceneError if the file has wrong numbers, or lists a
    frame that does not exist.
    """
    folder = source.path.parent
    if source.folder is not None and not (folder / FRAMES_FILE).is_file():
        folder = source.folder
    selected = [views[i] for i in _frame_ids(folder / FRAMES_FILE, len(views))]
    if not selected:
        return views
    poses = np.array([view.pose for view in selected]).reshape(-1, 4, 4)
    with np.errstate(all="ignore"):  # the check of the cameras refuses overflows
        poses = mean_pose_frame(poses).move_viewmats(poses)
    return [view._replace(pose=pose) for view, pose in zip(selected, poses, strict=True)]


def _frame_ids(path: Path, count: int) -> list[int]:
    """Read the numbers, below ``count``, of the frames that the model saw; no numbers if the file is missing."""
    words = read_text(path).replace(",", " ").split(maxsplit=MAX_VIEWS) if path.is_file() else []
    if len(words) > MAX_VIEWS:
        raise SceneError(path, f"expected at most {MAX_VIEWS} numbers, found more")
    with number_errors(path, "expected numbers"):
        ids = [round(float(word)) for word in words]
    outside = next((i for i in ids if not 0 <= i < count), None)
    if outside is not None:
        raise SceneError(path, f"expected frames 0 to {count - 1}, found {outside:.6g}")
    return ids
