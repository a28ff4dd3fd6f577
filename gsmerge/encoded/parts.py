"""What the files of encoded scenes and of states have in common: safetensors, checked entry by entry.

Within one major schema tensors and entries of the header are only ever added; what is not known here is not looked at.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from gsmerge import __version__
from gsmerge.encoded.encoded import StoredSettings
from gsmerge.errors import SceneError
from gsmerge.io.bounds import check_file
from gsmerge.stages.decode import MAX_CHILDREN
from gsmerge.types import Cameras, FeatureGaussians, Gaussians

SCHEMA = 1  # files of a larger one cannot be read
SUFFIX = ".gsm"
REMEDY = "copy it again, or encode the scene again"
MAX_COUNT = 1 << 40

COLUMNS = tuple(f.name for f in fields(FeatureGaussians) if f.name not in ("starts", "members", "views", "backing"))
Take = Callable[..., Tensor]


def to_bytes(form: str, header: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> bytes:
    """The whole file; ``form``: the name of the entry that holds the header."""
    told = {"schema": SCHEMA, "gsmerge": __version__, **header}
    data = {name: tensor.detach().cpu().clone().contiguous() for name, tensor in tensors.items()}  # none share memory
    return save(data, {form: json.dumps(told)})  # one entry: the order of several is not fixed


def read_file(path: Path, prefixes: Sequence[str]) -> tuple[dict[str, str], dict[str, Tensor]]:
    """The header's entries, and the tensors whose names begin with one of the prefixes; nothing is ever executed.

    Raises:
        SceneError: If there is no such file, or it is no safetensors file or damaged.
    """
    check_file(path)
    try:
        with safe_open(path, "pt") as file:
            known = [name for name in file.keys() if name.startswith(tuple(prefixes))]  # noqa: SIM118 - no mapping
            return file.metadata() or {}, {name: file.get_tensor(name) for name in known}
    except (SafetensorError, OSError, ValueError) as error:
        told = str(error).splitlines()[0]
        remedy = REMEDY if path.suffix == SUFFIX else "name a file of gsmerge encode or extend"
        raise SceneError(path, f"expected a {SUFFIX} file, could not read it ({told})", remedy) from error


def gaussian_tensors(prefix: str, gaussians: Gaussians) -> dict[str, Tensor]:
    """Gaussians by name."""
    return {f"{prefix}.{f.name}": getattr(gaussians, f.name).float() for f in fields(Gaussians)}


def feature_tensors(features: FeatureGaussians) -> dict[str, Tensor]:
    """Feature Gaussians by name, without their members."""
    found = {f"features.{name}": getattr(features, name).float() for name in COLUMNS}
    return found | {"features.views": features.views.int(), "features.backing": features.backing.to(torch.uint8)}


def camera_tensors(cameras: Cameras) -> dict[str, Tensor]:
    """Cameras by name, without their size."""
    return {"cameras.viewmats": cameras.viewmats.double(), "cameras.Ks": cameras.Ks.double()}


def read_header(path: Path, text: str, kinds: Mapping[str, Any]) -> dict[str, Any]:
    """What the file says of itself, of a schema that is known here; ``kinds``: the type of each entry it must have."""
    try:
        told = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(path, "expected a header in JSON, found something else", REMEDY) from error
    if not isinstance(told, dict) or not isinstance(told.get("schema"), int):
        raise SceneError(path, "expected a header with its schema, found none", REMEDY)
    if told["schema"] != SCHEMA:
        newer = f"written by gsmerge {str(told.get('gsmerge'))[:40]}; this is {__version__}, update it"
        problem = f"expected schema {SCHEMA}, found {told['schema']}"
        raise SceneError(path, problem, newer if told["schema"] > SCHEMA else REMEDY)
    for name, kind in kinds.items():
        if name not in told or not isinstance(told[name], kind):
            raise SceneError(path, f"expected {name} in the header, found {told.get(name)!r:.40}", REMEDY)
    return told


def read_settings(path: Path, told: Mapping[str, Any]) -> StoredSettings:
    """The settings that are known here, each within its range."""
    found: dict[str, Any] = {}
    for f in fields(StoredSettings):
        value, share = told.get(f.name), f.name in ("min_opacity", "prune")
        least, most = (1, MAX_CHILDREN) if f.name in ("k", "most") else (0, 1 if share else MAX_COUNT)
        absent = value is None and f.name in told and f.name in ("wanted", "places")
        if not absent and not (f.name == "k" and value == "auto"):
            number = isinstance(value, int | float if share else int) and not isinstance(value, bool)
            if not number or not least <= value <= most:  # type: ignore[operator]
                problem = f"{f.name}: expected a number from {least} to {most}, found {value!r:.40}"
                raise SceneError(path, problem, REMEDY)
        found[f.name] = value
    return StoredSettings(**found)


def read_unit(path: Path, unit: float) -> float:
    """The unit of the frame, a length."""
    if not 0 < unit < float("inf"):
        raise SceneError(path, f"unit: expected a length above 0, found {unit}", REMEDY)
    return unit


def taker(path: Path, tensors: Mapping[str, Tensor]) -> Take:
    """A function that hands out a tensor by name, of the type and shape wanted (None: any) and finite."""

    def take(name: str, dtype: torch.dtype, *shape: int | None) -> Tensor:
        tensor = tensors.get(name)
        words = f"{name}: expected {str(dtype).removeprefix('torch.')} {[n if n is not None else 'n' for n in shape]}"
        if tensor is None:
            raise SceneError(path, f"{words}, found none", REMEDY)
        fits = tensor.dtype == dtype and tensor.ndim == len(shape)
        if not fits or any(n is not None and n != have for n, have in zip(shape, tensor.shape, strict=True)):
            found = f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"
            raise SceneError(path, f"{words}, found {found}", REMEDY)
        if dtype.is_floating_point and not bool(torch.isfinite(tensor).all()):
            raise SceneError(path, f"{name}: expected finite numbers, found others", REMEDY)
        return tensor

    return take


def read_features(take: Take) -> FeatureGaussians:
    """Feature Gaussians without their members."""
    g = len(take("features.means", torch.float32, None, 3))
    shapes: dict[str, tuple[int | None, ...]] = {"means": (3,), "covars": (3, 3), "sh0": (1, 3), "shN": (None, 3)}
    shapes["latents"] = (None,)
    return FeatureGaussians(
        **{name: take(f"features.{name}", torch.float32, g, *shapes.get(name, ())) for name in COLUMNS},
        views=take("features.views", torch.int32, g).long(),
        backing=take("features.backing", torch.uint8, g).bool(),
        starts=torch.zeros(g + 1, dtype=torch.int64),
        members=torch.zeros(0, dtype=torch.int64),
    )


def read_gaussians(take: Take, prefix: str, count: int | None, num_higher: int) -> Gaussians:
    """Gaussians of as many harmonics as the others, none of them beyond what can be rendered."""
    n = len(take(f"{prefix}.means", torch.float32, count, 3))
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (num_higher, 3)}
    return Gaussians(*(take(f"{prefix}.{name}", torch.float32, n, *shape) for name, shape in shapes.items()))


def read_cameras(path: Path, take: Take, header: Mapping[str, Any]) -> Cameras:
    """The views, of a size that can be."""
    viewmats = take("cameras.viewmats", torch.float64, None, 4, 4)
    Ks = take("cameras.Ks", torch.float64, len(viewmats), 3, 3)
    width, height = header["width"], header["height"]
    if not (0 < width <= 1 << 16 and 0 < height <= 1 << 16):
        raise SceneError(path, f"expected the size of the views, found {width} x {height}", REMEDY)
    return Cameras(viewmats, Ks, width, height)
