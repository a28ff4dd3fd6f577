"""Examples in files: written once, hashed, and read one by one.

A shard is a safetensors file with one example. A scene's shards are named in a record, a JSON file that is written
when all of them are; its name is a hash of the scene's files and of the settings. So a call that was interrupted goes
on with the first example that is missing, and what is complete is not made again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from gsmerge import __version__
from gsmerge.errors import SceneError
from gsmerge.io import find_scene_files
from gsmerge.io.atomic import atomic_output
from gsmerge.moments import Members
from gsmerge.render.photos import Photos
from gsmerge.research.training.examples import Example, make_examples, scene_name
from gsmerge.research.training.processes import ALONE, Processes
from gsmerge.research.training.targets import Targets
from gsmerge.research.training.train_options import TrainOptions
from gsmerge.types import Cameras, FeatureGaussians, Gaussians, Matches

Report = Callable[[str, int, int], None]  # what is done, step, steps
LAYOUT = 3  # version of the files
FORMAT = "gsmerge-example"
REMEDY = "remove it; the next call makes it again"
# Settings that an example depends on; fit_steps and levels only with a fit.
SETTINGS = ("densities", "segmentation", "photo_scale", "photo_side", "seed")
FIT_SETTINGS = ("match", "overlap", "iou", "fit_steps", "levels")
PARTS = {"members": Members, "features": FeatureGaussians, "base": Gaussians}


@dataclass(frozen=True)
class Shard:
    """A file with an example."""

    path: Path
    scene: str  # name of the scene
    sha256: str  # of the arrays


def prepare_shards(
    scenes: Sequence[Path],
    options: TrainOptions,
    folder: Path,
    processes: Processes = ALONE,
    report: Report | None = None,
) -> list[Shard]:
    """The shards of all scenes, in their order; those that are missing are made, by all processes together.

    Args:
        scenes: Folders or ``.ply`` files, see :func:`gsmerge.research.training.examples.make_examples`.
        options: What the examples depend on.
        folder: Of the shards, created if it is missing.
        processes: Of which each prepares some of the scenes.
        report: Called with (what is done, step, steps).

    Raises:
        SceneError: If a scene cannot be used, or the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SceneError(folder, f"cannot be written ({error.strerror})", "choose another folder") from error
    lists = []
    for number, scene in enumerate(own := processes.share(scenes)):
        lists.append(_scene_shards(scene, options, folder, report))
        if report:
            report("prepare", number + 1, len(own))
    return [shard for shards in processes.gather(lists) for shard in shards]


def _scene_shards(scene: Path, options: TrainOptions, folder: Path, report: Report | None) -> list[Shard]:
    key, name = scene_key(scene, options), scene_name(scene)
    record = folder / f"{key[:32]}.json"
    known = _read_record(record)
    if known is None:
        known = {}

        def fitted(step: int, steps: int) -> None:
            if report:
                report(f"fit {name}", step, steps)

        for label, make in make_examples(scene, options, fitted):
            path = folder / f"{key[:32]}-{label}.safetensors"
            known[path.name] = _content_hash(path) or write_shard(path, make())
        with atomic_output(record, overwrite=True) as temporary:
            temporary.write_text(json.dumps(known, indent=1) + "\n")
    return [Shard(folder / file, name, sha256) for file, sha256 in known.items()]


def scene_key(scene: Path, options: TrainOptions) -> str:
    """Hash of a scene's files and of the settings that its examples depend on.

    Raises:
        SceneError: If there is no scene.
    """
    names = (*SETTINGS, *FIT_SETTINGS) if options.uses_fit else SETTINGS
    head = {"layout": LAYOUT, "gsmerge": __version__, "fit": options.uses_fit, "views": options.example_views}
    head |= {name: getattr(options, name) for name in names}
    state = hashlib.sha256(json.dumps(head, sort_keys=True).encode("ascii"))
    files = find_scene_files(scene)
    for root in dict.fromkeys((files.ply, files.cameras, files.images, files.ply.parent / "targets")):
        if root is None:
            continue
        inside = sorted(p for p in root.rglob("*") if p.is_file()) if root.is_dir() else [root] * root.is_file()
        for path in inside:
            state.update(f"{path.relative_to(root.parent)} {path.stat().st_size}\n".encode("utf-8", "surrogateescape"))
            with path.open("rb") as stream:
                while block := stream.read(1 << 20):
                    state.update(block)
    return state.hexdigest()


def _read_record(path: Path) -> dict[str, str] | None:
    """Hash of each shard of a scene; None if the scene is not complete."""
    try:
        known = json.loads(path.read_text())
        complete = all(_content_hash(path.with_name(file)) == sha256 for file, sha256 in known.items())
    except (OSError, ValueError, AttributeError):
        return None
    return known if complete else None


def _content_hash(path: Path) -> str | None:
    """What the header says; None if there is no complete shard."""
    try:
        with safe_open(path, "np") as file:
            return str(json.loads((file.metadata() or {})[FORMAT])["sha256"])
    except (SafetensorError, OSError, ValueError, KeyError, TypeError):
        return None


def write_shard(path: Path, example: Example) -> str:
    """Write an example, in place of an existing file, and return the hash of its arrays.

    Raises:
        SceneError: If the file cannot be written.
    """
    arrays = dict(_arrays(example))
    facts = {"layout": LAYOUT, "sha256": hash_arrays(arrays), "unit": example.unit, "eps2d": example.photos.eps2d}
    facts |= {"size": [example.cameras.width, example.cameras.height], "levels": list(example.targets)}
    with atomic_output(path, overwrite=True) as temporary:
        temporary.write_bytes(save(arrays, {FORMAT: json.dumps(facts)}))  # save_file would change the file's mode
    return str(facts["sha256"])


def _arrays(example: Example) -> Iterator[tuple[str, np.ndarray]]:
    for part, kind in PARTS.items():
        for f in fields(kind):
            if f.name != "pixels":  # one member per pixel
                yield f"{part}.{f.name}", np.ascontiguousarray(getattr(getattr(example, part), f.name))
    for part, cameras in (("cameras", example.cameras), ("photos", example.photos)):
        yield f"{part}.viewmats", np.ascontiguousarray(cameras.viewmats)
        yield f"{part}.Ks", np.ascontiguousarray(cameras.Ks)
    yield "images", example.images
    yield "covers", example.covers
    if example.matches is not None:
        yield "clusters", example.matches.clusters
    for k, targets in example.targets.items():
        for f in fields(Targets):
            yield f"targets.{k}.{f.name}", getattr(targets, f.name)


def hash_arrays(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of names, types, shapes and values."""
    state = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        state.update(json.dumps([name, str(array.dtype), *array.shape]).encode("ascii"))
        state.update(array.data if array.size else b"")
    return state.hexdigest()


def read_shard(shard: Shard, *, check: bool = True) -> Example:
    """The example of a shard.

    Args:
        shard: Its file.
        check: Compare the arrays with their hash.

    Raises:
        SceneError: If the file is missing, damaged, or another than when the run began.
    """
    arrays, facts = _read(shard.path)
    if facts["sha256"] != shard.sha256 or (check and hash_arrays(arrays) != shard.sha256):
        raise SceneError(shard.path, "expected the example that was written, found a damaged file or another", REMEDY)

    def part(name: str) -> dict[str, Any]:
        prefix = f"{name}."
        return {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}

    black = np.broadcast_to(np.float32(0), arrays["images"].shape)
    clusters = arrays.get("clusters")
    return Example(
        name=shard.scene,
        unit=float(facts["unit"]),
        members=Members(**part("members")),
        cameras=Cameras(**part("cameras"), width=facts["size"][0], height=facts["size"][1]),
        features=FeatureGaussians(**part("features")),
        base=Gaussians(**part("base")),
        photos=Photos(black, **part("photos"), eps2d=facts["eps2d"]),
        images=arrays["images"],
        covers=arrays["covers"],
        matches=None if clusters is None else Matches(clusters, int(clusters.max()) + 1),
        targets={k: Targets(**part(f"targets.{k}")) for k in facts["levels"]},
    )


def _read(path: Path, prefix: str = "") -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays whose name begins with ``prefix``, and the header's facts."""
    try:
        with safe_open(path, "np") as file:
            facts = json.loads((file.metadata() or {})[FORMAT])
            return {n: file.get_tensor(n) for n in file.keys() if n.startswith(prefix)}, facts  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        raise SceneError(path, "expected an example, found a damaged file or none", REMEDY) from error


def read_targets(shard: Shard) -> dict[int, Targets]:
    """The targets alone of a shard's example.

    Raises:
        SceneError: If the file is missing or damaged.
    """
    arrays, facts = _read(shard.path, "targets.")
    names = [f.name for f in fields(Targets)]
    return {k: Targets(*(arrays[f"targets.{k}.{n}"] for n in names)) for k in facts["levels"]}
