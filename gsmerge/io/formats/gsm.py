"""Read and write states (``.gsm``), the files in which ``extend`` stores batches of views.

A ``.gsm`` is a safetensors file. Its only metadata entry is a header in JSON, with checksums of the header and of each
array. Files of the kind ``scene`` hold results with their cameras and pictures. This module reads ``scene`` files.
Files of the kind ``features`` hold Feature Gaussians, and are read by :mod:`gsmerge.jobs.states.features`. No content
of a file is executed, and each array is checked before it is used.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

from gsmerge.arrays import as_array
from gsmerge.errors import SceneError, count_words
from gsmerge.frozen import dataclass, replace
from gsmerge.io.atomic import atomic_output
from gsmerge.io.bounds import check_image_size, parse_json, read_budget
from gsmerge.io.cameras.camera_file import StoredView
from gsmerge.io.cameras.camera_source import CameraSource, StoredCameras
from gsmerge.io.formats.rows import Columns, Packed, StoredRows, check_gaussian_count, copied_comments, to_stored
from gsmerge.io.tensor_file import read_tensors
from gsmerge.method.kernels.elementary import log
from gsmerge.types import Cameras, Gaussians, Scene, StrPath
from gsmerge.version import __version__

SCHEMA = 3  # version of the whole file; gsmerge 0.3.0 and earlier wrote lower versions
# names of the metadata entry; gsmerge 0.1 wrote gsmerge-encoded
HEADER = "gsmerge-state"
ENCODED = "gsmerge-encoded"
# kinds of files
SCENE = "scene"
FEATURES = "features"
REMEDY = "run extend again with all batches"
# Entry of the header -> its type
HEADER_ENTRIES: Mapping[str, type] = {
    "schema": int, "gsmerge": str, "kind": str, "width": int, "height": int, "names": list, "about": dict,
}  # fmt: skip
NUM_HIGHER = (0, 3, 8, 15, 24)  # numbers of harmonics above degree 0, for degree 0 to 4


@dataclass(frozen=True, eq=False)
class GsmFile:
    """Content of a ``.gsm``: a header whose entries have the right types, and arrays that match their checksums."""

    path: Path
    header: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]

    def error(self, problem: str) -> SceneError:
        """Return the SceneError for a damaged file."""
        return SceneError(self.path, problem, "copy it again, or " + REMEDY)

    def array(self, name: str, dtype: type[np.generic], *shape: int | None) -> np.ndarray:
        """Return the array ``name``; raise SceneError for another type or shape. None in ``shape`` allows any size."""
        array = self.arrays.get(name)
        expected = f"{name}: expected {dtype.__name__} {['n' if n is None else n for n in shape]}"
        if array is None:
            raise self.error(f"{expected}, found none")
        sizes_fit = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        if array.dtype != dtype or not sizes_fit:
            raise self.error(f"{expected}, found {array.dtype} {list(array.shape)}")
        return array

    def finite(self, name: str, dtype: type[np.generic], *shape: int | None) -> np.ndarray:
        """Return an array as :meth:`array` does; also raise SceneError if the array has NaN or inf."""
        array = self.array(name, dtype, *shape)
        if not np.isfinite(array).all():
            raise self.error(f"{name}: expected finite numbers, found NaN or inf")
        return array


def write_gsm(
    path: StrPath, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], *, overwrite: bool, mode: int
) -> None:
    """Write a ``.gsm`` with ``arrays`` and a header, to which schema, version and checksums are added.

    ``mode``: the most rights that the file gets, since its pictures may be private.
    """
    header = {"schema": SCHEMA, "gsmerge": __version__, **header}
    data = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    with atomic_output(path, overwrite=overwrite, mode=mode) as temporary:
        header["checksums"] = _checksums(header, data)
        # Metadata is a single entry, since safetensors writes several entries in an order that varies
        temporary.write_bytes(save(data, {HEADER: json.dumps(header)}))


def _checksums(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Compute the CRC-32 of the header without its checksums, and of each array."""
    plain = {name: value for name, value in header.items() if name != "checksums"}
    text = json.dumps(json.loads(json.dumps(plain)), sort_keys=True)  # converts keys to text, as a reader sees them
    sums = {"header": zlib.crc32(text.encode("utf-8", "replace"))}
    return sums | {name: zlib.crc32(np.ascontiguousarray(array).tobytes()) for name, array in sorted(arrays.items())}


def read_gsm(path: StrPath, kind: str | None = None) -> GsmFile:
    """Read a ``.gsm`` of a ``kind``, or of any kind if None; raise SceneError for other files or a wrong checksum."""
    path = Path(path)
    metadata, arrays = read_tensors(path, "a .gsm file", REMEDY)
    header = _parse_header(path, metadata)
    if kind not in (None, header["kind"]):
        remedy = f"decode them with gsmerge compact {path} --k 2"
        raise SceneError(path, "expected results in the .gsm, found Feature Gaussians", remedy)
    file = GsmFile(path, header, arrays)
    stored = header.get("checksums")
    actual = _checksums(header, arrays)
    if stored != actual:
        wrong = [name for name in actual if not isinstance(stored, dict) or stored.get(name) != actual[name]]
        raise file.error(f"{wrong[0] if wrong else 'arrays'}: expected the checksum in the header, found another")
    return file


def read_header(path: Path) -> dict[str, Any]:
    """Read only the header of a ``.gsm``; raise SceneError for other files."""
    return _parse_header(path, read_tensors(path, "a .gsm file", REMEDY, arrays=False)[0])


def _parse_header(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """Parse the header of a file; raise SceneError if the file has no header, or if its schema or an entry is wrong."""
    text = metadata.get(HEADER, metadata.get(ENCODED))
    if text is None:
        raise SceneError(path, "expected a .gsm of gsmerge, found another safetensors file", "name the .gsm")
    try:
        header = parse_json(text, read_budget(path))
    except ValueError as error:
        raise SceneError(path, f"expected a header in JSON, found other text ({error})", REMEDY) from error
    schema = header.get("schema") if isinstance(header, dict) else None
    if schema != SCHEMA:
        newer = isinstance(schema, int) and schema > SCHEMA
        remedy = f"update gsmerge, this is {__version__}" if newer else REMEDY
        version = header.get("gsmerge") if isinstance(header, dict) else None
        writer = f" of gsmerge {version!s:.20}" if version else ""
        problem = f"expected a .gsm of schema {SCHEMA}, which gsmerge {__version__} reads, found schema {schema!r:.40}"
        raise SceneError(path, f"{problem}{writer}", remedy)
    for name, entry_type in HEADER_ENTRIES.items():
        if type(header.get(name)) is not entry_type:
            raise SceneError(path, f"expected {name} in the header, found {header.get(name)!r:.40}", REMEDY)
    if header["kind"] not in (SCENE, FEATURES):
        problem = f"expected the kind {SCENE} or {FEATURES} in the header, found {header['kind']!r:.40}"
        raise SceneError(path, problem, REMEDY)
    return dict(header)


def write_scene(path: StrPath, scene: Scene, about: Mapping[str, Any], *, overwrite: bool, mode: int) -> None:
    """Write a scene without pixels: Gaussians, cameras, pictures as uint8, masks, and facts ``about`` it as JSON."""
    arrays = {name: np.asarray(column, np.float32) for name, column in vars(scene.gaussians).items()}
    cameras = scene.cameras
    arrays |= {name: np.asarray(getattr(cameras, name), np.float64) for name in ("viewmats", "Ks")}
    if scene.images is not None:
        arrays["images"] = np.rint(255 * scene.images.clip(0, 1)).astype(np.uint8)
    if scene.masks is not None:
        arrays["masks"] = scene.masks
    header = {"kind": SCENE, "width": cameras.width, "height": cameras.height, "names": list(scene.names)}
    write_gsm(path, header | {"about": dict(about)}, arrays, overwrite=overwrite, mode=mode)


def read_rows(path: Path) -> StoredRows:
    """Read the Gaussians of a ``.gsm`` of results; raise SceneError if it is damaged, or has Feature Gaussians."""
    file = read_gsm(path, SCENE)
    means = file.array("means", np.float32, None, 3)
    n = len(means)
    num_higher = file.array("shN", np.float32, n, None, 3).shape[1]
    if num_higher not in NUM_HIGHER:
        raise file.error(f"shN: expected {NUM_HIGHER} harmonics, found {num_higher}")
    columns = {"quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (num_higher, 3)}
    rows = Gaussians(means, *(file.array(name, np.float32, n, *shape) for name, shape in columns.items()))
    check_gaussian_count(read_budget(path), n, num_higher, 0)

    def unpack(block: slice) -> Columns:
        part = rows[block]
        least_scale = 1e-30  # scale that replaces 0, so that its logarithm is finite
        log_scales = log(np.maximum(part.scales, least_scale))
        return Columns(
            part.means, quats=part.quats, log_scales=log_scales, opacities=part.opacities, sh0=part.sh0[:, 0],
            harmonics=part.shN,
        )  # fmt: skip

    sizes = {name: as_array(column).nbytes for name, column in vars(rows).items()}
    comments, batches = (file.header["about"].get(name) for name in ("comments", "batches"))
    num_batches = len(batches) if isinstance(batches, list) else 0
    stored = to_stored([Packed(n, num_higher, unpack)], f"{count_words(num_batches, 'batch')} of views", sizes)
    copied = copied_comments(comments if isinstance(comments, list) else ())
    pictures = file.header["about"].get("pictures")
    notes = tuple[str, ...]()
    others = sorted({str(name)[:40] for name in pictures if name != "photos"}) if isinstance(pictures, list) else []
    if others:
        notes = (f"some batches have no photos; {' and '.join(others)} replace them",)
    return replace(stored, format="binary little-endian", comments=copied, notes=notes)


def list_batches(path: Path) -> list[dict[str, Any]]:
    """List the batches of views in the header of a ``.gsm``, each with its counts and the names of its views.

    Entries of a wrong type are left out.
    """
    batches = read_header(path)["about"].get("batches")
    described = list[dict[str, Any]]()
    for batch in batches if isinstance(batches, list) else ():
        if isinstance(batch, dict):
            counts = {name: batch.get(name) for name in ("num_views", "num_input", "num_new")}
            known = {name: count for name, count in counts.items() if isinstance(count, int)}
            views = batch.get("views")
            described.append(known | {"views": [*map(str, views.values())] if isinstance(views, dict) else []})
    return described


def holds_views(path: Path) -> bool:
    """Return whether a ``.gsm`` has cameras; True for a damaged file, so that its reader reports the damage."""
    try:
        return len(read_header(path)["names"]) > 0
    except SceneError:
        return True


def read_views(source: CameraSource) -> StoredCameras:
    """Read the cameras, pictures and masks of a ``.gsm`` of results; SceneError if some are missing or damaged."""
    file = read_gsm(source.path)
    cameras = stored_cameras(file)
    names = stored_names(file, len(cameras))
    size = cameras.width, cameras.height
    shape = len(cameras), cameras.height, cameras.width
    images = file.array("images", np.uint8, *shape, 3)
    counts = file.array("masks", np.bool_, *shape) if "masks" in file.arrays else None
    views = [
        StoredView(name, viewmat, K, size) for name, viewmat, K in zip(names, cameras.viewmats, cameras.Ks, strict=True)
    ]
    return StoredCameras(views, images, order="none", counts=counts)


def stored_names(file: GsmFile, num_views: int) -> tuple[str, ...]:
    """Return the names of a file's views; raise SceneError unless the file has ``num_views`` names."""
    names = file.header["names"]
    if len(names) != num_views or not all(isinstance(name, str) for name in names):
        raise file.error(f"names: expected {num_views} names, one per view, found others")
    return tuple(names)


def stored_cameras(file: GsmFile) -> Cameras:
    """Return the cameras of a file; raise SceneError if they are damaged."""
    viewmats = file.finite("viewmats", np.float64, None, 4, 4)
    width = file.header["width"]
    height = file.header["height"]
    check_image_size(file.path, width, height)
    return Cameras(viewmats, file.finite("Ks", np.float64, len(viewmats), 3, 3), width, height)
