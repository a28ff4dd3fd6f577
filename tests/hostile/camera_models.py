"""Camera files other than ``transforms.json`` that promise much: JSON of others, COLMAP models, pose lists."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.geometry import rotmat_to_quat
from gsmerge.kernels.matrices import invert

from .camera_files import set_first
from .case import EITHER, HEIGHT, READ, REFUSED, WIDTH, Case, Spoil, names, sparse, without_transforms

MILLION = "MILLION"  # stands for as many attributes, which take a second to name
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
    w2c = invert(c2w)
    frames = [{"file_path": name, "w2c": pose.tolist(), **common} for name, pose in zip(names(), w2c, strict=True)]
    return {"frames": frames}


def changed(make: Make, change: Callable[[Any], None]) -> Make:
    def both(c2w: np.ndarray, K: np.ndarray) -> Any:
        data = make(c2w, K)
        change(data)
        return data

    return both


def _other_json() -> dict[str, Case]:
    cases: dict[str, tuple[str, Make, tuple[int, ...]]] = {
        "INRIA as it is": ("cameras.json", inria, READ),
        "Long-LRM as it is": ("cameras.json", long_lrm, READ),
        "WorldMirror as it is": ("camera_params.json", world_mirror, READ),
        "INRIA of a huge width": ("cameras.json", changed(inria, set_first("width", 10**400)), EITHER),
        "INRIA of 20,000 cameras": ("cameras.json", repeated(inria), REFUSED),
    }
    for key in ("extrinsics", "intrinsics"):
        cases[f"WorldMirror {key} of 20,000 cameras"] = "camera_params.json", repeated(world_mirror, key), REFUSED
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


def many_numbers(folder: Path) -> None:
    """A file beside Long-LRM's cameras, of which a few numbers are expected."""
    in_place_of_transforms("cameras.json", long_lrm)(folder)
    (folder / "input_frame_idx.txt").write_text("0 " * 3_000_000)


def colmap(c2w: np.ndarray, K: np.ndarray, *, text: bool) -> tuple[bytes, bytes]:
    """The two files of a model, as text or binary."""
    params = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    poses = [np.array([*rotmat_to_quat(pose[None, :3, :3])[0], *pose[:3, 3]]) for pose in invert(c2w)]
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

    cameras = {f"count {n}": packed(0, "<Q", n) for n in (2**63, 2**64 - 1)}
    cameras |= {f"width {n}": packed(16, "<Q", n) for n in (60_000, 2**63)}
    images = {f"count {n}": packed(0, "<Q", n) for n in (2**63, 2**64 - 1)}
    images |= {f"{n} points": packed(84, "<Q", n) for n in (2**40, 2**61, 2**64 - 1)}
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
    many = b"".join(b"%d SIMPLE_PINHOLE 1 1 1 1 1\n" % i for i in range(20_000))
    digits = b"1 PINHOLE " + b"9" * 5000 + b" 16 20 20 12 8"
    million = b"0 1 0 0 0 0 0 0 1 a\n" * 1_000_000
    cases = {
        "COLMAP text as it is": Case(model(lambda c, i: (c, i), text=True), READ),
        "cameras.txt with a size of 5000 digits": Case(model(lambda c, i: (digits, i), text=True)),
        "cameras.txt with bytes": Case(model(lambda c, i: (bytes(range(256)), i), text=True)),
        "cameras.txt with 20,000 cameras": Case(model(lambda c, i: (many, i), text=True)),
        "images.txt with a million images": Case(model(lambda c, i: (c, million), text=True)),
    }
    for name in ("cameras.txt", "images.txt", "cameras.bin", "images.bin"):

        def spoil(folder: Path, name: str = name) -> None:
            model(lambda c, i: (c, i), text=name.endswith("txt"))(folder)
            sparse(folder / "sparse" / "0" / name, 2**33)

        cases[f"{name} of 8 GB of zeros"] = Case(spoil)
    return cases


def _pose_lists() -> dict[str, Case]:
    def spoil(change: Callable[[list[str]], list[str]]) -> Spoil:
        def both(folder: Path) -> None:
            c2w, _ = without_transforms(folder)
            lines = [" ".join(map(repr, pose[:3].reshape(-1).tolist())) for pose in c2w]
            (folder / "camera_poses.txt").write_text("\n".join(change(lines)), encoding="utf-8")
            (folder / "intrinsic.txt").write_text("38.755 38.755 12 8")

        return both

    changes: dict[str, Callable[[list[str]], list[str]]] = {
        "a line of 1 MB": lambda _: ["1 " * 2**19], "50,000 lines": lambda x: [x[1]] * 50_000,
        "a zero byte": lambda x: [x[0] + " \0", *x[1:]],
        "4,000,000 lines of one number": lambda x: [x[0], "1\n" * 4_000_000],
        "15,000,000 blank lines": lambda x: [*x, " \n" * 15_000_000],
        "15,000,000 comments": lambda x: [*x, "#\n" * 15_000_000],
    }  # fmt: skip
    cases = {f"pose list with {word}": Case(spoil(change), EITHER) for word, change in changes.items()}
    return cases | {"pose list as it is": Case(spoil(lambda x: x), READ)}


def _metashape() -> dict[str, Case]:
    """XML whose parts a parser copies, or goes through again and again."""
    pose = "<transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform>"
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    sensor = f'{size}<calibration class="adjusted"><f>38.755</f></calibration>'
    one = f'<camera sensor_id="0" label="view_000">{pose}</camera>'

    def chunk(sensors: str, cameras: str, more: str = "") -> str:
        return f"<document><chunk><sensors>{sensors}</sensors><cameras>{cameras}</cameras>{more}</chunk></document>"

    many = 400
    usual, address = f'<sensor id="0">{sensor}</sensor>', "u" * 1_000_000
    contents = {
        "nested sensors": chunk(
            "".join(f'<sensor id="{i}">{sensor}' for i in range(many)) + "<a/>" * 100_000 + "</sensor>" * many,
            "".join(f'<camera sensor_id="{i}">{pose}</camera>' for i in range(many)),
        ),
        "a million attributes": chunk(usual, one, f"<x {MILLION}/>"),
        "a namespace of 1 MB": chunk(usual, one, f"<x xmlns:a='{address}'>{'<a:b/>' * 100_000}</x>"),
        "names in a namespace of 1 MB": chunk(
            usual, one, f"<x xmlns:a='{address}'>{''.join(f'<a:b{i}/>' for i in range(3000))}</x>"
        ),
        "depth": chunk(usual, one, "<a>" * 400_000 + "</a>" * 400_000),
        "a component named by a quote": chunk(usual, one.replace("label", 'component_id="a\'b" label')),
        "an entity": "<!DOCTYPE x [<!ENTITY a 'aaaa'>]>" + chunk(usual, one, "&a;"),
    }

    def spoil(content: str) -> Spoil:
        def both(folder: Path) -> None:
            without_transforms(folder)
            attributes = " ".join(f"a{i}=''" for i in range(1_000_000)) if MILLION in content else ""
            (folder / "cameras.xml").write_text(content.replace(MILLION, attributes))

        return both

    return {f"Metashape with {word}": Case(spoil(content), EITHER) for word, content in contents.items()}


GROUPS = (_other_json, _binary, _text, _pose_lists, _metashape)
CASES = {f"cameras: {name}": case for group in GROUPS for name, case in group().items()}
CASES["cameras: input_frame_idx.txt with 3,000,000 numbers"] = Case(many_numbers, EITHER)
