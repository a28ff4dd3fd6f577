"""``transforms.json`` of much in little, of depth, and with places that are none."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .case import EITHER, READ, Case, Spoil, edit_json, sparse, write


def set_first(key: str, value: Any) -> Callable[[Any], None]:
    """Set a key of the first entry of a list of cameras, or of all frames."""

    def change(data: Any) -> None:
        (data[0] if isinstance(data, list) else data["frames"][0])[key] = value

    return change


def _transforms() -> dict[str, Case]:
    name = "transforms.json"
    places: dict[str, Any] = {
        "of 5000 letters": "x" * 5000, "with a zero byte": "a\0b", "with line breaks": "a\nb\r\nc",
        "that is the root": "/", "of half a letter": "\ud800", "with 5000 digits": "1" * 5000,
        "outside": "../../../../etc/passwd", "that is a device": "/dev/zero", "with an escape sequence": "\x1b[2J",
    }  # fmt: skip
    cases = {f"path {w}, no images": Case(without_images(all_places(v)), EITHER) for w, v in places.items()}
    for key, value in (("w", 10**400), ("fl_x", 1e300), ("cx", float("nan")), ("k1", 1e9)):
        cases[f"{key} of {str(value)[:9]}"] = Case(edit_json(name, set_key(key, value)), EITHER)
    fisheye = {"camera_model": "OPENCV_FISHEYE", "k1": 1e5}
    cases["fisheye k1 of 1e5"] = Case(edit_json(name, lambda data: data.update(fisheye)))
    cases["a pose of 1e200"] = Case(edit_json(name, set_first("transform_matrix", [[1e200] * 4] * 4)))
    cases["path with line breaks and no pose"] = Case(edit_json(name, no_pose("a\nb\r\n\x1b[2Jc")))
    return {
        **{f"transforms: {word}": replace(case, named=name) for word, case in cases.items()},
        **_raw_json(name),
        **_large(name),
    }


def set_key(key: str, value: Any) -> Callable[[Any], None]:
    return lambda data: data.update({key: value})


def all_places(value: Any) -> Callable[[Any], None]:
    def change(data: Any) -> None:
        for frame in data["frames"]:
            frame["file_path"] = value

    return change


def no_pose(value: str) -> Callable[[Any], None]:
    def change(data: Any) -> None:
        data["frames"][0] = {"file_path": value}

    return change


def without_images(change: Callable[[Any], None]) -> Spoil:
    """The images are not where they are looked for, so the camera file alone says where."""

    def spoil(folder: Path) -> None:
        (folder / "images").rename(folder / "elsewhere")
        edit_json("transforms.json", change)(folder)

    return spoil


def many_frames(data: Any) -> None:
    """Frames that say the same again and again."""
    frames = data["frames"] if isinstance(data, dict) else data
    frames[:] = (frames * 9998)[:9998]


def _raw_json(name: str) -> dict[str, Case]:
    frame = b'{"frames": [{"transform_matrix": '
    contents = {
        "100,000 brackets": b"[" * 100_000, "100,000 nested objects": b'{"a":' * 100_000,
        "a nested pose": frame + b"[" * 900 + b"]" * 900 + b"}]}", "a number of 10,000 digits": b"9" * 10_000,
    }  # fmt: skip
    cases = {f"{name}: {word}": Case(write(name, data), named=name) for word, data in contents.items()}
    cases[f"{name}: 4 GB of zeros"] = Case(lambda folder: sparse(folder / name, 2**32), named=name)
    cases[f"{name}: 9,998 frames of the same views"] = Case(edit_json(name, many_frames), EITHER)
    cases[f"{name}: 20,000 frames"] = Case(edit_json(name, multiplied(20_000 // 3)), named=name)
    cases[f"{name}: 300 frames"] = Case(edit_json(name, multiplied(100)), codes=(0, 3))
    return cases


def _large(name: str) -> dict[str, Case]:
    """What all frames share is large, and frames are many: neither is copied for the other."""
    pose = np.eye(4).tolist()
    shared: dict[str, Callable[[], dict[str, Any]]] = {
        "keys": lambda: {f"{i:x}": 0 for i in range(300_000)},
        "distortion": lambda: {"distortion_params": [0] * 1_000_000},
        "model": lambda: {"camera_model": "a" * 3_000_000}, "digits": lambda: {"fl_x": "1" * 3_000_000},
    }  # fmt: skip
    frames: dict[str, dict[str, Any]] = {"empty": {}, "with poses": {"transform_matrix": pose, "file_path": "a"}}
    cases = {}
    for word, make in shared.items():
        for kind, frame in frames.items():

            def spoil(folder: Path, make: Callable[[], dict[str, Any]] = make, frame: dict[str, Any] = frame) -> None:
                data = {"fl_x": 30, "cx": 12, "cy": 8, **make(), "frames": [frame] * 10_000}
                (folder / name).write_text(json.dumps(data))

            cases[f"{name}: large {word}, 10,000 frames {kind}"] = Case(spoil)
    deep = set_first("file_path", "a/" * 20_000 + "view_000.png")
    cases[f"{name}: a path of 20,000 folders"] = Case(edit_json(name, deep), READ)
    return cases


def multiplied(times: int) -> Callable[[Any], None]:
    def change(data: Any) -> None:
        data["frames"] = data["frames"] * times

    return change


CASES = _transforms()
