"""The size that an image file says it has, read from its first bytes, so that nothing is decoded to learn it."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import BinaryIO

from gsmerge.errors import SceneError
from gsmerge.io.bounds import check_file, check_pixels

_HEAD = 64  # bytes that hold the size, in all formats but JPEG and TIFF
_MAX_PIXEL_BYTES, _MAX_EXTRA = 16, 16 << 20  # of any file: four floats a pixel, and profiles or thumbnails
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # markers of a JPEG that hold its size
_TIFF_TYPES = {3: "H", 4: "I"}
_MAX_TAGS = 4096


def stored_size(path: Path) -> tuple[int, int]:
    """(width, height) of a PNG, JPEG, WebP, BMP, TIFF or PNM file, pixels, without regard to its orientation tag.

    Raises:
        SceneError: If it is no such file, cannot be read, or tells a size that no image of Gaussians has.
    """
    file_size = check_file(path)
    try:
        with path.open("rb") as file:
            width, height = told_size(path, file)
    except OSError as error:
        raise SceneError(path, f"cannot be read ({error.strerror})") from error
    if file_size > _MAX_PIXEL_BYTES * width * height + _MAX_EXTRA:
        raise SceneError(path, f"expected an image of {width} x {height}, found {file_size >> 20} MiB for it")
    return width, height


def told_size(path: Path, file: BinaryIO) -> tuple[int, int]:
    """:func:`stored_size` of an image that is open, or inside another file.

    Args:
        path: The file, for messages.
        file: At the image's first byte.
    """
    try:
        width, height = _size(file)
    except (struct.error, ValueError) as error:
        raise SceneError(path, "expected an image, found a file that cannot be decoded", "replace it") from error
    check_pixels(path, width, height)
    return width, height


def _size(file: BinaryIO) -> tuple[int, int]:
    head = file.read(_HEAD)
    if head[:8] == b"\x89PNG\r\n\x1a\n":
        return struct.unpack_from(">II", head, 16)
    if head[:2] == b"\xff\xd8":
        return _jpeg(file)
    if head[:2] == b"BM":
        return _bmp(head)
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return _webp(head)
    if head[:4] in (b"II*\0", b"MM\0*"):
        return _tiff(file, "<" if head[:2] == b"II" else ">")
    match = re.match(rb"P[1-6]\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s", head)
    if match is None:
        raise ValueError("no format that is known")
    return int(match[1]), int(match[2])


def _jpeg(file: BinaryIO) -> tuple[int, int]:
    file.seek(2)
    while True:
        start, marker = struct.unpack(">BB", file.read(2))
        while marker == 0xFF:  # padding
            (marker,) = file.read(1) or b"\0"
        if start != 0xFF or marker in (0, 0xD9, 0xDA):
            raise ValueError("no frame before the data")
        (length,) = struct.unpack(">H", file.read(2))
        if marker in _FRAMES:
            _, height, width = struct.unpack(">BHH", file.read(5))
            return width, height
        file.seek(max(length - 2, 0), 1)


def _bmp(head: bytes) -> tuple[int, int]:
    if struct.unpack_from("<I", head, 14)[0] == 12:
        return struct.unpack_from("<HH", head, 18)
    width, height = struct.unpack_from("<ii", head, 18)
    return width, abs(height)  # negative where the first row is on top


def _webp(head: bytes) -> tuple[int, int]:
    if head[12:16] == b"VP8X":
        width, height = (int.from_bytes(head[i : i + 3], "little") for i in (24, 27))
        return width + 1, height + 1
    if head[12:16] == b"VP8L":
        (bits,) = struct.unpack_from("<I", head, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    width, height = struct.unpack_from("<HH", head, 26)
    return width & 0x3FFF, height & 0x3FFF


def _tiff(file: BinaryIO, order: str) -> tuple[int, int]:
    file.seek(4)
    (place,) = struct.unpack(f"{order}I", file.read(4))
    file.seek(place)
    (count,) = struct.unpack(f"{order}H", file.read(2))
    found: dict[int, int] = {}
    for _ in range(min(count, _MAX_TAGS)):
        entry = file.read(12)
        tag, kind, _ = struct.unpack_from(f"{order}HHI", entry)
        if tag in (256, 257) and kind in _TIFF_TYPES:
            (found[tag],) = struct.unpack_from(f"{order}{_TIFF_TYPES[kind]}", entry, 8)
    if len(found) < 2:
        raise ValueError("no size")
    return found[256], found[257]
