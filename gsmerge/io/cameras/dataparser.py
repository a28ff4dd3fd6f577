"""Read how programs moved cameras into the Gaussians' world: nerfstudio's map, or an offset of surveys."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.geometry.transforms import Similarity
from gsmerge.io.bounds import read_json
from gsmerge.io.cameras.camera_file import MAX_NUMBER, make_similarity
from gsmerge.io.cameras.camera_source import number_errors, to_array, to_number
from gsmerge.kernels.matrices import invert, matmul

DATAPARSER = "dataparser_transforms.json"
_OFFSET = re.compile(r"(?:^|[>:=(])\s*N[\s,;]+N[\s,;]+N\s*(?:$|[<)])".replace("N", r"([-+]?\d+\.?\d*)"), re.MULTILINE)


def read_dataparser(ply: Path, cameras: Path | None) -> list[Similarity]:
    """Read the similarities that nerfstudio may have applied to the cameras: candidates to be measured.

    Nerfstudio's ``dataparser_transforms.json`` has the map into the Gaussians' world: X' = scale (transform [X; 1]).
    ``transform`` starts from the world of the capture. A ``transforms.json`` with ``applied_transform`` (and
    ``applied_scale``) has poses that were moved by these already, so the second candidate undoes them. Empty if
    there is no such file. SceneError if a file lacks a rotation, shift and positive scale.
    """
    folders = [ply.parent] + ([] if cameras is None else [cameras.parent])
    path = next((folder / DATAPARSER for folder in folders if (folder / DATAPARSER).is_file()), None)
    if path is None:
        return _read_offsets(folders)
    data = read_json(path)
    with number_errors(path, "expected 'transform' of 3x4 numbers and 'scale'"):
        transform = _square(data["transform"])
        scale = to_number(data["scale"])
    candidates = [make_similarity(path, transform, scale)]
    camera_data = read_json(cameras) if cameras is not None and cameras.suffix == ".json" and cameras.is_file() else {}
    if isinstance(camera_data, dict) and "applied_transform" in camera_data:
        with number_errors(cameras or path, "expected 'applied_transform' of 3x4 numbers"):
            applied = _square(camera_data["applied_transform"])
            factor = to_number(camera_data.get("applied_scale") or 1)
            candidates.append(make_similarity(path, matmul(transform, invert(applied)), scale / factor))
    return candidates


def _read_offsets(folders: Sequence[Path]) -> list[Similarity]:
    """Read offsets that surveys subtract from coordinates in metres: three numbers alone in a small text or XML file.

    Metashape and CloudCompare have them in text files, and DJI Terra in metadata.xml. The cameras are moved by each
    offset in both directions, since either side may be without it.
    """
    offset_endings, max_offsets = (".txt", ".xml", ".xyz"), 8  # of files that may have an offset, and how many are read
    paths = sorted({path for folder in folders for path in folder.glob("[!.]*") if path.suffix in offset_endings})
    small = [path for path in paths if path.is_file() and os.access(path, os.R_OK) and path.stat().st_size <= 1 << 12]
    found = [(path.name, _OFFSET.search(path.read_text("latin-1"))) for path in small[:max_offsets]]
    offsets = {tuple(map(float, numbers.groups())): name for name, numbers in found if numbers is not None}
    return [
        Similarity(
            np.eye(3), 1.0, sign * np.array(offset), f"moved by {'minus ' if sign < 0 else ''}the offset in {name}"
        )
        for offset, name in offsets.items()
        for sign in (-1, 1)
        if max(map(abs, offset)) < MAX_NUMBER
    ]


def _square(values: Any) -> np.ndarray:
    matrix = to_array(values)
    if matrix.shape not in ((3, 4), (4, 4)) or not np.all(np.abs(matrix) < MAX_NUMBER):
        raise ValueError(f"found shape {list(matrix.shape)}, or numbers that are not finite")
    return np.concatenate([matrix[:3], [[0.0, 0, 0, 1]]])
