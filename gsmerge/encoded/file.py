"""The ``.gsm`` file of an encoded scene: data alone, with what it is in the header."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsmerge.encoded.encoded import Division, Encoded, StoredHeads
from gsmerge.encoded.parts import (
    REMEDY,
    Take,
    camera_tensors,
    feature_tensors,
    gaussian_tensors,
    read_cameras,
    read_features,
    read_file,
    read_gaussians,
    read_header,
    read_settings,
    read_unit,
    taker,
    to_bytes,
)
from gsmerge.errors import SceneError
from gsmerge.io.atomic import atomic_output
from gsmerge.networks.checkpoint import build_networks
from gsmerge.networks.tokens import GROUP
from gsmerge.stages.decode import MAX_CHILDREN
from gsmerge.stages.prepare import Frame
from gsmerge.types import FeatureGaussians

MINOR = 0  # what was added since the first files of the schema
FORMAT = "gsmerge-encoded"
PREFIXES = ("features.", "division.", "kept.", "cameras.", "frame.", "heads.", "networks.")
KINDS = {
    "settings": dict,
    "unit": float,
    "width": int,
    "height": int,
    "about": dict,
    "networks": dict | None,
}


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
    heads = encoded.heads
    header = {
        "minor": MINOR,
        "settings": asdict(encoded.settings),
        "unit": encoded.frame.unit,
        "width": encoded.cameras.width,
        "height": encoded.cameras.height,
        "networks": None if heads is None else asdict(heads.networks.options),
        "about": {**encoded.about, **({} if source is None else {"source": dict(source)})},
    }
    data = to_bytes(FORMAT, header, _tensors(encoded))
    with atomic_output(path, overwrite=overwrite) as temporary, temporary.open("wb") as file:
        file.write(data)


def _tensors(encoded: Encoded) -> dict[str, Tensor]:
    """Everything by name, in the file's own types."""
    division, heads = encoded.division, encoded.heads
    found = feature_tensors(encoded.features) | camera_tensors(encoded.cameras)
    found |= {"division.splits": division.splits, "division.slots": division.slots}
    found |= {"division.whole": division.whole.int(), "division.deals": division.deals.int()}
    found |= gaussian_tensors("division", division.children)
    found |= gaussian_tensors("kept", encoded.kept if encoded.kept is not None else division.children[:0])
    found |= {"frame.origin": encoded.frame.origin.double()}
    if heads is not None:
        found |= {"heads.views": heads.views.int(), "heads.group": heads.group.float()}
        found |= {f"networks.{name}": tensor for name, tensor in heads.networks.state_dict().items()}
    return found


def load_encoded(path: str | PathLike[str]) -> Encoded:
    """An encoded scene from a file; nothing in it is ever executed.

    Raises:
        SceneError: If the file is missing or damaged, of another format or a newer schema, lacks a tensor, or holds
            numbers that cannot be.
    """
    path = Path(path)
    told, tensors = read_file(path, PREFIXES)
    if FORMAT not in told:
        raise SceneError(path, "expected Feature Gaussians of gsmerge, found another safetensors file", "name the .gsm")
    header = read_header(path, told[FORMAT], KINDS)
    take = taker(path, tensors)
    features = read_features(take)
    settings = read_settings(path, header["settings"])
    cameras = read_cameras(path, take, header)
    division = _division(path, take, features)
    kept = read_gaussians(take, "kept", None, features.shN.shape[1])
    return Encoded(
        features=features,
        division=division,
        kept=kept if len(kept) else None,
        frame=Frame(take("frame.origin", torch.float64, 3), read_unit(path, header["unit"])),
        cameras=cameras,
        settings=settings,
        heads=_heads(path, take, tensors, header, features, len(cameras)),
        about=header["about"],
    )


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
    children = read_gaussians(take, "division", 2 * len(slots) + len(whole), features.shN.shape[1])
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
    return StoredHeads(networks, views, group)
