"""The top: compact a scene in one piece or in blocks, for one count or for several until a quality is met."""

from __future__ import annotations

from functools import partial
from typing import Any

from gsmerge.compaction.blocks import compact_in_blocks
from gsmerge.compaction.methods import Build, choose_method
from gsmerge.compaction.result import Candidate, CompactResult, make_result, score
from gsmerge.compaction.search import level_counts, search_count
from gsmerge.facts.prepare import Prepared, prepare
from gsmerge.pipeline import build
from gsmerge.plan import Plan, make_plan, note_engine, plan_whole
from gsmerge.runtime.record import Progress, record_part, record_run
from gsmerge.runtime.threads import use_threads
from gsmerge.scene.read import as_scene
from gsmerge.settings.compact import CompactOptions
from gsmerge.stages.clean import clean_to_count
from gsmerge.stages.segment import measure_size
from gsmerge.types import Scene, StrPath


def compact(
    scene: Scene | StrPath, options: CompactOptions | None = None, *, progress: Progress | None = None, **settings: Any
) -> CompactResult:
    """Replace a scene by a compact one that renders at least as well from new viewpoints.

    Args:
        scene: What :func:`gsmerge.read_scene` returns, or the path that it reads. Tensors give tensors.
        options: Settings of all stages; None: the defaults.
        progress: Called with (stage, done, stages), and from within longer ones with ("fit: ...", step, steps).
        **settings: Single settings by name, on top of ``options``: ``compact(scene, k=2, superpixels="1%")``.

    Raises SceneError for a path that cannot be read, ValueError for a setting that is unknown or out of range.

    Example:
        >>> result = gsmerge.compact("demo", effort="draft", budget="5%")
        >>> len(result.gaussians)
        384
    """
    options = (options or CompactOptions()).with_settings(settings)
    with use_threads(options.threads), record_run(progress):
        scene = as_scene(scene)
        size = measure_size(scene.numpy())
        whole = plan_whole(size, options)  # what needs no work to decide
        note_engine(size, options, whole.blocks)
        return compact_in_blocks(scene, options, whole) if whole.blocks > 1 else compact_piece(scene, options)


def compact_piece(scene: Scene, options: CompactOptions) -> CompactResult:
    """Compact a scene in one piece."""
    method = choose_method(options, scene, build)  # ours, or a baseline
    prepared = prepare(scene.numpy(), options.prepare)  # facts: frame, photos, poses, unseen
    plan = make_plan(prepared, options)  # every "auto" is decided once; options end here
    search = search_count(prepared, plan)  # one count, or counts until a quality is met
    for count in search:
        search.add(build_scored(method, prepared, plan, count))
    fixed = prepared.with_cameras(search.best.fitted.cameras), plan.with_fixed_cameras()
    levels = [build_scored(method, *fixed, count) for count in level_counts(len(search.best.gaussians), plan)]
    return make_result(search.best, levels, prepared, plan, search.facts()).to(scene.gaussians.device)


@record_part()
def build_scored(method: Build, prepared: Prepared, plan: Plan, count: int | None) -> Candidate:
    """Build ``count`` Gaussians with a method, clean them up as the plan says, and score them."""
    fitted = clean_to_count(partial(method, prepared, plan), count, plan.clean, prepared)
    return score(count, fitted, prepared, plan)
