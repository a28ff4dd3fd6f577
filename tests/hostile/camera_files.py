"""``transforms.json`` with every kind of nonsense in it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from .case import EITHER, HEIGHT, NUMBERS, READ, VIEWS, WIDTH, Case, Spoil, both, edit_json, remove, sparse, write


def set_first(key: str, value: Any) -> Callable[[Any], None]:
    """Set a key of the first entry of a list of cameras, or of all frames."""

    def change(data: Any) -> None:
        (data[0] if isinstance(data, list) else data["frames"][0])[key] = value

    return change


def set_pose(value: Any) -> Callable[[Any], None]:
    def change(data: Any) -> None:
        data["frames"][1]["transform_matrix"][0][3] = value

    return change


def _transforms() -> dict[str, Case]:
    name = "transforms.json"
    poses: dict[str, Any] = {
        "no rows": [], "three numbers": [1, 2, 3], "ragged rows": [[1, 2], [3]], "a number": 5, "null": None,
        "words": [["a"] * 4] * 4, "zeros": [[0] * 4] * 4, "1e200": [[1e200] * 4] * 4, "5 x 5": [[0] * 5] * 5,
        "100,000 numbers": [[0] * 100_000], "a reflection": np.diag([1, 1, -1, 1]).tolist(),
        "the signs of 1e200": [[1e200, -1e200, 0, 0], [1e200, 1e200, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
    }  # fmt: skip
    contents: dict[str, Any] = {
        "frames that are a number": {"frames": 5}, "frames that are text": {"frames": "abc"},
        "frames that are numbers": {"frames": [1, 2]}, "no frames": {"frames": []}, "an empty list": [],
        "a list of lists": [[], []], "a number": 5, "null": None, "an empty object": {},
    }  # fmt: skip
    places: dict[str, Any] = {
        "of 5000 letters": "x" * 5000, "with a zero byte": "a\0b", "with line breaks": "a\nb\r\nc", "empty": "",
        "that is the root": "/", "that is a dot": ".", "that is two dots": "..", "of half a letter": "\ud800",
        "with 5000 digits": "1" * 5000, "that is a list": ["a"], "outside": "../../../../etc/passwd",
        "that is a device": "/dev/zero", "with an escape sequence": "\x1b[2J", "of a folder": "images/",
    }  # fmt: skip
    cases = {f"width {word}": Case(edit_json(name, set_key("w", v)), EITHER) for word, v in NUMBERS.items()}
    cases |= {f"focal length {word}": Case(edit_json(name, set_key("fl_x", v)), EITHER) for word, v in NUMBERS.items()}
    for key in ("k1", "k3", "p2"):
        lens = {word: set_lens({key: v}) for word, v in NUMBERS.items()}
        cases |= {f"lens {key} {word}": Case(edit_json(name, change), EITHER) for word, change in lens.items()}
        for value in (np.nan, np.inf, 1e9, -1e9):
            cases[f"lens {key} of {value:g}"] = Case(edit_json(name, set_lens({key: value})))
    fisheye = {"camera_model": "OPENCV_FISHEYE"}
    cases["fisheye k2 of NaN"] = Case(edit_json(name, set_lens({**fisheye, "k2": np.nan})))
    cases["fisheye k1 of 1e5"] = Case(edit_json(name, set_lens({**fisheye, "k1": 1e5})))
    cases["lens of NaN in a list"] = Case(edit_json(name, set_lens({"distortion_params": [0, np.nan, 0, 0]})))
    for key, value in (("cx", 1e9), ("cy", -1e9), ("fl_x", 1e11), ("cx", np.nan)):
        cases[f"{key} of {value:g}"] = Case(edit_json(name, set_key(key, value)))
    cases |= {f"position {word}": Case(edit_json(name, set_pose(v)), EITHER) for word, v in NUMBERS.items()}
    cases |= {f"pose of {w}": Case(edit_json(name, set_first("transform_matrix", v))) for w, v in poses.items()}
    cases |= {f"with {word}": Case(write(name, json.dumps(data))) for word, data in contents.items()}
    cases |= {f"path {w}, no images": Case(without_images(all_places(v)), EITHER) for w, v in places.items()}
    wrong_lens = edit_json(name, set_key("camera_model", "EQUIRECTANGULAR"))
    cases["unknown lens"] = Case(wrong_lens, says=("EQUIRECTANGULAR", "undistort"))
    a_third = (f"2 x {HEIGHT} x {WIDTH} = {2 * HEIGHT * WIDTH}", str(VIEWS * HEIGHT * WIDTH), "3 views")
    cases["path with line breaks and no pose"] = Case(edit_json(name, no_pose("a\nb\r\n\x1b[2Jc")))
    lost = both(remove(name), remove("images"))
    return {
        **{f"transforms: {word}": replace(case, named=name) for word, case in cases.items()},
        **_raw_json(name),
        **_large(name),
        "transforms: a frame missing": Case(
            edit_json(name, lambda data: data["frames"].pop() and None), named="scene.ply", says=a_third
        ),
        "transforms: none, no images": Case(lost, codes=(0,)),  # the rows are a grid
    }


def set_key(key: str, value: Any) -> Callable[[Any], None]:
    return lambda data: data.update({key: value})


def set_lens(values: dict[str, Any]) -> Callable[[Any], None]:
    return lambda data: data.update({"camera_model": "OPENCV", **values})


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


def _raw_json(name: str) -> dict[str, Case]:
    frame = b'{"frames": [{"transform_matrix": '
    contents = {
        "nothing": b"", "zero bytes": b"\0" * 1000, "half an object": b"{", "not UTF-8": b'{"\xff": 1}',
        "UTF-16": '{"frames": []}'.encode("utf-16"), "100,000 brackets": b"[" * 100_000,
        "100,000 nested lists": b"[" * 100_000 + b"]" * 100_000, "100,000 nested objects": b'{"a":' * 100_000,
        "a nested pose": frame + b"[" * 900 + b"]" * 900 + b"}]}", "a number of 10,000 digits": b"9" * 10_000,
        "a key twice": b'{"frames": 1, "frames": 2}',
    }  # fmt: skip
    says = {"half an object": ("JSON",)}
    cases = {f"{name}: {w}": Case(write(name, data), (3,), name, says.get(w, ())) for w, data in contents.items()}
    cases[f"{name}: 4 GB of zeros"] = Case(lambda folder: sparse(folder / name, 2**32), named=name)
    cases[f"{name}: cut in the middle"] = Case(halved(name), named=name)
    cases[f"{name}: with a byte order mark"] = Case(marked(name), READ)
    cases[f"{name}: 20,000 frames"] = Case(edit_json(name, multiplied(20_000 // 3)), named=name)
    cases[f"{name}: 3000 frames"] = Case(edit_json(name, multiplied(1000)))
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
    for key, value in (("fl_x", True), ("w", True), ("cx", False), ("k1", True), ("distortion_params", [True])):
        said = (name, str(value if isinstance(value, bool) else value[0]).lower())
        cases[f"{name}: {key} of {value}"] = Case(edit_json(name, set_key(key, value)), says=said)
    cases[f"{name}: a pose of true"] = Case(edit_json(name, set_pose(True)), says=(name, "view_001", "true"))
    for key in ("w", "h", "cx", "k1", "camera_model", "distortion_params", "is_fisheye"):
        cases[f"{name}: {key} of null"] = Case(edit_json(name, set_first(key, None)), READ)
    deep = set_first("file_path", "a/" * 20_000 + "view_000.png")
    cases[f"{name}: a path of 20,000 folders"] = Case(edit_json(name, deep), READ)
    return cases


def halved(name: str) -> Spoil:
    def spoil(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: len(data) // 2])

    return spoil


def marked(name: str) -> Spoil:
    return lambda folder: write(name, b"\xef\xbb\xbf" + (folder / name).read_bytes())(folder)


def multiplied(times: int) -> Callable[[Any], None]:
    def change(data: Any) -> None:
        data["frames"] = data["frames"] * times

    return change


CASES = _transforms()
