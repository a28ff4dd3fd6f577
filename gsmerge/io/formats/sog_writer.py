"""``.sog`` version 2: a zip of WebP textures without loss, one pixel per Gaussian, and ``meta.json``
(developer.playcanvas.com, "The SOG format").

Positions are 16 bits of their signed logarithms, rotations their three smaller components at 8 bits, log scales,
colours and harmonics codes of codebooks of 256; all harmonics of a Gaussian are one of at most 65,536 of a palette.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from typing import Any

import cv2
import numpy as np

from gsmerge.geometry import morton_codes
from gsmerge.io.formats.arrays import Columns, smallest_three, to_bytes, to_columns
from gsmerge.io.formats.codebooks import fit_codebook, fit_palette, nearest_codes
from gsmerge.types import Gaussians

MAX_DEGREE = 3
VERSION = 2
FIRST_MODE = 252  # alpha of a rotation whose largest component is the first
PALETTE_BITS = 16
PALETTE_COLUMNS = 64  # sets of harmonics side by side in the texture of the palette
_LOSSLESS = 101  # OpenCV's WebP quality


def sog_bytes(gaussians: Gaussians, *, mip: bool = False) -> bytes:
    """Content of a ``.sog`` file; rows along a space-filling curve. ``mip`` marks antialiased Gaussians.
    ValueError if there is NaN or inf.
    """
    columns = to_columns(gaussians, MAX_DEGREE)
    columns = columns.select(np.argsort(morton_codes(columns.means), kind="stable"))
    count = len(columns)
    meta: dict[str, Any] = {"version": VERSION, "asset": {"generator": "gsmerge"}, "count": count, "antialias": mip}
    if mip:
        meta["model"] = "antialiased"  # as splat-transform says it
    textures: dict[str, np.ndarray] = {}

    def add(key: str, files: dict[str, np.ndarray], **numbers: Any) -> None:
        meta[key] = {**numbers, "files": list(files)}
        textures.update(files)

    low, high, fixed = _log_positions(columns.means)
    halves = {"means_l.webp": fixed & 255, "means_u.webp": fixed >> 8}
    add("means", {name: _texture(half) for name, half in halves.items()}, mins=_numbers(low), maxs=_numbers(high))
    scales, sh0 = fit_codebook(columns.log_scales), fit_codebook(columns.sh0)
    add("scales", {"scales.webp": _texture(nearest_codes(scales, columns.log_scales))}, codebook=_numbers(scales))
    add("quats", {"quats.webp": _texture(_rotations(columns.quats))})
    colors = np.concatenate([nearest_codes(sh0, columns.sh0), to_bytes(255 * columns.opacities)[:, None]], 1)
    add("sh0", {"sh0.webp": _texture(colors)}, codebook=_numbers(sh0))
    if columns.harmonics.size:
        files, numbers = _harmonics(columns)
        add("shN", files, **numbers)
    return _zip({name: _webp(texture) for name, texture in textures.items()}, meta)


def _log_positions(means: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smallest and largest signed logarithms ``[3]``, and all between them as 16-bit numbers ``[n,3]``."""
    logs = np.sign(means) * np.log1p(np.abs(means))
    if len(logs) == 0:
        return np.zeros(3), np.zeros(3), np.zeros((0, 3), int)
    low, high = logs.min(0), logs.max(0)
    return low, high, np.round((logs - low) / np.where(high > low, high - low, 1) * 65535).astype(int)


def _rotations(quats: np.ndarray) -> np.ndarray:
    largest, others = smallest_three(quats)
    return np.concatenate([to_bytes(255 * (others / np.sqrt(2.0) + 0.5)), FIRST_MODE + largest[:, None]], 1)


def _harmonics(columns: Columns) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Textures of the palette and of the index of every Gaussian in it, and what ``meta.json`` says about them."""
    count, num_higher = columns.harmonics.shape[:2]
    palette, labels = fit_palette(columns.harmonics.reshape(count, -1), PALETTE_BITS)
    codebook = fit_codebook(palette)
    rows = -(-len(palette) // PALETTE_COLUMNS)
    centroids = np.zeros((rows * PALETTE_COLUMNS, num_higher, 3), np.uint8)
    centroids[: len(palette)] = nearest_codes(codebook, palette).reshape(-1, num_higher, 3)
    files = {
        "shN_centroids.webp": centroids.reshape(rows, PALETTE_COLUMNS * num_higher, 3),
        "shN_labels.webp": _texture(np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], 1)),
    }
    bands = round((num_higher + 1) ** 0.5) - 1
    return files, {"count": len(palette), "bands": bands, "codebook": _numbers(codebook)}


def _numbers(values: np.ndarray) -> list[float]:
    """As short as float32 allows."""
    return [float(f"{value:.8g}") for value in values]


def _texture(values: np.ndarray) -> np.ndarray:
    """Rows of channels as an image of RGB or RGBA about as high as wide, filled up with zeros."""
    width = max(4, math.ceil(math.sqrt(len(values)) / 4) * 4)
    height = max(4, math.ceil(len(values) / width / 4) * 4)
    pixels = np.zeros((height * width, values.shape[1]), np.uint8)
    pixels[: len(values)] = values
    return pixels.reshape(height, width, -1)


def _webp(image: np.ndarray) -> bytes:
    """WebP without loss; only the colours of pixels whose alpha is 0, which are never seen, may differ."""
    order = [2, 1, 0, 3][: image.shape[2]]
    _, data = cv2.imencode(".webp", np.ascontiguousarray(image[..., order]), [cv2.IMWRITE_WEBP_QUALITY, _LOSSLESS])
    return data.tobytes()


def _zip(files: dict[str, bytes], meta: dict[str, Any]) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, data in {**files, "meta.json": json.dumps(meta).encode("ascii")}.items():
            archive.writestr(zipfile.ZipInfo(name), data)  # of 1980: the same bytes at any time
    return content.getvalue()
