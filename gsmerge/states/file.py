"""States in files: save, load, and extend by the views of a scene's files."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, fields, replace
from os import PathLike
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmerge.compaction.files import read_input
from gsmerge.errors import SceneError, UsageError
from gsmerge.io import atomic_output, lock_folder
from gsmerge.networks.options import CORRECTED
from gsmerge.report import document_head, human_bytes, seconds_document, seconds_line
from gsmerge.runtime.memory import peak_memory
from gsmerge.runtime.record import Progress
from gsmerge.scene.exporters import AUTO, ReadHints
from gsmerge.scene.files import SceneFiles
from gsmerge.settings.reading import OpacityChoice
from gsmerge.states.encoded import Encoded, without_members
from gsmerge.states.extend import extend
from gsmerge.states.gsm_file import ENCODED, MINOR, STATE, GsmFile, read_encoded, read_gsm, write_gsm
from gsmerge.states.options import merge_settings
from gsmerge.states.state import (
    GroupSet,
    Learned,
    OnlineState,
    Replay,
    StateNetworks,
    ViewSamples,
    from_encoded,
    with_child_rows,
)
from gsmerge.types import Cameras, FeatureGaussians

if TYPE_CHECKING:
    from gsmerge.networks.weights import NetworkWeights

HEAD_COUNTS = ("views", "num_members")


def save_state(path: str | PathLike[str], state: OnlineState, *, overwrite: bool = False) -> None:
    """Write a state to a file; :func:`load_state` restores it bit for bit."""
    groups, replay = state.groups, state.replay
    arrays = {
        "children.counts": np.diff(groups.features.starts).astype(np.uint8),
        "features.fitted_sh0": groups.fitted_sh0,
        "features.color_precision": groups.color_precision,
        "replay.images": replay.images,
        "replay.views": replay.views.astype(np.int32),
    }
    entries, children = {"about": dict(state.about)}, ("children", groups.children)
    if state.networks is not None and groups.learned is not None:
        more_entries, more_arrays = _learned_parts(state.networks, groups.learned)
        entries, arrays = entries | more_entries, arrays | more_arrays
    write_gsm(path, STATE, state, groups.features, children, entries, arrays, overwrite=overwrite)


def _learned_parts(networks: StateNetworks, learned: Learned) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return header entries and arrays of what a state with networks has more."""
    weights, samples = networks.weights, networks.samples
    arrays = {f"refined.{name}": getattr(learned.refined, name) for name in CORRECTED}
    arrays |= {f"heads.{name}": getattr(learned, name).astype(np.int32) for name in HEAD_COUNTS}
    arrays |= {f"samples.{f.name}": getattr(samples, f.name) for f in fields(ViewSamples)}
    arrays |= {f"networks.{name}": array for name, array in weights.arrays.items()}
    return {"networks": asdict(weights.options), "minor": MINOR + 1}, arrays


def load_state(path: str | PathLike[str]) -> OnlineState:
    """Read a state from a file; an encoded scene (:func:`gsmerge.save_encoded`) is converted to a state."""
    stored = load_stored(path)
    return from_encoded(stored) if isinstance(stored, Encoded) else stored


def load_stored(path: str | PathLike[str]) -> Encoded | OnlineState:
    """Read an encoded scene or a state, whichever the file holds.

    Raises SceneError if the file is missing or damaged, of another format or a newer schema, lacks
    an array, or holds numbers out of range.
    """
    file = read_gsm(path, ENCODED, STATE)
    about = file.header["about"]
    try:
        merge_settings({}, about.get("options"))
    except ValueError as error:
        raise file.error(f"about: expected options of gsmerge, found others ({error})") from error
    if file.kind == ENCODED:
        return read_encoded(file)
    if not about.keys() >= {"options", "batches"}:
        raise file.error("about: expected options and batches in the header, found none")
    settings, weights = file.settings(), file.networks()
    groups = _read_groups(file, settings.max_k, weights)
    common = file.common(groups.children.shN.shape[1])
    networks = None
    num_latents = groups.features.latents.shape[1]
    if weights is None and num_latents:
        raise file.error(f"features.latents: expected 0 numbers in a state without networks, found {num_latents}")
    if weights is not None:
        num_views = len(common["cameras"])
        groups = replace(groups, learned=_read_learned(file, groups.features, weights, num_views))
        networks = StateNetworks(weights, _read_samples(file, num_views))
    replay = _read_replay(file, common["cameras"])
    return OnlineState(groups=groups, replay=replay, settings=settings, about=about, networks=networks, **common)


def _read_groups(file: GsmFile, max_k: int, weights: NetworkWeights | None) -> GroupSet:
    """Return the groups, each with 1 to ``max_k`` children, or without any where heads make them."""
    features = file.features()
    g = len(features)
    least, most = (0, 0) if weights is not None and weights.options.outputs == "absolute" else (1, max_k)
    counts = file.array("children.counts", np.uint8, g).astype(np.int64)
    if g and not least <= int(counts.min()) <= int(counts.max()) <= most:
        raise file.error(f"children.counts: expected {least} to {most}, found others")
    return GroupSet(
        features=with_child_rows(features, np.arange(g).repeat(counts)),
        children=file.gaussians("children", int(counts.sum()), features.shN.shape[1]),
        fitted_sh0=file.array("features.fitted_sh0", np.float32, g, 1, 3),
        color_precision=file.array("features.color_precision", np.float32, g),
    )


def _read_learned(file: GsmFile, features: FeatureGaussians, weights: NetworkWeights, num_views: int) -> Learned:
    """Return what a state with networks has more of its groups, with every view and number in its range."""
    g, latent = len(features), weights.options.latent
    if features.latents.shape[1] != latent:
        expected = f"features.latents: expected {latent} numbers, as of its networks"
        raise file.error(f"{expected}, found {features.latents.shape[1]}")
    shapes: dict[str, tuple[int, ...]] = {"means": (3,), "covars": (3, 3), "sh0": (1, 3), "latents": (latent,)}
    columns = {name: file.array(f"refined.{name}", np.float32, g, *shapes.get(name, ())) for name in CORRECTED}
    counts = {name: file.array(f"heads.{name}", np.int32, g).astype(np.int64) for name in HEAD_COUNTS}
    views, sizes = counts["views"], counts["num_members"]
    if g and not 0 <= int(views.min()) <= int(views.max()) < num_views:
        raise file.error("heads.views: expected views of the state, found others")
    if g and int(sizes.min()) < 1:
        raise file.error(f"heads.num_members: expected at least 1, found {sizes.min()}")
    return Learned(replace(without_members(features), **columns), **counts)


def _read_samples(file: GsmFile, num_views: int) -> ViewSamples:
    """Return the Gaussians of some pixels of every view, which are as many of each."""
    opacities = file.array("samples.opacities", np.float32, num_views, None, None)
    shape = *opacities.shape, 3
    if 0 in shape[1:]:
        raise file.error(f"samples.opacities: expected pixels of every view, found {list(opacities.shape)}")
    means, sh0 = (file.array(f"samples.{name}", np.float32, *shape) for name in ("means", "sh0"))
    return ViewSamples(means, opacities, sh0)


def _read_replay(file: GsmFile, cameras: Cameras) -> Replay:
    """Return the stored photos, if their views are there."""
    views = file.array("replay.views", np.int32, None).astype(np.int64)
    images = file.array("replay.images", np.uint8, len(views), cameras.height, cameras.width, 3)
    if len(views) and not (views[0] >= 0 and views[-1] < len(cameras) and (np.diff(views) > 0).all()):
        raise file.error("replay.views: expected views of the state, each once and in order, found others")
    return Replay(images, views)


def extend_file(
    path: Path,
    files: SceneFiles,
    settings: Mapping[str, Any],
    *,
    opacity: OpacityChoice = "auto",
    hints: ReadHints = AUTO,
    progress: Progress | None = None,
    seconds_before: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Add a batch of views to the state in a file, or to a new file, and return the report as plain JSON types.

    The file is replaced when all is done, and not at all if anything goes wrong or another process
    has changed it; of processes that end together, the second waits for the first and then sees its
    change. ``settings``: see :class:`gsmerge.Compactor`; by default the state's own.
    ``seconds_before``: wall time by name of the caller's earlier steps. Raises SceneError if a file
    cannot be read or written or was changed meanwhile, UsageError if a setting is unknown, out of
    range, or needs what the state or the scene does not have.
    """
    start, identity = perf_counter(), _file_identity(path)
    state = None if identity is None else load_state(path)
    try:
        options, online = merge_settings(settings, None if state is None else state.about["options"])
    except ValueError as error:
        raise UsageError(str(error)) from error
    with ExitStack() as until_renamed, atomic_output(path, overwrite=identity is not None) as temporary:
        loaded = perf_counter()
        load = read_input(files, opacity=opacity, hints=hints)
        read = perf_counter()
        state, report = extend(state, load.scene, options, online, progress=progress)
        done = perf_counter()
        save_state(temporary, state, overwrite=True)
        until_renamed.enter_context(lock_folder(path.resolve().parent))
        if _file_identity(path) != identity:
            raise SceneError(path, "was changed by another process meanwhile", "extend it again; it is as that left it")
    seconds = {**(seconds_before or {}), "load": loaded - start, "read": read - loaded, **report.seconds}
    seconds["other"] = done - read - sum(report.seconds.values())
    numbers = {name: value for name, value in asdict(report).items() if name not in ("seconds", "notes", "options")}
    return {
        **document_head(),
        "input": {"path": str(files.ply), **load.recognised},
        **numbers,
        "state": {"path": str(path), "bytes": path.stat().st_size, "num_batches": len(state.about["batches"])},
        "options": dict(report.options),
        **seconds_document(seconds | {"write": perf_counter() - done}),
        "peak_memory_bytes": peak_memory(),
        "notes": [*load.notes, *report.notes],
    }


def batch_line(document: Mapping[str, Any]) -> str:
    """Describe the report of a batch in one line."""
    state, dropped = document["state"], document["num_covered"] + document["num_hidden"]
    return (
        f"{state['path']}: batch {state['num_batches']}, {document['num_views']} views,"
        f" {document['num_input']:,} Gaussians -> {document['num_new']:,} groups: {document['num_joined']:,} joined"
        f" others, {dropped:,} not needed; {document['num_groups']:,} groups in all,"
        f" {human_bytes(state['bytes'])}; {seconds_line(document)}"
    )


def _file_identity(path: Path) -> tuple[int, int, int] | None:
    """Return numbers that differ between one file of this name and the next; None without a file."""
    try:
        status = os.stat(path)
    except OSError:  # other problems show when it is written
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size
