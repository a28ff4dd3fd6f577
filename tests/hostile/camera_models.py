"""Camera files other than ``transforms.json``, spoiled: JSON of others, COLMAP models, pose lists."""

from __future__ import annotations

import base64
import json
import struct
import textwrap
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from tiny_scene import wxyz_of

from .camera_files import set_first
from .case import EITHER, HEIGHT, NUMBERS, READ, WIDTH, Case, Spoil, names, sparse, without_transforms

Make = Callable[[np.ndarray, np.ndarray], Any]


def in_place_of_transforms(name: str, make: Make) -> Spoil:
    def spoil(folder: Path) -> None:
        made = make(*without_transforms(folder))
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(made if isinstance(made, bytes) else made.encode() if isinstance(made, str) else dump(made))

    return spoil


def dump(data: Any) -> bytes:
    return json.dumps(data).encode()


def inria(c2w: np.ndarray, K: np.ndarray) -> list[dict[str, Any]]:
    common = {"fx": K[0, 0], "fy": K[1, 1], "width": WIDTH, "height": HEIGHT}
    return [
        {"img_name": name, "position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist(), **common}
        for name, pose in zip(names(), c2w, strict=True)
    ]


def world_mirror(c2w: np.ndarray, K: np.ndarray) -> dict[str, Any]:
    poses = [{"camera_id": name, "matrix": pose.tolist()} for name, pose in zip(names(), c2w, strict=True)]
    return {"extrinsics": poses, "intrinsics": [{"camera_id": name, "matrix": K.tolist()} for name in names()]}


def long_lrm(c2w: np.ndarray, K: np.ndarray) -> dict[str, Any]:
    common = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": WIDTH, "h": HEIGHT}
    w2c = np.linalg.inv(c2w)
    frames = [{"file_path": name, "w2c": pose.tolist(), **common} for name, pose in zip(names(), w2c, strict=True)]
    return {"frames": frames}


def changed(make: Make, change: Callable[[Any], None]) -> Make:
    def both(c2w: np.ndarray, K: np.ndarray) -> Any:
        data = make(c2w, K)
        change(data)
        return data

    return both


def matrix(side: str, value: Any) -> Callable[[Any], None]:
    return lambda data: data[side][0].update(matrix=value)


def _other_json() -> dict[str, Case]:
    cases: dict[str, tuple[str, Make, tuple[int, ...]]] = {
        "INRIA as it is": ("cameras.json", inria, READ),
        "Long-LRM as it is": ("cameras.json", long_lrm, READ),
        "WorldMirror as it is": ("camera_params.json", world_mirror, READ),
    }
    for word, value in NUMBERS.items():
        for key in ("position", "width"):
            cases[f"INRIA {key} {word}"] = "cameras.json", changed(inria, set_first(key, value)), EITHER
        for key in ("w2c", "h"):
            cases[f"Long-LRM {key} {word}"] = "cameras.json", changed(long_lrm, set_first(key, value)), EITHER
        for key, side in (("extrinsics", 4), ("intrinsics", 3)):
            change = matrix(key, [[value] * side] * side)
            cases[f"WorldMirror {key} {word}"] = "camera_params.json", changed(world_mirror, change), (3,)
    odd = {"without a last row": np.diag([20.0, 20, 0]), "of 1e-300": np.diag([1e-300, 1e-300, 1])}
    for word, K in odd.items():
        change = matrix("intrinsics", K.tolist())
        cases[f"WorldMirror intrinsics {word}"] = "camera_params.json", changed(world_mirror, change), (3,)
    entries: dict[str, Any] = {"a list of numbers": [1, 2], "null": None, "an object": {"a": 1}, "one text": "abc"}
    for word, entry in entries.items():
        wrong: Callable[[Any], None] = lambda data, entry=entry: data.update(extrinsics=entry)  # noqa: E731
        cases[f"WorldMirror poses as {word}"] = "camera_params.json", changed(world_mirror, wrong), (3,)
    for key in ("extrinsics", "intrinsics"):
        cases[f"WorldMirror {key} of 20,000 cameras"] = "camera_params.json", repeated(world_mirror, key), (3,)
    cases["INRIA of 20,000 cameras"] = "cameras.json", repeated(inria), (3,)
    for name in ("camera_params.json", "stray.json"):
        cases[f"{name} with camera_id of 5,000 digits"] = name, changed(world_mirror, long_ids), EITHER
    return {word: Case(in_place_of_transforms(name, make), codes, name) for word, (name, make, codes) in cases.items()}


def long_ids(data: Any) -> None:
    for side in data.values():
        for i, entry in enumerate(side):
            entry["camera_id"] = str(i) * 5000


def repeated(make: Make, key: str = "") -> Make:
    def many(c2w: np.ndarray, K: np.ndarray) -> Any:
        data = make(c2w, K)
        return {**data, key: data[key][:1] * 20_000} if key else data[:1] * 20_000

    return many


def _beside_long_lrm() -> dict[str, Case]:
    def spoil(name: str, content: str) -> Spoil:
        def both(folder: Path) -> None:
            in_place_of_transforms("cameras.json", long_lrm)(folder)
            (folder / name).write_text(content)

        return both

    contents = {
        "input_frame_idx.txt": ["nan", "-1", "7", "1e300", "a b", "", "0 0 0", "0 " * 3_000_000],
        "pos_avg_inv.txt": ["0 " * 16, "1 " * 15, "nan " * 16, "1e200 " * 16, "x"],
        "scene_scale.txt": ["0", "-1", "inf", "1e-320", "1e300", "1 2", ""],
    }
    return {
        f"{name} with {text[:8]!r}": Case(spoil(name, text), EITHER)
        for name, texts in contents.items()
        for text in texts
    }


def colmap(c2w: np.ndarray, K: np.ndarray, *, text: bool) -> tuple[bytes, bytes]:
    """The two files of a model, as text or binary."""
    params = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    poses = [np.array([*wxyz_of(pose[None, :3, :3])[0], *pose[:3, 3]]) for pose in np.linalg.inv(c2w)]
    if text:
        lines = [
            f"{i} {' '.join(map(repr, pose.tolist()))} 1 {name}.png\n\n"
            for i, (pose, name) in enumerate(zip(poses, names(), strict=True))
        ]
        return f"1 PINHOLE {WIDTH} {HEIGHT} {' '.join(map(str, params))}\n".encode(), "".join(lines).encode()
    images = struct.pack("<Q", len(poses))
    for i, (pose, name) in enumerate(zip(poses, names(), strict=True)):
        images += struct.pack("<i7di", i, *pose, 1) + f"{name}.png".encode() + b"\0" + struct.pack("<Q", 0)
    return struct.pack("<QiiQQ4d", 1, 1, 1, WIDTH, HEIGHT, *params), images


def model(change: Callable[[bytes, bytes], tuple[bytes, bytes]], *, text: bool) -> Spoil:
    def spoil(folder: Path) -> None:
        both = change(*colmap(*without_transforms(folder), text=text))
        place = folder / "sparse" / "0"
        place.mkdir(parents=True)
        for name, data in zip(("cameras", "images"), both, strict=True):
            (place / f"{name}{'.txt' if text else '.bin'}").write_bytes(data)

    return spoil


def _binary() -> dict[str, Case]:
    def packed(at: int, form: str, *values: object) -> Callable[[bytes], bytes]:
        return lambda data: data[:at] + struct.pack(form, *values) + data[at + struct.calcsize(form) :]

    cameras = {f"cut to {n}": (lambda data, n=n: data[:n]) for n in (0, 7, 8, 12, 31, 32, 63)}
    cameras |= {f"count {n}": packed(0, "<Q", n) for n in (0, 2, 2**63, 2**64 - 1)}
    cameras |= {f"model {n}": packed(12, "<i", n) for n in (-1, 5, 11, 2**31 - 1)}
    cameras |= {f"width {n}": packed(16, "<Q", n) for n in (0, 60_000, 2**31, 2**63, 2**64 - 1)}
    cameras |= {f"focal length {x}": packed(32, "<d", x) for x in (np.nan, np.inf, -1.0, 0.0, 1e300)}
    ends = [0, 8, 12, 20, 71, 72, 80, 84, 85, 92]
    images = {f"cut to {n}": (lambda data, n=n: data[:n]) for n in ends}
    images |= {f"count {n}": packed(0, "<Q", n) for n in (0, 4, 2**63, 2**64 - 1)}
    images |= {f"{n} points": packed(84, "<Q", n) for n in (1, 2**40, 2**61, 2**64 - 1)}
    images |= {f"rotation {x}": packed(12, "<4d", x, x, x, x) for x in (np.nan, np.inf, 0.0, 1e300)}
    images |= {f"position {x}": packed(44, "<d", x) for x in (np.nan, np.inf, 1e300)}
    images["a million images"] = lambda data: struct.pack("<Q", 10**6) + data[8:] * 330_000
    images["a name of 1 MB"] = lambda data: data[:72] + b"x" * 2**20 + data[72:]
    images["a name that is not UTF-8"] = packed(72, "<2B", 255, 254)
    images["a name with line breaks"] = packed(72, "<3B", 10, 13, 27)
    cases = {
        f"cameras.bin, {w}": Case(model(lambda c, i, f=f: (f(c), i), text=False), EITHER) for w, f in cameras.items()
    }
    cases |= {
        f"images.bin, {w}": Case(model(lambda c, i, f=f: (c, f(i)), text=False), EITHER) for w, f in images.items()
    }
    return cases | {"COLMAP binary as it is": Case(model(lambda c, i: (c, i), text=False), READ)}


def _text() -> dict[str, Case]:
    cases = {"COLMAP text as it is": Case(model(lambda c, i: (c, i), text=True), READ)}
    lines = {
        "no numbers": b"1 PINHOLE a b c d e f", "too few": b"1 PINHOLE", "NaN": b"1 PINHOLE 24 16 nan nan nan nan",
        "an unknown model": b"1 MAGIC 24 16 1 2 3 4", "a distorted number": b"1 OPENCV 24 16 20 20 12 8 .1. 0 0 0",
        "a size of 400 digits": b"1 PINHOLE 1%s 16 20 20 12 8" % (b"0" * 400),
        "a size of 10^30": b"1 PINHOLE 1%s 16 20 20 12 8" % (b"0" * 30), "a size of 5000 digits": b"1 PINHOLE "
        + b"9" * 5000 + b" 16 20 20 12 8", "bytes": bytes(range(256)), "nothing": b"", "half a size": b"1 PINHOLE 24.5 "
        b"16 20 20 12 8", "a negative size": b"1 PINHOLE -24 -16 20 20 12 8",
    }  # fmt: skip
    for word, line in lines.items():
        cases[f"cameras.txt with {word}"] = Case(model(lambda c, i, line=line: (line, i), text=True))
    many = b"".join(b"%d SIMPLE_PINHOLE 1 1 1 1 1\n" % i for i in range(20_000))
    cases["cameras.txt with 20,000 cameras"] = Case(model(lambda c, i: (many, i), text=True))
    million = b"0 1 0 0 0 0 0 0 1 a\n"
    cases["images.txt with a million images"] = Case(model(lambda c, i: (c, million * 1_000_000), text=True))
    lines = {
        "nothing": b"", "one line": b"1 2 3", "words": b"a b c d e f g h i j", "bytes": bytes(range(256)),
        "an unknown camera": b"0 1 0 0 0 0 0 0 77 view_000.png\n\n", "inf": b"0 inf inf inf inf 0 0 0 1 a\n\n",
        "NaN": b"0 nan 0 0 0 0 0 0 1 a\n\n",
    }  # fmt: skip
    for word, line in lines.items():
        cases[f"images.txt with {word}"] = Case(model(lambda c, i, line=line: (c, line), text=True))
    for name in ("cameras.txt", "images.txt", "cameras.bin", "images.bin"):

        def spoil(folder: Path, name: str = name) -> None:
            model(lambda c, i: (c, i), text=name.endswith("txt"))(folder)
            sparse(folder / "sparse" / "0" / name, 2**33)

        cases[f"{name} of 8 GB of zeros"] = Case(spoil)
    lens = b"1 OPENCV 24 16 38.755 38.755 12 8 .1 0 0 0"
    for value in ("nan", "inf", "1e9"):
        bad = lens.replace(b" .1 ", f" {value} ".encode())
        cases[f"cameras.txt with a lens of {value}"] = Case(model(lambda c, i, bad=bad: (bad, i), text=True))
        packed = struct.pack("<QiiQQ8d", 1, 1, 4, WIDTH, HEIGHT, 38.755, 38.755, 12, 8, 0, float(value), 0, 0)
        cases[f"cameras.bin with a lens of {value}"] = Case(model(lambda c, i, p=packed: (p, i), text=False))
    cases["cameras.txt with a lens"] = Case(model(lambda c, i: (lens, i), text=True), READ)
    return cases


def _pose_lists() -> dict[str, Case]:
    def spoil(change: Callable[[list[str]], list[str]], intrinsics: str = "38.755 38.755 12 8") -> Spoil:
        def both(folder: Path) -> None:
            c2w, _ = without_transforms(folder)
            lines = [" ".join(map(repr, pose[:3].reshape(-1).tolist())) for pose in c2w]
            (folder / "camera_poses.txt").write_text("\n".join(change(lines)), encoding="utf-8")
            (folder / "intrinsic.txt").write_text(intrinsics)

        return both

    changes: dict[str, Callable[[list[str]], list[str]]] = {
        "a word": lambda x: [*x[:2], x[2].replace(" ", " x ", 1)], "a number less": lambda x: [*x[:2], x[2][:40]],
        "NaN": lambda x: ["nan " * 12, *x[1:]], "inf": lambda x: ["inf " * 12, *x[1:]],
        "1e300": lambda x: ["1e300 " * 12, *x[1:]], "zeros": lambda x: ["0 " * 12, *x[1:]],
        "nothing": lambda _: [], "empty lines": lambda _: [""] * 1000, "a line of 1 MB": lambda _: ["1 " * 2**19],
        "50,000 lines": lambda x: [x[1]] * 50_000, "a zero byte": lambda x: [x[0] + " \0", *x[1:]],
        "4,000,000 lines of one number": lambda x: [x[0], "1\n" * 4_000_000],
    }  # fmt: skip
    cases = {f"pose list with {word}": Case(spoil(change)) for word, change in changes.items()}
    for text in ("", "nan nan nan nan", "1 2", "a b c d", "0 0 0 0", "1e300 1e300 0 0", "1 1 1 1\n1 1 1 1"):
        cases[f"pose list with intrinsics {text!r}"] = Case(spoil(lambda x: x, text), EITHER)
    cases["pose list as it is"] = Case(spoil(lambda x: x), READ)
    return cases


def _embedded() -> dict[str, Case]:
    def spoil(change: Callable[[bytes], bytes] = lambda text: text, before: int = 0) -> Spoil:
        """The cameras inside the .ply, after so many bytes of other comments."""

        def both(folder: Path) -> None:
            text = zlib.compress(change((folder / "transforms.json").read_bytes()), 9)
            (folder / "transforms.json").unlink()
            wrapped = textwrap.wrap(base64.b64encode(text).decode(), 900)
            lines = [b"x" * 91] * (before // 100) + [b"gsmerge cameras: " + line.encode() for line in wrapped]
            start, end, rest = (folder / "scene.ply").read_bytes().partition(b"element vertex")
            comments = b"".join(b"comment " + line + b"\n" for line in lines)
            (folder / "scene.ply").write_bytes(start + comments + end + rest)

        return both

    cases = {f"after {size} bytes": Case(spoil(before=size), READ) for size in (0, 3_900, 4_000, 8_100, 60_000)}
    texts: dict[str, Callable[[bytes], bytes]] = {
        "of empty lists": lambda _: b'{"frames":[' + b"[]," * (10 << 20) + b"[]]}",
        "of wide letters": lambda _: '{"a":"\U0001f600'.encode() + b"a" * (16 << 20) + b'"}',
        "of nested lists": lambda _: b"[" * 100_000, "of spaces": lambda _: b" " * (32 << 20),
        "not UTF-8": lambda _: b'{"\xff":1}', "of nothing": lambda _: b"",
    }  # fmt: skip
    cases |= {word: Case(spoil(change), (3,), "scene.ply") for word, change in texts.items()}
    return {f"inside the ply, {word}": case for word, case in cases.items()}


GROUPS = (_embedded, _other_json, _beside_long_lrm, _binary, _text, _pose_lists)
CASES = {f"cameras: {name}": case for group in GROUPS for name, case in group().items()}
