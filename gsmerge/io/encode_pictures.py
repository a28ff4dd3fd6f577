"""Encode pictures for pages."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image


def encode_picture(picture: np.ndarray, quality: int) -> bytes:
    """Encode a picture ``[h,w,3]`` uint8 sRGB as a lossy WebP with a ``quality`` from 0 to 100."""
    from PIL import WebPImagePlugin  # noqa: F401 - without it, Pillow imports the plugins of all formats

    content = io.BytesIO()
    effort = 0  # of 0 to 6; an effort of 1 takes a quarter longer for 1 % fewer bytes, and an effort of 2 twice as long
    Image.fromarray(picture).save(content, "WEBP", quality=quality, method=effort)
    return content.getvalue()
