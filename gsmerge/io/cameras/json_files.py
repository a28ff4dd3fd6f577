"""Cameras in other JSON files: INRIA's ``cameras.json``, WorldMirror's, Long-LRM's, ffgs's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import mean_pose_frame
from gsmerge.io.bounds import MAX_VIEWS, read_text
from gsmerge.io.cameras.camera_file import (
    CENTRED_PX,
    MAX_NORMALISED_FOCAL,
    MAX_NUMBER,
    StoredView,
    check_count,
    make_pinhole,
)
from gsmerge.io.cameras.camera_format import CameraSource, StoredCameras, number_errors, to_array, to_number
from gsmerge.io.image_names import natural_key
from gsmerge.kernels.matrices import invert, matmul

_INRIA_KEYS = ("position", "rotation", "fx", "fy", "width", "height")
# Next to the dataset file of Long-LRM: which frames it took, and how it moved the world.
FRAMES_FILE, POSE_FILE, SCALE_FILE = "input_frame_idx.txt", "pos_avg_inv.txt", "scene_scale.txt"
FFGS = "ffgs cameras.json"  # format of cameras whose photos were resized to cover their size, and cropped
_SAME_POSE = 1e-4  # difference of numbers in poses that two files write


def read_inria(source: CameraSource) -> StoredCameras:
    """Read the cameras of a ``cameras.json``; SceneError if a key is missing or not a number.

    It has rows of the camera-to-world rotation, and the centre; InstantSplat writes the poses that it optimised beside
    it. The principal point is in the middle unless ``cx`` and ``cy`` say where.
    """
    views, path = [], source.path
    check_count(path, len(source.json))
    for i, entry in enumerate(source.json):
        name = str(entry.get("img_name", f"view {i}"))
        missing = [key for key in _INRIA_KEYS if entry.get(key) is None]
        if missing:
            raise SceneError(path, f"view {name}: missing {', '.join(missing)}")
        with number_errors(path, f"view {name}: expected numbers"):
            rotation = to_array(entry["rotation"]).reshape(3, 3)
            centre = to_array(entry["position"]).reshape(3, 1)
            fx, fy, width, height = (to_number(entry[key]) for key in ("fx", "fy", "width", "height"))
            size = round(width), round(height)
            middle = {"cx": width / 2, "cy": height / 2}
            cx, cy = (to_number(entry.get(key, half)) for key, half in middle.items())
        K = make_pinhole(fx, fy, cx, cy)
        views.append(StoredView(name, np.concatenate([rotation, centre], 1), K, size))
    return StoredCameras(_with_optimised_poses(views, path.parent / "pose"))


def _with_optimised_poses(views: list[StoredView], folder: Path) -> list[StoredView]:
    """Return views with the poses that InstantSplat optimised, where it wrote them with those that it began from."""
    from gsmerge.io.cameras.npz_files import read_matrices  # few folders need it

    last = max(folder.glob("ours_*/pose_optimized.npy"), key=lambda path: natural_key(path.parent.name), default=None)
    before, after = (None, None) if last is None else map(read_matrices, (last.with_name("pose_org.npy"), last))
    if before is None or after is None or not len(before) == len(after) == len(views):
        return views
    try:
        began, optimised = invert(before)[:, :3], invert(after)[:, :3]
    except np.linalg.LinAlgError:
        return views
    if not np.allclose([view.pose for view in views], began, rtol=_SAME_POSE, atol=_SAME_POSE):
        return views
    return [view._replace(pose=pose) for view, pose in zip(views, optimised, strict=True)]


def read_ffgs(source: CameraSource) -> StoredCameras:
    """Read the cameras of a ``cameras.json`` as ffgs's example writes it, and GlobalSplat.

    ``views`` have ``c2w`` with OpenCV axes and ``k_normalized``, divided by the size ``image_shape`` of the model's
    input; of GlobalSplat ``intrinsic``, in pixels or likewise. SceneError if a value is missing or not a number.
    """
    views, path = [], source.path
    check_count(path, len(source.json["views"]))
    with number_errors(path, "expected 'image_shape' of two numbers"):
        height, width = (round(to_number(side)) for side in source.json["image_shape"])
    for i, view in enumerate(source.json["views"]):
        name = str(view.get("file") or view.get("image") or f"view {i}")
        key, sides = ("intrinsic", (1, 1, 1)) if "intrinsic" in view else ("k_normalized", (width, height, 1))
        with number_errors(path, f"view {name}: expected numbers in 'c2w' and {key!r}"):
            pose, K = to_array(view["c2w"]).reshape(4, 4), to_array(view[key]).reshape(3, 3)
        views.append(StoredView(name, pose, K * np.array(sides)[:, None], (width, height)))
    return StoredCameras(views)


def is_ffgs(source: CameraSource, key: str = "c2w") -> bool:
    """Return whether a JSON file has ``views`` with a key, as ffgs and GlobalSplat write them."""
    views = source.object.get("views")
    return isinstance(views, list) and all(isinstance(v, dict) for v in views) and any(key in v for v in views)


def read_world_mirror(source: CameraSource) -> StoredCameras:
    """Read the cameras of a ``camera_params.json``.

    ``extrinsics`` and ``intrinsics`` are lists of ``{camera_id, matrix}``; poses are camera-to-world with OpenCV
    axes, intrinsics in pixels of the processed size, which is twice the principal point. ``camera_id`` is the stem of
    the image's name, or its number, by which the cameras are then sorted. SceneError if the lists differ in cameras,
    or a matrix is damaged.
    """
    path, data = source.path, source.json
    poses, Ks = (_matrices(path, data, key, side) for key, side in (("extrinsics", 4), ("intrinsics", 3)))
    if poses.keys() != Ks.keys():
        odd = sorted(poses.keys() ^ Ks.keys())[0]
        raise SceneError(path, f"expected extrinsics and intrinsics of the same cameras, found only one for {odd}")
    names = sorted(poses, key=natural_key) if all(name.isdecimal() for name in poses) else list(poses)
    size = _centred_size([Ks[name] for name in names])
    return StoredCameras([StoredView(name, poses[name], Ks[name], size) for name in names])


def _centred_size(Ks: Sequence[np.ndarray]) -> tuple[int, int]:
    """Return the (width, height) that centres all principal points; (0, 0) without one."""
    sides = 2 * np.array([K[:2, 2] for K in Ks]).reshape(-1, 2)
    whole = np.abs(sides[:1]).clip(0, MAX_NUMBER).round()
    centred = len(sides) > 0 and bool((np.abs(sides - whole) <= CENTRED_PX).all())
    if not centred or not (whole > MAX_NORMALISED_FOCAL).all():
        return 0, 0
    return int(whole[0, 0]), int(whole[0, 1])


def _matrices(path: Path, data: Mapping[str, Any], key: str, side: int) -> dict[str, np.ndarray]:
    entries = data.get(key)
    if not isinstance(entries, list):
        raise SceneError(path, f"expected {key!r} to be a list, found something else")
    check_count(path, len(entries))
    matrices = {}
    for entry in entries:
        with number_errors(path, f"{key}: expected entries of 'camera_id' and 'matrix'"):
            name, matrix = str(entry["camera_id"]), to_array(entry["matrix"])
        if matrix.shape not in ((side, side), (3, side)):
            raise SceneError(path, f"{key} of {name}: expected {side}x{side} numbers, found shape {matrix.shape}")
        matrices[name] = matrix
    return matrices


def is_long_lrm(source: CameraSource) -> bool:
    """Return whether a JSON file has ``frames`` with ``w2c``, which only Long-LRM writes."""
    frames = source.object.get("frames")
    return bool(frames) and isinstance(frames, list) and all(isinstance(f, dict) and "w2c" in f for f in frames)


def read_long_lrm(source: CameraSource) -> StoredCameras:
    """Read the cameras of a dataset file: ``frames`` of ``fx fy cx cy w h`` and ``w2c``.

    Long-LRM writes further files next to its Gaussians (they may have been copied next to the dataset file): the chosen
    frames in ``input_frame_idx.txt``, and the map from the world of the cameras to that of the Gaussians, X =
    scene_scale (pos_avg_inv X_cameras). Some versions write only the frames, and the map is computed from these. The
    cameras are moved into the Gaussians' world. SceneError if an entry is missing or not a number, or a frame does not
    exist.
    """
    frames, path, folder = [], source.path, source.folder
    for i, frame in enumerate(source.json["frames"]):
        name = str(frame.get("file_path") or frame.get("image_path") or f"view {i}")
        with number_errors(path, f"view {name}: expected w2c, fx, fy, cx, cy, w, h as numbers"):
            pose = to_array(frame["w2c"]).reshape(4, 4)
            K = make_pinhole(*(to_number(frame[key]) for key in ("fx", "fy", "cx", "cy")))
            frames.append(StoredView(name, pose, K, (round(to_number(frame["w"])), round(to_number(frame["h"])))))
    beside = path.parent
    if folder is not None and not (beside / FRAMES_FILE).is_file() and (folder / FRAMES_FILE).is_file():
        beside = folder
    frames_path, pose_path, scale_path = beside / FRAMES_FILE, beside / POSE_FILE, beside / SCALE_FILE
    frame_ids = _numbers(frames_path)
    ids = range(len(frames)) if frame_ids is None else [round(value) for value in frame_ids]
    odd = next((i for i in ids if not 0 <= i < len(frames)), None)
    if odd is not None:
        raise SceneError(frames_path, f"expected frames 0 to {len(frames) - 1}, found {odd:.6g}")
    poses = np.array([frames[i].pose for i in ids]).reshape(-1, 4, 4)
    move, scale = _numbers(pose_path), _numbers(scale_path)
    if frame_ids is not None and len(poses) and move is None and scale is None:
        with np.errstate(all="ignore"):  # what overflows is refused with the cameras
            poses = mean_pose_frame(poses).move_viewmats(poses)
    if scale is not None and (scale.size != 1 or not scale[0] > 0):
        raise SceneError(scale_path, "expected one positive number")
    if move is not None and move.size != 16:
        raise SceneError(pose_path, f"expected 16 numbers, found {move.size}")
    try:
        with np.errstate(all="ignore"):  # what overflows is refused with the cameras
            poses = poses if move is None else matmul(poses, invert(move.reshape(4, 4)))  # of X' = s (A X): R inv(A)
            poses[:, :3, 3] *= 1.0 if scale is None else scale[0]
    except np.linalg.LinAlgError as error:
        raise SceneError(pose_path, "expected a matrix that can be inverted") from error
    return StoredCameras([frames[i]._replace(pose=pose) for i, pose in zip(ids, poses, strict=True)])


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
