"""The ``.gsm`` file: safetensors, so data alone, with what it is in the header.

Within one major schema tensors and entries of the header are only ever added; what is not known here is not looked at.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from gsmerge import __version__
from gsmerge.canonical import Frame
from gsmerge.decode import MAX_CHILDREN
from gsmerge.errors import SceneError
from gsmerge.io.atomic import atomic_output
from gsmerge.io.bounds import check_file
from gsmerge.networks.checkpoint import build_networks
from gsmerge.networks.tokens import GROUP
from gsmerge.options import PRECISIONS
from gsmerge.stored.encoded import Division, Encoded, StoredHeads, StoredSettings
from gsmerge.types import Cameras, FeatureGaussians, Gaussians

SCHEMA = 1  # files of a larger one cannot be read
MINOR = 0  # what was added since
FORMAT = "gsmerge-encoded"
REMEDY = "copy it again, or encode the scene again"
SUFFIX = ".gsm"
MAX_COUNT = 1 << 40
PREFIXES = ("features.", "division.", "kept.", "cameras.", "frame.", "heads.", "networks.")

COLUMNS = tuple(f.name for f in fields(FeatureGaussians) if f.name not in ("starts", "members", "views", "backing"))
Take = Callable[..., Tensor]


def save_encoded(
    path: str | PathLike[str],
    encoded: Encoded,
    *,
    overwrite: bool = False,
    source: Mapping[str, Any] | None = None,
) -> None:
    """Write an encoded scene.

    Args:
        path: The file, ``.gsm`` by convention; complete or not there at all.
        encoded: From :func:`gsmerge.encode_scene`.
        overwrite: Replace an existing file.
        source: What is known of the file that the scene was read from; plain JSON types.

    Raises:
        SceneError: If the file exists or cannot be written.
    """
    about = {**encoded.about, **({} if source is None else {"source": dict(source)})}
    header = {"schema": SCHEMA, "minor": MINOR, "gsmerge": __version__, "settings": asdict(encoded.settings)}
    header |= {"unit": encoded.frame.unit, "width": encoded.cameras.width, "height": encoded.cameras.height}
    heads = encoded.heads
    header |= {"networks": None if heads is None else asdict(heads.networks.options), "about": about}
    header |= {"precision": "float32" if heads is None else heads.precision}
    data = save(_tensors(encoded), {FORMAT: json.dumps(header)})  # one entry: the order of several is not fixed
    with atomic_output(path, overwrite=overwrite) as temporary, temporary.open("wb") as file:
        file.write(data)


def _tensors(encoded: Encoded) -> dict[str, Tensor]:
    """Everything by name, in the file's own types."""
    features, division, heads = encoded.features, encoded.division, encoded.heads
    found = {f"features.{name}": getattr(features, name).float() for name in COLUMNS}
    found |= {"features.views": features.views.int(), "features.backing": features.backing.to(torch.uint8)}
    found |= {"division.splits": division.splits, "division.slots": division.slots}
    found |= {"division.whole": division.whole.int(), "division.deals": division.deals.int()}
    kept = encoded.kept if encoded.kept is not None else division.children[:0]
    for prefix, gaussians in (("division", division.children), ("kept", kept)):
        found |= {f"{prefix}.{f.name}": getattr(gaussians, f.name).float() for f in fields(Gaussians)}
    found |= {"cameras.viewmats": encoded.cameras.viewmats.double(), "cameras.Ks": encoded.cameras.Ks.double()}
    found |= {"frame.origin": encoded.frame.origin.double()}
    if heads is not None:
        found |= {"heads.views": heads.views.int(), "heads.group": heads.group.float()}
        found |= {f"networks.{name}": tensor for name, tensor in heads.networks.state_dict().items()}
    return {name: tensor.detach().cpu().clone().contiguous() for name, tensor in found.items()}  # none share memory


def load_encoded(path: str | PathLike[str]) -> Encoded:
    """An encoded scene from a file; nothing in it is ever executed.

    Raises:
        SceneError: If the file is missing or damaged, of another format or a newer schema, lacks a tensor, or holds
            numbers that cannot be.
    """
    path = Path(path)
    check_file(path)
    try:
        with safe_open(path, "pt") as file:
            header = _header(path, file.metadata() or {})
            known = [name for name in file.keys() if name.startswith(PREFIXES)]  # noqa: SIM118 - no mapping
            tensors = {name: file.get_tensor(name) for name in known}
    except (SafetensorError, OSError, ValueError) as error:
        told = str(error).splitlines()[0]
        remedy = REMEDY if path.suffix == SUFFIX else "name a file of gsmerge encode"
        raise SceneError(path, f"expected a {SUFFIX} file, could not read it ({told})", remedy) from error
    take = _taker(path, tensors)
    features = _features(take)
    settings = _settings(path, header["settings"])
    cameras = _cameras(path, take, header)
    division = _division(path, take, features)
    kept = _gaussians(take, "kept", None, features.shN.shape[1])
    return Encoded(
        features=features,
        division=division,
        kept=kept if len(kept) else None,
        frame=Frame(take("frame.origin", torch.float64, 3), _unit(path, header["unit"])),
        cameras=cameras,
        settings=settings,
        heads=_heads(path, take, tensors, header, features, len(cameras)),
        about=header["about"],
    )


def _header(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """What the file says of itself, of a schema that is known here."""
    if FORMAT not in metadata:
        raise SceneError(path, "expected Feature Gaussians of gsmerge, found another safetensors file", "name the .gsm")
    try:
        told = json.loads(metadata[FORMAT])
    except (ValueError, RecursionError) as error:
        raise SceneError(path, "expected a header in JSON, found something else", REMEDY) from error
    if not isinstance(told, dict) or not isinstance(told.get("schema"), int):
        raise SceneError(path, "expected a header with its schema, found none", REMEDY)
    if told["schema"] != SCHEMA:
        newer = f"written by gsmerge {str(told.get('gsmerge'))[:40]}; this is {__version__}, update it"
        problem = f"expected schema {SCHEMA}, found {told['schema']}"
        raise SceneError(path, problem, newer if told["schema"] > SCHEMA else REMEDY)
    kinds = {
        "settings": dict,
        "unit": float,
        "width": int,
        "height": int,
        "about": dict,
        "networks": dict | None,
        "precision": str,
    }
    for name, kind in kinds.items():
        if name not in told or not isinstance(told[name], kind):
            raise SceneError(path, f"expected {name} in the header, found {told.get(name)!r:.40}", REMEDY)
    return told


def _settings(path: Path, told: Mapping[str, Any]) -> StoredSettings:
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


def _unit(path: Path, unit: float) -> float:
    if not 0 < unit < float("inf"):
        raise SceneError(path, f"unit: expected a length above 0, found {unit}", REMEDY)
    return unit


def _taker(path: Path, tensors: Mapping[str, Tensor]) -> Take:
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


def _features(take: Take) -> FeatureGaussians:
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


def _gaussians(take: Take, prefix: str, count: int | None, num_higher: int) -> Gaussians:
    """Gaussians of as many harmonics as the others, none of them beyond what can be rendered."""
    n = len(take(f"{prefix}.means", torch.float32, count, 3))
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (num_higher, 3)}
    return Gaussians(*(take(f"{prefix}.{name}", torch.float32, n, *shape) for name, shape in shapes.items()))


def _cameras(path: Path, take: Take, header: Mapping[str, Any]) -> Cameras:
    viewmats = take("cameras.viewmats", torch.float64, None, 4, 4)
    Ks = take("cameras.Ks", torch.float64, len(viewmats), 3, 3)
    width, height = header["width"], header["height"]
    if not (0 < width <= 1 << 16 and 0 < height <= 1 << 16):
        raise SceneError(path, f"expected the size of the views, found {width} x {height}", REMEDY)
    return Cameras(viewmats, Ks, width, height)


def _division(path: Path, take: Take, features: FeatureGaussians) -> Division:
    """The children, with every index within its range."""
    g = len(features)
    splits, slots = take("division.splits", torch.uint8, g), take("division.slots", torch.uint8, None)
    whole, deals = take("division.whole", torch.int32, None), take("division.deals", torch.int32, None)
    numbers = splits.numpy().astype(np.int64)
    ok = numbers.max(initial=0) < MAX_CHILDREN and numbers.sum() == len(slots)
    if ok:
        steps = np.arange(len(slots)) - np.repeat(np.cumsum(numbers) - numbers, numbers)
        ok = bool((slots.numpy() <= steps).all()) and _rising(whole.numpy(), g) and not numbers[whole.numpy()].any()
    if ok and len(deals):
        ok = int(deals.min()) >= 0 and int(deals.max()) < g
        ok = ok and bool((np.bincount(deals.numpy(), minlength=g) <= numbers).all())
    if not ok:
        raise SceneError(path, "division: expected children that belong to their groups, found others", REMEDY)
    children = _gaussians(take, "division", 2 * len(slots) + len(whole), features.shN.shape[1])
    return Division(splits, slots, whole.long(), children, deals.long())


def _rising(rows: np.ndarray, count: int) -> bool:
    """Whether these are rows of ``count``, each once and in order."""
    return len(rows) == 0 or bool(rows[0] >= 0 and rows[-1] < count and (np.diff(rows) > 0).all())


def _heads(
    path: Path,
    take: Take,
    tensors: Mapping[str, Tensor],
    header: Mapping[str, Any],
    features: FeatureGaussians,
    num_views: int,
) -> StoredHeads | None:
    """The networks, if there are any, and what they know of the groups."""
    if header["networks"] is None:
        return None
    if header["precision"] not in PRECISIONS:
        problem = f"precision: expected {' or '.join(PRECISIONS)}, found {header['precision']!r:.40}"
        raise SceneError(path, problem, REMEDY)
    own = {name.removeprefix("networks."): t for name, t in tensors.items() if name.startswith("networks.")}
    networks = build_networks(path, header["networks"], own, REMEDY)
    views = take("heads.views", torch.int32, len(features)).long()
    if len(views) and not 0 <= int(views.min()) <= int(views.max()) < num_views:
        raise SceneError(path, "heads.views: expected views of the scene, found others", REMEDY)
    wide = features.latents.shape[1]
    if wide != networks.options.latent:
        problem = f"features.latents: expected {networks.options.latent} numbers, as of its networks, found {wide}"
        raise SceneError(path, problem, REMEDY)
    group = take("heads.group", torch.float32, len(features), GROUP)
    return StoredHeads(networks, header["precision"], views, group)
