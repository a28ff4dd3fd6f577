"""The ``.gsm`` file of a state: data alone, bit for bit what is in memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsmerge.encoded.encoded import Encoded
from gsmerge.encoded.file import FORMAT as ENCODED
from gsmerge.encoded.file import load_encoded
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
from gsmerge.online.state import OnlineState, Parts, Replay, from_encoded, owning
from gsmerge.stages.prepare import Frame

MINOR = 0  # what was added since the first files of the schema
FORMAT = "gsmerge-state"
PREFIXES = ("features.", "children.", "kept.", "cameras.", "frame.", "replay.")
KINDS = {"settings": dict, "unit": float, "width": int, "height": int, "about": dict}


def save_state(path: str | PathLike[str], state: OnlineState, *, overwrite: bool = False) -> None:
    """Write a state.

    Args:
        path: The file, ``.gsm`` by convention; complete, or what it was before.
        state: Of one or more batches.
        overwrite: Replace an existing file.

    Raises:
        SceneError: If the file exists or cannot be written.
    """
    header = {
        "minor": MINOR,
        "settings": asdict(state.settings),
        "unit": state.frame.unit,
        "width": state.cameras.width,
        "height": state.cameras.height,
        "about": dict(state.about),
    }
    data = to_bytes(FORMAT, header, _tensors(state))
    with atomic_output(path, overwrite=overwrite) as temporary, temporary.open("wb") as file:
        file.write(data)


def _tensors(state: OnlineState) -> dict[str, Tensor]:
    """Everything by name, in the file's own types."""
    parts, replay = state.parts, state.replay
    found = feature_tensors(parts.features) | camera_tensors(state.cameras)
    found |= gaussian_tensors("children", parts.children)
    found |= gaussian_tensors("kept", state.kept if state.kept is not None else parts.children[:0])
    found |= {"children.counts": parts.features.starts.diff().to(torch.uint8)}
    found |= {"features.solved": parts.solved.float(), "features.held": parts.held.float()}
    found |= {"replay.images": torch.from_numpy(replay.images), "replay.views": torch.from_numpy(replay.views).int()}
    return found | {"frame.origin": state.frame.origin.double()}


def load_state(path: str | PathLike[str]) -> OnlineState:
    """A state from a file, or what an encoded scene (:func:`gsmerge.save_encoded`) is as one.

    Raises:
        SceneError: If the file is missing or damaged, of another format or a newer schema, lacks a tensor, or holds
            numbers that cannot be.
    """
    found = load_stored(path)
    return from_encoded(found) if isinstance(found, Encoded) else found


def load_stored(path: str | PathLike[str]) -> Encoded | OnlineState:
    """An encoded scene or a state, whichever the file holds.

    Raises:
        SceneError: As :func:`load_state`.
    """
    path = Path(path)
    told, tensors = read_file(path, PREFIXES)
    if ENCODED in told:
        return load_encoded(path)
    if FORMAT not in told:
        raise SceneError(path, "expected Feature Gaussians of gsmerge, found another safetensors file", "name the .gsm")
    header, take = read_header(path, told[FORMAT], KINDS), taker(path, tensors)
    settings = read_settings(path, header["settings"])
    parts, cameras = _parts(path, take, settings.most), read_cameras(path, take, header)
    kept = read_gaussians(take, "kept", None, parts.children.shN.shape[1])
    return OnlineState(
        parts=parts,
        kept=kept if len(kept) else None,
        frame=Frame(take("frame.origin", torch.float64, 3), read_unit(path, header["unit"])),
        cameras=cameras,
        replay=_replay(path, take, (len(cameras), cameras.height, cameras.width)),
        settings=settings,
        about=_about(path, header["about"]),
    )


def _parts(path: Path, take: Take, most: int) -> Parts:
    """The groups, each with at least one child and no more than ``most``."""
    features = read_features(take)
    g = len(features)
    counts = take("children.counts", torch.uint8, g).long()
    if g and not 1 <= int(counts.min()) <= int(counts.max()) <= most:
        raise SceneError(path, f"children.counts: expected 1 to {most}, found others", REMEDY)
    children = read_gaussians(take, "children", int(counts.sum()), features.shN.shape[1])
    solved, held = take("features.solved", torch.float32, g, 1, 3), take("features.held", torch.float32, g)
    return Parts(owning(features, torch.arange(g).repeat_interleave(counts).numpy()), children, solved, held)


def _replay(path: Path, take: Take, shape: tuple[int, int, int]) -> Replay:
    """The photos, of views that are there."""
    count, height, width = shape
    views = take("replay.views", torch.int32, None).long().numpy()
    images = take("replay.images", torch.uint8, len(views), height, width, 3).numpy()
    if len(views) and not (views[0] >= 0 and views[-1] < count and (np.diff(views) > 0).all()):
        raise SceneError(
            path, "replay.views: expected views of the state, each once and in order, found others", REMEDY
        )
    return Replay(images, views)


def _about(path: Path, about: Mapping[str, Any]) -> dict[str, Any]:
    """Options and batches, of the types that later batches count on."""
    ok = isinstance(about.get("options"), dict) and isinstance(about.get("batches"), list)
    if not ok:
        raise SceneError(path, "about: expected options and batches in the header, found none", REMEDY)
    return dict(about)
