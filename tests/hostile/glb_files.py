"""Binary glTF of Gaussians that promises much, or goes round in circles."""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .case import EITHER, READ, Case, Spoil

NAME = "KHR_gaussian_splatting"
SPZ = f"{NAME}_compression_spz_2"
PARTS, PART_GAUSSIANS = 40, 600_000  # parts that each keep to what a file may take, and together do not
DEEP = 100_000  # brackets, or nodes in one another


def bytes_of(change: Callable[[bytes], bytes]) -> Spoil:
    """The scene as a ``.glb`` of other bytes."""

    def spoil(folder: Path) -> Sequence[object]:
        from gsmerge.io import read_ply, write_gaussians

        path = folder / "scene.glb"
        write_gaussians(path, read_ply(folder / "scene.ply").gaussians)
        path.write_bytes(change(path.read_bytes()))
        return [path]

    return spoil


def text(change: Callable[[bytes], bytes]) -> Spoil:
    """The same with other JSON before the same numbers."""

    def replace(data: bytes) -> bytes:
        (length,) = struct.unpack_from("<I", data, 12)
        changed = change(data[20 : 20 + length])
        changed += b" " * (-len(changed) % 4)
        rest = struct.pack("<I4s", len(changed), b"JSON") + changed + data[20 + length :]
        return struct.pack("<4sII", b"glTF", 2, 12 + len(rest)) + rest

    return bytes_of(replace)


def document(change: Callable[[dict[str, Any]], object]) -> Spoil:
    def edit(data: bytes) -> bytes:
        parsed = json.loads(data)
        change(parsed)
        return json.dumps(parsed).encode()

    return text(edit)


def placed(*path: str | int, value: Any) -> Spoil:
    """Another value at a place of the document."""

    def change(parsed: Any) -> None:
        for key in path[:-1]:
            parsed = parsed[key]
        parsed[path[-1]] = value

    return document(change)


def head(at: int, form: str, value: int) -> Spoil:
    return bytes_of(lambda data: data[:at] + struct.pack(form, value) + data[at + struct.calcsize(form) :])


def chain(parsed: dict[str, Any]) -> None:
    """Nodes in one another, of which the last has the Gaussians."""
    parsed["nodes"] = [{"children": [i + 1], "scale": [2, 2, 2]} for i in range(DEEP)] + parsed["nodes"]


def copies(parsed: dict[str, Any]) -> None:
    """As many nodes that show the same Gaussians."""
    parsed["nodes"] = [{"children": list(range(1, DEEP))}, *([{"mesh": 0}] * DEEP)]


def empty(parsed: dict[str, Any]) -> None:
    """Nodes of a few bytes, each of which takes longer to place than they allow."""
    parsed["nodes"] = [{"children": list(range(1, 200_000))}, *([{}] * 200_000)]


def shared(parsed: dict[str, Any]) -> None:
    """All harmonics are the positions."""
    names = [f"{NAME}:SH_DEGREE_{d}_COEF_{i}" for d in (1, 2, 3) for i in range(2 * d + 1)]
    parsed["meshes"][0]["primitives"][0]["attributes"] |= dict.fromkeys(names, 0)


def many_spz(folder: Path) -> Sequence[object]:
    """A ``.glb`` of many small ``.spz``, each of which unpacks to 12 MB."""
    packed = gzip.compress(
        struct.pack("<4sIIBBBB", b"NGSP", 3, PART_GAUSSIANS, 0, 12, 0, 0) + bytes(PART_GAUSSIANS * 20)
    )
    packed += b"\0" * (-len(packed) % 4)
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitives = [
        {"attributes": {}, "mode": 0, "extensions": {NAME: splats | {"extensions": {SPZ: {"bufferView": part}}}}}
        for part in range(PARTS)
    ]
    size = len(packed)
    parsed = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "extensionsUsed": [NAME],
        "nodes": [{"mesh": 0}], "meshes": [{"primitives": primitives}], "buffers": [{"byteLength": PARTS * size}],
        "bufferViews": [{"buffer": 0, "byteOffset": part * size, "byteLength": size} for part in range(PARTS)],
    }  # fmt: skip
    data = json.dumps(parsed).encode()
    data += b" " * (-len(data) % 4)
    rest = struct.pack("<I4s", len(data), b"JSON") + data + struct.pack("<I4s", PARTS * size, b"BIN\0") + packed * PARTS
    path = folder / "scene.glb"
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(rest)) + rest)
    return [path]


def _cases() -> dict[str, Case]:
    contents = {"brackets": b"[" * DEEP, "objects": b'{"a":' * DEEP, "a number": b"1e999"}
    cases = {f"JSON with {name}": Case(text(lambda _, data=data: data)) for name, data in contents.items()}
    for value in (0, 2**31, 2**32 - 1):
        cases[f"JSON of {value} bytes"] = Case(head(12, "<I", value))
    for value in (float("nan"), 1e300):
        for part in ("translation", "scale"):
            cases[f"{part} of {value}"] = Case(placed("nodes", 0, part, value=[value] * 3), EITHER)
    return cases | {
        "another length in the header": Case(head(8, "<I", 2**32 - 1)),
        "the same bytes": Case(text(lambda data: data), READ),
        "forty .spz in one": Case(many_spz),
        "nodes in one another": Case(document(chain)),
        "a node in itself": Case(placed("nodes", 0, "children", value=[0])),
        "copies without end": Case(document(copies)),
        "200,000 empty nodes": Case(document(empty)),
        "values for many attributes": Case(document(shared)),
        "a count of 400 digits": Case(placed("accessors", 0, "count", value=10**400)),
        "a promise": Case(placed("accessors", 0, "count", value=10**9)),
        "a length of 2^62": Case(placed("bufferViews", 0, "byteLength", value=2**62), EITHER),
        "a stride of 2^62": Case(placed("bufferViews", 0, "byteStride", value=2**62), EITHER),
    }


CASES = {f"glb: {name}": case for name, case in _cases().items()}
