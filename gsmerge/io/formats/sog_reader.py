"""Reading ``.sog`` version 2: textures in a zip (:mod:`gsmerge.io.formats.sog_writer`)."""

from __future__ import annotations

import json
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import check_file
from gsmerge.io.formats.arrays import Columns, StoredRows, from_smallest_three, to_rows
from gsmerge.io.formats.sog_writer import FIRST_MODE, MAX_DEGREE, PALETTE_BITS, PALETTE_COLUMNS, VERSION

MAX_PER_BYTE = 16  # Gaussians: no real file has more than a fifth of one
MAX_META_BYTES = 1 << 20


def read_rows(path: Path) -> StoredRows:
    """The Gaussians of a ``.sog``. SceneError if it is none, of another version, truncated or damaged."""
    size = check_file(path)
    try:
        with zipfile.ZipFile(path) as archive:
            sog = _Sog(path, archive, size)
            meta = json.loads(sog.member("meta.json", MAX_META_BYTES))
            _check_version(path, meta)
            count = int(meta["count"])
            if not 0 < count <= MAX_PER_BYTE * size:
                raise SceneError(path, f"expected Gaussians in {size} bytes, found {count} promised")
            mip = meta.get("antialias") is True or meta.get("model") == "antialiased"
            columns = _columns(sog, meta, count)
            keys = [key for key in ("means", "scales", "quats", "sh0", "shN") if meta.get(key)]
            sizes = {key: sum(archive.getinfo(name).compress_size for name in meta[key]["files"]) for key in keys}
            return to_rows(columns, f".sog version {VERSION}", sizes, mip=mip)
    except OSError as error:
        raise SceneError(path, f"cannot be read ({error.strerror})") from error
    except zipfile.BadZipFile as error:
        raise SceneError(path, f"expected a .sog file, found no complete zip ({error})", "copy it again") from error
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError, EOFError) as error:
        problem = f"expected meta.json and textures of .sog version {VERSION}, found others ({error})"
        raise SceneError(path, " ".join(problem.split()), "export it again") from error
    except (zlib.error, MemoryError) as error:
        raise SceneError(path, f"expected a readable .sog file, found a damaged one ({error})") from error


def _check_version(path: Path, meta: Any) -> None:
    version = meta.get("version", 1) if isinstance(meta, dict) else "none"
    if version != VERSION:
        raise SceneError(path, f"expected .sog version {VERSION}, found {version}", "export it with a newer program")


@dataclass(frozen=True)
class _Sog:
    """The archive; everything taken from it is bounded by its size."""

    path: Path
    archive: zipfile.ZipFile
    size: int

    def member(self, name: str, limit: int) -> bytes:
        info = self.archive.getinfo(name)
        if info.file_size > limit:
            raise ValueError(f"{name} of {info.file_size} bytes")
        return self.archive.read(info)

    def texture(self, name: str, count: int) -> np.ndarray:
        """``[count,4]`` pixels RGBA, row by row; alpha is 255 where the file has none."""
        data = self.member(name, self.size)
        width, height = _webp_size(data)
        if not count <= width * height <= 4 * count + (1 << 16):
            raise ValueError(f"{name} of {width} x {height} pixels for {count}")
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error as error:
            raise ValueError(f"{name} is damaged") from error
        if image is None or image.shape[:2] != (height, width) or image.ndim != 3:
            raise ValueError(f"{name} is damaged")
        pixels = image.reshape(width * height, -1)[:count]
        colors, alpha = pixels[:, 2::-1], pixels[:, 3:] if pixels.shape[1] == 4 else np.full((count, 1), 255, np.uint8)
        return np.concatenate([colors, alpha], 1)


def _webp_size(data: bytes) -> tuple[int, int]:
    """Width and height in the header of a WebP file without loss. ValueError if it is none."""
    kind = data[12:16] if data[:4] == b"RIFF" and data[8:12] == b"WEBP" else b""
    if kind == b"VP8X" and len(data) >= 30:
        return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
    if kind == b"VP8L" and len(data) >= 25:
        bits = int.from_bytes(data[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    raise ValueError("no WebP texture without loss")


def _columns(sog: _Sog, meta: dict[str, Any], count: int) -> Columns:
    def texture(key: str, index: int = 0) -> np.ndarray:
        return sog.texture(meta[key]["files"][index], count)

    low, high = (_numbers(meta["means"][key], 3) for key in ("mins", "maxs"))
    fixed = texture("means", 0)[:, :3] + 256.0 * texture("means", 1)[:, :3]
    quats, colors = texture("quats"), texture("sh0")
    if quats[:, 3].min() < FIRST_MODE:
        raise ValueError(f"rotations of mode {quats[:, 3].min()}")
    with np.errstate(all="ignore"):  # what is not finite is set aside later
        logs = low + (high - low) * fixed / 65535
        return Columns(
            means=np.sign(logs) * np.expm1(np.abs(logs)),
            quats=from_smallest_three(quats[:, 3].astype(int) - FIRST_MODE, (quats[:, :3] / 255 - 0.5) * np.sqrt(2.0)),
            log_scales=_values(meta["scales"], texture("scales")[:, :3]),
            opacities=colors[:, 3] / 255,
            sh0=_values(meta["sh0"], colors[:, :3]),
            harmonics=_harmonics(sog, meta["shN"], count) if meta.get("shN") else np.zeros((count, 0, 3)),
        )


def _numbers(values: Any, length: int) -> np.ndarray:
    numbers = np.asarray(values, np.float64)
    if numbers.shape != (length,):
        raise ValueError(f"{numbers.shape} numbers instead of {length}")
    return numbers


def _values(part: dict[str, Any], codes: np.ndarray) -> np.ndarray:
    """What codes mean in the codebook of a part."""
    return _numbers(part["codebook"], 256)[codes]


def _harmonics(sog: _Sog, part: dict[str, Any], count: int) -> np.ndarray:
    size, bands = int(part["count"]), int(part["bands"])
    if not (1 <= bands <= MAX_DEGREE and 1 <= size <= 2**PALETTE_BITS):
        raise ValueError(f"{size} harmonics of degree {bands}")
    num_higher = (bands + 1) ** 2 - 1
    name, labels_name = part["files"]
    low, high = sog.texture(labels_name, count)[:, :2].T.astype(int)
    labels = low + 256 * high
    rows = max(-(-size // PALETTE_COLUMNS), labels.max() // PALETTE_COLUMNS + 1)
    centroids = sog.texture(name, rows * PALETTE_COLUMNS * num_higher)[:, :3]
    return _values(part, centroids.reshape(-1, num_higher, 3)[labels])
