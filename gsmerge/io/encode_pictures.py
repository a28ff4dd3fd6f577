"""Encode pictures for pages."""

from __future__ import annotations

import io
import struct
import zlib

import numpy as np
from PIL import Image

from gsmerge.io.photo_files import PNG, PNG_END

_PALETTE = 3  # colour type of a PNG with a palette
_EFFORT = 0  # of a WebP, of at most 6; an effort of 1 takes a quarter longer for 1 % fewer bytes, 2 twice as long


def encode_picture(picture: np.ndarray, quality: int) -> bytes:
    """Encode a picture ``[h,w,3]`` uint8 sRGB as a WebP with a ``quality`` up to 100."""
    from PIL import WebPImagePlugin  # noqa: F401 - without it, Pillow imports the plugins of all formats

    content = io.BytesIO()
    Image.fromarray(picture).save(content, "WEBP", quality=quality, method=_EFFORT)
    return content.getvalue()


def encode_indexed(indices: np.ndarray, colors: np.ndarray) -> bytes:
    """Encode ``indices [h,w]`` uint8 into ``colors [n,3 or 4]`` uint8 sRGB as a PNG; index 0 is transparent.

    With up to 16 colours, two pixels share a byte.
    """
    (height, width), bits = indices.shape, 4 if len(colors) <= 16 else 8  # bits of an index
    opacities = colors[:, 3].copy() if colors.shape[1] > 3 else np.full(len(colors), 255, np.uint8)
    opacities[0] = 0
    if bits == 4:
        indices = np.pad(indices, ((0, 0), (0, width % 2)))
        indices = indices[:, ::2] << 4 | indices[:, 1::2]
    rows = np.pad(indices, ((0, 0), (1, 0)))  # each row begins with the number of its filter, 0 for none
    packer = zlib.compressobj(1, strategy=zlib.Z_RLE)  # single pixels repeat often, longer runs seldom
    content = PNG
    for kind, data in (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, bits, _PALETTE, 0, 0, 0)),
        (b"PLTE", colors[:, :3].tobytes()), (b"tRNS", opacities.tobytes()),
        (b"IDAT", packer.compress(rows.tobytes()) + packer.flush()),
    ):  # fmt: skip
        content += struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return content + PNG_END
