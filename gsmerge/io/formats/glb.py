"""Read and write binary glTF 2.0 (``.glb``) with the extension ``KHR_gaussian_splatting`` of KhronosGroup/glTF.

The axis y points up in glTF, and down in a ``.ply``. Therefore the writer rotates Gaussians by half a turn about z, and
the reader rotates them back. Viewers that do not know the extension show points in the base colours.

Drafts of the extension are read as well. They have logarithms of scales, of which some are negative, and attributes
``_ROTATION``, ``_SCALE`` and ``COLOR_0``. Cesium writes a ``.spz`` instead of the values.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import quat_to_rotmat, rgb_to_sh0
from gsmerge.io.bounds import ReadBudget, check_whole, parse_json, read_budget, read_errors
from gsmerge.io.formats import spz
from gsmerge.io.formats.arrays import (
    Columns,
    Packed,
    StoredRows,
    are_logarithms,
    to_bytes,
    to_columns,
    to_stored,
    turn_half,
    turner,
)
from gsmerge.kernels.elementary import exp, log, power
from gsmerge.kernels.matrices import matmul
from gsmerge.types import Gaussians

MAX_DEGREE = 3
NAME = "KHR_gaussian_splatting"
HARMONICS = [f"{NAME}:SH_DEGREE_{degree}_COEF_{i}" for degree in range(MAX_DEGREE + 1) for i in range(2 * degree + 1)]
COLOR_SPACE = "srgb_rec709_display"
SPZ_NAMES = (f"{NAME}_compression_spz_2", f"{NAME}_compression_spz")  # extensions for a .spz in the binary chunk
READ_EXTENSIONS = {NAME, *SPZ_NAMES, "KHR_mesh_quantization", "KHR_materials_unlit"}
_FLOAT, _BYTE, _VERTICES, _POINTS = 5126, 5121, 34962, 0  # constants of glTF
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_WIDTHS = {name: width for width, name in _TYPES.items()}
_COMPONENTS = {"<f4": _FLOAT, "|u1": _BYTE, "<i2": 5122, "<u2": 5123}
_DTYPES = {5120: "<i1", _BYTE: "<u1", 5122: "<i2", 5123: "<u2", _FLOAT: "<f4"}
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
_MAX_STRIDE = 252  # largest number of bytes from a value to the next that glTF allows
_STEPS_PER_NODE, _STEPS_PER_PART = 4, 100  # of a budget's 20 microseconds
_PLACEMENT = {"matrix", "rotation", "scale", "translation"}  # keys of a node with a transform of its own
_TOLERANCE = 1e-3  # largest difference of the scales of a node's axes, and largest cosine between two axes


def glb_bytes(gaussians: Gaussians, _: Sequence[str] = ()) -> bytes:
    """Encode a ``.glb`` file without comments; ValueError if there is NaN or inf.

    Rotations and opacities are 16-bit numbers, which the extension allows. All other values are float32.
    """
    columns = to_columns(gaussians, MAX_DEGREE)
    attributes = _attributes(turn_half(columns))
    at, views = 0, []
    accessors: list[dict[str, Any]] = []
    for array in attributes.values():
        padded = {"byteStride": 4} if array.strides[0] == 4 and array.shape[1] == 1 else {}
        size = len(array) * array.strides[0]
        views.append({"buffer": 0, "byteOffset": at, "byteLength": size, **padded, "target": _VERTICES})
        kind = {"componentType": _COMPONENTS[array.dtype.str]} | (
            {} if array.dtype.kind == "f" else {"normalized": True}
        )
        accessors.append({"bufferView": len(accessors), **kind, "count": len(array), "type": _TYPES[array.shape[1]]})
        at += size
    for name, end in (("min", np.min), ("max", np.max)):  # glTF asks for the bounds of positions
        accessors[0][name] = end(attributes["POSITION"], axis=0).tolist()
    content = b"".join((array if array.base is None else array.base).tobytes() for array in attributes.values())
    splats = {"kernel": "ellipse", "colorSpace": COLOR_SPACE}
    splats |= {"sortingMethod": "cameraDistance", "projection": "perspective"}
    places = {name: i for i, name in enumerate(attributes)}
    document = {
        "asset": {"version": "2.0", "generator": "gsmerge"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "extensionsUsed": [NAME],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": places, "mode": _POINTS, "extensions": {NAME: splats}}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(content)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    chunks = _chunk(b"JSON", text, b" ") + _chunk(b"BIN\0", content, b"\0")
    return _HEADER.pack(b"glTF", 2, _HEADER.size + len(chunks)) + chunks


def _attributes(columns: Columns) -> dict[str, np.ndarray]:
    """Return the attributes ``[n,width]`` by name; rows of two bytes are padded to four, as glTF requires."""
    wide = np.zeros((len(columns), 2), "<u2")
    wide[:, 0] = np.rint(columns.opacities.clip(0, 1) * 65535)
    values = {
        "POSITION": columns.means.astype("<f4"),
        f"{NAME}:ROTATION": np.rint(32767 * np.roll(columns.quats, -1, axis=1)).astype("<i2"),  # xyzw
        f"{NAME}:SCALE": exp(columns.log_scales).astype("<f4"),
        f"{NAME}:OPACITY": wide[:, :1],
        HARMONICS[0]: columns.sh0.astype("<f4"),
    }
    for name, harmonic in zip(HARMONICS[1:], columns.harmonics.transpose(1, 0, 2), strict=False):
        values[name] = harmonic.astype("<f4")
    shown = np.concatenate([_to_linear(columns.colors.clip(0, 1)), columns.opacities[:, None]], 1)
    return values | {"COLOR_0": to_bytes(255 * shown)}


def _to_linear(colors: np.ndarray) -> np.ndarray:
    """Convert sRGB, 0 to 1, to linear light (IEC 61966-2-1), which glTF uses for vertex colours."""
    return np.where(colors <= 0.04045, colors / 12.92, power((colors + 0.055) / 1.055, 2.4))


def _chunk(kind: bytes, content: bytes, padding: bytes) -> bytes:
    content += padding * (-len(content) % 4)
    return _CHUNK.pack(len(content), kind) + content


def holds_gaussians(path: Path) -> bool:
    """Return whether a ``.glb`` uses the extension for Gaussians.

    True also for a file that cannot be read, so that its reader reports the error.
    """
    try:
        with _damage(path), path.open("rb") as file:
            return NAME in str(_read_document(file, read_budget(path)).get("extensionsUsed"))
    except SceneError:
        return True


def read_rows(path: Path) -> StoredRows:
    """Read all Gaussians of a ``.glb`` in the frame of a ``.ply``; SceneError if it has none or is damaged."""
    budget, parts, sizes = read_budget(path), list[Packed](), dict[str, int]()
    with _damage(path), path.open("rb") as file, np.errstate(all="ignore"):  # rows with NaN or inf are set aside later
        document = _read_document(file, budget)
        content = _Content(budget, file, document, file.tell(), budget.file_bytes)
        for mesh, place in _walk_splats(document, budget):
            budget.check_steps(_STEPS_PER_PART * len(parts), "steps for meshes")
            parts.append(_read_splats(content, mesh, place, sizes, sum(part.count for part in parts)))
    if not parts:
        problem = f"expected Gaussians ({NAME}), found a .glb of points or a mesh"
        raise SceneError(path, problem, "name the .ply that the model wrote beside it")
    return replace(to_stored(parts, ".glb", sizes), format="binary little-endian")


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """Convert all errors that damaged or foreign files cause in the reader to a SceneError."""
    try:
        with read_errors(path):
            yield
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError, struct.error) as error:
        found = str(error) if isinstance(error, _ForeignError) else f"a damaged one ({error!r:.200})"
        raise SceneError(path, f"expected a .glb of Gaussians, found {found}", "export it again, or as .ply") from error


class _ForeignError(ValueError):
    """Content that the reader does not support; the message continues "expected a .glb of Gaussians, found"."""


@dataclass(frozen=True)
class _Values:
    """Stored values ``[n,width]`` of an accessor; a block of them is returned as float64."""

    stored: np.ndarray
    most: int  # stored number of the value 1

    def __getitem__(self, block: slice) -> np.ndarray:
        rows = self.stored[block]
        return np.maximum(rows / self.most, -1) if self.most > 1 else rows.astype(np.float64)


@dataclass(frozen=True)
class _Content:
    """The content of a ``.glb``, whose binary chunk is read part by part."""

    budget: ReadBudget
    file: IO[bytes]
    document: dict[str, Any]
    start: int  # of the binary chunk, in bytes from the start of the file
    end: int
    num_read: list[int] = field(default_factory=lambda: [0])  # bytes of all parts so far, at most those of the chunk

    def packed(self, view_id: int) -> bytes:
        """Read the bytes of a buffer view, which must lie in the chunk."""
        view = self.document["bufferViews"][view_id]
        at, size = self.start + view.get("byteOffset", 0), check_whole(view["byteLength"], "byteLength", 1)
        self.num_read[0] += size
        if view["buffer"] != 0 or "uri" in self.document["buffers"][0] or not self.start <= at <= self.end - size:
            raise _ForeignError(
                f"a truncated one, or a .spz in another file, of {self.end} bytes without {size} bytes of it"
            )
        return self._read(at, size)

    def _read(self, at: int, size: int) -> bytes:
        if self.num_read[0] > self.end - self.start:
            raise _ForeignError("one that uses the same values several times")
        self.file.seek(at)
        return self.file.read(size)

    def values(self, accessor_id: int) -> _Values:
        """Read the values of an accessor, which must lie in the chunk."""
        accessor = self.document["accessors"][accessor_id]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise _ForeignError("one with sparse values")
        view = self.document["bufferViews"][accessor["bufferView"]]
        if view.get("extensions") or view["buffer"] != 0 or "uri" in self.document["buffers"][0]:
            raise _ForeignError(f"one with compressed values or values in another file ({list(view)})")
        dtype, width = np.dtype(_DTYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]]
        each, first = dtype.itemsize * width, accessor.get("byteOffset", 0)
        count, stride = check_whole(accessor["count"], "count", 1), view.get("byteStride", each)
        span, at = (count - 1) * stride + each, self.start + view.get("byteOffset", 0) + first
        self.num_read[0] += count * each
        inside = first >= 0 and first + span <= view["byteLength"] and self.start <= at and at + span <= self.end
        if not each <= stride <= _MAX_STRIDE or not inside:
            raise _ForeignError(f"a truncated one, of {self.end} bytes without {count} values of {each} bytes")
        rows = np.ndarray((count, width), dtype, self._read(at, span), strides=(stride, dtype.itemsize))
        return _Values(np.ascontiguousarray(rows), np.iinfo(dtype).max if accessor.get("normalized") else 1)


def _read_document(file: IO[bytes], budget: ReadBudget) -> dict[str, Any]:
    """Read the JSON of a ``.glb``, and move to the start of its binary chunk."""
    size = budget.file_bytes
    start = file.read(_HEADER.size + _CHUNK.size)
    if len(start) < _HEADER.size + _CHUNK.size:
        raise _ForeignError("an early end of file")
    (magic, version, total), (length, kind) = _HEADER.unpack_from(start), _CHUNK.unpack_from(start, _HEADER.size)
    if (magic, version, kind) != (b"glTF", 2, b"JSON"):
        raise _ForeignError("a file that is no binary glTF 2.0")
    if total > size or length > total - len(start):
        raise _ForeignError(f"a truncated one, of {size} bytes instead of {max(total, length)}")
    document = parse_json(file.read(length).decode("utf-8-sig"), budget)
    if not isinstance(document, dict):
        raise _ForeignError("one whose JSON is no object")
    missing = set(document.get("extensionsRequired", ())) - READ_EXTENSIONS
    if missing and NAME in str(document.get("extensionsUsed")):
        raise _ForeignError(f"one that requires {', '.join(sorted(map(str, missing)))}, which is not supported")
    file.read(_CHUNK.size)
    return document


def _walk_splats(document: dict[str, Any], budget: ReadBudget) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """Yield the primitives that hold Gaussians, each with its matrix ``[4,4]`` into the frame of a ``.ply``."""
    scenes, nodes, seen = document.get("scenes") or [{}], document.get("nodes", []), set[int]()
    budget.check_steps(_STEPS_PER_NODE * len(nodes), "steps for nodes")
    stack = [(node_id, _HALF_TURN) for node_id in scenes[document.get("scene", 0)].get("nodes", [])]
    while stack:
        node_id, above = stack.pop()
        if node_id in seen:
            raise _ForeignError(f"one with two parents of node {node_id}")
        seen.add(node_id)
        node = nodes[node_id]
        place = above if _PLACEMENT.isdisjoint(node) else matmul(above, _node_matrix(node))
        primitives = document["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []
        yield from ((primitive, place) for primitive in primitives if NAME in primitive.get("extensions", {}))
        stack += [(child, place) for child in reversed(node.get("children", []))]


def _node_matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.ascontiguousarray(np.array(node["matrix"], np.float64).reshape(4, 4).T)
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    matrix = np.eye(4)
    matrix[:3, :3] = quat_to_rotmat(np.array([[w, x, y, z]], np.float64))[0] * np.array(node.get("scale", (1, 1, 1)))
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _read_splats(
    content: _Content, primitive: dict[str, Any], place: np.ndarray, sizes: dict[str, int], count_before: int
) -> Packed:
    """Read one primitive, move it by the matrix ``place [4,4]``, and add its bytes to ``sizes`` by attribute.

    ``count_before``: number of Gaussians in the primitives before it; all share the file's budget.
    """
    splats, attributes = primitive["extensions"][NAME], primitive.get("attributes", {})
    kernel, space = splats.get("kernel", "ellipse"), splats.get("colorSpace", COLOR_SPACE)
    more = dict(splats.get("extensions") or {})
    spz_part = next((more.pop(name) for name in SPZ_NAMES if name in more), None)
    if more or (kernel, space) != ("ellipse", COLOR_SPACE):
        raise _ForeignError(f"Gaussians of another kind ({', '.join(map(str, more or (kernel, space)))})")
    if spz_part is not None:
        rows, _, _, parts = spz.unpack_rows(content.budget, content.packed(spz_part["bufferView"]), count_before)
        sizes.update({name: sizes.get(name, 0) + size for name, size in parts.items()})
        turn = _mover(place, rows.num_higher)
        return replace(rows, unpack=lambda block: turn(rows.unpack(block)))

    def read(kind: str, width: int, *names: str) -> _Values:
        name = next((name for name in names if name in attributes), None)
        if name is None:
            raise _ForeignError(f"one whose Gaussians have no {names[0]}")
        before = content.num_read[0]
        values = content.values(attributes[name])
        if values.stored.shape[1] != width:
            raise _ForeignError(f"one with {values.stored.shape[1]} numbers of {name} per Gaussian")
        sizes[kind] = sizes.get(kind, 0) + content.num_read[0] - before
        return values

    means, scales = read("means", 3, "POSITION"), read("scales", 3, f"{NAME}:SCALE", "_SCALE")
    quats, names = read("quats", 4, f"{NAME}:ROTATION", "_ROTATION"), _harmonic_names(attributes)
    if names:
        sh0, *harmonics = [read("shN" if i else "sh0", 3, name) for i, name in enumerate(names)]
        opacities = read("opacities", 1, f"{NAME}:OPACITY")
    else:
        sh0, harmonics, opacities = read("sh0", 4, "COLOR_0"), [], None
    count = len(means.stored)
    columns = (quats, scales, sh0, *([] if opacities is None else [opacities]), *harmonics)
    if any(len(column.stored) != count for column in columns):
        raise _ForeignError(f"one whose attributes do not all have {count} values, one per Gaussian")
    are_logs, move = are_logarithms(scales.stored), _mover(place, len(harmonics))

    def unpack(block: slice) -> Columns:
        colors = sh0[block]
        return move(
            Columns(
                means=means[block],
                quats=np.roll(quats[block], 1, axis=1),
                log_scales=scales[block] if are_logs else log(scales[block]),
                opacities=colors[:, 3] if opacities is None else opacities[block][:, 0],
                sh0=rgb_to_sh0(colors[:, :3]) if opacities is None else colors,
                harmonics=np.stack([values[block] for values in harmonics], 1)
                if harmonics
                else np.zeros((len(colors), 0, 3)),
            )
        )

    return Packed(count, len(harmonics), unpack)


def _harmonic_names(attributes: dict[str, Any]) -> list[str]:
    """List the attributes of harmonics up to the highest degree that a primitive contains; empty for drafts."""
    return HARMONICS[: max(((d + 1) ** 2 for d in range(MAX_DEGREE + 1) if HARMONICS[d**2] in attributes), default=0)]


def _mover(place: np.ndarray, num_higher: int) -> Callable[[Columns], Columns]:
    """Return a function that moves Gaussians by the matrix ``[4,4]`` of their node, which must be a similarity."""
    scale = np.sqrt((place[:3, :3] ** 2).sum(0)).mean()
    rotation = place[:3, :3] / scale
    oblique = np.abs(matmul(rotation.T, rotation) - np.eye(3)).max()
    mirrored = (np.cross(rotation[0], rotation[1]) * rotation[2]).sum() < 0
    if mirrored or not (np.isfinite(place).all() and oblique < _TOLERANCE):
        raise _ForeignError("one with a node that stretches or mirrors its Gaussians")
    turn = turner(rotation, num_higher)
    return lambda columns: replace(
        turned := turn(columns),
        means=scale * turned.means + place[:3, 3],
        log_scales=columns.log_scales + float(log(scale)),
    )
