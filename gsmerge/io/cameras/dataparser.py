"""Read how programs moved cameras into the Gaussians' world: by the map of nerfstudio or Metashape, or by an offset."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.io.bounds import read_json
from gsmerge.io.cameras.camera_file import MAX_NUMBER, make_similarity
from gsmerge.io.cameras.camera_source import number_errors, to_array, to_number
from gsmerge.method.geometry.transforms import Similarity
from gsmerge.method.kernels.matrices import invert, matmul
from gsmerge.runtime.plugins import lazy_functions

_list_metashape_frames = lazy_functions(__package__)("metashape.list_metashape_frames")
DATAPARSER = "dataparser_transforms.json"  # name of nerfstudio's file with its map
_LEVELS = 4  # of folders above a scene and its cameras, in which nerfstudio's file or its outputs may be
_MOST_OUTPUTS = 16  # of nerfstudio that are tried
# Pattern of an offset: three numbers that stand alone in a line, an element or brackets
_OFFSET = re.compile(r"(?:^|[>:=(])\s*N[\s,;]+N[\s,;]+N\s*(?:$|[<)])".replace("N", r"([-+]?\d+\.?\d*)"), re.MULTILINE)


def list_dataparsers(ply: Path, cameras: Path) -> list[Path]:
    """List nerfstudio's files with its map: the one beside the scene, its cameras or above these, or of all outputs.

    nerfstudio keeps exports, captures and outputs apart, so that the folder ``outputs`` is beside those of the others.
    """
    above = [folder for path in (cameras, ply) for folder in Path(os.path.abspath(path)).parents[:_LEVELS]]
    above = [*dict.fromkeys((ply.parent, *above))]
    beside = next((folder / DATAPARSER for folder in above if (folder / DATAPARSER).is_file()), None)
    if beside is not None:
        return [beside]
    outputs = (path for folder in above for path in sorted(folder.glob(f"outputs/*/*/*/{DATAPARSER}")))
    return list(islice(outputs, _MOST_OUTPUTS))


def read_dataparser(ply: Path, cameras: Path) -> list[Similarity]:
    """Return the similarities by which nerfstudio or a survey may have moved the cameras. The caller tries each one.

    Nerfstudio's ``dataparser_transforms.json`` has the map from the world of the capture into the world of the
    Gaussians: X' = scale (transform [X; 1]). If a ``transforms.json`` has an ``applied_transform`` (and
    ``applied_scale``), its poses are already moved by ``applied_transform``. A second similarity is therefore returned,
    which undoes ``applied_transform`` before it applies the map. If nerfstudio's file is missing, offsets of surveys
    are read. A file of Metashape has maps of its own. Raise SceneError if a map is not a rotation, a shift and a
    positive scale.
    """
    candidates = [*_list_metashape_frames(cameras)] if cameras.suffix.lower() == ".xml" else []
    paths = list_dataparsers(ply, cameras)
    if not paths:
        return [*candidates, *_read_offsets((ply.parent, cameras.parent), cameras)]
    camera_data = read_json(cameras) if cameras.suffix == ".json" and cameras.is_file() else {}
    for path in paths:
        data = read_json(path)
        with number_errors(path, "expected 'transform' of 3x4 numbers and 'scale'"):
            transform = _to_square(data["transform"])
            scale = to_number(data["scale"])
        candidates.append(make_similarity(path, transform, scale))
        if isinstance(camera_data, dict) and "applied_transform" in camera_data:
            with number_errors(cameras, "expected 'applied_transform' of 3x4 numbers"):
                applied = _to_square(camera_data["applied_transform"])
                factor = to_number(camera_data.get("applied_scale") or 1)
                candidates.append(make_similarity(path, matmul(transform, invert(applied)), scale / factor))
    return candidates


def _read_offsets(folders: Sequence[Path], cameras: Path) -> list[Similarity]:
    """Read the offsets in metres that surveys subtract from coordinates; return moves of the cameras by each offset.

    An offset is three numbers that stand alone in a line or element of a small file. Metashape and CloudCompare write
    offsets into text files, and DJI Terra writes an offset into metadata.xml. Each offset gives two moves of the
    cameras, in opposite directions, since the offset may be missing from the cameras or from the Gaussians.
    """
    # of files that may have an offset, and how many of these are read
    endings = (".txt", ".xml", ".xyz")
    max_files = 8
    found = {path for folder in folders for path in folder.glob("[!.]*") if path.suffix in endings and path != cameras}
    paths = sorted(found)
    small = [path for path in paths if path.is_file() and os.access(path, os.R_OK) and path.stat().st_size <= 1 << 12]
    matches = [(path.name, _OFFSET.search(path.read_text("latin-1"))) for path in small[:max_files]]
    offsets = {tuple(map(float, numbers.groups())): name for name, numbers in matches if numbers is not None}
    return [
        Similarity(
            np.eye(3), 1.0, sign * np.array(offset), f"moved by {'minus ' if sign < 0 else ''}the offset in {name}"
        )
        for offset, name in offsets.items()
        for sign in (-1, 1)
        if max(map(abs, offset)) < MAX_NUMBER
    ]


def _to_square(values: Any) -> np.ndarray:
    """Convert the rows of a 3x4 or 4x4 matrix to ``[4,4]`` with the last row 0 0 0 1; raise ValueError for others."""
    matrix = to_array(values)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.all(np.abs(matrix) < MAX_NUMBER):
        raise ValueError(f"found shape {list(matrix.shape)}, or numbers that are not finite")
    return np.concatenate([matrix[:3], [[0.0, 0, 0, 1]]])
