"""Read and write binary glTF 2.0 (``.glb``) with the extension ``KHR_gaussian_splatting`` of KhronosGroup/glTF.

The axis y points up in glTF, and down in a ``.ply``. Therefore the writer rotates Gaussians by half a turn about z, and
the reader rotates them back. Viewers that do not know the extension show a point in the base colour for each Gaussian.

The reader also accepts files in which one packed ``.spz`` replaces the arrays of positions, colours and so on. The
reader refuses files of the extension's drafts, whose scales are logarithms.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, replace
from gsmerge.io.bounds import ReadBudget, check_whole, parse_json, read_budget, read_errors
from gsmerge.io.cameras.viewer_cameras import order_views, vertical_field
from gsmerge.io.formats.rows import (
    Columns,
    Packed,
    StoredRows,
    column_blocks,
    note_surplus,
    rotator,
    to_bytes,
    to_stored,
)
from gsmerge.io.formats.spz import read_packed
from gsmerge.io.formats.table import PLAIN, Contents
from gsmerge.method.geometry.transforms import quat_to_rotmat
from gsmerge.method.kernels.elementary import exp, log, power
from gsmerge.method.kernels.matrices import matmul
from gsmerge.types import NO_CAMERAS, Gaussians, number_views

MAX_DEGREE = 3  # of harmonics, the highest of the extension
NAME = "KHR_gaussian_splatting"
HARMONICS = [f"{NAME}:SH_DEGREE_{degree}_COEF_{i}" for degree in range(MAX_DEGREE + 1) for i in range(2 * degree + 1)]
_OPACITY = f"{NAME}:OPACITY"
COMPRESSED = f"{NAME}_compression_spz_2"  # of which Cesium's tiles consist
COLOR_SPACE = "srgb_rec709_display"
READ_EXTENSIONS = {NAME, COMPRESSED, "KHR_mesh_quantization", "KHR_materials_unlit"}
# Constants of glTF: float32, uint8, a buffer of vertices, and a mesh of points
_FLOAT = 5126
_BYTE = 5121
_VERTICES = 34962
_POINTS = 0
_TYPE_NAMES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}  # width of a value -> its type in glTF
_WIDTHS = {name: width for width, name in _TYPE_NAMES.items()}
# NumPy's name of a type -> glTF's number of the type. The second dictionary has glTF's number -> NumPy's name
_COMPONENTS = {"<f4": _FLOAT, "|u1": _BYTE, "<i2": 5122, "<u2": 5123}
_DTYPES = {5120: "<i1", _BYTE: "<u1", 5122: "<i2", 5123: "<u2", _FLOAT: "<f4"}
# A file begins with a mark, the version and the file's length. A chunk begins with its length and its kind
_FILE_HEAD, _CHUNK_HEAD = struct.Struct("<4sII"), struct.Struct("<I4s")
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # turns the axes of a ``.ply`` to those of glTF, and back
# steps of 20 microseconds in a ReadBudget
_STEPS_PER_NODE = 4
_STEPS_PER_PART = 100
_MOVING_KEYS = {"matrix", "rotation", "scale", "translation"}  # keys of a node that moves its mesh and its children


def glb_bytes(gaussians: Gaussians, contents: Contents = PLAIN) -> bytes:
    """Encode a ``.glb`` file without comments; raise ValueError if there is NaN or inf.

    The file has a camera node for each view in ``contents``. The view nearest to the middle of all views is the first
    camera, since viewers look from the first camera.

    Rotations and opacities are 16-bit numbers, which the extension allows. All other values are float32.
    """
    cameras = contents.cameras if contents.options.viewer_cameras else NO_CAMERAS
    view_names = contents.names or number_views(len(cameras))
    nodes: list[dict[str, Any]] = [{"mesh": 0}]
    gltf_cameras = list[dict[str, Any]]()
    near = 0.01  # distance of the near plane in world units, which `gsmerge render` uses, too
    for i, view_id in enumerate(order_views(cameras)):
        pose = np.eye(4)  # of glTF's cameras, which look along -z with y up
        pose[:3, :3], pose[:3, 3] = cameras.viewmats[view_id, :3, :3].T * (1, -1, -1), cameras.centres[view_id]
        pose = matmul(HALF_TURN, pose)
        nodes.append({"name": view_names[view_id], "camera": i, "matrix": pose.T.reshape(-1).tolist()})
        ratio = float(cameras.width * cameras.Ks[view_id, 1, 1] / (cameras.height * cameras.Ks[view_id, 0, 0]))
        perspective = {"yfov": vertical_field(cameras, view_id), "aspectRatio": ratio, "znear": near}
        gltf_cameras.append({"name": view_names[view_id], "type": "perspective", "perspective": perspective})
    num_higher = (min(MAX_DEGREE, gaussians.sh_degree) + 1) ** 2 - 1
    half_turn = rotator(np.diag([-1.0, -1.0, 1.0]), num_higher)  # from y down to y up
    blocks = [_attributes(half_turn(columns)) for _, columns in column_blocks(gaussians, MAX_DEGREE)]
    # The arrays of all attributes follow each other in one buffer
    names = tuple(blocks[0])
    content = list[bytes]()
    offset = 0
    views = list[dict[str, Any]]()
    accessors = list[dict[str, Any]]()
    for view_id, name in enumerate(names):
        parts = [block.pop(name) for block in blocks]
        # An array may be a view of a wider array with padded rows, which is then written
        array = np.concatenate([part if part.base is None else part.base for part in parts])
        width = parts[0].shape[1]
        row_bytes = array.strides[0]
        size = len(array) * row_bytes
        stride = {"byteStride": 4} if row_bytes == 4 and width == 1 else {}  # rows of two bytes are padded to four
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": size, **stride, "target": _VERTICES})
        component: dict[str, Any] = {"componentType": _COMPONENTS[array.dtype.str]}
        component |= {} if array.dtype.kind == "f" else {"normalized": True}
        accessors.append({"bufferView": view_id, **component, "count": len(array), "type": _TYPE_NAMES[width]})
        if name == "POSITION":  # glTF asks for the bounds of positions
            accessors[-1] |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        content.append(array.tobytes())
        offset += size
    splats = {"kernel": "ellipse", "colorSpace": COLOR_SPACE}
    splats |= {"sortingMethod": "cameraDistance", "projection": "perspective"}
    accessor_ids = {name: i for i, name in enumerate(names)}
    document = {
        "extensionsUsed": [NAME],
        "nodes": nodes,
        **({"cameras": gltf_cameras} if gltf_cameras else {}),
        "meshes": [{"primitives": [{"attributes": accessor_ids, "mode": _POINTS, "extensions": {NAME: splats}}]}],
        "accessors": accessors,
        "bufferViews": views,
    }
    return pack_glb(document, b"".join(content))


def pack_glb(document: dict[str, Any], content: bytes) -> bytes:
    """Encode a ``.glb`` from its binary ``content`` and a ``document``, which gets a version, a scene and a buffer."""
    document = {
        "asset": {"version": "2.0", "generator": "gsmerge"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(document["nodes"])))}],
        **document,
        "buffers": [{"byteLength": len(content)}],
    }
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    chunks = _chunk(b"JSON", text, b" ") + _chunk(b"BIN\0", content, b"\0")
    return _FILE_HEAD.pack(b"glTF", 2, _FILE_HEAD.size + len(chunks)) + chunks


def _attributes(columns: Columns) -> dict[str, np.ndarray]:
    """Return the attributes ``[n,width]`` of glTF by name; rows of two bytes are padded to four, as glTF requires."""
    padded_opacities = np.zeros((len(columns), 2), "<u2")
    padded_opacities[:, 0] = np.rint(columns.opacities.clip(0, 1) * 65535)
    values = {
        "POSITION": columns.means.astype("<f4"),
        f"{NAME}:ROTATION": np.rint(32767 * np.roll(columns.quats, -1, axis=1)).astype("<i2"),  # xyzw
        f"{NAME}:SCALE": exp(columns.log_scales).astype("<f4"),
        _OPACITY: padded_opacities[:, :1],
        HARMONICS[0]: columns.sh0.astype("<f4"),
    }
    for name, harmonic in zip(HARMONICS[1:], columns.harmonics.transpose(1, 0, 2), strict=False):
        values[name] = harmonic.astype("<f4")
    srgb = columns.colors.clip(0, 1)  # glTF uses linear light (IEC 61966-2-1) for vertex colours
    linear = np.where(srgb <= 0.04045, srgb / 12.92, power((srgb + 0.055) / 1.055, 2.4))
    return values | {"COLOR_0": to_bytes(255 * np.concatenate([linear, columns.opacities[:, None]], 1))}


def _chunk(kind: bytes, content: bytes, padding: bytes) -> bytes:
    """Encode a chunk of the file, whose content is padded to a multiple of four bytes."""
    content += padding * (-len(content) % 4)
    return _CHUNK_HEAD.pack(len(content), kind) + content


def holds_gaussians(path: Path) -> bool:
    """Return whether a ``.glb`` uses the extension for Gaussians.

    A file that cannot be read also returns True, so that its reader reports the error.
    """
    try:
        with _damage_errors(path), path.open("rb") as file:
            return NAME in str(_read_document(file, read_budget(path))[0].get("extensionsUsed"))
    except SceneError:
        return True


def read_rows(path: Path) -> StoredRows:
    """Read all Gaussians of a ``.glb``, with the axes of a ``.ply``; raise SceneError for none, or for damage."""
    budget = read_budget(path)
    parts = list[Packed]()
    sizes = dict[str, int]()
    with _damage_errors(path), path.open("rb") as file, np.errstate(all="ignore"):  # NaN and inf are set aside later
        document, total = _read_document(file, budget)
        content = _Content(budget, file, document, file.tell(), total)
        scenes = document.get("scenes") or [{}]
        nodes = document.get("nodes", [])
        visited = set[int]()
        budget.check_steps(_STEPS_PER_NODE * len(nodes), "steps for nodes")
        # Each node with the matrix ``[4,4]`` from the frame of its parent to the frame of a ``.ply``
        stack = [(node_id, HALF_TURN) for node_id in scenes[document.get("scene", 0)].get("nodes", [])]
        while stack:
            node_id, transform = stack.pop()
            if node_id in visited:
                raise _ForeignError(f"one with two parents of node {node_id}")
            visited.add(node_id)
            node = nodes[node_id]
            if not _MOVING_KEYS.isdisjoint(node):
                matrix = np.eye(4)
                if "matrix" in node:
                    matrix = np.ascontiguousarray(np.array(node["matrix"], np.float64).reshape(4, 4).T)
                else:
                    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
                    rotation = quat_to_rotmat(np.array([[w, x, y, z]], np.float64))[0]
                    matrix[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)))
                    matrix[:3, 3] = node.get("translation", (0, 0, 0))
                transform = matmul(transform, matrix)
            for primitive in document["meshes"][node["mesh"]]["primitives"] if "mesh" in node else []:
                if NAME in primitive.get("extensions", {}):
                    budget.check_steps(_STEPS_PER_PART * len(parts), "steps for meshes")
                    parts.append(_read_splats(content, primitive, transform, sizes, parts))
            stack += [(child, transform) for child in reversed(node.get("children", []))]
    if not parts:
        problem = f"expected Gaussians ({NAME}), found a .glb of points or a mesh"
        raise SceneError(path, problem, "name the .ply that the model wrote beside it")
    return replace(
        to_stored(parts, ".glb", sizes),
        format="binary little-endian",
        is_open="gsmerge" not in str(document.get("asset")) and any(part.unpack_logs for part in parts),
        notes=note_surplus(budget.file_bytes - total, _FILE_HEAD.size),
    )


@contextmanager
def _damage_errors(path: Path) -> Iterator[None]:
    """In a ``with`` block, convert errors that a damaged or unsupported file causes to a SceneError."""
    try:
        with read_errors(path):
            yield
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError, struct.error) as error:
        found = str(error) if isinstance(error, _ForeignError) else f"a damaged one ({error!r:.200})"
        raise SceneError(path, f"expected a .glb of Gaussians, found {found}", "export it again, or as .ply") from error


class _ForeignError(ValueError):
    """The content is not supported. The message continues the words "expected a .glb of Gaussians, found"."""


@dataclass(frozen=True, eq=False)
class _Values:
    """Values ``[n,width]`` of an accessor as they are stored; an index with a slice returns real values as float64."""

    stored: np.ndarray
    unit: int  # the stored number that stands for 1; 1 if stored numbers are the values

    def __getitem__(self, block: slice) -> np.ndarray:
        rows = self.stored[block]
        return np.maximum(rows / self.unit, -1) if self.unit > 1 else rows.astype(np.float64)


@dataclass
class _Content:
    """The content of a ``.glb``, whose binary chunk is read part by part."""

    budget: ReadBudget
    file: IO[bytes]
    document: dict[str, Any]
    start: int  # of the binary chunk, in bytes from the start of the file
    end: int  # of the binary chunk, too
    num_read: int = 0  # bytes read so far, at most the size of the chunk

    def read_view(self, view_id: int) -> bytes:
        """Read a buffer view with the bytes of a ``.spz``; the view must lie in the binary chunk."""
        view = self.document["bufferViews"][view_id]
        at = view.get("byteOffset", 0)
        length = view["byteLength"]
        self.num_read += length
        if min(at, length) < 0 or self.start + at + length > self.end or self.num_read > self.end - self.start:
            raise _ForeignError(f"a truncated one, of {self.end} bytes without {length} of a .spz")
        self.file.seek(self.start + at)
        return self.file.read(length)

    def read_values(self, accessor_id: int) -> _Values:
        """Read the values of an accessor; its bytes must lie in the binary chunk."""
        accessor = self.document["accessors"][accessor_id]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise _ForeignError("one with sparse values")
        view = self.document["bufferViews"][accessor["bufferView"]]
        if view.get("extensions") or view["buffer"] != 0 or "uri" in self.document["buffers"][0]:
            raise _ForeignError(f"one with compressed values or values in another file ({list(view)})")
        dtype = np.dtype(_DTYPES[accessor["componentType"]])
        width = _WIDTHS[accessor["type"]]
        row_bytes = dtype.itemsize * width
        offset = accessor.get("byteOffset", 0)
        count = check_whole(accessor["count"], "count", 1)
        stride = view.get("byteStride", row_bytes)
        num_bytes = (count - 1) * stride + row_bytes
        position = self.start + view.get("byteOffset", 0) + offset
        self.num_read += count * row_bytes
        in_view = offset >= 0 and offset + num_bytes <= view["byteLength"]
        in_chunk = self.start <= position and position + num_bytes <= self.end
        max_stride = 252  # bytes from a value to the next, the limit of glTF
        if not row_bytes <= stride <= max_stride or not (in_view and in_chunk):
            raise _ForeignError(f"a truncated one, of {self.end} bytes without {count} values of {row_bytes} bytes")
        if self.num_read > self.end - self.start:
            raise _ForeignError("one that uses the same values several times")
        self.file.seek(position)
        rows = np.ndarray((count, width), dtype, self.file.read(num_bytes), strides=(stride, dtype.itemsize))
        return _Values(np.ascontiguousarray(rows), np.iinfo(dtype).max if accessor.get("normalized") else 1)


def _read_document(file: IO[bytes], budget: ReadBudget) -> tuple[dict[str, Any], int]:
    """Return the JSON document of a ``.glb``, and the length that the file's header states.

    The next bytes to read from ``file`` are then the content of the binary chunk.
    """
    start = file.read(_FILE_HEAD.size + _CHUNK_HEAD.size)
    if len(start) < _FILE_HEAD.size + _CHUNK_HEAD.size:
        raise _ForeignError("an early end of file")
    magic, version, total = _FILE_HEAD.unpack_from(start)
    length, kind = _CHUNK_HEAD.unpack_from(start, _FILE_HEAD.size)
    if (magic, version, kind) != (b"glTF", 2, b"JSON"):
        raise _ForeignError("a file that is no binary glTF 2.0")
    if total > budget.file_bytes or length > total - len(start):
        raise _ForeignError(f"a truncated one, of {budget.file_bytes} bytes instead of {max(total, length)}")
    document = parse_json(file.read(length).decode("utf-8-sig"), budget)
    if not isinstance(document, dict):
        raise _ForeignError("one whose JSON is no object")
    missing = set(document.get("extensionsRequired", ())) - READ_EXTENSIONS
    if missing and NAME in str(document.get("extensionsUsed")):
        raise _ForeignError(f"one that requires {', '.join(sorted(map(str, missing)))}, which is not supported")
    file.read(_CHUNK_HEAD.size)  # of the binary chunk
    return document, total


def _read_splats(
    content: _Content, primitive: dict[str, Any], transform: np.ndarray, sizes: dict[str, int], before: Sequence[Packed]
) -> Packed:
    """Read the Gaussians of a primitive, and apply the matrix ``transform [4,4]`` of its node to them.

    The bytes of each attribute are added to ``sizes``. ``before``: the Gaussians of the primitives before.
    """
    splats = primitive["extensions"][NAME]
    if COMPRESSED in splats.get("extensions", {}):
        packed = content.read_view(splats["extensions"][COMPRESSED]["bufferView"])
        _, rows, column_bytes, _ = read_packed(content.budget, packed, before)
        sizes |= {name: sizes.get(name, 0) + size for name, size in column_bytes.items()}
        rotate = _transformer(transform, rows.num_higher)
        return Packed(rows.count, rows.num_higher, lambda block: rotate(rows.unpack(block)))
    kind = splats.get("kernel", "ellipse"), splats.get("colorSpace", COLOR_SPACE)
    if splats.get("extensions") or kind != ("ellipse", COLOR_SPACE):
        raise _ForeignError(f"Gaussians of another kind ({', '.join(map(str, splats.get('extensions') or kind))})")
    ids = primitive.get("attributes", {})  # of accessors, by name of the attribute

    def read(kind: str, width: int, name: str) -> _Values:
        """Read the glTF attribute ``name`` with ``width`` numbers per Gaussian; add its bytes to ``sizes[kind]``."""
        if name not in ids:
            raise _ForeignError(f"one whose Gaussians have no {name}")
        bytes_before = content.num_read
        values = content.read_values(ids[name])
        if values.stored.shape[1] != width:
            raise _ForeignError(f"one with {values.stored.shape[1]} numbers of {name} per Gaussian")
        sizes[kind] = sizes.get(kind, 0) + content.num_read - bytes_before
        return values

    means, scales = read("means", 3, "POSITION"), read("scales", 3, f"{NAME}:SCALE")
    quats, opacities = read("quats", 4, f"{NAME}:ROTATION"), read("opacities", 1, _OPACITY)
    degree = max((degree for degree in range(MAX_DEGREE + 1) if HARMONICS[degree**2] in ids), default=0)
    sh0, *harmonics = (read("shN" if i else "sh0", 3, HARMONICS[i]) for i in range((degree + 1) ** 2))
    count = len(means.stored)
    if any(len(values.stored) != count for values in (quats, scales, opacities, sh0, *harmonics)):
        raise _ForeignError(f"one whose attributes do not all have {count} values, one per Gaussian")
    transform_columns = _transformer(transform, len(harmonics))

    def unpack(block: slice, *, are_logs: bool = False) -> Columns:
        """Return the Gaussians of a block of rows; drafts of the extension stored scales as logarithms."""
        means_block = means[block]
        # np.stack needs at least one array, so an array of zeros is put before the harmonics and cut off again
        return transform_columns(
            Columns(
                means=means_block,
                quats=np.roll(quats[block], 1, axis=1),  # xyzw to wxyz
                log_scales=scales[block] if are_logs else log(scales[block]),
                opacities=opacities[block][:, 0],
                sh0=sh0[block],
                harmonics=np.stack([np.zeros_like(means_block), *(values[block] for values in harmonics)], 1)[:, 1:],
            )
        )

    return Packed(count, len(harmonics), unpack, partial(unpack, are_logs=True))


def _transformer(transform: np.ndarray, num_higher: int) -> Callable[[Columns], Columns]:
    """Return a function that applies the matrix ``[4,4]`` of a node to Gaussians.

    The matrix must be a similarity: a rotation, a uniform scale and a translation.
    """
    scale = np.sqrt((transform[:3, :3] ** 2).sum(0)).mean()
    rotation = transform[:3, :3] / scale
    translation = transform[:3, 3]
    deviation = np.abs(matmul(rotation.T, rotation) - np.eye(3)).max()
    is_mirror = (np.cross(rotation[0], rotation[1]) * rotation[2]).sum() < 0
    tolerance = 1e-3  # largest difference of the scales of a node's axes, and largest cosine between two axes
    if is_mirror or not (np.isfinite(transform).all() and deviation < tolerance):
        raise _ForeignError("one with a node that stretches or mirrors its Gaussians")
    rotate = rotator(rotation, num_higher)

    def apply(columns: Columns) -> Columns:
        rotated = rotate(columns)
        log_scales = columns.log_scales + float(log(scale))
        return replace(rotated, means=scale * rotated.means + translation, log_scales=log_scales)

    return apply
