"""Cameras inside a ``.ply``: comments of its header, which other readers skip, or the elements of SHARP."""

from __future__ import annotations

import base64
import binascii
import zlib
from pathlib import Path

import numpy as np
from plyfile import PlyListProperty

from gsmerge.errors import SceneError
from gsmerge.io.bounds import ReadBudget, check_file, parse_json, read_errors
from gsmerge.io.cameras.camera_file import StoredView, make_pinhole
from gsmerge.io.cameras.camera_format import CameraSource, StoredCameras
from gsmerge.io.cameras.json_files import transforms_views
from gsmerge.io.formats.ply import MAX_HEADER_BYTES
from gsmerge.io.formats.table import PLY, input_format

EMBEDDED = "inside the .ply"  # source of such cameras
PREFIX = "gsmerge cameras: "
_TEXT_COPIES = 8  # bytes of memory for each of unpacked JSON: as it comes, and four for each character
SHARP = "SHARP"  # the same
_SHARP_ELEMENTS = ("extrinsic", "intrinsic", "image_size")  # the last not in its first versions
SHARP_LAYERS = 2  # Gaussians per cell: a front and a back layer


def holds_cameras(path: Path) -> bool:
    """Return whether a file is a ``.ply`` with cameras in its header."""
    return path.suffix.lower() == ".ply" and bool(camera_lines(path))


def camera_lines(path: Path) -> list[bytes]:
    """Return the comment lines of a ``.ply`` that hold cameras; empty without any."""
    check_file(path)
    with read_errors(path), path.open("rb") as file:
        header = file.read(MAX_HEADER_BYTES if file.peek(3)[:3] == b"ply" else 0).partition(b"\nend_header")[0]
    start = f"comment {PREFIX}".encode()
    return [line[len(start) :].strip() for line in header.splitlines() if line.startswith(start)]


def read_embedded(source: CameraSource) -> StoredCameras:
    """Read the cameras in the header of a ``.ply``; SceneError if they are damaged."""
    path, lines = source.path, camera_lines(source.path)
    try:
        packed, unpacking = base64.b64decode(b"".join(lines), validate=True), zlib.decompressobj()
        budget = ReadBudget(path, len(packed))
        text = unpacking.decompress(packed, budget.memory // _TEXT_COPIES)
        if not unpacking.eof:
            raise ValueError("they are cut off or too long")
        data = parse_json(text.decode("utf-8"), budget)
        if not isinstance(data, dict) or "frames" not in data:
            raise ValueError("they have no 'frames'")
    except (ValueError, zlib.error, binascii.Error) as error:
        problem = f"expected whole cameras in its header, found damaged ones ({error})"
        raise SceneError(path, problem, "name others with --cameras") from error
    return StoredCameras(transforms_views(path, data))


def read_sharp(source: CameraSource) -> StoredCameras | None:
    """Read the camera that SHARP writes into its ``.ply``, at the size of the file's grid; None without one.

    The grid is square whatever the photo's shape: the photo was stretched to it. SceneError if the numbers are
    damaged.
    """
    if input_format(source.path).read is not PLY.read:
        return None
    data = source.ply
    present = [name for name in _SHARP_ELEMENTS if name in data]
    if "vertex" not in data or not {"extrinsic", "intrinsic"}.issubset(present):
        return None
    for element in (data[name] for name in present):
        if element.count > 16 or len(element.properties) != 1 or isinstance(element.properties[0], PlyListProperty):
            return None
    numbers = {name: np.asarray([row[0] for row in data[name].data], np.float64) for name in present}
    extrinsic, intrinsic = numbers["extrinsic"], numbers["intrinsic"]
    if len(intrinsic) == 4 and "image_size" not in numbers:  # first versions: focal lengths and size
        numbers["image_size"] = intrinsic[2:]
        intrinsic = make_pinhole(*intrinsic[:2], *(intrinsic[2:] / 2)).reshape(-1)
    size = numbers.get("image_size", np.zeros(0))
    side = round((data["vertex"].count / SHARP_LAYERS) ** 0.5)
    if SHARP_LAYERS * side * side != data["vertex"].count or len(size) != 2 or not (size > 0).all():
        return None
    if len(extrinsic) not in (12, 16) or len(intrinsic) != 9:
        problem = f"expected 16 and 9 numbers of a camera, found {len(extrinsic)} and {len(intrinsic)}"
        raise SceneError(source.path, problem)
    pose, K = extrinsic.reshape(-1, 4).copy(), intrinsic.reshape(3, 3)
    if len(extrinsic) == 12:  # its first versions: the rotation column by column
        pose[:, :3] = pose[:, :3].T.copy()
    K = K * np.array([[side / size[0]], [side / size[1]], [1.0]])
    return StoredCameras([StoredView(source.path.stem, pose, K, (side, side))])
