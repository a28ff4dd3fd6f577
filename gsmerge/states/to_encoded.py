"""Scene -> merged Feature Gaussians and all their children, to be stored: everything up to decoding."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

from gsmerge import __version__
from gsmerge.compaction.files import read_input
from gsmerge.compaction.search import choose_count
from gsmerge.errors import UsageError
from gsmerge.facts.prepare import Prepared, prepare
from gsmerge.io import atomic_output
from gsmerge.pipeline import merge_views
from gsmerge.plan import Plan, make_plan, require_children
from gsmerge.report import document_head, file_sha256, human_bytes, seconds_document, seconds_line
from gsmerge.runtime.record import Progress, current_record, record_run, stage
from gsmerge.runtime.threads import use_threads
from gsmerge.scene.exporters import ReadHints
from gsmerge.scene.files import SceneFiles
from gsmerge.settings.budget import AUTO
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.reading import OpacityChoice
from gsmerge.settings.stages import MAX_CHILDREN
from gsmerge.stages.decode import keep_all, merged_count
from gsmerge.stages.merge import MergedViews
from gsmerge.stages.segment import knee_count
from gsmerge.states.encoded import Encoded, StoredHeads, StoredSettings, without_members
from gsmerge.states.gsm_file import save_encoded
from gsmerge.states.to_gaussians import divide_all
from gsmerge.types import Scene

DEFAULT_MAX_K = 4  # children that are stored of a group, unless a number of Gaussians is asked for


def encode_scene(
    scene: Scene,
    options: CompactOptions | None = None,
    *,
    max_k: int | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Encoded:
    """Encode a scene: all stages of :func:`gsmerge.compact` up to decoding, without a fit.

    ``decode_scene(encode_scene(scene, **settings))`` equals ``compact(scene, fit="none", poses="fixed", **settings)``
    bit for bit. So does any other ``k`` at decoding, with two exceptions: a budget or the size of the input limits the
    number of superpixels; or Gaussians that no view sees are kept, since these are merged for one K when encoding.

    Args:
        scene: See :func:`gsmerge.compact`; tensors become arrays.
        options: Settings of all stages; those of the fit do not matter. None: the defaults.
        max_k: Most Gaussians of a group that can be decoded, 1 to 8: more take more space. None: 4, or 8 where ``k``
            is larger or a number of Gaussians is asked for (budgets, unaligned scenes).
        progress: See :func:`gsmerge.compact`.
        **settings: Single settings by name, on top of ``options``.

    Raises:
        ValueError: If a setting is unknown or out of range, or goes with a fit or another method.

    Example:
        >>> encoded = gsmerge.encode_scene(gsmerge.read_scene("demo"), superpixels="2%", max_k=2)
        >>> len(gsmerge.decode_scene(encoded, k=2)) > len(gsmerge.decode_scene(encoded, k=1))
        True
    """
    options = _without_fit((options or CompactOptions()).with_settings(settings), settings)
    if max_k is not None and not 1 <= max_k <= MAX_CHILDREN:
        raise UsageError(f"max_k: expected 1 to {MAX_CHILDREN}, got {max_k}")
    if max_k is not None and max_k < options.decode.max_k:
        raise UsageError(f"max_k: expected at least {options.decode.k}, which is k, got {max_k}")
    with use_threads(options.threads), record_run(progress):
        prepared = prepare(scene.numpy(), options.prepare)
        plan = make_plan(prepared, options)
        require_children("max_k", max_k or 1, plan.checkpoint)
        count = choose_count(prepared, plan)
        if keep_all(prepared.scene, count) is not None:
            raise UsageError(f"budget: {count} keeps every Gaussian, which needs no encoding; use compact")
        merged = merge_views(prepared, plan, count)
        with stage("decode"):
            return _to_encoded(prepared, plan, merged, max_k)


def _without_fit(options: CompactOptions, settings: dict[str, Any]) -> CompactOptions:
    """Return the options without a fit and with fixed poses, so that batches can be added later."""
    fit = [f"fit {options.fit.fit}"] if settings.get("fit", "none") != "none" else []
    for name in (*fit, *options.compact_only):
        raise UsageError(f"{name}: cannot be encoded, as nothing is fitted or searched for; use compact")
    return replace(options, fit=replace(options.fit, fit="none"), prepare=replace(options.prepare, poses="fixed"))


def _to_encoded(prepared: Prepared, plan: Plan, merged: MergedViews, max_k: int | None) -> Encoded:
    """Collect everything that decoding needs of the merged Feature Gaussians."""
    features, networks, exact = merged.features, merged.networks, merged.segmentation.exact
    options, scene = plan.decode, prepared.scene
    count = merged_count(merged, options, grows=plan.fit.grows)
    max_k = max_k or (DEFAULT_MAX_K if count is None and options.max_k <= DEFAULT_MAX_K else MAX_CHILDREN)
    if networks is not None:
        max_k = min(max_k, networks.options.max_children)
    settings = StoredSettings(
        num_input=prepared.input_scene.num_gaussians,
        k=AUTO if plan.auto_count else options.k,
        max_k=max_k,
        min_opacity=options.min_opacity,
        min_contribution=plan.fit.min_contribution,
        target_count=count if exact else None,
        num_slots=None if exact or count is None else count // options.max_k,
        knee_count=knee_count(scene, plan.superpixels),
    )
    heads = None
    if networks is not None and plan.checkpoint is not None:
        group_features = networks.describe(features)
        heads = StoredHeads(plan.checkpoint.networks, group_features.views, group_features.group)
    return Encoded(
        features=without_members(features),
        division=divide_all(features, merged.members, max_k),
        kept=plan.unseen,
        frame=prepared.frame,
        cameras=scene.cameras,
        settings=settings,
        heads=heads,
        about=_about(plan.settings),
    )


def _about(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return version, options, choices and notes; nothing that depends on the machine."""
    settings = {**settings, "checkpoint": Path(settings["checkpoint"]).name}
    del settings["threads"]
    record = current_record()
    choices = {name: value for name, value in record.choices.items() if name != "networks"}
    return {"gsmerge": __version__, "options": settings, "choices": choices, "notes": list(record.notes)}


def encode_files(
    files: SceneFiles,
    settings: CompactOptions,
    out: Path,
    *,
    max_k: int | None,
    opacity: OpacityChoice = "auto",
    hints: ReadHints,
    overwrite: bool = False,
    progress: Progress | None = None,
    seconds_before: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Read a scene, encode it, write it to a file, and return the report as plain JSON types.

    Arguments and errors are those of :func:`encode_scene` and :func:`gsmerge.compaction.files.compact_files`.
    """
    start = perf_counter()
    with atomic_output(out, overwrite=overwrite) as temporary:
        load = read_input(files, opacity=opacity, hints=hints)
        read = perf_counter()
        encoded = encode_scene(load.scene, settings, max_k=max_k, progress=progress)
        done = perf_counter()
        hashed: dict[str, Any] = {"sha256": file_sha256(*files.plys)}
        hashed["bytes"] = sum(path.stat().st_size for path in files.plys)
        texts = {"comments": list(load.comments), "notes": list(load.notes)}
        save_encoded(temporary, encoded, overwrite=True, source={"name": files.ply.name, **hashed, **texts})
    seconds = {**(seconds_before or {}), "read": read - start, "encode": done - read, "write": perf_counter() - done}
    stored, size, about = encoded.settings, out.stat().st_size, encoded.about
    counts = {"num_groups": len(encoded), "num_gaussians_at_most": encoded.max_gaussians, "max_k": stored.max_k}
    return {
        **document_head(),
        "input": {"path": str(files.ply), "num_gaussians": stored.num_input, **hashed, **load.recognised},
        "output": {"path": str(out), "bytes": size, **counts},
        "ratio_bytes": size / hashed["bytes"],
        "options": about["options"],
        "seed": about["options"]["seed"],
        "choices": about["choices"],
        **seconds_document(seconds),
        "notes": [*load.notes, *about["notes"]],
    }


def encoding_line(document: Mapping[str, Any]) -> str:
    """Describe the report of an encoding in one line."""
    scene, file = document["input"], document["output"]
    line = f"{file['path']}: {scene['num_gaussians']:,} Gaussians -> {file['num_groups']:,} groups, "
    line += f"{human_bytes(scene['bytes'])} -> {human_bytes(file['bytes'])} ({100 * document['ratio_bytes']:.0f} %); "
    return f"{line}decodes to {file['num_gaussians_at_most']:,} Gaussians at most; {seconds_line(document)}"
