"""Read the optimised poses of InstantSplat, which are in files beside a ``cameras.json`` with the initial poses."""

from __future__ import annotations

import numpy as np

from gsmerge.io.cameras.camera_file import StoredView
from gsmerge.io.cameras.camera_source import CameraSource
from gsmerge.io.cameras.npz_files import read_matrices
from gsmerge.io.image_names import natural_key
from gsmerge.kernels.matrices import invert


def take_optimised_poses(source: CameraSource, views: list[StoredView]) -> list[StoredView]:
    """Replace the poses of views by the optimised poses of InstantSplat's last iteration.

    Views stay unchanged if InstantSplat wrote no optimised poses, or if the optimisation started from other poses than
    those of the file.
    """
    paths = (source.path.parent / "pose").glob("ours_*/pose_optimized.npy")
    last_path = max(paths, key=lambda path: natural_key(path.parent.name), default=None)
    if last_path is None:
        return views
    original, optimised = read_matrices(last_path.with_name("pose_org.npy")), read_matrices(last_path)
    if original is None or optimised is None or not len(original) == len(optimised) == len(views):
        return views
    try:
        first_poses, poses = invert(original)[:, :3], invert(optimised)[:, :3]
    except np.linalg.LinAlgError:
        return views
    same_pose = 1e-4  # largest difference of numbers in two files with the same poses, absolute and relative
    if not np.allclose([view.pose for view in views], first_poses, rtol=same_pose, atol=same_pose):
        return views
    return [view._replace(pose=pose) for view, pose in zip(views, poses, strict=True)]
