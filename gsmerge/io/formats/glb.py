"""Binary glTF 2.0 (``.glb``) with the extension ``KHR_gaussian_splatting`` of github.com/KhronosGroup/glTF.

Its axis y points up, that of a ``.ply`` down: a node turns the Gaussians by half a turn about z. Viewers that do not
know the extension show points in the base colours.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from gsmerge.io.formats.arrays import to_bytes, to_columns
from gsmerge.kernels.elementary import exp
from gsmerge.types import Gaussians

MAX_DEGREE = 3
NAME = "KHR_gaussian_splatting"
_FLOAT, _BYTE, _VERTICES, _POINTS = 5126, 5121, 34962, 0  # numbers of glTF
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def glb_bytes(gaussians: Gaussians, _: Sequence[str] = ()) -> bytes:
    """Encode a ``.glb`` file, without comments; ValueError if there is NaN or inf."""
    columns = to_columns(gaussians, MAX_DEGREE)
    values = {
        "POSITION": columns.means,
        f"{NAME}:ROTATION": np.roll(columns.quats, -1, axis=1),  # xyzw
        f"{NAME}:SCALE": exp(columns.log_scales),
        f"{NAME}:OPACITY": columns.opacities,
        f"{NAME}:SH_DEGREE_0_COEF_0": columns.sh0,
    }
    for i in range(columns.harmonics.shape[1]):
        degree = int((i + 1) ** 0.5)
        values[f"{NAME}:SH_DEGREE_{degree}_COEF_{i + 1 - degree**2}"] = columns.harmonics[:, i]
    attributes = {name: array.astype("<f4") for name, array in values.items()}
    attributes["COLOR_0"] = to_bytes(255 * np.concatenate([columns.colors, columns.opacities[:, None]], 1))
    document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "gsmerge"}, "scene": 0, "scenes": [{}]}
    content = b""
    if len(gaussians):
        at, views = 0, []
        accessors: list[dict[str, Any]] = []
        for array in attributes.values():
            views.append({"buffer": 0, "byteOffset": at, "byteLength": array.nbytes, "target": _VERTICES})
            kind = {"componentType": _BYTE, "normalized": True}
            if array.dtype != np.uint8:
                kind = {"componentType": _FLOAT}
            shape = {"count": len(array), "type": _TYPES[array[0].size]}
            accessors.append({"bufferView": len(accessors), **kind, **shape})
            at += array.nbytes
        for name, end in (("min", np.min), ("max", np.max)):  # of the positions, which glTF asks for
            accessors[0][name] = end(attributes["POSITION"], axis=0).tolist()
        content = b"".join(array.tobytes() for array in attributes.values())
        splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
        splats |= {"sortingMethod": "cameraDistance", "projection": "perspective"}
        places = {name: i for i, name in enumerate(attributes)}
        document |= {
            "extensionsUsed": [NAME],
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "rotation": [0, 0, 1, 0]}],
            "meshes": [{"primitives": [{"attributes": places, "mode": _POINTS, "extensions": {NAME: splats}}]}],
            "accessors": accessors,
            "bufferViews": views,
            "buffers": [{"byteLength": len(content)}],
        }
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    chunks = _chunk(b"JSON", text, b" ") + (_chunk(b"BIN\0", content, b"\0") if content else b"")
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _chunk(kind: bytes, content: bytes, padding: bytes) -> bytes:
    content += padding * (-len(content) % 4)
    return struct.pack("<I4s", len(content), kind) + content
