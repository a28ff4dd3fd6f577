"""Cameras in JSON: nerfstudio's ``transforms.json``, INRIA's ``cameras.json``, WorldMirror's, Long-LRM's, ffgs's."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import Similarity, mean_pose_frame
from gsmerge.io.bounds import MAX_VIEWS, read_json, read_text
from gsmerge.io.cameras.camera_file import (
    MAX_NORMALISED_FOCAL,
    MAX_NUMBER,
    Lens,
    StoredView,
    check_count,
    is_orthonormal,
    make_lens,
    make_pinhole,
)
from gsmerge.io.cameras.camera_format import CameraSource, StoredCameras
from gsmerge.io.image_names import find_image, natural_key
from gsmerge.io.photo_files import Size, image_size
from gsmerge.kernels.elementary import cos, sin
from gsmerge.kernels.matrices import determinant, invert, matmul
from gsmerge.types import Cameras

_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")  # the order of "distortion_params"
_COEFFICIENTS = (*_DISTORTION, "k5", "k6")
_DISTORTED = {"OPENCV", "RADIAL", "SIMPLE_RADIAL"}
_PERSPECTIVE = {"PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", *_DISTORTED}
_FOCAL_KEYS = ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y")
_NUMBER_KEYS = (*_FOCAL_KEYS, "w", "h", "cx", "cy", *_COEFFICIENTS)
_MAX_MODEL = 40  # letters of a camera model's name
_MAX_NAME = 255  # bytes of a file's name
_INRIA_KEYS = ("position", "rotation", "fx", "fy", "width", "height")
# Next to the dataset file of Long-LRM: which frames it took, and how it moved the world.
FRAMES_FILE, POSE_FILE, SCALE_FILE = "input_frame_idx.txt", "pos_avg_inv.txt", "scene_scale.txt"
FFGS = "ffgs cameras.json"  # format of cameras whose photos were resized to cover their size, and cropped
VIEWER_CAMERAS = ".cameras.json"  # ending of the cameras for viewers beside a result
DATAPARSER = "dataparser_transforms.json"
_SAME_POSE = 1e-4  # difference of numbers in poses that two files write
_CENTRED = 1e-3  # pixels by which twice a principal point in the middle may differ from the image's size


def is_long_lrm(source: CameraSource) -> bool:
    """Return whether a JSON file has ``frames`` with ``w2c``, which only Long-LRM writes."""
    frames = source.object.get("frames")
    return bool(frames) and isinstance(frames, list) and all(isinstance(f, dict) and "w2c" in f for f in frames)


@contextmanager
def number_errors(path: Path, expected: str) -> Iterator[None]:
    """Turn errors of missing entries, and of values that are no numbers or objects, in the block into a SceneError."""
    try:
        yield
    except (LookupError, AttributeError, TypeError, ValueError, ArithmeticError) as error:
        raise SceneError(path, f"{expected} ({error})") from error


def read_transforms(source: CameraSource) -> StoredCameras:
    """Read the cameras of a ``transforms.json`` or a bare list of frames; SceneError if a value is missing.

    Intrinsics are global or per frame, in pixels or as field of view; no frame need have any. ``applied_transform``
    is not applied: poses are in the Gaussians' world.
    """
    return StoredCameras(transforms_views(source.path, source.json))


def transforms_views(path: Path, data: Any) -> list[StoredView]:
    """Read the views of a parsed ``transforms.json``; see :func:`read_transforms`."""
    frames = data["frames"] if isinstance(data, dict) else data
    if not isinstance(frames, list) or not all(isinstance(f, dict) for f in frames):
        raise SceneError(path, "expected 'frames' to be a list of objects, found something else")
    check_count(path, len(frames))
    with number_errors(path, "expected numbers"):
        common = _camera_values(data) if isinstance(data, dict) else {}
    entries: list[tuple[str, np.ndarray, dict[str, Any]]] = []
    for i, frame in enumerate(frames):
        name = str(frame.get("file_path") or frame.get("image_path") or frame.get("name") or f"view {i}")
        if "transform_matrix" not in frame:
            raise SceneError(path, f"view {name}: expected 'transform_matrix', found none")
        with number_errors(path, f"view {name}: expected numbers"):
            entries.append((name, _array(frame["transform_matrix"]), {**common, **_camera_values(frame)}))
    bare = not any(key in values for _, _, values in entries for key in _FOCAL_KEYS)
    views, size_of = [], cache(image_size)  # of photos that many frames may name
    for name, pose, values in entries:
        with number_errors(path, f"view {name}: expected numbers"):
            lens = _lens(path, name, values)
            size = round(values.get("w", 0)), round(values.get("h", 0))
            K, size = (None, size) if bare else _intrinsics(path, name, values, size_of)
            views.append(StoredView(name, pose, K, size, lens))
    return views


def _camera_values(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a camera's intrinsics in a file, or in one of its frames; null counts as missing."""
    values: dict[str, Any] = {key: _number(entry[key]) for key in _NUMBER_KEYS if entry.get(key) is not None}
    values |= {key: entry[key] for key in ("camera_model", "is_fisheye") if entry.get(key) is not None}
    if "camera_model" in values:
        values["camera_model"] = str(values["camera_model"]).upper()[:_MAX_MODEL]
    if entry.get("distortion_params") is not None:
        values["distortion_params"] = [_number(value) for value in entry["distortion_params"][: len(_DISTORTION)]]
    return values


def _number(value: Any) -> float:
    """Convert a JSON number; TypeError for true, false and null, ValueError for other text."""
    if isinstance(value, bool):
        raise TypeError(f"found {str(value).lower()}")
    return float(value)


def _array(values: Any) -> np.ndarray:
    """Convert lists of numbers to float64; errors as in :func:`_number`."""
    array = np.array(values, np.float64)
    if bool in set(map(type, np.array(values, object).flat)):
        raise TypeError("found true or false")
    return array


def _intrinsics(
    path: Path, name: str, values: Mapping[str, Any], size_of: Callable[[Path], Size]
) -> tuple[np.ndarray, Size]:
    """Return intrinsics ``[3,3]`` and (width, height) of a frame, from its own values or those of all frames."""
    if not any(key in values for key in _FOCAL_KEYS):
        missing = ", ".join(key for key in ("fl_x", "w", "h") if key not in values)
        problem = f"expected intrinsics (fl_x, fl_y, cx, cy, w, h), found none of {missing} for view {name}"
        raise SceneError(path, problem, "add them in pixels, for all frames or for each")
    width, height = values.get("w", 0.0), values.get("h", 0.0)
    if not (width and height) and not {"fl_x", "cx", "cy"} <= values.keys():
        image = find_image(path.parent, name, "add 'w' and 'h' to the camera file")
        if image is None:
            raise SceneError(path, f"view {name}: expected 'w' and 'h', found neither them nor the image itself")
        width, height = size_of(image)
    fx = _focal(values, "x", width) or _focal(values, "y", height)
    fy = _focal(values, "y", height) or fx
    K = make_pinhole(fx, fy, values.get("cx", width / 2), values.get("cy", height / 2))
    return K, (round(width), round(height))


def _focal(values: Mapping[str, float], axis: str, size: float) -> float:
    """Return the focal length along an axis in pixels, 0 where the file has none."""
    if f"fl_{axis}" in values:
        return values[f"fl_{axis}"]
    if f"camera_angle_{axis}" in values:
        half = 0.5 * values[f"camera_angle_{axis}"]
        return float(0.5 * size * cos(half) / sin(half))
    return 0.0


def _lens(path: Path, name: str, values: Mapping[str, Any]) -> Lens | None:
    """Return the lens of a frame, None for a pinhole."""
    model = values.get("camera_model", "PINHOLE")
    params = {key: values.get(key, 0.0) for key in _COEFFICIENTS}
    if not any(params.values()):
        params |= dict(zip(_DISTORTION, values.get("distortion_params", ()), strict=False))
    if model == "OPENCV_FISHEYE" or values.get("is_fisheye"):
        return make_lens("OPENCV_FISHEYE", "fisheye", [params[key] for key in ("k1", "k2", "k3", "k4")])
    odd = next((key for key in ("k4", "k5", "k6") if params[key]), None)
    if model not in _PERSPECTIVE or odd is not None:
        odd_lens = f"lens distortion {odd}, which formats understand differently"
        what = odd_lens if odd is not None else f"camera model {model}"
        problem = f"view {name}: expected a pinhole, OPENCV or OPENCV_FISHEYE camera, found {what}"
        raise SceneError(path, problem, "undistort the images first")
    coefficients = [params[key] for key in ("k1", "k2", "p1", "p2", "k3")]
    return make_lens(model if model in _DISTORTED else "OPENCV", "perspective", coefficients)


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
            rotation = _array(entry["rotation"]).reshape(3, 3)
            centre = _array(entry["position"]).reshape(3, 1)
            fx, fy, width, height = (_number(entry[key]) for key in ("fx", "fy", "width", "height"))
            size = round(width), round(height)
            middle = {"cx": width / 2, "cy": height / 2}
            cx, cy = (_number(entry.get(key, half)) for key, half in middle.items())
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
        height, width = (round(_number(side)) for side in source.json["image_shape"])
    for i, view in enumerate(source.json["views"]):
        name = str(view.get("file") or view.get("image") or f"view {i}")
        key, sides = ("intrinsic", (1, 1, 1)) if "intrinsic" in view else ("k_normalized", (width, height, 1))
        with number_errors(path, f"view {name}: expected numbers in 'c2w' and {key!r}"):
            pose, K = _array(view["c2w"]).reshape(4, 4), _array(view[key]).reshape(3, 3)
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
    centred = len(sides) > 0 and bool((np.abs(sides - whole) <= _CENTRED).all())
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
            name, matrix = str(entry["camera_id"]), _array(entry["matrix"])
        if matrix.shape not in ((side, side), (3, side)):
            raise SceneError(path, f"{key} of {name}: expected {side}x{side} numbers, found shape {matrix.shape}")
        matrices[name] = matrix
    return matrices


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
            pose = _array(frame["w2c"]).reshape(4, 4)
            K = make_pinhole(*(_number(frame[key]) for key in ("fx", "fy", "cx", "cy")))
            frames.append(StoredView(name, pose, K, (round(_number(frame["w"])), round(_number(frame["h"])))))
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


def viewer_cameras_path(output: Path) -> Path:
    """Return the path of the camera file for viewers: ``out.ply`` -> ``out.cameras.json``."""
    name = output.name
    stem = name[: -len(".compressed.ply")] if name.lower().endswith(".compressed.ply") else output.stem
    stem = os.fsencode(stem)[: _MAX_NAME - len(VIEWER_CAMERAS)].decode("utf-8", "ignore")
    return output.with_name(stem + VIEWER_CAMERAS)


def viewer_cameras(cameras: Cameras, names: Sequence[str]) -> str:
    """Return the text of cameras as INRIA's ``cameras.json``, for SuperSplat and other viewers.

    :func:`read_inria` reads it. Viewers assume a principal point in the middle; another one is written as ``cx`` and
    ``cy``.
    """

    def point(K: np.ndarray) -> dict[str, float]:
        centred = np.allclose(2 * K[:2, 2], (cameras.width, cameras.height), rtol=0, atol=_CENTRED)
        return {} if centred else {"cx": float(K[0, 2]), "cy": float(K[1, 2])}

    rotations, centres = cameras.viewmats[:, :3, :3].transpose(0, 2, 1), cameras.centres
    entries = [
        {
            "id": i, "img_name": name, "width": cameras.width, "height": cameras.height,
            "position": centres[i].tolist(), "rotation": rotations[i].tolist(),
            "fy": float(cameras.Ks[i, 1, 1]), "fx": float(cameras.Ks[i, 0, 0]), **point(cameras.Ks[i]),
        }
        for i, name in enumerate(names)
    ]  # fmt: skip
    return json.dumps(entries) + "\n"


def read_dataparser(ply: Path, cameras: Path | None) -> list[Similarity]:
    """Read the similarities that a nerfstudio ``dataparser_transforms.json`` may mean, or Metashape's file of cameras.

    The file says how cameras were moved into the Gaussians' world: X' = scale (transform [X; 1]). ``transform`` starts
    from the world of the capture. Poses of a ``transforms.json`` with ``applied_transform`` (and ``applied_scale``)
    have been moved by that already, so it is undone. Which reading is right has to be measured. SceneError if the file
    lacks a rotation, shift and positive scale.
    """
    folders = [ply.parent] + ([] if cameras is None else [cameras.parent])
    path = next((folder / DATAPARSER for folder in folders if (folder / DATAPARSER).is_file()), None)
    if path is None:
        from gsmerge.io.cameras.programs import read_metashape_world  # few files need it

        world = read_metashape_world(cameras) if cameras is not None and cameras.suffix == ".xml" else None
        return [] if world is None else [world, replace(world, scale=1.0, shift=world.shift / world.scale)]
    data = read_json(path)
    with number_errors(path, "expected 'transform' of 3x4 numbers and 'scale'"):
        moved = _square(data["transform"])
        scale = _number(data["scale"])
    frames = [make_similarity(path, moved, scale)]
    camera_data = read_json(cameras) if cameras is not None and cameras.suffix == ".json" and cameras.is_file() else {}
    if isinstance(camera_data, dict) and "applied_transform" in camera_data:
        with number_errors(cameras or path, "expected 'applied_transform' of 3x4 numbers"):
            applied, factor = _square(camera_data["applied_transform"]), _number(camera_data.get("applied_scale") or 1)
            frames.append(make_similarity(path, matmul(moved, invert(applied)), scale / factor))
    return frames


def _square(values: Any) -> np.ndarray:
    matrix = _array(values)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.all(np.abs(matrix) < MAX_NUMBER):
        raise ValueError(f"found shape {list(matrix.shape)}, or numbers that are not finite")
    return np.concatenate([matrix[:3], [[0.0, 0, 0, 1]]])


def make_similarity(path: Path, matrix: np.ndarray, scale: float) -> Similarity:
    """Make the similarity of a matrix ``[3,4]`` and the scale after it; SceneError if it is none."""
    R = matrix[:3, :3]
    odd = not is_orthonormal(R) or determinant(R) < 0 or not 0 < scale < MAX_NUMBER
    if odd or not np.all(np.abs(matrix) < MAX_NUMBER):
        raise SceneError(path, "expected 'transform' to rotate and shift and 'scale' to be positive, found another map")
    return Similarity(R, scale, scale * matrix[:3, 3], f"moved into the Gaussians' frame by {path.name}", "other")
