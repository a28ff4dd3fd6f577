"""Damages of cameras in JSON repeat what is little, nest deep, and name places that are none."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .case import Change, Damage, accept, allow, refuse
from .changes import change_beside, drop_json, edit_json, set_json, write_file, write_json
from .sounds import NAMES

MOST = 10_000  # cameras of a file


def edit_frames(change: Callable[[dict[str, Any]], object]) -> Change:
    """Change every frame."""

    def each(data: dict[str, Any]) -> None:
        for frame in data["frames"]:
            change(frame)

    return edit_json(each)


def repeat_cameras(times: int, key: str = "") -> Change:
    """Repeat the cameras, or one list of them, that many times."""

    def change(data: Any) -> None:
        cameras = data[key] if key else data
        cameras[:] = cameras * times

    return edit_json(change)


def move_photos(change: Change) -> Change:
    """Move photos from where they are looked for, so that the file alone says where they are."""

    def both(path: Path) -> None:
        (path.parent / "images").rename(path.parent / "elsewhere")
        change(path)

    return both


def write_large(shared: dict[str, Any], frame: dict[str, Any]) -> Change:
    """Write many frames with much that all share: neither is copied for the other."""
    data = {"fl_x": 30, "cx": 12, "cy": 8, **shared, "frames": [frame] * MOST}
    return lambda path: write_file(path, json.dumps(data))


def _large() -> dict[str, Damage]:
    shared: dict[str, dict[str, Any]] = {
        "300,000 keys": {f"{i:x}": 0 for i in range(300_000)},
        "a million distortion_params": {"distortion_params": [0] * 1_000_000},
        "a camera_model of 3 MB": {"camera_model": "a" * 3_000_000},
        "fl_x of 3,000,000 digits": {"fl_x": "1" * 3_000_000},
    }  # fmt: skip
    kinds = {"without poses": {}, "with poses": {"transform_matrix": np.eye(4).tolist(), "file_path": "a"}}
    return {
        f"{word} for 10,000 frames {kind}": refuse(write_large(data, frame), slow=True)
        for word, data in shared.items()
        for kind, frame in kinds.items()
    }


def of_transforms() -> dict[str, Damage]:
    places = {
        "of 5,000 letters": "x" * 5000, "with a zero byte": "a\0b", "with line breaks": "a\nb\r\nc",
        "that is the root folder": "/", "of half a letter": "\ud800", "of 5,000 digits": "1" * 5000,
        "outside the folder": "../../../../etc/passwd", "that is a device": "/dev/zero",
        "with an escape sequence": "\x1b[2J",
    }  # fmt: skip
    damages = {
        f"a photo's path {word}": allow(move_photos(edit_frames(lambda frame, v=value: frame.update(file_path=v))))
        for word, value in places.items()
    }
    for key, value in (("w", 10**400), ("fl_x", 1e300), ("cx", float("nan")), ("k1", 1e9)):
        damages[f"{key} of {value if key != 'w' else '400 digits'}"] = allow(set_json(key, value=value))
    fisheye = {"camera_model": "OPENCV_FISHEYE", "k1": 1e5}
    nested = b'{"frames": [{"transform_matrix": ' + b"[" * 900 + b"]" * 900 + b"}]}"
    deep = "a/" * 20_000 + NAMES[0]
    return damages | {
        "a fisheye's k1 of 1e5": refuse(edit_json(lambda data: data.update(fisheye)), in_scene=True),
        "a pose of 1e200": refuse(set_json("frames", 0, "transform_matrix", value=[[1e200] * 4] * 4)),
        "a photo's path with line breaks and no pose": refuse(
            set_json("frames", 0, value={"file_path": "a\nb\r\n\x1b[2Jc"})
        ),
        "a pose of 900 nested lists": refuse(write_json(nested)),
        "300 frames": allow(repeat_cameras(100, "frames")),
        "9,999 frames": allow(repeat_cameras(3333, "frames"), slow=True),
        "20,001 frames": refuse(repeat_cameras(6667, "frames"), slow=True),
        "a photo's path of 20,000 folders": accept(set_json("frames", 0, "file_path", value=deep), slow=True),
        **_large(),
    }


def lengthen_ids(data: dict[str, Any]) -> None:
    for side in data.values():
        for i, entry in enumerate(side):
            entry["camera_id"] = str(i) * 5000


def rename_stray(change: Change) -> Change:
    """Change the file under another name, by which no program has cameras."""
    return lambda path: change(path.rename(path.with_name("stray.json")))


MANY = repeat_cameras(2 * MOST // 3 + 1)
DAMAGES = {
    "transforms.json": of_transforms(),
    "Blender": {
        "no width of the photos": refuse(drop_json("w"), "'w'", "'h'", place="transforms.json: view 0.png"),
        "a camera angle of 0": refuse(set_json("camera_angle_x", value=0), "finite",
                                      place="transforms.json: view 0.png"),
    },
    "INRIA": {
        "a width of 400 digits": allow(set_json(0, "width", value=10**400)), "20,001 cameras": refuse(MANY, slow=True),
    },
    "WorldMirror": {
        **{f"20,001 {key}": refuse(repeat_cameras(2 * MOST // 3 + 1, key)) for key in ("extrinsics", "intrinsics")},
        "camera_id of 5,000 digits": allow(edit_json(lengthen_ids)),
        "camera_id of 5,000 digits in a stray file": allow(rename_stray(edit_json(lengthen_ids))),
    },
    "Long-LRM": {
        "3,000,000 numbers in input_frame_idx.txt": allow(
            change_beside("input_frame_idx.txt", lambda path: write_file(path, "0 " * 3_000_000)), slow=True
        ),
    },
}  # fmt: skip
