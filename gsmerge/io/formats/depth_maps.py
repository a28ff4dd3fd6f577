"""Depth maps with poses and images, which models without Gaussians leave, read as one Gaussian for each pixel.

``results.npz`` of Depth Anything 3, ``predictions.npz`` of VGGT and ``views.npz`` with depths have all views;
``results_output/frame_N.npz`` of DA3-Streaming one each, in one world (:mod:`gsmerge.io.cameras.pose_lines`). Depth is
along z. Nothing but position and colour is known of a pixel: its Gaussian is a ball of ``SIGMA`` pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import rgb_to_sh0
from gsmerge.io.bounds import read_budget
from gsmerge.io.cameras.camera_file import C2W_OPENCV, W2C_OPENCV, to_viewmats
from gsmerge.io.cameras.camera_format import CameraSource
from gsmerge.io.cameras.npz_files import (
    array_names,
    holds_poses,
    read_da3,
    read_depths,
    read_dump,
    read_frame,
)
from gsmerge.io.cameras.pose_lines import FRAMES, POSES, list_frames, pose_of_frame
from gsmerge.io.formats.arrays import Columns, Packed, StoredRows, check_count, to_stored
from gsmerge.io.photo_files import PhotoReader, Photos, keep_photos
from gsmerge.kernels.elementary import log
from gsmerge.kernels.matrices import invert, matmul

SUFFIX = ".npz"
PLACES = (  # in a folder, besides the frames
    "exports/npz/results.npz", "exports/mini_npz/results.npz", "results.npz", "predictions.npz", "views.npz",
)  # fmt: skip
SIGMA, OPACITY = 0.6, 0.7  # of a Gaussian: pixels, 0 to 1
_GREY = 128
_ROW_BYTES = 40  # of a pixel while it is unpacked: its ray and position
_KEPT_BYTES = 128 << 20  # of images; more are read at each use


def find_depth_maps(folder: Path) -> list[Path]:
    """Find a folder's depth maps: one file of all views, or one for each in their order; none without any.

    SceneError if a frame is missing.
    """
    whole = next((folder / place for place in PLACES if holds_depth_maps(folder / place)), None)
    return list_frames(folder) if whole is None else [whole]


def is_frame(path: Path) -> bool:
    """Return whether a file has one of DA3-Streaming's frames."""
    return path.suffix == SUFFIX and path.parent.name == FRAMES and (path.parent.parent / POSES).is_file()


def holds_depth_maps(path: Path) -> bool:
    """Return whether an ``.npz`` has depth maps with cameras; False if it cannot be read."""
    return not array_names(path).isdisjoint(("depth", "depths")) and (holds_poses(path) or is_frame(path))


def read_rows(path: Path) -> StoredRows:
    """Read the depth maps of a file as Gaussians, view by view and row by row of pixels.

    A depth that is not positive and finite gives a row that is not finite; without images, as of Depth Anything 3's
    ``mini_npz``, Gaussians are grey. SceneError if the file is damaged, lacks an array, or images and depth maps differ
    in size.
    """
    images: np.ndarray | None
    if is_frame(path):
        frame = read_frame(path)
        depths, images, Ks = frame.depth[None], frame.image[None], frame.K[None]
        viewmats = to_viewmats(_squared([pose_of_frame(path)]), C2W_OPENCV)
    else:
        depths, images, Ks, viewmats = _read_views(path)
    if images is not None and images.shape[:3] != depths.shape:
        problem = f"expected images of the depth maps' size {list(depths.shape)}, found {list(images.shape[:3])}"
        raise SceneError(path, problem)
    check_count(read_budget(path), depths.size, 0, _ROW_BYTES)
    pictures = np.full((*depths.shape, 3), _GREY, np.uint8) if images is None else images
    parts = [_pack(*view) for view in zip(depths, pictures, Ks, viewmats, strict=True)]
    sizes = {"means": depths.nbytes, "sh0": 0 if images is None else images.nbytes}
    return replace(to_stored(parts, "depth maps", sizes), format=str(depths.dtype))


def read_images(frames: Sequence[Path]) -> Photos:
    """Read the images of DA3-Streaming's frames; many are read at each use."""
    width, height = read_frame(frames[0]).size

    def read(view: int) -> np.ndarray:
        frame = read_frame(frames[view])
        if frame.size != (width, height):
            problem = f"expected a depth map of {width} x {height} pixels as in {frames[0].name}"
            raise SceneError(frames[view], f"{problem}, found {frame.size[0]} x {frame.size[1]}")
        return frame.image

    photos = PhotoReader(len(frames), (width, height), read)
    return keep_photos(photos) if 3 * width * height * len(frames) <= _KEPT_BYTES else photos


def _read_views(path: Path) -> tuple[np.ndarray, np.ndarray | None, np.ndarray, np.ndarray]:
    """Read depth maps ``[v,h,w]``, images ``[v,h,w,3]`` or None, intrinsics and world-to-camera matrices of a file."""
    dumped = "c2w" in array_names(path)
    stored, depths = (read_dump if dumped else read_da3)(CameraSource(path)), read_depths(path)
    if depths is None or len(depths) != len(stored.views) or any(view.K is None for view in stored.views):
        problem = f"expected depth maps [{len(stored.views)},h,w], one for each pose, with intrinsics, found others"
        raise SceneError(path, problem, "write all of them, or name a .ply of Gaussians")
    convention = stored.convention or (C2W_OPENCV if dumped else W2C_OPENCV)
    Ks = np.array([view.K for view in stored.views], np.float64)
    viewmats = to_viewmats(_squared([view.pose for view in stored.views]), convention)
    return depths, None if stored.images is None else np.asarray(stored.images), Ks, viewmats


def _squared(poses: Sequence[np.ndarray]) -> np.ndarray:
    """Return poses ``[3,4]`` or ``[4,4]`` as ``[c,4,4]``."""
    return np.stack([np.concatenate([pose[:3], [[0, 0, 0, 1]]]) for pose in poses]).astype(np.float64)


def _pack(depth: np.ndarray, image: np.ndarray, K: np.ndarray, viewmat: np.ndarray) -> Packed:
    """Pack the pixels ``[h,w]`` of one view as Gaussians."""
    height, width = depth.shape
    to_rays = invert(K).T

    def unpack(block: slice) -> Columns:
        pixels = np.arange(height * width)[block]
        z = depth.reshape(-1)[block].astype(np.float64)
        z[~(z > 0)] = np.nan
        rays = matmul(np.stack([pixels % width + 0.5, pixels // width + 0.5, np.ones(len(z))], 1), to_rays)
        world = matmul(z[:, None] * rays - viewmat[:3, 3], viewmat[:3, :3])  # transposed twice
        count = len(z)
        return Columns(
            means=world,
            quats=np.tile((1.0, 0.0, 0.0, 0.0), (count, 1)),
            log_scales=np.repeat(log(SIGMA * z / K[0, 0])[:, None], 3, 1),
            opacities=np.full(count, OPACITY),
            sh0=rgb_to_sh0(image.reshape(-1, 3)[block] / 255),
            harmonics=np.zeros((count, 0, 3)),
        )

    return Packed(height * width, 0, unpack)
