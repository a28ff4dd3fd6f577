"""The ``.gsm`` container of a state.

A safetensors file with one metadata entry, whose text is a header in JSON. Nothing in a file is ever executed; every
array and every entry is checked before it is used. Within one schema arrays and entries are only ever added, and
unknown ones are ignored. Keys are the names of fields in the code.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from safetensors.numpy import save

from gsmerge import __version__
from gsmerge.errors import SceneError
from gsmerge.facts.prepare import Frame
from gsmerge.io.atomic import atomic_output
from gsmerge.io.bounds import ReadBudget, check_pixels, parse_json, read_budget
from gsmerge.io.cameras.camera_file import MAX_NUMBER as MAX_LENGTH
from gsmerge.io.cameras.camera_file import check_camera, check_size
from gsmerge.io.tensor_file import read_tensors
from gsmerge.settings.budget import AUTO
from gsmerge.settings.extend import SUFFIX
from gsmerge.settings.stages import MAX_CHILDREN, MIXED
from gsmerge.states.state import StoredSettings
from gsmerge.types import Array, Cameras, FeatureGaussians, Gaussians, as_array

if TYPE_CHECKING:
    from gsmerge.networks.weights import NetworkWeights

SCHEMA = 2  # files of a larger one cannot be read
STATE = "gsmerge-state"  # name of the metadata entry
ENCODED = "gsmerge-encoded"  # its name in files of gsmerge 0.1's command `encode`, of schema 1
REMEDY = "copy it again, or extend a new state"
MAX_COUNT = 1 << 40
NUM_HIGHER = (0, 3, 8, 15, 24)  # harmonics above degree 0
MAX_NUMBER = 1e37  # of any array: float32 ends at 3e38
MAX_FACTOR = 1e6  # of what is multiplied with others
FACTORS = ("gains", "quats")
NOT_NEGATIVE = (
    "gains",
    "weights",
    "masses",
    "extinctions",
    "footprints",
    "scales",
    "opacities",
    "color_precision",
)  # of keys
# Pixels of a view that a file may claim: each of its bytes says something about some of them, or it is a small one.
PIXELS_PER_BYTE, SMALL_VIEW = 100, 1 << 20

ENTRIES: Mapping[str, Any] = {"settings": dict, "unit": float, "width": int, "height": int, "about": dict}  # types
ABOUT = {"gsmerge": str, "options": dict, "choices": dict, "notes": list, "batches": list, "source": dict}  # types
PREFIXES = (
    "features.", "division.", "children.", "kept.", "cameras.", "frame.", "heads.", "networks.", "replay.", "refined.",
    "samples.",
)  # fmt: skip
FEATURE_COLUMNS = tuple(f.name for f in fields(FeatureGaussians) if f.name not in ("starts", "members", "views"))


def write_gsm(
    path: str | PathLike[str], header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], *, overwrite: bool
) -> None:
    """Write a ``.gsm`` file with the entries of a header, schema and checksums added."""
    header = {"schema": SCHEMA, "gsmerge": __version__, **header}
    data = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    with atomic_output(path, overwrite=overwrite) as temporary:
        header["checksums"] = _checksums(header, data)
        temporary.write_bytes(save(data, {STATE: json.dumps(header)}))  # one entry: the order of several is not fixed


def _checksums(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Return CRC-32 of the header without its checksums, and of each array."""
    plain = {name: value for name, value in header.items() if name != "checksums"}
    text = json.dumps(json.loads(json.dumps(plain)), sort_keys=True)  # keys as they are read
    sums = {"header": zlib.crc32(text.encode("utf-8", "replace"))}
    for name, array in sorted(arrays.items()):
        sums[name] = zlib.crc32(np.ascontiguousarray(array).tobytes())
    return sums


def _check_checksums(file: GsmFile) -> None:
    """Raise SceneError if the header or an array is not what was written; some older files have no checksums."""
    if not file.has_checksums:
        return
    stored, found = file.header["checksums"], _checksums(file.header, file.arrays)
    wrong = [name for name, value in found.items() if stored.get(name) != value]
    wrong += [name for name in stored if name not in found and name.startswith(PREFIXES)]
    if wrong:
        raise file.error(f"{', '.join(wrong[:4])}: not what was written, by the checksums")


def float32(values: Array) -> np.ndarray:
    """Return float32 numbers within the range that a reader accepts."""
    with np.errstate(over="ignore"):
        numbers = np.nan_to_num(as_array(values).astype(np.float32, copy=False))
    return np.clip(numbers, -MAX_NUMBER, MAX_NUMBER, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class GsmFile:
    """Content of a ``.gsm`` file, each part checked when it is read."""

    path: Path
    is_encoded: bool  # Whether 0.1's command `encode` wrote it
    header: Mapping[str, Any]  # Its header, each entry of its type
    arrays: Mapping[str, np.ndarray]

    def error(self, problem: str) -> SceneError:
        """Make the SceneError for a damaged file."""
        return SceneError(self.path, problem, REMEDY)

    @property
    def has_checksums(self) -> bool:
        """Whether its arrays were compared with checksums, which some files of 0.1 lack."""
        return isinstance(self.header.get("checksums"), dict)

    def has(self, *prefixes: str) -> bool:
        """Return whether the name of any array begins with one of the prefixes."""
        return any(name.startswith(prefixes) for name in self.arrays)

    def array(self, key: str, dtype: type[np.generic], *shape: int | None) -> np.ndarray:
        """Return an array, checked for type, shape (None: any size), finite values and range."""
        array = self.arrays.get(key)
        expected = f"{key}: expected {dtype.__name__} {['n' if n is None else n for n in shape]}"
        if array is None:
            raise self.error(f"{expected}, found none")
        same_rank = array.dtype == dtype and array.ndim == len(shape)
        if not same_rank or any(n is not None and n != size for n, size in zip(shape, array.shape, strict=True)):
            raise self.error(f"{expected}, found {array.dtype} {list(array.shape)}")
        if array.dtype.kind == "f":
            column = key.rpartition(".")[2]
            most = MAX_FACTOR if column in FACTORS else MAX_NUMBER
            least = 0.0 if column in NOT_NEGATIVE else -most
            low, high = array.min(initial=0), array.max(initial=0)
            if not (least <= low and high <= most):  # NaN, too
                beyond = high if least <= low else low
                raise self.error(f"{key}: expected finite numbers from {least:g} to {most:g}, found {beyond:g}")
        return array

    def features(self) -> FeatureGaussians:
        """Return the Feature Gaussians without their members."""
        g = len(self.array("features.means", np.float32, None, 3))
        num_higher = self.array("features.shN", np.float32, g, None, 3).shape[1]
        if num_higher not in NUM_HIGHER:
            raise self.error(f"features.shN: expected {NUM_HIGHER} harmonics, found {num_higher}")
        shapes: dict[str, tuple[int | None, ...]] = {
            "means": (3,), "covars": (3, 3), "sh0": (1, 3), "shN": (num_higher, 3), "latents": (None,),
        }  # fmt: skip
        return FeatureGaussians(
            **{name: self.array(f"features.{name}", np.float32, g, *shapes.get(name, ())) for name in FEATURE_COLUMNS},
            views=self.array("features.views", np.int32, g).astype(np.int64),
            starts=np.zeros(g + 1, np.int64),
            members=np.zeros(0, np.int64),
        )

    def gaussians(self, prefix: str, count: int | None, num_higher: int) -> Gaussians:
        """Return ``count`` Gaussians (None: any number) stored under ``prefix``; ``num_higher``: higher harmonics."""
        n = len(self.array(f"{prefix}.means", np.float32, count, 3))
        shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (num_higher, 3)}
        return Gaussians(*(self.array(f"{prefix}.{name}", np.float32, n, *shape) for name, shape in shapes.items()))

    def common(self, num_higher: int) -> dict[str, Any]:
        """Return the fields of every state that are not groups: kept, frame, cameras."""
        kept = self.gaussians("kept", None, num_higher)
        unit, width, height = (self.header[name] for name in ("unit", "width", "height"))
        origin = self.array("frame.origin", np.float64, 3)
        if not 0 < unit < MAX_LENGTH:
            raise self.error(f"unit: expected a length above 0 and below {MAX_LENGTH:g}, found {unit}")
        if np.abs(origin).max() > MAX_LENGTH:
            raise self.error(f"frame.origin: expected numbers up to {MAX_LENGTH:g}, found others")
        viewmats = self.array("cameras.viewmats", np.float64, None, 4, 4)
        Ks = self.array("cameras.Ks", np.float64, len(viewmats), 3, 3)
        cameras = self._cameras(viewmats, Ks, width, height)
        return {"kept": kept, "frame": Frame(origin, unit), "cameras": cameras}

    def _cameras(self, viewmats: np.ndarray, Ks: np.ndarray, width: int, height: int) -> Cameras:
        """Return the cameras, if they are plausible and the file has enough bytes for their size."""
        check_pixels(self.path, width, height)
        most = SMALL_VIEW + PIXELS_PER_BYTE * sum(
            a.nbytes for key, a in self.arrays.items() if not key.startswith("networks.")
        )
        if width * height > most:
            raise self.error(
                f"expected views of at most {most:,} pixels in a file of this size, found {width} x {height}"
            )
        for i, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True)):
            check_camera(self.path, f"{i}", viewmat, K)
            check_size(self.path, f"{i}", K, (width, height))
        return Cameras(viewmats, Ks, width, height)

    def networks(self) -> NetworkWeights | None:
        """Return the networks; None without any."""
        options, prefix = self.header.get("networks"), "networks."
        if options is None:
            return None
        from gsmerge.networks.checkpoint import build_networks

        if not isinstance(options, dict):
            raise self.error(f"expected networks in the header, found {options!r:.40}")
        arrays = {name.removeprefix(prefix): array for name, array in self.arrays.items() if name.startswith(prefix)}
        return build_networks(self.path, options, arrays, REMEDY)

    def settings(self) -> StoredSettings:
        """Return the settings, each checked for its range."""
        values: dict[str, Any] = {}
        for f in fields(StoredSettings):
            value, is_share = self.header["settings"].get(f.name), f.name in ("min_opacity", "min_contribution")
            low, high = (1, MAX_CHILDREN) if f.name in ("k", "max_k") else (0, 1 if is_share else MAX_COUNT)
            absent = value is None and f.name in {"target_count", "num_slots"} & self.header["settings"].keys()
            if not absent and not (f.name == "k" and value in (AUTO, MIXED)):
                number = isinstance(value, int | float if is_share else int) and not isinstance(value, bool)
                if not number or not low <= value <= high:
                    raise self.error(f"{f.name}: expected a number from {low} to {high}, found {value!r:.40}")
            values[f.name] = value
        return StoredSettings(**values)


def read_gsm(path: str | PathLike[str]) -> GsmFile:
    """Read a ``.gsm`` file, and compare its checksums; SceneError for other files, and where one is wrong."""
    path = Path(path)
    budget = read_budget(path)
    remedy = REMEDY if path.suffix == SUFFIX else "name a file of gsmerge extend"
    metadata, arrays = read_tensors(path, f"a {SUFFIX} file", remedy, lambda name: name.startswith(PREFIXES))
    text = metadata.get(STATE, metadata.get(ENCODED))
    if text is None:
        raise SceneError(path, "expected Feature Gaussians of gsmerge, found another safetensors file", "name the .gsm")
    gsm = GsmFile(path, STATE not in metadata, _read_header(text, budget), arrays)
    _check_checksums(gsm)
    return gsm


def _read_header(text: str, budget: ReadBudget) -> dict[str, Any]:
    """Parse the header of a known schema."""
    path = budget.path
    try:
        header = parse_json(text, budget)
    except ValueError as error:
        raise SceneError(path, "expected a header in JSON, found something else", REMEDY) from error
    if not isinstance(header, dict) or not isinstance(header.get("schema"), int):
        raise SceneError(path, "expected a header with its schema, found none", REMEDY)
    if not 1 <= header["schema"] <= SCHEMA:
        newer = f"written by gsmerge {str(header.get('gsmerge'))[:40]}; this is {__version__}, update it"
        problem = f"expected schema 1 to {SCHEMA}, found {header['schema']}"
        raise SceneError(path, problem, newer if header["schema"] > SCHEMA else REMEDY)
    for name, kind in ENTRIES.items():
        if not isinstance(header.get(name, ...), kind) or isinstance(header[name], bool):
            raise SceneError(path, f"expected {name} in the header, found {header.get(name)!r:.40}", REMEDY)
    about = header["about"]
    for name, kind in ABOUT.items():
        if name in about and not isinstance(about[name], kind):
            problem = f"about: expected {name} as a {kind.__name__}, found {about[name]!r:.40}"
            raise SceneError(path, problem, REMEDY)
    return header
