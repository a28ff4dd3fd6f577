"""``results.npz`` of Depth Anything 3: cameras, depth, and sometimes the images."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import check_pixels
from gsmerge.io.cameras.camera_file import W2C_OPENCV, CameraFile, make_camera_file
from gsmerge.io.formats.npz import array_names, read_arrays

_EXTRINSICS, _INTRINSICS = ("extrinsics", "exts"), ("intrinsics", "ixts")
_IMAGES, _DEPTHS = ("image", "images"), ("depth", "depths")
_MAX_INTRINSIC, _SMALL = 1e12, 1e-9


def read_da3(path: Path) -> CameraFile:
    """Cameras (and images, where stored) of an npz: world-to-camera 3x4 or 4x4, intrinsics in pixels.

    Intrinsics of another image size than the depth maps' (they are stored so when a COLMAP export ran in the same
    call), or normalised ones, are scaled to it.

    Raises:
        SceneError: If the file cannot be read or lacks an array.
    """
    arrays = _load(path)
    poses, Ks = _first(arrays, _EXTRINSICS), _first(arrays, _INTRINSICS)
    if poses is None or Ks is None:
        missing = [names[0] for names, a in ((_EXTRINSICS, poses), (_INTRINSICS, Ks)) if a is None]
        raise SceneError(path, f"missing array{'s' * (len(missing) > 1)} {', '.join(missing)}, found {list(arrays)}")
    check_poses(path, poses, Ks, ("extrinsics [c,3,4]", "intrinsics [c,3,3]"))
    images, depths = _first(arrays, _IMAGES), _first(arrays, _DEPTHS)
    if images is not None:
        images = as_images(path, images, len(poses))
    grid = images if images is not None else depths
    Ks = Ks.astype(np.float64)
    if grid is not None and grid.ndim >= 3 and min(grid.shape[1:3]) > 0:
        height, width = grid.shape[1:3]
        Ks = _at_size(Ks, width, height)
    else:
        width, height = round(2 * Ks[0, 0, 2]), round(2 * Ks[0, 1, 2])
    names = [f"view {i}" for i in range(len(poses))]
    sizes = [(int(width), int(height))] * len(poses)
    return make_camera_file(path, "DA3 npz", W2C_OPENCV, poses, Ks, sizes, names, images)


def holds_images(path: Path) -> bool:
    """Whether an npz has the images themselves; False if it cannot be read."""
    return not array_names(path).isdisjoint(_IMAGES)


def read_depths(path: Path) -> np.ndarray | None:
    """The depth maps ``[c,h,w]`` of the cameras' file; None without any."""
    if path.suffix != ".npz" or array_names(path).isdisjoint(_DEPTHS):
        return None
    depths = _first(read_arrays(path, _DEPTHS), _DEPTHS)
    if depths is not None and depths.ndim == 4 and depths.shape[3] == 1:
        depths = depths[..., 0]
    usable = depths is not None and depths.ndim == 3 and depths.dtype.kind in "fiu"
    return depths if usable else None


def _load(path: Path) -> dict[str, np.ndarray]:
    """The arrays that matter; depth only for its shape, so the confidence is never decompressed."""
    shapes = () if holds_images(path) else _DEPTHS
    return read_arrays(path, {*_EXTRINSICS, *_INTRINSICS, *_IMAGES, *shapes})


def check_poses(path: Path, poses: np.ndarray, Ks: np.ndarray, names: tuple[str, str]) -> None:
    """Refuse poses and intrinsics that are not as many matrices of finite numbers.

    Args:
        path: The file, for messages.
        poses: What should be ``[c,3,4]`` or ``[c,4,4]``.
        Ks: What should be ``[c,3,3]``.
        names: What to call the two, with their shapes.

    Raises:
        SceneError: If they are not.
    """
    for name, array in zip(names, (poses, Ks), strict=True):
        if array.dtype.kind not in "fiu":
            raise SceneError(path, f"expected numbers in {name}, found {array.dtype}")
    if poses.ndim != 3 or len(poses) == 0 or Ks.shape != (len(poses), 3, 3):
        raise SceneError(path, f"expected {names[0]} and {names[1]}, found {poses.shape} and {Ks.shape}")
    if not (
        np.isfinite(poses).all() and np.isfinite(Ks).all() and np.abs(Ks.astype(np.float64)).max() < _MAX_INTRINSIC
    ):
        raise SceneError(path, f"expected finite numbers in {names[0]} and {names[1]}, found others")


def _first(arrays: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray | None:
    return next((arrays[name] for name in names if name in arrays), None)


def as_images(path: Path, images: np.ndarray, count: int) -> np.ndarray:
    """``[c,h,w,3]`` uint8 from images in any of the usual forms; what is not finite becomes black or white."""
    if images.ndim == 4 and images.shape[1] == 3 and images.shape[3] != 3:
        images = images.transpose(0, 2, 3, 1)
    if images.ndim != 4 or images.shape[0] != count or images.shape[3] != 3:
        raise SceneError(path, f"expected images [{count},h,w,3], found {list(images.shape)}")
    if images.dtype.kind not in "fiu":
        raise SceneError(path, f"expected images of numbers, found {images.dtype}")
    check_pixels(path, images.shape[2], images.shape[1])
    if images.dtype != np.uint8:
        share = np.nan_to_num(np.clip(images, 0, 1).astype(np.float32))
        images = np.round(share * 255).astype(np.uint8)
    return np.ascontiguousarray(images)


def _at_size(Ks: np.ndarray, width: int, height: int) -> np.ndarray:
    """Intrinsics at the given size: these networks keep the principal point in the middle."""
    middle = np.maximum(Ks[:, :2, 2], _SMALL)
    ratio_x, ratio_y = 2 * middle[:, 0] / width, 2 * middle[:, 1] / height
    normalised = (Ks[:, 0, 0] < 10) & (Ks[:, 0, 2] < 2) & (width > 10)
    # the same ratio on both axes, clearly: another size; otherwise a principal point that is not in the middle
    other_size = (np.abs(ratio_x / ratio_y - 1) < 0.03) & (np.abs(ratio_x - 1) > 0.1)
    scaled = Ks.copy()
    for i in range(len(Ks)):
        if normalised[i]:
            scaled[i, 0] *= width
            scaled[i, 1] *= height
        elif other_size[i]:
            scaled[i, 0] /= ratio_x[i]
            scaled[i, 1] /= ratio_y[i]
    return scaled
