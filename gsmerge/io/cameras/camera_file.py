"""What every reader of camera files returns, and the conventions they translate from."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from gsmerge.errors import SceneError
from gsmerge.io.bounds import MAX_VIEWS, check_pixels
from gsmerge.types import Cameras

_MAX_NUMBER, _MAX_SIDE, _MIN_FOCAL = 1e12, 1e6, 1e-6  # beyond them no camera is, and numbers would overflow later
_MAX_ROTATION_ERROR = 0.02  # of the entries of R R^T
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL camera axes (y up, z backward) <-> OpenCV (y down, z forward)

MAX_NORMALISED_FOCAL = 10.0  # a longer one is in pixels; and no image is that small

# How a format stores poses: direction of the matrix, and the camera's axes.
Convention = tuple[str, str]
W2C_OPENCV: Convention = ("world-to-camera", "OpenCV")
C2W_OPENCV: Convention = ("camera-to-world", "OpenCV")
W2C_OPENGL: Convention = ("world-to-camera", "OpenGL")
C2W_OPENGL: Convention = ("camera-to-world", "OpenGL")
CONVENTIONS = (W2C_OPENCV, C2W_OPENCV, W2C_OPENGL, C2W_OPENGL)


@dataclass(frozen=True)
class Lens:
    """A lens that is no pinhole.

    Args:
        name: As the camera file calls the model.
        model: "perspective": radial and tangential, as ``cv2.undistort``; "fisheye": as ``cv2.fisheye``.
        coefficients: The first of k1, k2, p1, p2, k3, k4, k5, k6, or of a fisheye's k1, k2, k3, k4; others are 0.
    """

    name: str
    model: Literal["perspective", "fisheye"]
    coefficients: tuple[float, ...]


def perspective(name: str, coefficients: Sequence[float]) -> Lens | None:
    """A lens with coefficients in the order k1, k2, p1, p2, k3, k4, k5, k6; None where all are zero: a pinhole."""
    return Lens(name, "perspective", tuple(coefficients)) if any(coefficients) else None


def fisheye(name: str, coefficients: Sequence[float]) -> Lens:
    """A fisheye with up to four coefficients; with none of them it is no pinhole either."""
    return Lens(name, "fisheye", tuple(coefficients))


@dataclass(frozen=True)
class CameraFile:
    """c cameras in the order of their file.

    Args:
        path: The file or folder.
        viewmats: ``[c,4,4]`` world to camera, OpenCV axes, float64.
        Ks: ``[c,3,3]`` intrinsics in pixels, float64; the top-left pixel's centre is (0.5, 0.5).
        widths: ``[c]`` int64, pixels; 0 where unknown, 1 where unknown and the intrinsics are divided by it.
        heights: The same.
        names: Image names as the file gives them.
        source: The format's name.
        convention: How the format stores poses.
        images: ``[c,h,w,3]`` uint8 sRGB where the file holds the images themselves.
        order: Order of the Gaussians' rows where the file names it, otherwise "auto".
        lenses: Of each camera where one of them is no pinhole; empty where all are.
    """

    path: str
    viewmats: Tensor
    Ks: Tensor
    widths: Tensor
    heights: Tensor
    names: tuple[str, ...]
    source: str
    convention: Convention = W2C_OPENCV
    images: np.ndarray | None = None
    order: str = "auto"
    lenses: tuple[Lens | None, ...] = ()

    def __len__(self) -> int:
        return len(self.names)


def make_camera_file(
    path: str | os.PathLike[str],
    source: str,
    convention: Convention,
    poses: np.ndarray | Sequence[np.ndarray],
    Ks: np.ndarray | Sequence[np.ndarray],
    sizes: Sequence[tuple[int, int]],
    names: Sequence[str],
    images: np.ndarray | None = None,
    lenses: Sequence[Lens | None] = (),
) -> CameraFile:
    """Translate poses to the one convention and check that they are poses.

    Args:
        path: The file, for messages.
        source: The format's name.
        convention: How ``poses`` are stored.
        poses: c matrices, 3x4 or 4x4.
        Ks: c matrices 3x3, pixels, or all of them divided by the image's size.
        sizes: (width, height) of each camera, pixels; 0 where unknown.
        names: Image names.
        images: ``[c,h,w,3]`` uint8, if the file holds them.
        lenses: None for a pinhole; empty for pinholes throughout.

    Raises:
        SceneError: If there is no camera, a number is not finite, a rotation is not orthonormal, or a focal length is
            not positive.
    """
    if len(poses) == 0:
        raise SceneError(path, "expected at least one camera, found none")
    if len(poses) > MAX_VIEWS:
        raise SceneError(path, f"expected at most {MAX_VIEWS} cameras, found {len(poses)}")
    full = np.tile(np.eye(4), (len(poses), 1, 1))
    for i, pose in enumerate(poses):
        pose = np.asarray(pose, np.float64)
        if pose.shape not in ((3, 4), (4, 4)):
            raise SceneError(path, f"view {names[i]}: expected a pose of 3x4 or 4x4 numbers, found {pose.shape}")
        full[i, :3] = pose[:3]
    K = np.asarray(Ks, np.float64).reshape(-1, 3, 3)
    _check(path, full, K, names)
    odd = next(((w, h) for w, h in sizes if not (0 <= w <= _MAX_SIDE and 0 <= h <= _MAX_SIDE)), None)
    if odd is not None:
        raise SceneError(path, f"expected a positive image size, found {odd[0]:.6g} x {odd[1]:.6g}")
    K, sizes = _in_pixels(K, sizes)
    return CameraFile(
        path=str(path),
        viewmats=torch.from_numpy(to_viewmats(full, convention)),
        Ks=torch.from_numpy(K),
        widths=torch.tensor([w for w, _ in sizes], dtype=torch.int64),
        heights=torch.tensor([h for _, h in sizes], dtype=torch.int64),
        names=tuple(names),
        source=source,
        convention=convention,
        images=images,
        lenses=tuple(lenses) if any(lenses) else (),
    )


def _in_pixels(Ks: np.ndarray, sizes: Sequence[tuple[int, int]]) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """Intrinsics that are divided by the image's size, multiplied by it; where it is unknown, that of 1 x 1 pixels."""
    known = [w > 0 and h > 0 for w, h in sizes]
    small = (Ks[:, 0, 0] < MAX_NORMALISED_FOCAL) & (Ks[:, 1, 1] < MAX_NORMALISED_FOCAL)
    small &= (np.abs(Ks[:, :2, 2] - 0.5) < 1).all(1)
    if not small.all() or any(ok and min(size) <= MAX_NORMALISED_FOCAL for ok, size in zip(known, sizes, strict=True)):
        return Ks, list(sizes)
    scale = [(w, h, 1) if ok else (1, 1, 1) for ok, (w, h) in zip(known, sizes, strict=True)]
    return Ks * np.array(scale, np.float64)[:, :, None], [
        s if ok else (1, 1) for ok, s in zip(known, sizes, strict=True)
    ]


def _check(path: str | os.PathLike[str], poses: np.ndarray, Ks: np.ndarray, names: Sequence[str]) -> None:
    for name, pose, K in zip(names, poses, Ks, strict=True):
        if not (np.isfinite(pose).all() and np.isfinite(K).all()):
            raise SceneError(path, f"view {name}: expected finite numbers, found NaN or inf")
        largest = max(np.abs(pose).max(), np.abs(K).max())
        if largest > _MAX_NUMBER:
            raise SceneError(path, f"view {name}: expected numbers up to {_MAX_NUMBER:g}, found {largest:g}")
        rotation = pose[:3, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > _MAX_ROTATION_ERROR:
            raise SceneError(path, f"view {name}: expected a rotation matrix, found one whose axes are not orthonormal")
        if np.linalg.det(rotation) < 0:
            raise SceneError(
                path, f"view {name}: expected a rotation, found a mirrored (left-handed) one", "negate one axis"
            )
        if K[0, 0] < _MIN_FOCAL or K[1, 1] < _MIN_FOCAL:
            raise SceneError(path, f"view {name}: expected positive focal lengths, found {K[0, 0]:g} and {K[1, 1]:g}")
        if np.abs(K[2] - (0, 0, 1)).max() > 1e-3 or abs(K[1, 0]) > 1e-3 * K[0, 0]:
            raise SceneError(path, f"view {name}: expected intrinsics whose last row is 0 0 1, found others")


def to_viewmats(poses: np.ndarray, convention: Convention) -> np.ndarray:
    """World-to-camera matrices with OpenCV axes from ``[c,4,4]`` poses of a convention."""
    direction, axes = convention
    if direction == "camera-to-world":
        poses = np.linalg.inv(poses)
    return FLIP @ poses if axes == "OpenGL" else poses


def from_viewmats(viewmats: np.ndarray, convention: Convention) -> np.ndarray:
    """The inverse of :func:`to_viewmats`: the poses as a file of that convention holds them."""
    direction, axes = convention
    poses = FLIP @ viewmats if axes == "OpenGL" else viewmats
    return np.linalg.inv(poses) if direction == "camera-to-world" else poses


def describe(convention: Convention) -> str:
    """A convention in words."""
    return f"{convention[0]} matrices with {convention[1]} axes"


def with_convention(camera_file: CameraFile, convention: Convention) -> CameraFile:
    """The same file, its poses read in another convention."""
    stored = from_viewmats(camera_file.viewmats.numpy(), camera_file.convention)
    return replace(camera_file, viewmats=torch.from_numpy(to_viewmats(stored, convention)), convention=convention)


def with_poses(cameras: Cameras, viewmats: np.ndarray) -> Cameras:
    """The same cameras at other poses ``[c,4,4]``."""
    return replace(cameras, viewmats=torch.from_numpy(viewmats))


def select_views(cameras: CameraFile, view_ids: Sequence[int]) -> CameraFile:
    """The views of these ids, in that order."""
    ids = list(view_ids)
    lenses = tuple(cameras.lenses[i] for i in ids) if cameras.lenses else ()
    return replace(
        cameras,
        viewmats=cameras.viewmats[ids],
        Ks=cameras.Ks[ids],
        widths=cameras.widths[ids],
        heights=cameras.heights[ids],
        names=tuple(cameras.names[i] for i in ids),
        images=None if cameras.images is None else cameras.images[ids],
        lenses=lenses if any(lenses) else (),
    )


def _stored_sizes(camera_file: CameraFile) -> list[tuple[int, int]]:
    return sorted(set(zip(camera_file.widths.tolist(), camera_file.heights.tolist(), strict=True)))


def sizes_of(camera_file: CameraFile) -> list[tuple[int, int]]:
    """All (width, height) that the file's cameras are known to have."""
    return [(w, h) for w, h in _stored_sizes(camera_file) if min(w, h) > 0 and (w, h) != (1, 1)]


def to_cameras(camera_file: CameraFile, size: tuple[int, int] | None = None) -> Cameras:
    """Cameras of one image size.

    Args:
        camera_file: What was read.
        size: (width, height), pixels; intrinsics of another size are scaled to it, each axis by itself. None takes
            the file's size.

    Raises:
        SceneError: If no size is given and the file's cameras have none, or several; or a lens is no pinhole.
    """
    if camera_file.lenses:
        name, lens = next((n, x) for n, x in zip(camera_file.names, camera_file.lenses, strict=True) if x is not None)
        raise SceneError(
            camera_file.path,
            f"view {name}: expected a pinhole camera, found {lens.name} with lens distortion",
            "undistort the images first",
        )
    if size is None:
        stored = _stored_sizes(camera_file)
        if len(stored) > 1:
            sizes = " and ".join(f"{w} x {h}" for w, h in stored[:2])
            raise SceneError(camera_file.path, f"expected cameras of one image size, found {sizes}")
        size = stored[0]
        if 0 in size or size == (1, 1):
            raise SceneError(camera_file.path, "expected the image size (w, h) of the cameras, found none")
    check_pixels(camera_file.path, *size)
    known = (camera_file.widths > 0) & (camera_file.heights > 0)
    scale = torch.ones(len(camera_file), 3, dtype=torch.float64)
    scale[:, 0] = torch.where(known, size[0] / camera_file.widths.clamp_min(1), 1.0)
    scale[:, 1] = torch.where(known, size[1] / camera_file.heights.clamp_min(1), 1.0)
    return Cameras(camera_file.viewmats, camera_file.Ks * scale[:, :, None], *size)
