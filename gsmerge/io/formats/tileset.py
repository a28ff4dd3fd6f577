"""Read and write 3D Tiles 1.1 for Cesium: a ``tileset.json`` with one tile, which is a ``.glb`` with a ``.spz`` inside.

The ``.glb`` uses ``KHR_gaussian_splatting_compression_spz_2``, which Cesium requires. A node of the ``.glb`` rotates
the axes of the ``.spz`` to the axes of glTF, with y up. Cesium rotates glTF's axes to z up. The ``tileset.json`` adds
half a turn, so that the axes x, y and z of the ``.spz`` point east, down and north on the globe.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.atomic import AddOutput
from gsmerge.io.bounds import read_json
from gsmerge.io.formats import glb
from gsmerge.io.formats.glb import COLOR_SPACE, COMPRESSED, HALF_TURN, HARMONICS, NAME, pack_glb
from gsmerge.io.formats.rows import StoredRows
from gsmerge.io.formats.spz import MAX_DEGREE, spz_bytes
from gsmerge.io.formats.table import TILESET, Contents
from gsmerge.method.kernels.elementary import cos, sin
from gsmerge.method.kernels.matrices import matmul
from gsmerge.settings.files import parse_place
from gsmerge.types import Cameras, Gaussians

REST = 3000  # most bytes of the index, and of the numbers of the bounds in the tile
PLACED = "the place on the globe is not kept: --set place=LON,LAT,HEIGHT states it again"
_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # turns y up to z up


def write_output(add: AddOutput, path: Path, index: Path, contents: Contents) -> dict[Path, list[Path]]:
    """Write the files of a tileset.

    ``add`` makes the temporary file of a path; ``index`` is the temporary file of ``path``. Return ``path``, with a
    list of all temporary files.
    """
    tile = path.with_name(TILESET.beside)
    # The bounds are percentiles of the means, since bounds with a few far Gaussians would make the scene look small
    percentiles = 1, 99
    file, low, high = add(tile), *np.percentile(contents.levels[0].means.astype(np.float64), percentiles, axis=0)
    file.write_bytes(_tile_bytes(contents, low, high))
    to_z_up = matmul(_Z_UP, HALF_TURN)[:3, :3]
    half_edges = np.diag(np.abs(matmul(to_z_up, (high - low)[:, None] / 2))[:, 0])
    box = [*matmul(to_z_up, (low + high)[:, None] / 2)[:, 0].tolist(), *half_edges.reshape(-1).tolist()]
    place = contents.options.place
    root = {"boundingVolume": {"box": box}, "geometricError": 0, "refine": "REPLACE", "content": {"uri": tile.name}}
    # Half a turn is applied first, so that the z axis of the ``.spz`` points north
    to_globe = matmul(np.eye(4) if place is None else globe_matrix(place), HALF_TURN)
    root["transform"] = to_globe.T.reshape(-1).tolist()
    extensions = {"extensionsUsed": [NAME, COMPRESSED], "extensionsRequired": [NAME, COMPRESSED]}
    document = {
        "asset": {"version": "1.1", "generator": "gsmerge"},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {"3DTILES_content_gltf": extensions},
        "geometricError": float(np.abs(high - low).max()),  # without the tile, a picture lacks the whole scene
        "root": root,
    }
    index.write_text(json.dumps(document), encoding="utf-8")
    return {path: [index, file]}


def read_rows(path: Path) -> StoredRows:
    """Read the Gaussians of a tileset with one tile; raise SceneError for any other tileset."""
    document = read_json(path)
    try:
        root = document["root"]
        name = PurePosixPath(root["content"]["uri"])
        has_one_tile = not root.get("children") and name.suffix == ".glb" and len(name.parts) == 1
        is_placed = any(root.get("transform", [])[12:15])  # translation to a place on the globe
    except (LookupError, TypeError, AttributeError):
        has_one_tile = False
    if not has_one_tile:
        count = str(document).count("'uri'")
        found = f"found {count}, each with a transform that is not read" if count > 1 else "found another"
        remedy = "name one of its tiles, or export the whole scene as .ply"
        raise SceneError(path, f"expected a tileset with one tile, a .glb beside it, {found}", remedy)
    rows = glb.read_rows(path.with_name(name.name))
    return replace(
        rows,
        bytes_beside=path.with_name(name.name).stat().st_size,
        notes=(*rows.notes, *([PLACED] if is_placed else [])),
    )


def most_other_bytes() -> int:
    """Return the largest number of bytes that a tileset may have besides its ``.spz``."""
    return REST


def most_bytes(gaussians: Gaussians, cameras: Cameras, comments: Sequence[str]) -> int:
    """Return the largest number of bytes that a tileset of these Gaussians may have, at any place on the globe."""
    return len(_tile_bytes(Contents([gaussians], comments, cameras), np.zeros(3), np.zeros(3))) + REST


def _tile_bytes(contents: Contents, low: np.ndarray, high: np.ndarray) -> bytes:
    """Encode the ``.glb`` of a tile, whose Gaussians lie mostly between the corners ``low [3]`` and ``high [3]``."""
    gaussians = contents.levels[0]
    packed = spz_bytes(contents.levels[0], contents)
    num_harmonics = (min(MAX_DEGREE, gaussians.sh_degree) + 1) ** 2
    names = ["POSITION", "COLOR_0", f"{NAME}:ROTATION", f"{NAME}:SCALE", *HARMONICS[1:num_harmonics]]
    accessors: list[dict[str, Any]] = [{"componentType": 5126, "type": "VEC3", "count": len(gaussians)} for _ in names]
    # glTF requires the bounds of positions. The component types are 5126 for float32 and 5121 for uint8
    accessors[0] |= {"min": low.tolist(), "max": high.tolist()}
    accessors[1] |= {"componentType": 5121, "type": "VEC4", "normalized": True}
    accessors[2]["type"] = "VEC4"
    splats = {"kernel": "ellipse", "colorSpace": COLOR_SPACE, "extensions": {COMPRESSED: {"bufferView": 0}}}
    primitive = {"attributes": {name: i for i, name in enumerate(names)}, "mode": 0, "extensions": {NAME: splats}}
    document = {
        "extensionsUsed": [NAME, COMPRESSED],
        "extensionsRequired": [NAME, COMPRESSED],
        "nodes": [{"mesh": 0, "matrix": HALF_TURN.T.reshape(-1).tolist()}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteLength": len(packed)}],
    }
    return pack_glb(document, packed)


def globe_matrix(place: str) -> np.ndarray:
    """Return the matrix ``[4,4]`` from the frame of a place (east, north, up, metres) to the earth's, EPSG 4978.

    ``place``: longitude and latitude in degrees, and height in metres above the ellipsoid, separated by commas.
    """
    longitude, latitude, height = parse_place(place)
    angles = np.radians([longitude, latitude])
    sin_lon, sin_lat = sin(angles)
    cos_lon, cos_lat = cos(angles)
    up = np.array([cos_lat * cos_lon, cos_lat * sin_lon, sin_lat])
    east = np.array([-sin_lon, cos_lon, 0])
    north = np.array([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat])
    # metres; of the ellipsoid WGS 84
    semi_major_axis = 6378137.0
    squared_eccentricity = 0.0066943799901413165
    radius = semi_major_axis / np.sqrt(1 - squared_eccentricity * sin_lat**2)  # of curvature in the prime vertical
    matrix = np.eye(4)
    matrix[:3] = np.stack([east, north, up, radius * up + height * up], 1)
    matrix[2, 3] -= squared_eccentricity * radius * sin_lat
    return matrix
