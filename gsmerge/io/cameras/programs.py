"""List the views of OpenSfM, Polycam and WorldMirror, which write the values of a view into several lists or files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import read_json
from gsmerge.io.cameras.camera_file import CENTRED_PX, MAX_NORMALISED_FOCAL, MAX_NUMBER, StoredView, check_camera_count
from gsmerge.io.cameras.camera_source import CameraSource, number_errors
from gsmerge.io.cameras.view_layout import Entry
from gsmerge.io.image_names import natural_key, natural_order


def list_shots(source: CameraSource) -> list[Entry]:
    """List the views of OpenSfM's largest reconstruction, each with its camera. OpenSfM calls views shots."""
    with number_errors(source.path, "expected reconstructions of 'cameras' and 'shots'"):
        largest = max(source.json, key=lambda entry: len(entry["shots"]))
        shots, cameras = dict(largest["shots"]), largest["cameras"]
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
    paths, entries = natural_order(source.path.glob("*.json")), list[Entry]()
    check_camera_count(source.path, len(paths))
    for path in paths:
        with number_errors(path, f"view {path.stem}: expected an object with t_00 to t_23, among others"):
            values = read_json(path)
            pose = [[values[f"t_{row}{column}"] for column in range(4)] for row in range(3)]
        entries.append(Entry({**values, "transform": pose}, name=path.stem, path=path))
    return entries


def join_matrices(source: CameraSource) -> list[Entry]:
    """List WorldMirror's views from the lists of extrinsics and intrinsics, which belong together by ``camera_id``.

    ``camera_id`` is a number, or the stem of the image's name. Views whose ``camera_id`` is a number are sorted by it.
    Other views keep the order of the file. Raise SceneError if one of the lists lacks a view.
    """
    poses, Ks = (_matrices_by_id(source, key) for key in ("extrinsics", "intrinsics"))
    if poses.keys() != Ks.keys():
        single = sorted(poses.keys() ^ Ks.keys())[0]
        problem = f"expected extrinsics and intrinsics of the same cameras, found only one for {single}"
        raise SceneError(source.path, problem)
    names = sorted(poses, key=natural_key) if all(name.isdecimal() for name in poses) else list(poses)
    return [Entry({"extrinsics": poses[name], "intrinsics": Ks[name]}, name=name) for name in names]


def _matrices_by_id(source: CameraSource, key: str) -> dict[str, Any]:
    """Return the matrices of the list ``key`` by their ``camera_id``. Of matrices with equal ids, the last is taken."""
    entries: Sequence[Mapping[str, Any]] = source.object[key]
    if not isinstance(entries, list):
        raise SceneError(source.path, f"expected {key!r} to be a list, found something else")
    check_camera_count(source.path, len(entries))
    with number_errors(source.path, f"{key}: expected entries of 'camera_id' and 'matrix'"):
        return {str(entry["camera_id"]): entry["matrix"] for entry in entries}


def set_centred_size(source: CameraSource, views: list[StoredView]) -> list[StoredView]:
    """Set the size of all views to twice their principal point, if that size is whole and equal in all views."""
    sides = 2 * np.array([view.K for view in views])[:, :2, 2].reshape(-1, 2) if views else np.zeros((0, 2))
    first_size = np.abs(sides[:1]).clip(0, MAX_NUMBER).round()
    are_centred = len(sides) > 0 and bool((np.abs(sides - first_size) <= CENTRED_PX).all())
    if not are_centred or not (first_size > MAX_NORMALISED_FOCAL).all():
        return views
    size = int(first_size[0, 0]), int(first_size[0, 1])
    return [view._replace(size=size) for view in views]
