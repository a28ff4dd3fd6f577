"""Read depth maps with poses and images, the output of models without Gaussians, as one Gaussian per pixel.

``results.npz`` of Depth Anything 3, ``predictions.npz`` of VGGT and ``views.npz`` with depths have all views. Each
``results_output/frame_N.npz`` of DA3-Streaming has one view, and all are in one world
(:mod:`gsmerge.io.cameras.pose_lines`). Depth is measured along z. Only position and colour of a pixel are known, so its
Gaussian is a ball with a standard deviation of ``SIGMA`` pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import project_points, rgb_to_sh0
from gsmerge.io.bounds import ReadBudget, check_file, check_pixels, read_budget
from gsmerge.io.cameras.camera_file import C2W_OPENCV, FLIP, W2C_OPENCV, CameraFile, StoredView, make_camera_file
from gsmerge.io.cameras.camera_source import CameraSource
from gsmerge.io.cameras.npz_files import (
    array_names,
    array_shape,
    holds_poses,
    read_da3,
    read_depth_frame,
    read_depths,
    read_dump,
)
from gsmerge.io.cameras.pose_lines import list_frames, pose_of_frame
from gsmerge.io.formats.arrays import Columns, Packed, StoredRows, check_count, to_stored
from gsmerge.io.formats.table import FRAMES as FRAMES
from gsmerge.io.formats.table import POSES, is_frame
from gsmerge.io.photo_files import PhotoArrays, PhotoReader, keep_photos
from gsmerge.kernels.elementary import log
from gsmerge.kernels.matrices import invert, matmul
from gsmerge.runtime.threads import parallel_map

PLACES = (  # in a folder, besides the frames
    "exports/npz/results.npz", "exports/mini_npz/results.npz", "results.npz", "predictions.npz", "views.npz",
)  # fmt: skip
SIGMA, OPACITY = 0.6, 0.7  # standard deviation (pixels) and opacity of each Gaussian
_GREY = 128
_SAMPLE_PIXELS = 1000  # pixels of a view whose depths are compared with those of the next view
_MAX_DEPTH_DIFFERENCE = 0.05  # relative; depths with a smaller difference agree
# With right poses at least 1.9 times as many pixels agree as with wrong poses, on each of 15 captures
_MIN_AGREEMENT, _MIN_RATIO = 0.2, 1.5
_PIXEL_BYTES = 11  # bytes of a packed pixel, at most: a float64 and three colours
_KEPT_BYTES = 128 << 20  # images up to this size stay in memory; larger ones are read at each use


def find_depth_maps(folder: Path) -> list[Path]:
    """Find the files of a folder's depth maps: one file of all views, or one file per view in order; empty without any.

    SceneError if a frame is missing.
    """
    whole = next((folder / place for place in PLACES if holds_depth_maps(folder / place)), None)
    return list_frames(folder) if whole is None else [whole]


def holds_depth_maps(path: Path) -> bool:
    """Return whether an ``.npz`` has depth maps with cameras; False if it cannot be read."""
    return not array_names(path).isdisjoint(("depth", "depths")) and (holds_poses(path) or is_frame(path))


def read_rows(path: Path) -> StoredRows:
    """Read the depth maps of a file as Gaussians, view by view and row by row of pixels.

    A depth that is not positive and finite gives a row that is not finite. Without images, as in Depth Anything 3's
    ``mini_npz``, Gaussians are grey. SceneError if the file is damaged or lacks an array, or if images and depth maps
    differ in size.
    """
    depths, cameras = _read_frame(path) if is_frame(path) else _read_views(path)
    grey = np.broadcast_to(np.uint8(_GREY), (*depths.shape, 3))  # takes no memory
    images = np.asarray(cameras.images) if len(cameras.images) else grey
    if images.shape[:3] != depths.shape:
        problem = f"expected images of the depth maps' size {list(depths.shape)}, found {list(images.shape[:3])}"
        raise SceneError(path, problem, "write both at one size")
    check_pixels(path, depths.shape[2], depths.shape[1])
    check_count(read_budget(path), depths.size, 0, _PIXEL_BYTES)
    parts = [_pack(*view) for view in zip(depths, images, cameras.Ks, cameras.viewmats, strict=True)]
    sizes = {"means": depths.nbytes, "sh0": 0 if images is grey else images.nbytes}
    return replace(to_stored(parts, "depth maps", sizes), format=str(depths.dtype))


def read_frames(frames: Sequence[Path]) -> list[StoredRows]:
    """Read the frames of DA3-Streaming, each as in :func:`read_rows`.

    SceneError if they take more memory than a file of all their bytes may take. The limit of each single file would
    allow too much memory for thousands of small files.
    """
    budget = ReadBudget(frames[0].parent, sum(map(check_file, frames)))
    check_count(budget, sum(math.prod(array_shape(frame, "depth")) for frame in frames), 0, _PIXEL_BYTES)
    return parallel_map(read_rows, frames)


def read_images(frames: Sequence[Path]) -> PhotoArrays:
    """Read the images of DA3-Streaming's frames; if there are many, they are read again at each use."""
    width, height = read_depth_frame(frames[0]).size

    def read(view: int) -> np.ndarray:
        frame = read_depth_frame(frames[view])
        if frame.size != (width, height):
            problem = f"expected a depth map of {width} x {height} pixels as in {frames[0].name}"
            raise SceneError(frames[view], f"{problem}, found {frame.size[0]} x {frame.size[1]}", "run the model again")
        return frame.image

    photos = PhotoReader(len(frames), (width, height), read)
    return keep_photos(photos) if 3 * width * height * len(frames) <= _KEPT_BYTES else photos


def _read_frame(path: Path) -> tuple[np.ndarray, CameraFile]:
    """Read the depth map ``[1,h,w]`` of a frame of DA3-Streaming, and its camera with the image of the frame."""
    frame = read_depth_frame(path)
    view = StoredView(f"{path.stem} with its pose in {POSES}", pose_of_frame(path), frame.K, frame.size)
    return frame.depth[None], make_camera_file(path, "", C2W_OPENCV, [view], frame.image[None])


def _read_views(path: Path) -> tuple[np.ndarray, CameraFile]:
    """Read the depth maps ``[v,h,w]`` of a file, and the cameras of its v views, with images if the file has some."""
    dumped = "c2w" in array_names(path)
    stored, depths = (read_dump if dumped else read_da3)(CameraSource(path)), read_depths(path)
    convention = stored.convention or (C2W_OPENCV if dumped else W2C_OPENCV)
    cameras = make_camera_file(path, "", convention, stored.views, stored.images)
    if depths is None or len(depths) != len(cameras) or cameras.focal is None:
        problem = f"expected depth maps [{len(cameras)},h,w], one for each pose, and intrinsics, found others"
        raise SceneError(path, problem, "write all of these arrays, or name a .ply of Gaussians")
    _check_poses(path, depths, cameras)
    return depths, cameras


def _check_poses(path: Path, depths: np.ndarray, cameras: CameraFile) -> None:
    """Raise SceneError if depth maps agree far better with the poses of another convention."""
    inverted = invert(cameras.viewmats)
    conventions = {
        "the inverse matrices": inverted,
        "OpenGL's axes": matmul(FLIP, cameras.viewmats),
        "the inverse matrices and OpenGL's axes": matmul(FLIP, inverted),
    }
    shares = ((_agreement(depths, replace(cameras, viewmats=poses)), name) for name, poses in conventions.items())
    best_share, best_name = max(shares)
    share = _agreement(depths, cameras)
    if best_share > max(_MIN_AGREEMENT, _MIN_RATIO * share):
        problem = f"expected poses with which depth maps agree, found {share:.0%} of pixels that agree"
        raise SceneError(
            path, f"{problem}, but {best_share:.0%} with {best_name}", "write the poses in that convention"
        )


def _agreement(depths: np.ndarray, cameras: CameraFile) -> float:
    """Return the share of sampled pixels whose depth agrees with the depth map of the next view."""
    (count, height, width), poses = depths.shape, cameras.viewmats
    sample = slice(None, None, max(1, height * width // _SAMPLE_PIXELS))
    views = zip(depths, np.zeros((*depths.shape, 3), np.uint8), cameras.Ks, poses, strict=True)
    points = np.stack([_pack(*view).unpack(sample).means for view in views])
    next_views = (np.arange(count) + 1) % count
    with np.errstate(all="ignore"):  # pixels without a depth, or behind a view
        pixels, projected_depths = project_points(points, poses[next_views], cameras.Ks[next_views])
        inside = (projected_depths > 0) & (pixels >= 0).all(-1) & (pixels < (width, height)).all(-1)
        columns, rows = pixels[inside].astype(np.int64).T
        ratios = depths[next_views[np.nonzero(inside)[0]], rows, columns] / projected_depths[inside]
    return float((np.abs(ratios - 1) < _MAX_DEPTH_DIFFERENCE).sum() / max(inside.size, 1))


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
