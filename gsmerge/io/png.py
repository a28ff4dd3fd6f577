"""PNG files looked through before they are decoded: the decoder prints lines of its own about damage it meets."""

from __future__ import annotations

import struct
import zlib

import numpy as np

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_DECODED = frozenset({b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"})


def checked_png(data: np.ndarray) -> np.ndarray | None:
    """The chunks of a PNG file that make up its picture; None where one is damaged, missing or of an unknown kind.

    Colour profiles, texts and times are left out, damaged or not: they do not change what is decoded.

    Args:
        data: ``[b]`` uint8, the file.
    """
    view, start = np.ascontiguousarray(data).data, len(SIGNATURE)
    parts: list[bytes | memoryview] = [SIGNATURE]
    while start + 12 <= len(view):
        (length,) = struct.unpack_from(">I", view, start)
        kind, end = bytes(view[start + 4 : start + 8]), start + 12 + length
        if kind == b"IEND":
            parts.append(struct.pack(">I4sI", 0, kind, zlib.crc32(kind)))
            return np.frombuffer(b"".join(parts), np.uint8)
        if end > len(view):
            return None
        if kind in _DECODED:
            if zlib.crc32(view[start + 4 : end - 4]) != struct.unpack_from(">I", view, end - 4)[0]:
                return None
            parts.append(view[start:end])
        elif kind[:1].isupper():  # critical, and unknown
            return None
        start = end
    return None
