"""Poses that InstantSplat optimised, which it writes beside INRIA's ``cameras.json`` of the first poses."""

from __future__ import annotations

import numpy as np

from gsmerge.io.cameras.camera_file import StoredView
from gsmerge.io.cameras.camera_source import CameraSource
from gsmerge.io.cameras.npz_files import read_matrices
from gsmerge.io.image_names import natural_key
from gsmerge.kernels.matrices import invert

_SAME_POSE = 1e-4  # difference of numbers in poses that two files write


def take_optimised_poses(source: CameraSource, views: list[StoredView]) -> list[StoredView]:
    """Replace poses by those that InstantSplat optimised last, if it wrote them together with the poses of the file."""
    folders = (source.path.parent / "pose").glob("ours_*/pose_optimized.npy")
    last = max(folders, key=lambda path: natural_key(path.parent.name), default=None)
    if last is None:
        return views
    first, optimised = read_matrices(last.with_name("pose_org.npy")), read_matrices(last)
    if first is None or optimised is None or not len(first) == len(optimised) == len(views):
        return views
    try:
        first_poses, poses = invert(first)[:, :3], invert(optimised)[:, :3]
    except np.linalg.LinAlgError:
        return views
    if not np.allclose([view.pose for view in views], first_poses, rtol=_SAME_POSE, atol=_SAME_POSE):
        return views
    return [view._replace(pose=pose) for view, pose in zip(views, poses, strict=True)]
