"""Read and write ``.sog`` version 2 (developer.playcanvas.com, "The SOG format"): WebP textures in a zip or a folder.

The textures are lossless, and each pixel belongs to one Gaussian. Positions are signed logarithms of 16 bits. Rotations
are the three smaller components of quaternions, of 8 bits each. Log scales and colours are indices of codebooks with
256 values. For its harmonics, a Gaussian has the index of one entry in a palette of at most 65,536 entries. The numbers
of the palette are indices of a codebook, too.
"""

from __future__ import annotations

import heapq
import io
import json
import math
import os
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsmerge.arrays import to_float32
from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, replace
from gsmerge.io.archives import open_archive, read_member
from gsmerge.io.bounds import (
    ReadBudget,
    check_file,
    check_whole,
    parse_json,
    read_budget,
    read_errors,
    read_json,
    read_text,
)
from gsmerge.io.formats import rows as row_values
from gsmerge.io.formats.table import META, PLAIN, Contents
from gsmerge.method.kernels.elementary import expm1, log1p
from gsmerge.types import Gaussians

MAX_DEGREE = 3  # of harmonics, the highest of the format
VERSION = 2  # of the format, as its metadata states it
MODELS = {row_values.MIP: "antialiased", row_values.FLAT: "2dgs"}  # splat-transform's names of the modes of rendering
GENERATOR = "gsmerge"
# Names of all files that writers of the format make
SOG_FILES = (
    "means_l.webp", "means_u.webp", "scales.webp", "quats.webp", "sh0.webp", "shN_centroids.webp", "shN_labels.webp",
    META,
)  # fmt: skip
FIRST_MODE = 252  # alpha of a rotation with w as the largest component; 253 to 255 stand for x, y and z
PALETTE_BITS = 16  # bits of an index in the palette
PALETTE_COLUMNS = 64  # entries of the palette that are side by side in its texture
PACKED_BYTES = 19  # bytes of a Gaussian in the decoded textures
CODES = 256  # number of values in a codebook
_GSPLAT = "train with the option save_ply of simple_trainer, or decompress it and call gsplat.export_splats"
_CELLS = 1 << 11  # number of cells of equal width, and of cells with equal counts of values, before any are merged


@dataclass(frozen=True)
class _ZipFiles:
    """The files of a ``.sog`` in a zip. A file that would unpack to more bytes than the zip has is refused."""

    archive: zipfile.ZipFile
    size: int  # bytes of the zip

    def num_bytes(self, name: str) -> int:
        """Return the number of bytes that the file ``name`` takes in the zip."""
        return self.archive.getinfo(name).compress_size

    def read(self, name: str) -> bytes:
        """Read the file ``name``; raise ValueError if it is larger than the zip."""
        info = self.archive.getinfo(name)
        if info.file_size > self.size:
            raise ValueError(f"{name} of {info.file_size} bytes")
        return read_member(self.archive, info)


@dataclass(frozen=True)
class _FolderFiles:
    """The files of a ``.sog`` without a zip, in a folder."""

    folder: Path
    size: int  # bytes of all files of the ``.sog``

    def num_bytes(self, name: str) -> int:
        """Return the number of bytes of the file ``name``; raise ValueError if it is outside the folder."""
        path = self.folder / name
        inside = Path(os.path.realpath(path)).parent == Path(os.path.realpath(self.folder))
        if path.name != name or "\\" in name or not inside:
            raise ValueError(f"{name!r}, which is outside the folder")
        return check_file(path)

    def read(self, name: str) -> bytes:
        """Read the file ``name``; raise ValueError if it is outside the folder, or larger than the whole ``.sog``."""
        size = self.num_bytes(name)
        if size > self.size:
            raise ValueError(f"{name} of {size} bytes")
        return (self.folder / name).read_bytes()


_Files = _ZipFiles | _FolderFiles


@dataclass(frozen=True)
class SogContent:
    """Content of one ``.sog``."""

    packed: row_values.Packed
    sizes: dict[str, int]  # attribute -> bytes of its textures
    mode: str | None  # mode of rendering, see row_values.render_mode
    num_bytes: int  # of all files


def read_rows(path: Path) -> row_values.StoredRows:
    """Read the Gaussians of a ``.sog``; raise SceneError if it is no ``.sog`` of version 2, or is damaged."""
    budget = read_budget(path)
    with _damage_errors(path), open_archive(path) as archive:
        content = _read_content(_ZipFiles(archive, budget.file_bytes), budget)
    return row_values.to_stored([content.packed], f".sog version {VERSION}", content.sizes, content.mode)


def read_unzipped(path: Path) -> SogContent:
    """Read a ``.sog`` without its zip from its ``meta.json`` and the textures beside it.

    Raise SceneError as in :func:`read_rows`.
    """
    text = read_text(path)  # the size of the files that it names limits the memory of the reader
    with _damage_errors(path):
        entries = (entry for entry in os.scandir(path.parent) if f'"{entry.name}"' in text or entry.name == path.name)
        size = sum(entry.stat().st_size for entry in entries)
        return _read_content(_FolderFiles(path.parent, size), ReadBudget(path, size))


def read_folder(path: Path) -> row_values.StoredRows:
    """Read the rows of a ``.sog`` without its zip, by its ``meta.json``; raise SceneError as in :func:`read_rows`."""
    content = read_unzipped(path)
    meta_bytes = check_file(path)
    rows = row_values.to_stored([content.packed], f"unzipped .sog version {VERSION}", content.sizes, content.mode)
    return replace(rows, bytes_beside=content.num_bytes - meta_bytes)


def is_sog_meta(path: Path) -> bool:
    """Return whether a file of the name ``meta.json`` belongs to a ``.sog``, rather than to another program."""
    try:
        document = read_json(path)
    except SceneError:
        return False
    return isinstance(document, dict) and {"means", "scales", "quats", "sh0"} <= document.keys()


@contextmanager
def _damage_errors(path: Path) -> Iterator[None]:
    """In a ``with`` block, convert errors that a damaged file causes to a SceneError."""
    try:
        with read_errors(path):
            yield
    except zipfile.BadZipFile as error:
        raise SceneError(path, f"expected a .sog file, found no complete zip ({error})", "copy it again") from error
    except SceneError:
        raise
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError, EOFError) as error:
        problem = f"expected meta.json and textures of .sog version {VERSION}, found others ({error})"
        raise SceneError(path, problem, "export it again") from error
    except zlib.error as error:
        problem = f"expected a readable .sog file, found a damaged one ({error})"
        raise SceneError(path, problem, row_values.EXPORT_AGAIN) from error


def _read_content(files: _Files, budget: ReadBudget) -> SogContent:
    """Read the ``meta.json`` of a ``.sog``, and the textures that it names."""
    meta = parse_json(files.read(META).decode("utf-8-sig"), budget)
    version = meta.get("version", 1) if isinstance(meta, dict) else "none"
    means = meta.get("means") if version == 1 else None
    if isinstance(means, dict) and "mins" in means and "files" not in means:
        problem = f"expected .sog version {VERSION}, found a compressed checkpoint of gsplat (PngCompression)"
        raise SceneError(budget.path, problem, _GSPLAT)
    if version != VERSION:
        problem = f"expected .sog version {VERSION}, found {version}"
        raise SceneError(budget.path, problem, f"export it as version {VERSION}")
    count = check_whole(meta["count"], "count", 1)
    bands = check_whole(meta["shN"]["bands"], "bands", 1, MAX_DEGREE) if meta.get("shN") else 0
    row_values.check_gaussian_count(budget, count, (bands + 1) ** 2 - 1, PACKED_BYTES)
    modes_by_model = {model: mode for mode, model in MODELS.items()}
    mode = modes_by_model.get(str(meta.get("model")), row_values.MIP if meta.get("antialias") is True else None)
    packed = _read_packed(files, meta, count, budget)
    keys = [key for key in ("means", "scales", "quats", "sh0", "shN") if meta.get(key)]
    sizes = {key: sum(files.num_bytes(name) for name in meta[key]["files"]) for key in keys}
    return SogContent(packed, sizes, mode, files.size)


def _image_size(data: bytes) -> tuple[int, int]:
    """Return width and height of a lossless WebP image; raise ValueError for any other file."""
    at = 12  # bytes before the first chunk: "RIFF", the size of the file, "WEBP"
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        # A chunk has 4 bytes of name, 4 bytes of size, and content that is padded to an even number of bytes
        while at + 8 <= len(data) and data[at : at + 4] in (b"VP8X", b"ICCP"):  # chunks before the image
            at += 8 + (int.from_bytes(data[at + 4 : at + 8], "little") + 1) // 2 * 2
        if data[at : at + 4] == b"VP8L" and len(data) >= at + 13:
            bits = int.from_bytes(data[at + 9 : at + 13], "little")  # width - 1 and height - 1, of 14 bits each
            return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    raise ValueError("no WebP texture without loss")


def _read_texture(files: _Files, name: str, count: int, budget: ReadBudget) -> np.ndarray:
    """Decode the first ``count`` pixels of a texture to RGBA ``[count,4]``; without alpha, all get 255."""
    data = files.read(name)
    width, height = _image_size(data)
    if not count <= width * height <= 4 * count + (1 << 16):
        raise ValueError(f"{name} of {width} x {height} pixels for {count}")
    # The decoded image is in memory twice, in two orders of channels
    budget.check_memory(12 * width * height, f"{name} of {width} x {height} pixels")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(f"{name} is damaged") from error
    if image is None or image.shape[:2] != (height, width) or image.ndim != 3:
        raise ValueError(f"{name} is damaged")
    order = cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGBA
    return cv2.cvtColor(image, order).reshape(width * height, 4)[:count]


def _read_packed(files: _Files, meta: dict[str, Any], count: int, budget: ReadBudget) -> row_values.Packed:
    """Decode textures and codebooks, and return the Gaussians that they hold; raise ValueError for damaged content."""

    def texture(key: str, index: int = 0, channels: int = 3) -> np.ndarray:
        """Decode a texture that ``meta`` names under ``key``, to the first ``channels`` numbers of each Gaussian."""
        pixels = _read_texture(files, meta[key]["files"][index], count, budget)
        return pixels[:, :channels].copy()  # a copy, so that unused channels take no memory

    mins, maxs = (_to_numbers(meta["means"][key], 3) for key in ("mins", "maxs"))
    low_bytes, high_bytes, scales = texture("means"), texture("means", 1), texture("scales")
    quats, sh0 = texture("quats", channels=4), texture("sh0", channels=4)
    scale_codes, color_codes = (_to_numbers(meta[key]["codebook"], CODES) for key in ("scales", "sh0"))
    if quats[:, 3].min() < FIRST_MODE:
        raise ValueError(f"rotations of mode {quats[:, 3].min()}")
    # The entry of each Gaussian in the palette ``[n,num_higher,3]`` of codes, if there are harmonics
    labels: np.ndarray | None = None
    palette, harmonic_codes = np.zeros((0, 0, 3), np.uint8), np.zeros(CODES)
    if meta.get("shN"):
        size = check_whole(meta["shN"]["count"], "count", 1, 2**PALETTE_BITS)
        num_higher = (meta["shN"]["bands"] + 1) ** 2 - 1
        palette_name, labels_name = meta["shN"]["files"]
        labels = _read_texture(files, labels_name, count, budget)[:, :2].copy().view("<u2")[:, 0]
        # Rows of the texture; a label may exceed the size of the palette that ``meta.json`` states
        rows = max(-(-size // PALETTE_COLUMNS), int(labels.max()) // PALETTE_COLUMNS + 1)
        centroids = _read_texture(files, palette_name, rows * PALETTE_COLUMNS * num_higher, budget)[:, :3]
        palette = centroids.reshape(-1, num_higher, 3)
        harmonic_codes = _to_numbers(meta["shN"]["codebook"], CODES)

    def unpack(block: slice) -> row_values.Columns:
        """Return the Gaussians of a block of rows."""
        largest = quats[block, 3].astype(int) - FIRST_MODE
        smallest = (quats[block, :3] / 255 - 0.5) * np.sqrt(2.0)
        codes = np.zeros((len(largest), 0, 3), np.uint8) if labels is None else palette[labels[block]]
        return row_values.Columns(
            means=_decode_means(low_bytes[block] + 256.0 * high_bytes[block], mins, maxs),
            quats=row_values.from_smallest_three(largest, smallest),
            log_scales=scale_codes[scales[block]],
            opacities=sh0[block, 3] / 255,
            sh0=color_codes[sh0[block, :3]],
            harmonics=harmonic_codes[codes],
        )

    return row_values.Packed(count, palette.shape[1], unpack)


def _to_numbers(values: Any, length: int) -> np.ndarray:
    """Convert a list of ``meta.json`` to an array ``[length]``; raise ValueError if it has another length."""
    numbers = np.asarray(values, np.float64)
    if numbers.shape != (length,):
        raise ValueError(f"{numbers.shape} numbers instead of {length}")
    return numbers


def sog_bytes(gaussians: Gaussians, contents: Contents = PLAIN) -> bytes:
    """Encode a ``.sog``, with rows in the order of a space-filling curve; raise ValueError if there is NaN or inf.

    Comments may state the mode of rendering, see :func:`gsmerge.io.formats.rows.render_mode`.
    """
    columns = row_values.to_columns(gaussians, MAX_DEGREE).along_curve()
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, data in sog_files(columns, row_values.render_mode(contents.comments)).items():
            member = zipfile.ZipInfo(name)  # with the date 1980
            member.create_system = 3  # Unix on every system, so that equal files give equal archives
            archive.writestr(member, data)
    return content.getvalue()


def sog_files(columns: row_values.Columns, mode: str | None = None) -> dict[str, bytes]:
    """Encode the files of a ``.sog`` by name: textures, whose pixels have the order of the rows, and ``meta.json``."""
    count = len(columns)
    meta: dict[str, Any] = {"version": VERSION, "asset": {"generator": GENERATOR}, "count": count}
    meta["antialias"] = mode == row_values.MIP
    if mode is not None:
        meta["model"] = MODELS[mode]
    textures: dict[str, bytes] = {}

    def add(key: str, files: dict[str, bytes], **numbers: Any) -> None:
        """Add textures, and an entry of ``meta`` with their names and the given numbers."""
        meta[key] = {**numbers, "files": list(files)}
        textures.update(files)

    codes, mins, maxs = _quantise_means(columns.means)
    means_files = {"means_l.webp": _encode_texture(codes & 255), "means_u.webp": _encode_texture(codes >> 8)}
    add("means", means_files, mins=mins, maxs=maxs)
    scales = fit_codebook(columns.log_scales)
    sh0 = fit_codebook(columns.sh0)
    add(
        "scales", {"scales.webp": _encode_texture(nearest_codes(scales, columns.log_scales))}, codebook=_shorten(scales)
    )
    largest, smallest = row_values.smallest_three(columns.quats)
    quats = np.concatenate(
        [row_values.to_bytes(255 * (smallest / np.sqrt(2.0) + 0.5)), FIRST_MODE + largest[:, None]], 1
    )
    add("quats", {"quats.webp": _encode_texture(quats)})
    colors = np.concatenate([nearest_codes(sh0, columns.sh0), row_values.to_bytes(255 * columns.opacities)[:, None]], 1)
    add("sh0", {"sh0.webp": _encode_texture(colors)}, codebook=_shorten(sh0))
    if columns.harmonics.size:
        num_higher = columns.harmonics.shape[1]
        palette, labels = fit_palette(columns.harmonics.reshape(count, -1), PALETTE_BITS)
        codebook = fit_codebook(palette)
        rows = -(-len(palette) // PALETTE_COLUMNS)
        centroids = np.zeros((rows * PALETTE_COLUMNS, num_higher, 3), np.uint8)
        centroids[: len(palette)] = nearest_codes(codebook, palette).reshape(-1, num_higher, 3)
        files = {
            "shN_centroids.webp": _encode_webp(centroids.reshape(rows, PALETTE_COLUMNS * num_higher, 3)),
            "shN_labels.webp": _encode_texture(np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], 1)),
        }
        bands = row_values.sh_degree(num_higher)
        add("shN", files, count=len(palette), bands=bands, codebook=_shorten(codebook))
    return {**textures, META: json.dumps(meta).encode("ascii")}


def round_means(means: np.ndarray) -> np.ndarray:
    """Round means ``[n,3]`` as writing and reading a ``.sog`` does."""
    fixed, low, high = _quantise_means(means)
    return to_float32(_decode_means(fixed, np.array(low), np.array(high)))


def _quantise_means(means: np.ndarray) -> tuple[np.ndarray, list[float], list[float]]:
    """Quantise the signed logarithms of means to 16 bits; also return their minima and maxima for ``meta.json``."""
    logs = np.sign(means) * log1p(np.abs(means))
    mins = logs.min(axis=0)
    maxs = logs.max(axis=0)
    codes = np.round((logs - mins) / np.where(maxs > mins, maxs - mins, 1) * 65535).astype(int)
    return codes, _shorten(mins), _shorten(maxs)


def _decode_means(codes: np.ndarray, mins: np.ndarray, maxs: np.ndarray) -> np.ndarray:
    """Restore means from the results of :func:`_quantise_means`."""
    logs = mins + (maxs - mins) * codes / 65535
    return np.asarray(np.sign(logs) * expm1(np.abs(logs)))


def _shorten(values: np.ndarray) -> list[float]:
    """Round values to eight digits, which keep ``meta.json`` short and are enough for float32."""
    return [float(f"{value:.8g}") for value in values]


def _encode_texture(values: np.ndarray) -> bytes:
    """Encode rows of channels as pixels of a lossless, roughly square WebP image, whose last pixels may be padding."""
    width = max(4, math.ceil(math.sqrt(len(values)) / 4) * 4)
    height = max(4, math.ceil(len(values) / width / 4) * 4)
    pixels = np.zeros((height * width, values.shape[1]), np.uint8)
    pixels[: len(values)] = values
    return _encode_webp(pixels.reshape(height, width, -1))


def _encode_webp(image: np.ndarray) -> bytes:
    """Encode a lossless WebP image. The colours of a pixel with an alpha of 0 may change."""
    bgr_or_bgra = [2, 1, 0, 3][: image.shape[2]]  # OpenCV's order of channels
    lossless = 101  # OpenCV's WebP quality
    _, data = cv2.imencode(".webp", np.ascontiguousarray(image[..., bgr_or_bgra]), [cv2.IMWRITE_WEBP_QUALITY, lossless])
    return data.tobytes()


def fit_codebook(values: np.ndarray) -> np.ndarray:
    """Choose ``[256]`` rising codes that represent finite ``values`` of any shape, by 1-D k-means.

    The values are first divided into thousands of cells. Each step merges the two neighbouring cells whose merging adds
    the least squared error (Ward 1963), until 256 cells are left. Isolated values thus keep their own codes. Lloyd's
    algorithm then improves the codes. Codes that are not needed repeat the last code.
    """
    ordered = np.sort(values, axis=None)
    distinct = np.unique(ordered)
    if len(distinct) <= CODES:
        return np.pad(distinct, (0, CODES - len(distinct)), "edge" if len(distinct) else "constant")
    sums = np.concatenate([[0], np.cumsum(ordered)])
    # Ends of cells of equal width keep isolated values apart, and ends of cells with equal numbers of values divide
    # dense ranges
    equal_width = np.searchsorted(ordered, np.linspace(ordered[0], ordered[-1], _CELLS))
    equal_count = np.linspace(0, len(ordered), _CELLS).astype(int)
    ends = np.unique([*equal_width, *equal_count])
    # How many values each cell has, and their mean. Neighbouring cells are merged until 256 cells are left
    count, mean = np.diff(ends).astype(float).tolist(), (np.diff(sums[ends]) / np.diff(ends)).tolist()
    previous = list(range(-1, len(count) - 1))
    following = list(range(1, len(count) + 1))

    def merge_entry(i: int) -> tuple[float, int, int, float, float]:
        """Return the error that merging cell ``i`` and the next cell adds, both cells' indices, and their counts."""
        j = following[i]
        added_error = count[i] * count[j] / (count[i] + count[j]) * (mean[i] - mean[j]) ** 2
        return added_error, i, j, count[i], count[j]

    heap = [merge_entry(i) for i in range(len(count) - 1)]
    heapq.heapify(heap)
    for _ in range(len(count) - CODES):
        _, i, j, *counts = heapq.heappop(heap)
        while following[i] != j or [count[i], count[j]] != counts:  # one of the two cells has been merged meanwhile
            _, i, j, *counts = heapq.heappop(heap)
        mean[i] = (count[i] * mean[i] + count[j] * mean[j]) / (count[i] + count[j])
        count[i] = count[i] + count[j]
        count[j] = 0.0
        following[i] = following[j]
        if following[i] < len(count):
            previous[following[i]] = i
            heapq.heappush(heap, merge_entry(i))
        if previous[i] >= 0:
            heapq.heappush(heap, merge_entry(previous[i]))
    codes = np.array([m for m, n in zip(mean, count, strict=True) if n > 0])
    max_steps = 200  # steps of Lloyd's algorithm
    for _ in range(max_steps):
        ends = np.concatenate([[0], np.searchsorted(ordered, (codes[1:] + codes[:-1]) / 2), [len(ordered)]])
        numbers = np.diff(ends)
        totals = np.diff(sums[ends])
        cell_means = np.where(numbers > 0, totals / np.maximum(numbers, 1), codes)
        if np.array_equal(cell_means, codes):
            break
        codes = np.sort(cell_means)
    return codes


def nearest_codes(codebook: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the index (uint8) of the code nearest to each value, in the shape of ``values``."""
    return np.searchsorted((codebook[1:] + codebook[:-1]) / 2, values).astype(np.uint8)


def fit_palette(vectors: np.ndarray, max_bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Choose a palette of at most ``2**max_bits`` entries for ``vectors [n,d]``; also return each vector's entry.

    Groups of vectors are halved ``max_bits`` times at the median of the coordinate with the largest spread. The entries
    are the means of the final groups. If there are at most ``2**max_bits`` vectors, each vector is an entry.
    """
    count = len(vectors)
    if count <= 2**max_bits:
        return vectors, np.arange(count)
    order = np.arange(count)
    starts = np.zeros(1, int)
    for _ in range(max_bits):
        sizes = np.diff([*starts, count])
        groups = np.repeat(np.arange(len(starts)), sizes)
        ordered = vectors[order]
        means = np.add.reduceat(ordered, starts) / sizes[:, None]
        axes = np.add.reduceat((ordered - means[groups]) ** 2, starts).argmax(1)
        order = order[np.lexsort((ordered[np.arange(count), axes[groups]], groups))]
        starts = np.stack([starts, starts + sizes // 2], 1).reshape(-1)
    sizes = np.diff([*starts, count])
    labels = np.empty(count, int)
    labels[order] = np.repeat(np.arange(len(starts)), sizes)
    return np.add.reduceat(vectors[order], starts) / sizes[:, None], labels
