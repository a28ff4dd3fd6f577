"""``results.npz`` of Depth Anything 3: cameras, depth, and sometimes the images."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import W2C_OPENCV, CameraFile, make_camera_file

_EXTRINSICS, _INTRINSICS = ("extrinsics", "exts"), ("intrinsics", "ixts")
_IMAGES, _DEPTHS = ("image", "images"), ("depth", "depths")


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
    if poses.ndim != 3 or Ks.shape != (len(poses), 3, 3):
        raise SceneError(
            path, f"expected extrinsics [c,3,4] and intrinsics [c,3,3], found {poses.shape} and {Ks.shape}"
        )
    images, depths = _first(arrays, _IMAGES), _first(arrays, _DEPTHS)
    if images is not None:
        images = as_images(path, images, len(poses))
    grid = images if images is not None else depths
    Ks = Ks.astype(np.float64)
    if grid is not None and grid.ndim >= 3:
        height, width = grid.shape[1:3]
        Ks = _at_size(Ks, width, height)
    else:
        width, height = round(2 * Ks[0, 0, 2]), round(2 * Ks[0, 1, 2])
    names = [f"view {i}" for i in range(len(poses))]
    sizes = [(int(width), int(height))] * len(poses)
    return make_camera_file(path, "DA3 npz", W2C_OPENCV, poses, Ks, sizes, names, images)


def holds_images(path: Path) -> bool:
    """Whether an npz has the images themselves; False if it cannot be read."""
    if not zipfile.is_zipfile(path):
        return False
    try:
        with path.open("rb") as file, np.load(file) as arrays:
            return any(name in arrays.files for name in _IMAGES)
    except (OSError, ValueError, zipfile.BadZipFile):
        return False


def read_depths(path: Path) -> np.ndarray | None:
    """The depth maps ``[c,h,w]`` beside the cameras; None where there are none."""
    if path.suffix != ".npz" or not zipfile.is_zipfile(path):
        return None
    try:
        with path.open("rb") as file, np.load(file) as stored:
            depths = _first({name: stored[name] for name in _DEPTHS if name in stored.files}, _DEPTHS)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise SceneError(path, f"expected a readable .npz file, found a damaged one ({error})") from error
    if depths is not None and depths.ndim == 4 and depths.shape[3] == 1:
        depths = depths[..., 0]
    return depths if depths is not None and depths.ndim == 3 else None


def _load(path: Path) -> dict[str, np.ndarray]:
    """The arrays that matter; depth only for its shape, so the confidence is never decompressed."""
    wanted = {*_EXTRINSICS, *_INTRINSICS, *_IMAGES}
    if not zipfile.is_zipfile(path):
        raise SceneError(path, "expected a readable .npz file, found something else")
    try:
        with path.open("rb") as file, np.load(file) as stored:
            has_images = any(name in stored.files for name in _IMAGES)
            wanted |= set() if has_images else set(_DEPTHS)
            return {name: stored[name] for name in stored.files if name in wanted}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise SceneError(path, f"expected a readable .npz file, found a damaged one ({error})") from error


def _first(arrays: dict[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray | None:
    return next((arrays[name] for name in names if name in arrays), None)


def as_images(path: Path, images: np.ndarray, count: int) -> np.ndarray:
    """``[c,h,w,3]`` uint8 from images in any of the usual forms."""
    if images.ndim == 4 and images.shape[1] == 3 and images.shape[3] != 3:
        images = images.transpose(0, 2, 3, 1)
    if images.ndim != 4 or images.shape[0] != count or images.shape[3] != 3:
        raise SceneError(path, f"expected images [{count},h,w,3], found {list(images.shape)}")
    if images.dtype != np.uint8:
        images = np.round(np.clip(images.astype(np.float32), 0, 1) * 255).astype(np.uint8)
    return np.ascontiguousarray(images)


def _at_size(Ks: np.ndarray, width: int, height: int) -> np.ndarray:
    """Intrinsics at the given size: these networks keep the principal point in the middle, which tells their size."""
    ratio_x, ratio_y = 2 * Ks[:, 0, 2] / width, 2 * Ks[:, 1, 2] / height
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
