"""Read the views of programs whose files no :class:`ViewLayout` alone describes.

OpenSfM, Polycam, WorldMirror and nerfstudio's exports write the values of a view into several lists or files. Long-LRM
moves its cameras, and SHARP writes its camera into the elements of its ``.ply``.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import MAX_VIEWS, read_json, read_text
from gsmerge.io.cameras.camera_file import (
    CENTRED_PX,
    MAX_NORMALISED_FOCAL,
    MAX_NUMBER,
    StoredView,
    check_camera_count,
    make_pinhole,
)
from gsmerge.io.cameras.camera_source import CameraSource, StoredCameras, check_objects, number_errors, to_number
from gsmerge.io.cameras.view_layout import Entry
from gsmerge.io.formats.table import PLY, find_format
from gsmerge.io.image_names import natural_key, natural_order
from gsmerge.method.geometry.transforms import mean_pose_frame

FRAMES_FILE = "input_frame_idx.txt"  # of Long-LRM; lists the frames that the model saw
SHARP = "SHARP"  # ``source`` of the camera in SHARP's ``.ply``
_SHARP_ELEMENTS = ("extrinsic", "intrinsic", "image_size")  # SHARP's first versions do not write image_size


def list_shots(source: CameraSource) -> list[Entry]:
    """List the views of OpenSfM's largest reconstruction, each with its camera. OpenSfM calls views shots."""
    with number_errors(source.path, "expected reconstructions of 'cameras' and 'shots'"):
        largest = max(source.json, key=lambda entry: len(entry["shots"]))
        shots = dict(largest["shots"])
        cameras = largest["cameras"]
        check_camera_count(source.path, len(shots))
        for name, shot in shots.items():
            if shot["camera"] not in cameras:
                problem = f"view {name}: expected one of the 'cameras' in 'camera', found {shot['camera']!r}"
                raise SceneError(source.path, problem)
        if not all(isinstance(cameras[shot["camera"]], dict) for shot in shots.values()):
            raise TypeError("found a camera that is no object")
        return [Entry(shot, shared=cameras[shot["camera"]], name=name) for name, shot in shots.items()]


def list_keyframes(source: CameraSource) -> list[Entry]:
    """List the views in a folder of Polycam. Each view has a file, with a key for each number of its pose."""
    paths = natural_order(source.path.glob("*.json"))
    entries = list[Entry]()
    check_camera_count(source.path, len(paths))
    for path in paths:
        with number_errors(path, f"view {path.stem}: expected an object with t_00 to t_23, among others"):
            values = read_json(path)
            pose = [[values[f"t_{row}{column}"] for column in range(4)] for row in range(3)]
        entries.append(Entry({**values, "transform": pose}, name=path.stem, path=path))
    return entries


def list_path(source: CameraSource) -> list[Entry]:
    """List the views of a path of nerfstudio's viewer, which has vertical fields of view in degrees."""
    with number_errors(source.path, "expected a 'camera_path' of objects with 'fov'"):
        views = source.object["camera_path"]
        return [
            Entry({**view, "camera_angle_y": math.radians(to_number(view["fov"]))}, source.object) for view in views
        ]


def list_exported_cameras(source: CameraSource) -> list[Entry]:
    """List what `ns-export cameras` writes, with the intrinsics of the ``transforms.json`` beside it or the photos.

    Raise SceneError if there is no ``transforms.json``.
    """
    check_objects(source.path, source.json)
    max_folders = 8  # above a photo
    photo = source.path.parent / str(source.first.get("file_path"))
    captures = (folder / "transforms.json" for folder in (source.path.parent, *photo.parents[:max_folders]))
    capture = next(filter(os.path.isfile, captures), None)
    if capture is None:
        problem = "expected the capture's transforms.json with the intrinsics, which ns-export leaves out, found none"
        raise SceneError(source.path, problem, "copy it beside this file")
    shared = CameraSource(capture).object
    return [Entry(view, shared) for view in source.json]


def join_matrices(source: CameraSource) -> list[Entry]:
    """List WorldMirror's views from the lists of extrinsics and intrinsics, which belong together by ``camera_id``.

    ``camera_id`` is a number, or the stem of the image's name. Views whose ``camera_id`` is a number are sorted by it.
    Other views keep the order of the file. Raise SceneError if one of the lists lacks a view.
    """
    matrices = list[dict[str, Any]]()  # by ``camera_id``; of matrices with equal ids, the last is taken
    for key in ("extrinsics", "intrinsics"):
        entries: Sequence[Mapping[str, Any]] = source.object[key]
        if not isinstance(entries, list):
            raise SceneError(source.path, f"expected {key!r} to be a list, found something else")
        check_camera_count(source.path, len(entries))
        with number_errors(source.path, f"{key}: expected entries of 'camera_id' and 'matrix'"):
            matrices.append({str(entry["camera_id"]): entry["matrix"] for entry in entries})
    poses, Ks = matrices
    if poses.keys() != Ks.keys():
        single = sorted(poses.keys() ^ Ks.keys())[0]
        problem = f"expected extrinsics and intrinsics of the same cameras, found only one for {single}"
        raise SceneError(source.path, problem)
    names = sorted(poses, key=natural_key) if all(name.isdecimal() for name in poses) else list(poses)
    return [Entry({"extrinsics": poses[name], "intrinsics": Ks[name]}, name=name) for name in names]


def set_centred_size(source: CameraSource, views: list[StoredView]) -> list[StoredView]:
    """Set the size of all views to twice their principal point, if that size is whole and equal in all views."""
    sides = 2 * np.array([view.K for view in views])[:, :2, 2].reshape(-1, 2) if views else np.zeros((0, 2))
    first_size = np.abs(sides[:1]).clip(0, MAX_NUMBER).round()
    are_centred = len(sides) > 0 and bool((np.abs(sides - first_size) <= CENTRED_PX).all())
    if not are_centred or not (first_size > MAX_NORMALISED_FOCAL).all():
        return views
    size = int(first_size[0, 0]), int(first_size[0, 1])
    return [view._replace(size=size) for view in views]


def is_long_lrm(source: CameraSource) -> bool:
    """Return whether a JSON file has ``frames`` with ``w2c``, which only Long-LRM writes."""
    frames = source.object.get("frames")
    return bool(frames) and isinstance(frames, list) and all(isinstance(f, dict) and "w2c" in f for f in frames)


def move_to_gaussians(source: CameraSource, views: list[StoredView]) -> list[StoredView]:
    """Select the views that Long-LRM saw, and move them into the Gaussians' world: the frame of the views' mean pose.

    ``input_frame_idx.txt``, in the folder of the Gaussians or in that of the cameras, lists the views that the model
    saw. Without this file, all views are returned unchanged. Raise SceneError if the file has wrong numbers, or lists a
    frame that does not exist.
    """
    folder = source.path.parent
    if source.folder is not None and not (folder / FRAMES_FILE).is_file():
        folder = source.folder
    path = folder / FRAMES_FILE
    words = read_text(path).replace(",", " ").split(maxsplit=MAX_VIEWS) if path.is_file() else []
    if len(words) > MAX_VIEWS:
        raise SceneError(path, f"expected at most {MAX_VIEWS} numbers, found more")
    with number_errors(path, "expected numbers"):
        ids = [round(float(word)) for word in words]
    outside = next((i for i in ids if not 0 <= i < len(views)), None)
    if outside is not None:
        raise SceneError(path, f"expected frames 0 to {len(views) - 1}, found {outside:.6g}")
    if not ids:
        return views
    selected = [views[i] for i in ids]
    with number_errors(source.path, "expected poses of 4x4 numbers"):
        poses = np.array([view.pose for view in selected]).reshape(-1, 4, 4)
    with np.errstate(all="ignore"):  # the check of the cameras refuses overflows
        poses = mean_pose_frame(poses).move_viewmats(poses)
    return [view._replace(pose=pose) for view, pose in zip(selected, poses, strict=True)]


def read_sharp(source: CameraSource) -> StoredCameras | None:
    """Read the camera that SHARP writes into a ``.ply``; None if the ``.ply`` has no such camera.

    The width and height of the view are those of SHARP's grid of Gaussians. The grid is square, because SHARP stretches
    photos of any shape to a square. Raise SceneError if the numbers of the camera are damaged.
    """
    if find_format(source.path).read is not PLY.read:
        return None
    elements = source.ply
    present = [name for name in _SHARP_ELEMENTS if name in elements]
    if "vertex" not in elements or not {"extrinsic", "intrinsic"}.issubset(present):
        return None
    for element in (elements[name] for name in present):
        if element.count > 16 or len(element.columns) != 1 or element.has_lists:
            return None
    with np.errstate(all="ignore"):  # the check of all cameras refuses NaN
        numbers = {name: np.asarray([row[0] for row in elements[name].rows[:]], np.float64) for name in present}
    extrinsic = numbers["extrinsic"]
    intrinsic = numbers["intrinsic"]
    size = numbers.get("image_size", np.zeros(0))
    if len(intrinsic) == 4 and "image_size" not in numbers:  # first versions write focal lengths and size
        focal_lengths = intrinsic[:2]
        size = intrinsic[2:]
        intrinsic = make_pinhole(*focal_lengths, *(size / 2)).reshape(-1)
    sharp_layers = 2  # Gaussians in each cell of the grid, of a front and a back layer
    side = round((elements["vertex"].count / sharp_layers) ** 0.5)
    if sharp_layers * side * side != elements["vertex"].count or len(size) != 2 or not (size > 0).all():
        return None
    if len(extrinsic) not in (12, 16) or len(intrinsic) != 9:
        problem = f"expected 16 and 9 numbers of a camera, found {len(extrinsic)} and {len(intrinsic)}"
        raise SceneError(source.path, problem)
    pose = extrinsic.reshape(-1, 4).copy()
    K = intrinsic.reshape(3, 3)
    if len(extrinsic) == 12:  # first versions write the rotation column by column
        pose[:, :3] = pose[:, :3].T.copy()
    K = K * np.array([[side / size[0]], [side / size[1]], [1.0]])
    return StoredCameras([StoredView(source.path.stem, pose, K, (side, side))])
