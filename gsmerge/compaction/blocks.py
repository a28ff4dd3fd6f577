"""A scene of many views in blocks: each is compacted by itself, cut to what is its own, and joined with the others."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import astuple, dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np

from gsmerge.alignment.registration.join import concat_scenes
from gsmerge.budget import file_size
from gsmerge.compaction.file_size import drop_to_bytes, measure_rest
from gsmerge.compaction.forecast import AFTER, BEFORE, fit_cost
from gsmerge.compaction.make_plan import make_plan
from gsmerge.compaction.partition import (
    Block,
    Covisibility,
    count_factors,
    gaussians_at_once,
    measure_covisibility,
    owning_views,
    partition_apart,
    partition_views,
)
from gsmerge.compaction.report import CompactReport, Covered, PhotoFiles
from gsmerge.compaction.result import Besides, CompactResult, InputScores, measure_besides, measure_result, score_input
from gsmerge.facts.prepare import Prepared, prepare
from gsmerge.facts.row_colors import OWN_PHOTOS, PHOTOS
from gsmerge.facts.views import in_float64, subset
from gsmerge.fit import fit_scene, peak_weights
from gsmerge.frame import Frame, scene_frame
from gsmerge.pipeline import decode_views
from gsmerge.plan import WHOLE_GAUSSIANS, Plan, SceneChoices
from gsmerge.raster import contributions, make_splats, tile_view
from gsmerge.raster.metrics import describe_loss
from gsmerge.raster.photos import Photos, blank_photos
from gsmerge.raster.tiled_view import Splats
from gsmerge.runtime.estimate import memory_bytes
from gsmerge.runtime.memory import free_pages, make_array, peak_memory
from gsmerge.runtime.record import (
    Record,
    add_seconds,
    begin_part,
    choose,
    current_record,
    expect_parts,
    note,
    record_part,
    stage,
)
from gsmerge.runtime.threads import in_turn
from gsmerge.runtime.time_left import Part
from gsmerge.runtime.work import start_work
from gsmerge.settings.budget import parse_share, share_text
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.setting import piece_settings
from gsmerge.settings.stages import AUTO_SHARE
from gsmerge.stages.clean import faintest_dropped
from gsmerge.stages.prune import split_unseen
from gsmerge.types import Cameras, Decoded, Gaussians, PicturedScene, Scene, SceneT

T = TypeVar("T")
# of a result on a block: PSNR (dB), and what is measured besides
Scores = tuple[float | None, Besides]
FOREIGN = 0.1  # share of a Gaussian's weights in other blocks' views from which on it is at a seam
SEAM_SHARE = 0.1  # of a view's weights that such Gaussians have from which on it is fitted to
SEAM_STEPS = 100  # at least
SEAM_LOOKS = 2  # at each view, at least
MOSTLY_SEAMS, ROOM_LOOKS = 0.5, 4  # share of Gaussians at seams from which on a scene is one room, and then the looks
SEAM_RATE = 0.6  # times the usual first steps: what is there is fitted, but not beside its neighbours as they are now
SEAM_DECAY = 0.1  # factor on the steps at the end
MOST_DENSITY = 2.0  # times the superpixels of one piece, where a scene's views see so much of each other's
IN_FILE = 1 << 24  # bytes from which on the photos of a block are in a file
SURPLUS = 1.03  # times an exact number of Gaussians: the faintest of what is too many are left out


def cut_views(scene: Scene, options: CompactOptions, count: int) -> tuple[list[Block], Covisibility]:
    """Cut the views of a scene into ``count`` blocks, or fewer if only the number of views asks for blocks."""
    with stage("partition"):
        covisibility = measure_covisibility(scene.numpy())
        fewer = options.blocks.blocks == "auto" and scene.num_gaussians <= WHOLE_GAUSSIANS
        return (partition_apart if fewer else partition_views)(covisibility.weights, count), covisibility


def compact_in_blocks(
    scene: Scene, options: CompactOptions, choices: SceneChoices, blocks: Sequence[Block], covisibility: Covisibility
) -> CompactResult:
    """Compact a scene in blocks of views.

    The views of each block are merged first, and only the Gaussians that belong to the block are kept, so that all
    blocks together start from one set of Gaussians. Then each block fits what its views see, its neighbours' Gaussians
    included, and keeps its own: where two blocks meet, both fit the same Gaussians to the same photos.
    """
    device, scene = scene.gaussians.device, scene.numpy()
    count, most = len(blocks), choices.limits.count
    with stage("partition"):
        factors = count_factors(blocks, covisibility).tolist()
        frame, options = scene_frame(scene), with_choices(options, choices)
    size = gaussians_at_once(scene.num_gaussians, count)
    memory = memory_bytes(size, num_rest=3 * scene.gaussians.shN.shape[1])
    engine = options.blocks.engine
    with start_work(engine.engine, engine.address, threads=options.threads, memory=memory) as work:
        seen = work.share(covisibility)

        def pieces() -> Iterator[tuple[Any, ...]]:
            for block, factor in zip(blocks, factors, strict=True):
                piece_options = block_options(options, scene, block, factor, most)
                piece = subset(scene, block.views)
                free_scene(scene)
                yield piece, block, seen, piece_options, frame

        expect_parts(block_parts(scene, choices, blocks))
        parts = [part for part, _ in adopt_records(work.run("merge", start_part, count, pieces()))]
        with stage("join"):
            joined = Gaussians.concat([part.gaussians for part in parts])
            owners = np.repeat(np.arange(count), [len(part.gaussians) for part in parts])
            growth = sum(part.count for part in parts) / max(1, len(joined))
            if most is not None and options.budget.is_filled:  # what views of other blocks show better is left to them
                growth = max(growth, SURPLUS * most / max(1, len(joined)))
        everything = work.share((joined, owners))
        fitted = list(adopt_records(work.run("fit", fit_part, count, each_part(parts, everything, growth))))
        joined = Gaussians.concat([gaussians for gaussians, _ in fitted])
        owners = np.repeat(np.arange(count), [len(gaussians) for gaussians, _ in fitted])
        joined = fit_seams(joined, owners, parts, options.seed)
        if choices.fit.min_contribution > 0:
            joined = prune_joined(joined, frame.enter_cameras(scene.cameras), options, most)
        result = frame.leave(joined)
        if most is not None and most < len(result):
            result = faintest_dropped(result, most)
        if most is not None and options.budget.is_filled and len(result) < most:
            note(f"budget: {most:,} Gaussians were asked for, {len(result):,} are left of those of all blocks")
        if (asked := file_size(options.budget)) and asked.packed:
            page = asked.num_bytes, asked.file, scene.cameras
            result = drop_to_bytes(result, *page, measure_rest(result, *page))
        everything = work.share(result)
        scored = work.run("score", score_part, count, each_part(parts, everything))
        scores = [score for score, _ in adopt_records(scored)]
    facts = [
        {
            "views": len(part.block.own), "shared_views": len(part.block.shared), "num_start": len(part.gaussians),
            "psnr_input_views": psnr, "fit": chosen.get("fit"),
        }
        for part, (_, chosen), (psnr, _) in zip(parts, fitted, scores, strict=True)
    ]  # fmt: skip
    choose(blocks=facts)
    return CompactResult(result, join_reports(scene, result, parts, scores, options), scene.cameras).to(device)


def block_parts(scene: Scene, choices: SceneChoices, blocks: Sequence[Block]) -> list[Part]:
    """Return the costs of a run in blocks, whose fits take as many steps as they have views."""
    pixels, steps = scene.pixels_per_view, 0 if choices.fit.fit == "none" else choices.fit.steps
    shares = [len(block.views) / len(scene) for block in blocks]
    merges, scores = ([Part(cost * pixels * len(scene) * share) for share in shares] for cost in (BEFORE, AFTER))
    count = choices.limits.default
    fits = [Part(0, fit_cost(round(steps * share), pixels, count * share)) for share in shares]
    seams = Part(0, fit_cost(max(SEAM_STEPS, SEAM_LOOKS * len(scene)), pixels, count))
    return [*merges, *fits, *[seams] * (steps > 0), *scores]


def adopt_records(outcomes: Iterable[tuple[T, Record]]) -> Iterator[tuple[T, dict[str, Any]]]:
    """Yield each value with the choices of its record; add the seconds and notes to the current record."""
    for value, record in outcomes:
        add_seconds(record.seconds)
        for text in record.notes:
            note(text)
        yield value, record.choices


@dataclass(frozen=True, eq=False)
class BlockStart:
    """A block whose views are merged but whose Gaussians are not fitted yet."""

    block: Block
    gaussians: Gaussians  # canonical ones that belong to it
    count: int  # Gaussians that it is to have in the end
    prepared: Prepared  # its views, without the Gaussians of their pixels
    plan: Plan
    before: InputScores


def start_part(
    piece: Scene, block: Block, covisibility: Covisibility, options: CompactOptions, frame: Frame
) -> BlockStart:
    """Merge the views of a block, and keep the start Gaussians that belong to the block."""
    begin_part()
    prepared = prepare(piece, options.prepare, frame)
    plan = make_plan(prepared, options)
    decoded = decode_views(prepared, plan, plan.limits.count)
    keep = belongs_to_block(frame.leave(decoded.gaussians).means, block, covisibility)
    before = score_input(prepared, plan)
    count, prepared = round(keep.sum() / max(1, len(keep)) * decoded.count), without_gaussians(prepared)
    return BlockStart(block, decoded.gaussians[keep], count, prepared, plan, before)


def without_gaussians(prepared: Prepared) -> Prepared:
    """Return a prepared scene without Gaussians and with photos in a file, to free their memory."""
    moved: dict[int, np.ndarray] = {}  # photos that both scenes share are moved once

    def move(images: np.ndarray) -> np.ndarray:
        if id(images) not in moved:
            moved[id(images)] = make_array(images.shape, images.dtype.type, IN_FILE)
            moved[id(images)][:] = images
            free_pages([moved[id(images)]])
        return moved[id(images)]

    def bare(scene: SceneT) -> SceneT:
        images = move(np.asarray(scene.images))  # views with Gaussians of their own always have pictures
        return replace(scene, gaussians=scene.gaussians[np.zeros(0, int)], images=images, pixels=None)

    reference = prepared.reference
    if reference.photo_files is not None:
        reference = replace(reference, photo_files=move(reference.photo_files))
    scene, input_scene = bare(prepared.scene), bare(prepared.input_scene)
    return replace(prepared, reference=reference, scene=scene, input_scene=input_scene)


def each_part(parts: Sequence[BlockStart], *values: Any) -> Iterator[tuple[Any, ...]]:
    """Yield arguments for one call per part: the part and its ``values``; then release its files."""
    for number, part in enumerate(parts):
        yield part, *values, number
        for scene in (part.prepared.scene, part.prepared.input_scene):
            free_scene(scene)


def fit_part(part: BlockStart, everything: tuple[Gaussians, np.ndarray], growth: float, number: int) -> Gaussians:
    """Fit all Gaussians that the views of a block may see; return the fitted Gaussians of block ``number``.

    ``everything``: canonical Gaussians of all blocks, and the block of each. ``growth``: final number of Gaussians
    divided by the number at the start.
    """
    begin_part()
    (joined, owners), scene, plan = everything, part.prepared.scene, part.plan
    used = owners == number
    if plan.fit.fit != "none":
        used |= peak_weights(joined, blank_photos(scene.cameras, 2))[0] >= plan.fit.min_contribution
    rows = np.flatnonzero(used)
    decoded = Decoded(joined[rows], round(growth * len(rows)), exact=False)
    fitted = fit_scene(decoded, scene, part.prepared.reference.fit_views, plan.fit, plan.seed)
    if fitted.report is None:  # nothing was fitted, and what no photo shows is left out
        return fitted.gaussians
    assert fitted.report.origins is not None
    return fitted.gaussians[owners[rows[fitted.report.origins]] == number]


def score_part(part: BlockStart, gaussians: Gaussians, _: int) -> Scores:
    """Measure the PSNR (dB) of the whole result on a block's scored photos, and what :class:`Besides` lists."""
    begin_part()
    measured = measure_result(gaussians, part.prepared, part.plan)
    psnr = None if measured is None else measured.psnr
    return psnr, measure_besides(part.before, gaussians, part.prepared, part.plan)


def fit_seams(joined: Gaussians, owners: np.ndarray, parts: Sequence[BlockStart], seed: int) -> Gaussians:
    """Fit the Gaussians at seams, which views of several blocks show, again to the photos that show them.

    All other Gaussians stay unchanged. Before this step a Gaussian was fitted beside its own block's version of the
    neighbouring Gaussians, not beside the final version.
    """
    plan = next((part.plan for part in parts if part.plan.fit.fit != "none"), None)
    if plan is None:
        return joined
    begin_part()
    with stage("join"):
        at_seam, views = find_seams(joined, owners, parts)
        if not any(views):
            return joined
        scene = join_views([(part.prepared.scene, ids) for part, ids in zip(parts, views, strict=True) if ids])
    rows = np.flatnonzero(peak_weights(joined, blank_photos(scene.cameras, 2))[0] >= plan.fit.min_contribution)
    tuning = replace(plan.fit.tuning.scaled(SEAM_RATE), decay=SEAM_DECAY)
    looks = SEAM_LOOKS if at_seam.mean() < MOSTLY_SEAMS else ROOM_LOOKS
    options = replace(
        plan.fit, fit_steps=max(SEAM_STEPS, looks * len(scene)), photo_scale=1.0, scored=False, dropout=0.0,
        half_res_share=0.0, min_contribution=0.0, beyond=True, tuning=tuning,
    )  # fmt: skip
    decoded = Decoded(joined[rows], len(rows), exact=True, fixed=~at_seam[rows])
    with record_part(title="seams") as record:
        fitted = fit_scene(decoded, scene, range(len(scene)), options, seed)
    add_seconds(record.seconds)
    choose(seams={"views": len(scene), "num_gaussians": int(at_seam.sum()), "steps": options.steps})
    columns = {f.name: np.array(getattr(joined, f.name)) for f in fields(Gaussians)}
    moved = at_seam[rows]  # what was fixed comes back rounded
    for name, column in columns.items():
        column[rows[moved]] = getattr(fitted.gaussians, name)[moved]
    return Gaussians(**columns)


def prune_joined(joined: Gaussians, cameras: Cameras, options: CompactOptions, most: int | None) -> Gaussians:
    """Leave out the Gaussians of all blocks that none of all ``cameras`` shows, unless ``most`` have to be written."""
    seen, unseen = split_unseen(joined, cameras)
    room = len(unseen) if most is None else most - len(seen)
    unseen = unseen[: max(0, room) if options.budget.is_filled else 0]
    choose(pruned=len(joined) - len(seen) - len(unseen))
    return Gaussians.concat([seen, unseen])


def find_seams(
    joined: Gaussians, owners: np.ndarray, parts: Sequence[BlockStart]
) -> tuple[np.ndarray, list[list[int]]]:
    """Return a mask ``[n]`` of Gaussians at seams and, for each block, its own views that show many of them."""
    total, foreign, splats = np.zeros(len(joined)), np.zeros(len(joined)), make_splats(joined)
    views: list[list[int]] = [[] for _ in parts]
    for number, _, weights in _view_weights(splats, parts):
        total += weights
        foreign += np.where(owners == number, 0, weights)
    at_seam = foreign > FOREIGN * total
    for number, place, weights in _view_weights(splats, parts):  # again: those of all views would not fit into memory
        of_seam, of_all = (float(values.sum(dtype=np.float64)) for values in (weights[at_seam], weights))
        if place in parts[number].prepared.reference.fit_views and of_seam > SEAM_SHARE * of_all:
            views[number].append(place)
    return at_seam, views


def join_views(chosen: Sequence[tuple[PicturedScene, list[int]]]) -> PicturedScene:
    """Join views of several scenes without Gaussians into one scene; many photos are kept in a file."""
    total, cameras = sum(len(ids) for _, ids in chosen), chosen[0][0].cameras
    images, first = make_array((total, cameras.height, cameras.width, 3), np.float32), 0
    for scene, ids in chosen:
        for view in ids:
            images[first] = scene.images[view]
            first += 1
        free_pages([scene.images, images])
    joined = concat_scenes([subset(scene.without_pictures(), ids) for scene, ids in chosen], images)
    return PicturedScene.with_pictures(replace(joined, cameras=in_float64(joined.cameras)), images, joined.masks)


def _view_weights(splats: Splats, parts: Sequence[BlockStart]) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield block, view, and the blending weights ``[n]`` of all Gaussians in it, for each block's own views."""
    for number, part in enumerate(parts):
        own_views, repeated = set(part.block.own), part.prepared.repeated
        places = sorted({repeated[place] for place, view in enumerate(part.block.views) if view in own_views})
        photos = blank_photos(part.prepared.scene.cameras[places], 2)

        def weights_of(view: int, photos: Photos = photos) -> np.ndarray:
            return contributions(tile_view(splats, **photos.camera(view)))[0]

        for place, weights in zip(places, in_turn(weights_of, range(len(photos))), strict=True):
            yield number, place, weights


def free_scene(scene: Scene) -> None:
    """Release the memory of those arrays of a scene that :func:`gsmerge.runtime.memory.make_array` put into files."""
    free_pages([*vars(scene.gaussians).values(), *([] if scene.images is None else [scene.images])])


def with_choices(options: CompactOptions, choices: SceneChoices) -> CompactOptions:
    """Return options with the fit steps and the networks that were chosen for the whole scene."""
    checkpoint = options.checkpoint if choices.checkpoint != "none" else "none"
    options = options.with_settings({"fit_steps": choices.fit.steps, "checkpoint": checkpoint})
    return replace(options, fit=replace(options.fit, share=choices.limits.share))


def block_options(
    options: CompactOptions, scene: Scene, block: Block, factor: float, most: int | None
) -> CompactOptions:
    """Return the options of a block: those of the scene, with ``factor`` times the block's share of the Gaussians.

    Cameras and exposures stay fixed. The block also gets its share of all steps, and of the first ones of them,
    so each view is fitted as often as in one piece. ``most``: Gaussians of all blocks together; None: as many as
    ``superpixels`` and K give.
    """
    settings: dict[str, Any] = {**piece_settings(CompactOptions), "budget": None}
    settings["fit_steps"] = max(1, round(options.fit.steps * len(block.views) / len(scene)))
    if replace(options.fit, fit_steps=settings["fit_steps"]).half_res_part != options.fit.half_res_part:
        settings["half_res_share"] = options.fit.half_res_part
    superpixels = options.segment.superpixels
    if most is not None:
        settings["budget"] = max(1, round(SURPLUS * factor * most * len(block.views) / len(scene)))
    elif isinstance(superpixels, str) and superpixels.endswith("%"):
        share = min(1.0, min(factor, MOST_DENSITY) * parse_share(superpixels))
        settings["superpixels"] = share_text(round(share, 6))
    elif superpixels != AUTO_SHARE:
        settings["superpixels"] = round(min(factor, MOST_DENSITY) * int(superpixels))
    return options.with_settings(settings)


def belongs_to_block(means: np.ndarray, block: Block, covisibility: Covisibility) -> np.ndarray:
    """Return a mask ``[n]`` of means ``[n,3]`` whose nearest view is one of the block's own views.

    Only views that see the mean, and share surfaces with the block, are considered.
    """
    sees = covisibility.weights[list(block.own)].sum(0) > 0
    sees[list(block.own)] = True
    owners = owning_views(means, covisibility, np.flatnonzero(sees).tolist())
    return np.isin(owners, block.own)


def join_reports(
    scene: Scene, gaussians: Gaussians, parts: Sequence[BlockStart], scores: Sequence[Scores], options: CompactOptions
) -> CompactReport:
    """Report the whole scene: mean PSNR of the blocks weighted by views, sums of seconds, all notes."""
    run, sizes = current_record(), [len(part.block.own) for part in parts]

    def mean(values: Sequence[float | None]) -> float | None:
        numbers = [value for value in values if value is not None]
        return None if len(numbers) < len(values) else float(np.average(numbers, weights=sizes))

    scored = sum(len(part.plan.scored_views) for part, (psnr, _) in zip(parts, scores, strict=True) if psnr is not None)
    before = mean([None if part.before.photos is None else part.before.photos.psnr for part in parts])
    after = mean([psnr for psnr, _ in scores])
    besides = _join_besides(parts, scores, sizes)
    covered = besides.covered
    reference = None if before is None else parts[0].prepared.reference.name
    compared = (covered.before, covered.after) if covered else (before, after)
    pictures = OWN_PHOTOS if reference == PHOTOS else reference
    worse = None if pictures is None else describe_loss("the result", *compared, pictures)
    notes = list(dict.fromkeys(run.notes))
    return CompactReport(
        num_input=scene.num_gaussians, num_output=len(gaussians), seconds=dict(run.seconds), psnr_before=before,
        psnr_after=after, choices=run.choices | {"scored_views": scored},
        notes=notes if worse is None else [*notes, worse], options=options.to_dict(),
        peak_memory_bytes=peak_memory(), worse=worse, psnr_reference=reference, **vars(besides),
    )  # fmt: skip


def _join_besides(parts: Sequence[BlockStart], scores: Sequence[Scores], sizes: Sequence[int]) -> Besides:
    """Average over blocks the scores of covered pixels, and on files of photos; a block without has its others.

    None in place of those that no block has, or that some block lacks altogether. Scores of protected pixels are
    averaged over those blocks that have some, by how many.
    """
    whole = [
        (part.before.photos.psnr, psnr)
        for part, (psnr, _) in zip(parts, scores, strict=True)
        if part.before.photos is not None and psnr is not None
    ]
    if len(whole) < len(sizes):
        return Besides()

    def mean(rows: Sequence[tuple[float, ...]], weights: Sequence[float] = sizes) -> list[float]:
        return np.average(rows, axis=0, weights=weights).tolist()

    each = [besides for _, besides in scores]
    covered = [one.covered or Covered(1.0, *pair) for one, pair in zip(each, whole, strict=True)]
    files = [one.photo_files or PhotoFiles(*pair) for one, pair in zip(each, whole, strict=True)]
    shares = [
        size * (0.0 if one.protected is None else one.protected.share) for one, size in zip(each, sizes, strict=True)
    ]
    protected = None
    if sum(shares) > 0:
        pairs = [(one.protected.before, one.protected.after) if one.protected else (0.0, 0.0) for one in each]
        protected = Covered(sum(shares) / sum(sizes), *mean(pairs, shares))
    return Besides(
        Covered(*mean([astuple(one) for one in covered])) if any(one.covered for one in each) else None,
        PhotoFiles(*mean([astuple(one) for one in files])) if any(one.photo_files for one in each) else None,
        protected,
    )
