"""Read cameras from NumPy's files: ``results.npz`` of Depth Anything 3, ``views.npz`` of any model, and InstantSplat's.

A user whose model saves no cameras can write ``views.npz`` while the model runs (``examples/04_dump_views.py``). The
arrays of ``views.npz``:

- ``c2w``: poses ``[v,4,4]`` or ``[v,3,4]``, camera to world, OpenCV axes.
- ``K``: intrinsics ``[v,3,3]`` in pixels of ``images``, or divided by their size. ``K`` may be missing.
- ``images``: ``[v,h,w,3]`` or ``[v,3,h,w]`` as the network saw them, uint8 or float in [0, 1].
- ``order``: order of the rows of the ``.ply``. ``order`` may be missing.
"""

from __future__ import annotations

import io
import math
import re
import zipfile
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.archives import open_archive
from gsmerge.io.bounds import check_file, check_image_size, read_budget
from gsmerge.io.cameras.camera_file import C2W_OPENCV, MAX_NORMALISED_FOCAL, ORDERS, StoredView, check_camera_count
from gsmerge.io.cameras.camera_source import CameraSource, StoredCameras
from gsmerge.io.image_names import natural_key
from gsmerge.io.photo_files import PhotoArrays
from gsmerge.method.kernels.matrices import invert
from gsmerge.runtime.threads import quiet_warnings

# Names of arrays in the files of several programs. Names in files of Lyra 2 end with one of the words of ``_LYRA``
_LYRA = ("recon_sampled", "da3", "da3_pred")
_EXTRINSICS = ("extrinsics", "exts", "extrinsic", *(f"w2c_{name}" for name in _LYRA))
_INTRINSICS = ("intrinsics", "ixts", "intrinsic", *(f"intrinsics_{name}" for name in _LYRA))
_IMAGES = ("image", "images")
_DEPTHS = ("depth", "depths")
_MAX_HEADER = 1 << 16  # most bytes of an array's header
_KINDS = "biufU"  # NumPy's kinds of arrays that are read: numbers and text


def is_da3(path: Path) -> bool:
    """Return whether an npz has poses under a name that Depth Anything 3 uses."""
    return not array_names(path).isdisjoint(_EXTRINSICS[:2])


def read_da3(source: CameraSource) -> StoredCameras:
    """Read the cameras of an ``.npz`` of Depth Anything 3, and its images if it has any.

    Poses are 3x4 or 4x4, world to camera. Intrinsics that are divided by the image size, or are for another image size,
    are scaled to pixels of the images or depth maps in the file. Depth Anything 3 stores intrinsics for another image
    size if it exports a COLMAP model in the same call. Files of Lyra 2 (``cameras.npz``), VGGT and AnySplat are also
    read. AnySplat writes poses as camera to world, intrinsics divided by the image size, and arrays as a batch of one.
    Raise SceneError if the file cannot be read or lacks an array.
    """
    path = source.path
    arrays = read_arrays(path, {*_EXTRINSICS, *_INTRINSICS, *_IMAGES, *_DEPTHS})
    poses, Ks, images, depths = (
        next((arrays[name] for name in names if name in arrays), None)
        for names in (_EXTRINSICS, _INTRINSICS, _IMAGES, _DEPTHS)
    )
    if poses is None:
        raise _missing_arrays(path, ["extrinsics", *(["intrinsics"] if Ks is None else [])], arrays)
    poses = poses[0] if poses.ndim == 4 and len(poses) == 1 else poses
    Ks = Ks[0] if Ks is not None and Ks.ndim == 4 and len(Ks) == 1 else Ks
    _check_poses(path, poses, Ks, ("extrinsics [c,3,4]", "intrinsics [c,3,3]"))
    images = None if images is None else _as_images(path, images, len(poses))
    photos: PhotoArrays = () if images is None else images
    sized = depths if images is None else images  # an array whose shape has the size of the views
    Ks = None if Ks is None else Ks.astype(np.float64)
    width = height = 0
    if sized is not None and sized.ndim >= 3 and min(sized.shape[1:3]) > 0:
        height, width = sized.shape[1:3]
        Ks = None if Ks is None else _at_size(Ks, width, height)
    elif Ks is not None:
        width = round(2 * Ks[0, 0, 2])
        height = round(2 * Ks[0, 1, 2])
    if width <= 1 and Ks is not None and not is_da3(path):  # AnySplat divides intrinsics by the size
        return StoredCameras(_make_views(poses, Ks, (0, 0)), photos, convention=C2W_OPENCV)
    if depths is not None and depths.size == math.prod((len(poses), height, width)):
        depths = depths.reshape(len(poses), height, width)
    return StoredCameras(_make_views(poses, Ks, (width, height)), photos, depths=depths)


def read_views_npz(source: CameraSource) -> StoredCameras:
    """Read the cameras and images of a ``views.npz``; raise SceneError if an array other than ``K`` is missing."""
    path = source.path
    arrays = read_arrays(path, ("c2w", "K", "images", "order"))
    missing = [name for name in ("c2w", "images") if name not in arrays]
    if missing:
        raise _missing_arrays(path, missing, arrays)
    poses = arrays["c2w"]
    Ks = arrays.get("K")
    _check_poses(path, poses, Ks, ("c2w [v,4,4]", "K [v,3,3]"))
    images = _as_images(path, arrays["images"], len(poses))
    order = str(arrays.get("order", "auto"))
    if order not in ORDERS:
        raise SceneError(path, f"expected 'order' to be one of {', '.join(ORDERS)}, found {order[:40]!r}")
    return StoredCameras(_make_views(poses, Ks, (images.shape[2], images.shape[1])), images, order)


def holds_images(path: Path) -> bool:
    """Return whether a file is an ``.npz`` with images; False for a file that cannot be read."""
    return not array_names(path).isdisjoint(_IMAGES)


def holds_poses(path: Path) -> bool:
    """Return whether a file is an ``.npz`` with poses and intrinsics; False for a file that cannot be read."""
    names = array_names(path)
    return {"c2w", "K"} <= names or not (names.isdisjoint(_EXTRINSICS) or names.isdisjoint(_INTRINSICS))


def _missing_arrays(path: Path, missing: list[str], arrays: dict[str, np.ndarray]) -> SceneError:
    """Make the error for an ``.npz`` that has the ``arrays``, but lacks the arrays ``missing``."""
    return SceneError(path, f"missing array{'s' * (len(missing) > 1)} {', '.join(missing)}, found {list(arrays)}")


def _make_views(poses: np.ndarray, Ks: np.ndarray | None, size: tuple[int, int]) -> list[StoredView]:
    """Make views of one size, called "view 0", "view 1" and so on."""
    return [StoredView(f"view {i}", pose, None if Ks is None else Ks[i], size) for i, pose in enumerate(poses)]


def _check_poses(path: Path, poses: np.ndarray, Ks: np.ndarray | None, names: tuple[str, str]) -> None:
    """Raise SceneError unless two arrays are c poses, 3x4 or 4x4, and intrinsics ``[c,3,3]``, of finite numbers.

    ``names``: what errors call the two arrays.
    """
    Ks = np.zeros((*poses.shape[:1], 3, 3)) if Ks is None else Ks
    for name, array in zip(names, (poses, Ks), strict=True):
        if array.dtype.kind not in "fiu":
            raise SceneError(path, f"expected numbers in {name}, found {array.dtype}")
    are_poses = poses.ndim == 3 and len(poses) > 0 and poses.shape[1:] in ((3, 4), (4, 4))
    if not are_poses or Ks.shape != (len(poses), 3, 3):
        raise SceneError(path, f"expected {names[0]} and {names[1]}, found {poses.shape} and {Ks.shape}")
    check_camera_count(path, len(poses))
    max_intrinsic = 1e12  # pixels; the comparison also refuses NaN and infinity
    if not (np.isfinite(poses).all() and np.all(np.abs(Ks.astype(np.float64)) < max_intrinsic)):
        raise SceneError(path, f"expected finite numbers in {names[0]} and {names[1]}, found NaN or inf")


def _as_images(path: Path, images: np.ndarray, count: int) -> np.ndarray:
    """Convert images ``[c,h,w,3]`` or ``[c,3,h,w]``, as uint8 or in [0, 1], to ``[c,h,w,3]`` uint8.

    NaN becomes black. Raise SceneError if there are not ``count`` images, one for each pose, or if the array has
    another shape.
    """
    if images.ndim == 4 and images.shape[1] == 3 and images.shape[3] != 3:
        images = images.transpose(0, 2, 3, 1)
    if images.ndim != 4 or images.shape[0] != count or images.shape[3] != 3:
        raise SceneError(path, f"expected images [{count},h,w,3], found {list(images.shape)}")
    if images.dtype.kind not in "fiu":
        raise SceneError(path, f"expected images of numbers, found {images.dtype}")
    check_image_size(path, images.shape[2], images.shape[1])
    if images.dtype == np.uint8:
        return np.ascontiguousarray(images)
    read_budget(path).check_memory(images.nbytes + images.size, "images")
    out = np.empty(images.shape, np.uint8)
    for row in range(images.shape[1]):  # row by row, so that floats take little memory
        out[:, row] = np.round(np.nan_to_num(np.clip(images[:, row], 0, 1).astype(np.float32)) * 255)
    return out


def _at_size(Ks: np.ndarray, width: int, height: int) -> np.ndarray:
    """Convert intrinsics divided by the image size, or for another image size, to pixels of ``width`` x ``height``.

    The networks put the principal point in the middle of the image. Twice the principal point is thus the image size to
    which a view's intrinsics belong.
    """
    size = np.array([width, height])
    least_centre = 1e-9  # smaller principal points are raised to this, since a later line divides by them
    ratios = 2 * np.maximum(Ks[:, :2, 2], least_centre) / size  # size of the intrinsics, divided by that of the images
    is_normalised = (Ks[:, 0, 0] < MAX_NORMALISED_FOCAL) & (Ks[:, 0, 2] < 2) & (width > 10)
    # If a view's two ratios, for width and height, are equal but not 1, its intrinsics are for another image size. If
    # the two ratios differ, the principal point is not in the middle of the image
    # relative
    max_axis_difference = 0.03
    min_size_difference = 0.1
    are_equal = np.abs(ratios[:, 0] / ratios[:, 1] - 1) < max_axis_difference
    is_for_other_size = ~is_normalised & are_equal & (np.abs(ratios[:, 0] - 1) > min_size_difference)
    scaled = Ks.copy()
    scaled[is_normalised, :2] *= size[:, None]
    scaled[is_for_other_size, :2] /= ratios[is_for_other_size, :, None]
    return scaled


def array_names(path: Path) -> frozenset[str]:
    """List the names of the arrays in an ``.npz``; empty if the file cannot be read."""
    try:
        if not path.is_file() or not zipfile.is_zipfile(path):
            return frozenset()
        with zipfile.ZipFile(path) as archive:
            return frozenset(_members(archive))
    except Exception:  # a damaged archive may make the library raise any error
        return frozenset()


def read_arrays(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    """Read arrays from an ``.npz`` by name. Names that the file lacks are left out.

    Raise SceneError if the file cannot be read, if an array holds anything but numbers and text or has too few bytes
    for its shape, or if the arrays take more memory than the file allows.
    """
    budget = read_budget(path)
    if not zipfile.is_zipfile(path):
        raise SceneError(path, "expected a readable .npz file, found something else")
    try:
        with open_archive(path) as archive, quiet_warnings():  # the library warns of headers in old styles
            members = {name: info for name, info in _members(archive).items() if name in names}
            budget.check_memory(sum(info.file_size for info in members.values()), "arrays")
            arrays: dict[str, np.ndarray] = {}
            for name, info in members.items():
                shape, dtype = _read_header(archive.open(info))
                if dtype.kind not in _KINDS:
                    kind = "objects, which are not read because they could run code"
                    found = kind if dtype.hasobject else str(dtype)[:40]
                    raise SceneError(path, f"{info.filename}: expected numbers, found {found}")
                if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize > info.file_size:
                    problem = f"expected as many bytes as shape {list(shape)} needs, found fewer"
                    raise SceneError(path, f"{info.filename}: {problem}")
                with archive.open(info) as file:
                    arrays[name] = np.asarray(np.lib.format.read_array(file, allow_pickle=False))
            return arrays
    except (SceneError, MemoryError):
        raise
    except Exception as error:  # a damaged archive may make the libraries raise any error
        cause = re.sub(r" at 0x[0-9a-f]+", "", str(error))  # addresses of objects differ in every process
        raise SceneError(path, f"expected a readable .npz file, found a damaged one ({cause})") from error


def _members(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Return the members of an ``.npz`` that are arrays, by the names of the arrays."""
    return {info.filename[:-4]: info for info in archive.infolist() if info.filename.endswith(".npy")}


def _read_header(stream: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return the shape and the type in the header of a ``.npy``, and close the stream."""
    with stream:
        start = io.BytesIO(stream.read(_MAX_HEADER))
    is_version_1 = np.lib.format.read_magic(start) == (1, 0)
    read_header = np.lib.format.read_array_header_1_0 if is_version_1 else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(start)
    return shape, dtype


def read_matrices(path: Path) -> np.ndarray | None:
    """Read matrices ``[c,4,4]`` from a ``.npy``; None if the file holds another array, NaN or inf."""
    with suppress(Exception):  # a damaged file may make the library raise any error
        size = check_file(path)
        shape, dtype = _read_header(path.open("rb"))
        if dtype.kind == "f" and shape[1:] == (4, 4) and 0 < math.prod(shape) * dtype.itemsize <= size:
            matrices = np.load(path, allow_pickle=False).astype(np.float64)
            return matrices if np.isfinite(matrices).all() else None
    return None


def take_optimised_poses(source: CameraSource, views: list[StoredView]) -> list[StoredView]:
    """Replace the poses of views by the optimised poses of InstantSplat's last iteration.

    These are in files beside the ``cameras.json`` with the initial poses.
    Views stay unchanged if InstantSplat wrote no optimised poses, or if the optimisation started from other poses than
    those of the file.
    """
    paths = (source.path.parent / "pose").glob("ours_*/pose_optimized.npy")
    last_path = max(paths, key=lambda path: natural_key(path.parent.name), default=None)
    if last_path is None:
        return views
    original = read_matrices(last_path.with_name("pose_org.npy"))
    optimised = read_matrices(last_path)
    if original is None or optimised is None or not len(original) == len(optimised) == len(views):
        return views
    try:
        first_poses = invert(original)[:, :3]
        poses = invert(optimised)[:, :3]
    except np.linalg.LinAlgError:
        return views
    same_pose = 1e-4  # largest difference of numbers in two files with the same poses, absolute and relative
    if not np.allclose([view.pose for view in views], first_poses, rtol=same_pose, atol=same_pose):
        return views
    return [view._replace(pose=pose) for view, pose in zip(views, poses, strict=True)]
