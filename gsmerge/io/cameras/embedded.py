"""Cameras inside a ``.ply``: comments of its header, which other readers skip."""

from __future__ import annotations

import base64
import binascii
import json
import textwrap
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from gsmerge.errors import SceneError, UsageError
from gsmerge.io.bounds import read_errors
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.cameras.json_files import read_transforms, transforms_document
from gsmerge.io.formats.ply import MAX_HEADER_BYTES
from gsmerge.types import Cameras

EMBEDDED = "inside the .ply"  # source of such cameras
PREFIX = "gsmerge cameras: "
LINE = 900  # characters of a comment: readers in C keep lines of 1,024
MAX_CHARS = 96 << 10  # of all: splat-transform looks for the end of a header in 128 KiB
MAX_TEXT = 32 << 20  # bytes of the JSON, as of a file of cameras
DIGITS = 10  # of each number: 1e-9 of a pixel or of the scene, in half the space of all
_PROBE = 1 << 12  # bytes from the start of a file within which the first comment is


def camera_comments(cameras: Cameras, names: Sequence[str]) -> list[str]:
    """Write cameras as comments for a ``.ply``: a compressed ``transforms.json`` in base64.

    UsageError if they are so many that other programs would not read the header.
    """
    text = json.dumps(transforms_document(cameras, names, digits=DIGITS), separators=(",", ":"))
    packed = base64.b64encode(zlib.compress(text.encode(), 9)).decode("ascii")
    if len(packed) > MAX_CHARS:
        raise UsageError(
            f"--embed-cameras: expected at most {MAX_CHARS:,} characters in the header, got {len(packed):,} of"
            f" {len(names):,} views; write them to a file with --save-cameras"
        )
    return [PREFIX + line for line in textwrap.wrap(packed, LINE)]


def holds_cameras(path: Path) -> bool:
    """Return whether a file is a ``.ply`` with cameras in the comments of its header."""
    if path.suffix.lower() != ".ply":
        return False
    with read_errors(path), path.open("rb") as file:
        start = file.read(_PROBE)
    header = start.partition(b"\nend_header")[0]
    return header.startswith(b"ply") and f"\ncomment {PREFIX}".encode() in header


def read_embedded(path: Path) -> CameraFile:
    """Read the cameras in the header of a ``.ply``; SceneError if there are none, or damaged ones."""
    with read_errors(path), path.open("rb") as file:
        header = file.read(MAX_HEADER_BYTES).partition(b"\nend_header")[0]
    start = f"comment {PREFIX}".encode()
    lines = [line[len(start) :].strip() for line in header.splitlines() if line.startswith(start)]
    if not lines:
        problem = "expected cameras inside it (compact --embed-cameras), found none"
        raise SceneError(path, problem, "name another file")
    try:
        unpacking = zlib.decompressobj()
        text = unpacking.decompress(base64.b64decode(b"".join(lines), validate=True), MAX_TEXT)
        if not unpacking.eof:
            raise ValueError("they are cut off or too long")
        data = json.loads(text)
        if not isinstance(data, dict) or "frames" not in data:
            raise ValueError("they have no 'frames'")
    except (ValueError, RecursionError, zlib.error, binascii.Error) as error:
        problem = f"expected whole cameras in its header, found damaged ones ({error})"
        raise SceneError(path, problem, "name others with --cameras") from error
    return replace(read_transforms(path, data), source=EMBEDDED)
