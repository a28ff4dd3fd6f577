"""scene -> merged feature gaussians and all their children: everything up to decoding, to be kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from gsmerge import __version__
from gsmerge.build import Merged, merged_groups, wanted_count
from gsmerge.encoded.divide import divide_all
from gsmerge.encoded.encoded import Encoded, StoredHeads, StoredSettings, without_members
from gsmerge.errors import UsageError
from gsmerge.options import CompactOptions
from gsmerge.pipeline import Work, begin, choose_groups, decide, keeps_all
from gsmerge.runtime.run_log import Progress, RunLog
from gsmerge.runtime.threads import use_threads
from gsmerge.stages.decode import MAX_CHILDREN
from gsmerge.stages.group import Grouping, knee_count, scene_tree
from gsmerge.types import PixelScene, UnalignedScene

USUAL_MOST = 4  # children that are kept of a group, unless a number of Gaussians is to be dealt out


def encode_scene(
    scene: PixelScene | UnalignedScene,
    options: CompactOptions | None = None,
    *,
    max_k: int | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Encoded:
    """All of :func:`gsmerge.compact` up to decoding, kept: superpixels, merging, matching, networks; never a fit.

    ``decode_scene(encode_scene(scene, **settings))`` is ``compact(scene, fit="none", **settings)``, bit for bit; so is
    any other ``k`` at decoding, unless a budget, a preset, ``k="auto"`` or the size of the input limits the number of
    superpixels of either, or Gaussians that no view sees are kept: these are merged for one K.

    Args:
        scene: As of :func:`gsmerge.compact`.
        options: Settings of all stages; those of the fit do not matter. None: the defaults.
        max_k: Most Gaussians of a group that can be decoded, 1 to 8: more take more space. None: 4, or 8 where ``k``
            is larger or a number of Gaussians is dealt out (budgets, presets, ``k="auto"``, scenes in no order).
        progress: As of :func:`gsmerge.compact`.
        **settings: Single settings by name, on top of ``options``.

    Raises:
        ValueError: If a setting is unknown or out of range, or goes with a fit or another method.
    """
    options = _unfitted((options or CompactOptions()).with_settings(settings), settings)
    if max_k is not None and not 1 <= max_k <= MAX_CHILDREN:
        raise UsageError(f"max k: expected 1 to {MAX_CHILDREN}, got {max_k}")
    if max_k is not None and max_k < options.decode.count:
        raise UsageError(f"max k: expected at least {options.decode.count}, which is k, got {max_k}")
    log = RunLog(progress)
    with use_threads(options.threads), torch.no_grad():
        work = begin(scene, options, log)
        count = decide(work, log)
        if keeps_all(work, count):
            raise UsageError(f"budget: {count} keeps every Gaussian, which needs no encoding; use compact")
        grouping = choose_groups(work, count, log)
        merged = merged_groups(work.source, grouping, work.options, log)
        with log.stage("decode"):
            return _kept(work, grouping, merged, max_k, log)


def _unfitted(options: CompactOptions, settings: dict[str, Any]) -> CompactOptions:
    """The options without a fit.

    Raises:
        UsageError: If a fit, another method, a quality or levels are asked for.
    """
    fitted = [f"fit {options.fit.fit}"] if settings.get("fit", "none") != "none" else []
    for name in (*fitted, *options.whole_only):
        raise UsageError(f"{name}: cannot be encoded, as nothing is fitted or searched for; use compact")
    return replace(options, fit=replace(options.fit, fit="none"))


def _kept(work: Work, grouping: Grouping, merged: Merged, max_k: int | None, log: RunLog) -> Encoded:
    """Everything that decoding needs of the merged Feature Gaussians."""
    features, learned = merged.features, merged.learned
    options, scene = work.options, work.source.scene
    wanted = wanted_count(merged, grouping, options)
    dealt = wanted is not None or options.decode.count > USUAL_MOST
    most = max_k or (MAX_CHILDREN if dealt else USUAL_MOST)
    tree = work.tree or scene_tree(scene, work.canvas, options, work.canvas.usual)
    prunes = scene.images is not None and options.fit.effort != "draft"
    settings = StoredSettings(
        num_input=work.scene.num_gaussians,
        k=options.decode.k,
        most=most,
        min_opacity=options.decode.min_opacity,
        prune=options.fit.prune if prunes else 0.0,
        wanted=wanted if grouping.exact else None,
        places=None if grouping.exact or wanted is None else wanted // options.decode.count,
        knee=knee_count(tree, work.canvas, options),
    )
    heads = None
    if learned is not None:
        group_features = learned.describe(features)
        heads = StoredHeads(learned.networks, group_features.views, group_features.group)
    return Encoded(
        features=without_members(features),
        division=divide_all(features, merged.members, most, options.encode.rule),
        kept=work.kept,
        frame=work.frame,
        cameras=scene.cameras,
        settings=settings,
        heads=heads,
        about=_about(work.settings, log),
    )


def _about(options: CompactOptions, log: RunLog) -> dict[str, Any]:
    """Version, options, choices and notes; nothing that depends on the machine."""
    told = options.to_dict()
    del told["threads"]
    checkpoint = {"checkpoint": Path(options.checkpoint).name}
    choices = {name: value for name, value in log.choices.items() if name != "networks"}
    return {"gsmerge": __version__, "options": told | checkpoint, "choices": choices, "notes": list(log.notes)}
