"""Compact a scene of many views in blocks: each block keeps the Gaussians that belong to it, and the kept Gaussians of
all blocks are joined."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from gsmerge.blocks.fit_seams import fit_seams
from gsmerge.blocks.partition import (
    Block,
    Covisibility,
    count_factors,
    gaussians_at_once,
    measure_covisibility,
    partition_apart,
    partition_views,
)
from gsmerge.blocks.start_block import BlockStart, start_block
from gsmerge.counts.file_size import drop_to_bytes, measure_least_bytes
from gsmerge.errors import Doubt
from gsmerge.method.facts.pictures import OWN_PHOTOS, PHOTOS
from gsmerge.method.facts.scene_size import SceneSize
from gsmerge.method.fit import fit_scene, peak_weights
from gsmerge.method.geometry.frame import Frame, scene_frame
from gsmerge.method.geometry.views import subset
from gsmerge.method.pipelines.plan import Plan
from gsmerge.method.raster.metrics import SAMPLE_LOSS, describe_loss, is_worse
from gsmerge.method.raster.photos import blank_photos
from gsmerge.method.stages.clean import faintest_dropped
from gsmerge.method.stages.prune import split_unseen
from gsmerge.plan.blocks import WHOLE_GAUSSIANS
from gsmerge.plan.counts import file_size
from gsmerge.plan.forecast import INPUT_STEPS, STAGE_STEPS
from gsmerge.plan.make_plan import plan_scene
from gsmerge.results.report import CompactReport
from gsmerge.results.result import CompactResult
from gsmerge.results.scores import measure_result
from gsmerge.runtime.memory import free_pages, memory_bytes, peak_memory
from gsmerge.runtime.record import (
    Record,
    RunPart,
    add_seconds,
    begin_part,
    current_record,
    expect_parts,
    note,
    record_choices,
    stage,
)
from gsmerge.runtime.work import start_work
from gsmerge.scoring.evaluate import evaluate
from gsmerge.settings.budget import AUTO, parse_share, share_text
from gsmerge.settings.compact import ONE_PIECE, CompactOptions
from gsmerge.settings.evaluate import EvaluateOptions
from gsmerge.types import Cameras, Decoded, Gaussians, Scene

T = TypeVar("T")
# A block may have more superpixels than its views would have in one piece, if views of other blocks also see the
# block's surfaces (see count_factors). The block has at most MOST_DENSITY times as many superpixels as its views would
# have in one piece
MOST_DENSITY = 2.0
BLOCK_SURPLUS = 1.03  # Gaussians of all blocks, relative to the requested number; the faintest are dropped at the end


def compact_in_blocks(scene: Scene, options: CompactOptions, size: SceneSize, count: int) -> CompactResult | None:
    """Compact a scene in ``count`` blocks of views, or in fewer; None if one block is enough."""
    blocks, covisibility = cut_views(scene, options, count)
    if len(blocks) == 1:
        return None
    return compact_blocks(scene, options, plan_scene(size, options), blocks, covisibility)


def cut_views(scene: Scene, options: CompactOptions, count: int) -> tuple[list[Block], Covisibility]:
    """Cut the views of a scene into ``count`` blocks; also return how much each view sees of every other view.

    If the user asks for blocks, or the memory is too small for one piece, there are ``count`` blocks. If the only
    reason is the number of views, there may be fewer blocks, down to one.
    """
    with stage("partition"):
        covisibility = measure_covisibility(scene.numpy())
        by_views_alone = options.blocks.blocks == "auto" and scene.num_gaussians <= WHOLE_GAUSSIANS
        partition = partition_apart if by_views_alone else partition_views
        return partition(covisibility.weights, count), covisibility


def compact_blocks(
    scene: Scene, options: CompactOptions, plan: Plan, blocks: Sequence[Block], covisibility: Covisibility
) -> CompactResult:
    """Compact a scene in blocks of views.

    First the views of each block are merged, and each block keeps the Gaussians that belong to it. The sets of all
    blocks are joined into one set of Gaussians. Each block fits all Gaussians that its views see, also Gaussians of its
    neighbours, and keeps the Gaussians that belong to it. At the border of two blocks, both fit the same Gaussians to
    the same photos.
    """
    scene = scene.numpy()
    count = len(blocks)
    limit = plan.count.limits.count
    if scene.images is not None:
        note(f"compacted in {count} blocks of views: photos keep their exposures, and new views are not estimated")
    with stage("partition"):
        factors = count_factors(blocks, covisibility).tolist()
        frame = scene_frame(scene)
        # Blocks take the steps of the fit, the networks and the density that were chosen for the whole scene
        checkpoint = options.checkpoint if plan.settings["checkpoint"] != "none" else "none"
        options = options.with_settings({"fit_steps": plan.fit.steps, "checkpoint": checkpoint})
        options = replace(options, fit=replace(options.fit, share=plan.count.limits.share))
    size = gaussians_at_once(scene.num_gaussians, count)
    memory = memory_bytes(size, num_rest=3 * scene.gaussians.shN.shape[1])
    engine = options.blocks.engine
    with start_work(engine.engine, engine.address, threads=options.threads, memory=memory) as work:
        shared = work.share(covisibility)

        def pieces() -> Iterator[tuple[Any, ...]]:
            """Yield the arguments of :func:`start_block` for each block: its part of the scene, and its options."""
            for block, factor in zip(blocks, factors, strict=True):
                piece_options = block_options(options, scene, block, factor, limit)
                piece = subset(scene, block.views)
                free_scene(scene)  # its pages can be read again from the file; the piece is a copy
                yield piece, block, shared, piece_options, frame

        expect_parts(block_parts(len(scene), 0 if plan.fit.fit == "none" else plan.fit.steps, count))
        starts = [start for start, _ in adopt_records(work.run("merge", start_block, count, pieces()))]
        with stage("join"):
            joined, owners = join_parts([start.gaussians for start in starts])
            growth = sum(start.count for start in starts) / max(1, len(joined))
            if limit is not None and options.budget.is_filled:
                # Blocks drop new Gaussians that belong to other blocks, so each block needs a surplus to reach its
                # number
                growth = max(growth, BLOCK_SURPLUS * limit / max(1, len(joined)))
        shared_start = work.share((joined, owners))
        fitted = list(adopt_records(work.run("fit", fit_block, count, list_calls(starts, shared_start, growth))))
        joined, owners = join_parts([gaussians for gaussians, _ in fitted])
        joined = fit_seams(joined, owners, starts, options.seed)
        result = finish_joined(joined, scene.cameras, names=scene.names, frame=frame, options=options, plan=plan)
        scored = work.run("score", score_block, count, list_calls(starts, work.share(result)))
        scores = [score for score, _ in adopt_records(scored)]
    facts = [
        {
            "views": len(start.block.own), "shared_views": len(start.block.shared), "num_start": len(start.gaussians),
            "psnr_input_views": score, "fit": block_choices.get("fit"),
        }
        for start, (_, block_choices), score in zip(starts, fitted, scores, strict=True)
    ]  # fmt: skip
    record_choices(blocks=facts)
    return CompactResult(result, join_reports(scene, result, starts, scores, options), scene.cameras)


def join_reports(
    scene: Scene,
    gaussians: Gaussians,
    starts: Sequence[BlockStart],
    psnrs: Sequence[float | None],
    options: CompactOptions,
) -> CompactReport:
    """Make the report of the whole scene. Its PSNR is the mean of the blocks' PSNR, weighted by their numbers of views.

    ``psnrs`` has the PSNR (dB) of the result on the photos of each block, or None without photos. Seconds and notes
    come from the current record. If the result may be worse than the input, result and input are scored again on all
    photos.
    """
    run = current_record()
    num_views = [len(start.block.own) for start in starts]

    def mean(values: Sequence[float | None]) -> float | None:
        """Average a value of each block, weighted by the blocks' numbers of views; None if a block has no value."""
        numbers = [value for value in values if value is not None]
        return None if len(numbers) < len(values) else float(np.average(numbers, weights=num_views))

    scored = sum(len(start.plan.score.views) for start, psnr in zip(starts, psnrs, strict=True) if psnr is not None)
    before = mean([start.psnr_before for start in starts])
    after = mean(psnrs)
    reference = None if before is None else starts[0].prepared.reference.name
    pictures = OWN_PHOTOS if reference == PHOTOS else reference
    may_be_worse = reference == PHOTOS and is_worse(before, after, SAMPLE_LOSS)
    if may_be_worse:
        exact = evaluate(scene, {"result": gaussians}, options=EvaluateOptions(lpips=(), fog=False))
        before, after = (scores.mean("context")[scene.masks is not None].psnr for scores in exact.results)
    worse = None if pictures is None else describe_loss("the result", before, after, pictures)
    return CompactReport(
        num_input=scene.num_gaussians, num_output=len(gaussians), seconds=dict(run.seconds), psnr_before=before,
        psnr_after=after, notes=[*run.notes, *([] if worse is None else [Doubt(worse, "worse")])],
        choices=run.choices | {"scored_views": len(scene) if may_be_worse else scored, "scored_all": may_be_worse},
        options=options.to_dict(), peak_memory_bytes=peak_memory(), worse=worse, psnr_reference=reference,
    )  # fmt: skip


def join_parts(parts: Sequence[Gaussians]) -> tuple[Gaussians, np.ndarray]:
    """Join the Gaussians of all blocks; also return the number ``[n]`` of the block that owns each Gaussian."""
    return Gaussians.concat(parts), np.repeat(np.arange(len(parts)), [len(gaussians) for gaussians in parts])


def block_parts(views: int, steps: int, count: int) -> list[RunPart]:
    """Return the parts of a run in ``count`` blocks: merge each block, fit each, fit the seams, score each block.

    All blocks are assumed to cost the same, and the fit of the seams half as much as the fits of all blocks.
    """
    merges = [RunPart("merge", STAGE_STEPS * views / count)] * count
    scores = [RunPart("score", INPUT_STEPS * views / count)] * count
    fits = [*[RunPart("fit", 0.0, steps / count)] * count, RunPart("seams", 0.0, 0.5 * steps)]
    return [*merges, *fits, *scores]


def adopt_records(outcomes: Iterable[tuple[T, Record]]) -> Iterator[tuple[T, dict[str, Any]]]:
    """Yield, for each block, what the block returned, and the choices in its record.

    Seconds, notes, changes and left-out photos in the block's record are added to the current record.
    """
    for value, record in outcomes:
        add_seconds(record.seconds)
        for text in record.notes:
            note(text)
        for name in ("changes", "photos_left_out"):
            if of_block := record.choices.get(name):
                record_choices(**{name: list(dict.fromkeys([*current_record().choices.get(name, ()), *of_block]))})
        yield value, record.choices


def list_calls(starts: Sequence[BlockStart], *values: Any) -> Iterator[tuple[Any, ...]]:
    """Yield the arguments of a call for each block: the block's start, the ``values``, and the block's number.

    The caller sends the arguments of one block before it asks for the next, so that the memory of the sent arguments is
    released.
    """
    for number, start in enumerate(starts):
        yield start, *values, number
        for scene in (start.prepared.scene, start.prepared.input_scene):
            free_scene(scene)


def fit_block(start: BlockStart, shared_start: tuple[Gaussians, np.ndarray], growth: float, number: int) -> Gaussians:
    """Fit all Gaussians that the views of a block may see; return the fitted Gaussians that the block owns.

    ``shared_start`` has the canonical Gaussians of all blocks, and for each the number of the block that owns it.
    ``growth`` is the final number of Gaussians divided by the number at the start. ``number`` is that of the block.
    """
    begin_part("fit")
    joined, owners = shared_start
    scene = start.prepared.scene
    plan = start.plan
    used = owners == number
    if plan.fit.fit != "none":
        used |= peak_weights(joined, blank_photos(scene.cameras, 2))[0] >= plan.fit.min_contribution
    rows = np.flatnonzero(used)
    decoded = Decoded(joined[rows], round(growth * len(rows)), exact=False)
    fitted = fit_scene(decoded, scene, plan.fit, plan.seed)
    if fitted.report is None:  # without a fit, these are the start Gaussians of the block
        return fitted.gaussians
    assert fitted.report.origins is not None
    return fitted.gaussians[owners[rows[fitted.report.origins]] == number]


def score_block(start: BlockStart, gaussians: Gaussians, _: int) -> float | None:
    """Return the PSNR (dB) of the result of all blocks on the photos of one block; None without photos."""
    begin_part("score")
    measured = measure_result(gaussians, start.prepared, start.plan.score)
    return None if measured is None else measured.psnr


def finish_joined(
    joined: Gaussians, cameras: Cameras, names: Sequence[str], frame: Frame, options: CompactOptions,
    plan: Plan,
) -> Gaussians:  # fmt: skip
    """Prune the canonical Gaussians of all blocks, move them into the world, meet the budget, and return them."""
    limit = plan.count.limits.count
    if plan.fit.min_contribution > 0:
        # Gaussians that no camera sees are dropped. If the options fill the budget, as many of these are kept as the
        # budget allows
        seen, unseen = split_unseen(joined, frame.enter_cameras(cameras))
        max_unseen = len(unseen) if limit is None else max(0, limit - len(seen))
        unseen = unseen[: max_unseen if options.budget.is_filled else 0]
        record_choices(pruned=len(joined) - len(seen) - len(unseen))
        joined = Gaussians.concat([seen, unseen])
    result = frame.leave(joined)
    if limit is not None and limit < len(result):
        result = faintest_dropped(result, limit)
    if limit is not None and options.budget.is_filled and len(result) < limit:
        note(f"budget: {limit:,} Gaussians were asked for, {len(result):,} remain of those of all blocks")
    if (size := file_size(options.budget, 0)) and size.packed:
        content = size, cameras, names
        result = drop_to_bytes(result, *content, measure_least_bytes(result, *content))
    return result


def free_scene(scene: Scene) -> None:
    """Release the memory of the arrays of a scene that are kept in files, from which they are read again if needed."""
    free_pages([*vars(scene.gaussians).values(), *([] if scene.images is None else [scene.images])])


def block_options(
    options: CompactOptions, scene: Scene, block: Block, factor: float, limit: int | None
) -> CompactOptions:
    """Return the options of a block: the scene's options, but with only a part of the Gaussians and fit steps.

    This part is the block's share of the scene's views. The block's number of Gaussians is also multiplied by
    ``factor``. Cameras and exposures stay fixed. ``limit`` is the number of Gaussians of all blocks together; None:
    ``superpixels`` and K decide.
    """
    settings: dict[str, Any] = {**ONE_PIECE, "budget": None}
    settings["fit_steps"] = max(1, round(options.fit.steps * len(block.views) / len(scene)))
    # with few steps, the share of steps that draw a quarter of the pixels would differ from the whole scene's share
    if replace(options.fit, fit_steps=settings["fit_steps"]).half_res_part != options.fit.half_res_part:
        settings["half_res_share"] = options.fit.half_res_part
    superpixels = options.segment.superpixels
    if limit is not None:
        settings["budget"] = max(1, round(BLOCK_SURPLUS * factor * limit * len(block.views) / len(scene)))
    elif isinstance(superpixels, str) and superpixels.endswith("%"):
        share = min(1.0, min(factor, MOST_DENSITY) * parse_share(superpixels))
        settings["superpixels"] = share_text(round(share, 6))
    elif superpixels != AUTO:
        settings["superpixels"] = round(min(factor, MOST_DENSITY) * int(superpixels))
    return options.with_settings(settings)
