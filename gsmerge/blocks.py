"""A scene of many views in blocks: each is compacted by itself, cut to what is its own, and joined with the others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from gsmerge.budget import exact_count, parse_share, share_text
from gsmerge.options import CompactOptions
from gsmerge.plan import Plan, make_plan
from gsmerge.render import contributions, plan_view
from gsmerge.render import prepare as prepare_splats
from gsmerge.render.metrics import describe_loss
from gsmerge.render.photos import blank_photos
from gsmerge.result import CompactReport, CompactResult, measure_psnr
from gsmerge.runtime.memory import free_pages, peak_memory
from gsmerge.runtime.record import Record, choose, current_record, record_part, stage
from gsmerge.runtime.threads import in_turn
from gsmerge.stages.decode import Decoded
from gsmerge.stages.fit import fit_scene
from gsmerge.stages.partition import (
    Block,
    Covisibility,
    count_factors,
    measure_covisibility,
    owning_views,
    partition_views,
)
from gsmerge.stages.prepare import Frame, Prepared, prepare, scene_frame
from gsmerge.stages.superpixels import AUTO_SHARE
from gsmerge.types import Gaussians, Scene
from gsmerge.views import subset

Start = Callable[[Prepared, Plan, int | None], Decoded]
LEAST_WEIGHT = 1 / 255  # in blending, of a Gaussian that a view shows
FOREIGN = 0.1  # share of a Gaussian's weights in other blocks' views from which on it is at a seam
SEAM_SHARE = 0.1  # of a view's weights that such Gaussians have from which on it is fitted to
SEAM_STEPS = 100
SURPLUS = 1.03  # times an exact number of Gaussians: the faintest of what is too many are left out


def compact_in_blocks(given: Scene, options: CompactOptions, count: int, start: Start) -> CompactResult:
    """Compact an aligned scene in ``count`` blocks of views.

    The views of each block are merged first, and of the Gaussians those are kept that belong to it, so that all blocks
    together have one set of Gaussians to start with. Then each block fits what its views see, its neighbours'
    Gaussians included, and keeps its own: where two blocks meet, both fit the same Gaussians to the same photos.
    """
    device, given = given.gaussians.device, given.numpy()
    with stage("partition"):
        covisibility = measure_covisibility(given)
        blocks = partition_views(covisibility.weights, count)
        factors = count_factors(blocks, covisibility).tolist()
        frame = scene_frame(given)
    parts = list[Part]()
    for i, (block, factor) in enumerate(zip(blocks, factors, strict=True), 1):
        free_scene(given)
        with record_part(title=f"block {i} of {count}: merge"):
            parts.append(
                start_part(given, block, covisibility, block_options(options, given, block, factor), frame, start)
            )
    with stage("join"):
        joined = Gaussians.concat([part.gaussians for part in parts])
        owners = np.repeat(np.arange(count), [len(part.gaussians) for part in parts])
        growth = sum(part.count for part in parts) / max(1, len(joined))
    fitted = list[Gaussians]()
    for i, part in enumerate(parts):
        with record_part(title=f"block {i + 1} of {count}: fit") as part.fit_record:
            fitted.append(fit_part(part, joined, owners, i, growth))
    owners = np.repeat(np.arange(count), [len(one) for one in fitted])
    joined = fit_seams(Gaussians.concat(fitted), owners, parts, options.seed)
    gaussians = frame.leave(joined)
    exact = exact_count(options.budget, given.num_gaussians, given.gaussians.sh_degree)
    if exact is not None and exact < len(gaussians):
        clearest = np.argsort(-gaussians.opacities, kind="stable")[:exact]
        gaussians = gaussians[np.sort(clearest)]
    for part in parts:
        with record_part() as record:
            score_part(part, gaussians)
        part.fit_record.seconds |= record.seconds
        part.fit_record.choices |= record.choices
    return CompactResult(gaussians, join_reports(given, gaussians, parts, options), given.cameras).to(device)


@dataclass(eq=False)
class Part:
    """A block between merging and fit."""

    block: Block
    gaussians: Gaussians  # canonical ones that belong to it
    count: int  # Gaussians that it is to have in the end
    prepared: Prepared  # its views, without the Gaussians of their pixels
    plan: Plan
    psnr_before: float | None  # of the scored views
    record: Record
    fit_record: Record = field(default_factory=Record)
    psnr_after: float | None = None


def start_part(
    given: Scene, block: Block, covisibility: Covisibility, options: CompactOptions, frame: Frame, start: Start
) -> Part:
    """Merge the views of a block, and keep what belongs to it of the Gaussians that its fit starts with."""
    prepared = prepare(subset(given, block.views), options.prepare, frame)
    plan = make_plan(prepared, options)
    decoded = start(prepared, plan, plan.limits.count)
    own = belongs_to_block(frame.leave(decoded.gaussians).means, block, covisibility)
    before = None
    if prepared.given.images is not None and prepared.photo_views:
        with stage("input"):
            before = measure_psnr(prepared.given.file_gaussians, prepared.given, prepared, plan)
    share = own.sum() / max(1, len(own))
    kept = decoded.gaussians[own]
    return Part(block, kept, round(share * decoded.count), without_gaussians(prepared), plan, before, current_record())


def without_gaussians(prepared: Prepared) -> Prepared:
    """Return a prepared scene without the Gaussians of its pixels."""

    def bare(scene: Scene) -> Scene:
        return replace(scene, gaussians=scene.gaussians[np.zeros(0, int)], pixel_ids=None, missing=None)

    return replace(prepared, scene=bare(prepared.scene), given=bare(prepared.given))


def fit_part(part: Part, joined: Gaussians, owners: np.ndarray, own: int, growth: float) -> Gaussians:
    """Fit the canonical Gaussians that a block's views may see, and return those of block ``own``."""
    scene, plan = part.prepared.scene, part.plan
    fits = plan.fit.fit != "none" and scene.images is not None
    rows = np.flatnonzero((owners == own) | shown_in_views(joined, scene) if fits else owners == own)
    decoded = Decoded(joined[rows], round(growth * len(rows)), exact=False)
    fitted = fit_scene(decoded, scene, part.prepared.photo_views, plan.fit, plan.seed, plan.backend)
    if fitted.report is None:  # nothing was fitted, and what no photo shows is left out
        return fitted.gaussians
    assert fitted.report.origins is not None
    return fitted.gaussians[owners[rows[fitted.report.origins]] == own]


def score_part(part: Part, gaussians: Gaussians) -> None:
    """Measure the PSNR of some of a block's photos from the whole result."""
    prepared, plan = part.prepared, part.plan
    if prepared.scene.images is None or not prepared.photo_views:
        return
    with stage("score"):
        part.psnr_after = measure_psnr(gaussians, prepared.result_views(), prepared, plan)
    choose(scored_views=len(plan.scored_views))


def fit_seams(joined: Gaussians, owners: np.ndarray, parts: Sequence[Part], seed: int) -> Gaussians:
    """Fit what views of several blocks show, once more, to all photos that show it; all else stays as it is.

    Until here each Gaussian was fitted beside its neighbours as its own block has them, not as they are.
    """
    plan = parts[0].plan
    if any(part.prepared.scene.images is None for part in parts) or plan.fit.fit == "none":
        return joined
    weights = np.stack([sum(view_weights(joined, part), np.zeros(len(joined))) for part in parts])
    total = weights.sum(0)
    at_seam = total - weights[owners, np.arange(len(joined))] > FOREIGN * total
    scene = seam_views(joined, at_seam, parts)
    if scene is None:
        return joined
    rows = np.flatnonzero(shown_in_views(joined, scene))
    options = replace(
        plan.fit, fit_steps=SEAM_STEPS, photo_scale=1.0, judged=False, dropout=0.0, half_res_share=0.0,
        min_contribution=0.0,
    )  # fmt: skip
    decoded = Decoded(joined[rows], len(rows), exact=True, fixed=~at_seam[rows])
    with record_part(title="seams"):
        fitted = fit_scene(decoded, scene, range(len(scene)), options, seed, plan.backend)
    columns = {f.name: np.array(getattr(joined, f.name)) for f in fields(Gaussians)}
    for name, column in columns.items():
        column[rows] = getattr(fitted.gaussians, name)
    return Gaussians(**columns)


def seam_views(joined: Gaussians, at_seam: np.ndarray, parts: Sequence[Part]) -> Scene | None:
    """Return the views whose photos show Gaussians ``at_seam [n]``, without Gaussians; None without any."""
    scenes = []
    for part in parts:
        shares = [float(one[at_seam].sum() / max(one.sum(), 1e-9)) for one in view_weights(joined, part)]
        photos = [view for view in own_views(part) if view in part.prepared.photo_views]
        kept = dict(zip(own_views(part), shares, strict=True))
        scenes.append(subset(part.prepared.scene, [view for view in photos if kept[view] > SEAM_SHARE]))
    scenes = [scene for scene in scenes if len(scene)]
    if not scenes:
        return None
    cameras, masks = [scene.cameras for scene in scenes], None
    viewmats, Ks = (np.concatenate([getattr(one, name) for one in cameras]) for name in ("viewmats", "Ks"))
    images = [scene.images for scene in scenes if scene.images is not None]
    if any(scene.masks is not None for scene in scenes):
        whole = [np.ones(one.shape[:3], bool) for one in images]
        masks = np.concatenate([w if s.masks is None else s.masks for s, w in zip(scenes, whole, strict=True)])
    names = tuple(name for scene in scenes for name in scene.names)
    joint = replace(cameras[0], viewmats=viewmats, Ks=Ks)
    return Scene(scenes[0].gaussians, joint, np.concatenate(images), None, names, masks=masks)


def own_views(part: Part) -> list[int]:
    """Return the places of a block's own views among its views."""
    own = set(part.block.own)
    return [place for place, view in enumerate(part.block.views) if view in own]


def view_weights(gaussians: Gaussians, part: Part) -> Iterator[np.ndarray]:
    """Yield the sums of all blending weights ``[n]`` in half-size pictures of each of a block's own views."""
    splats, photos = prepare_splats(gaussians), blank_photos(part.prepared.scene.cameras[own_views(part)], 2)
    yield from in_turn(lambda view: contributions(plan_view(splats, **photos.camera(view)))[0], range(len(photos)))


def free_scene(scene: Scene) -> None:
    """Take what is in files of a scene's arrays out of memory."""
    arrays = [getattr(scene.gaussians, f.name) for f in fields(Gaussians)]
    free_pages([*arrays, *([] if scene.images is None else [scene.images])])


def block_options(options: CompactOptions, given: Scene, block: Block, factor: float) -> CompactOptions:
    """Return the options of a block: cameras and exposures stay, and ``factor`` times its share of the Gaussians."""
    settings: dict[str, Any] = {"poses": "fixed", "exposure": "fixed", "blocks": "none"}
    exact = exact_count(options.budget, given.num_gaussians, given.gaussians.sh_degree)
    superpixels = options.segment.superpixels
    if exact is not None:
        settings["budget"] = max(1, round(SURPLUS * factor * exact * len(block.views) / len(given)))
    elif isinstance(superpixels, str) and superpixels.endswith("%"):
        settings["superpixels"] = share_text(round(min(1.0, factor * parse_share(superpixels)), 6))
    elif superpixels != AUTO_SHARE:
        settings["superpixels"] = round(factor * int(superpixels))
    return options.with_settings(settings)


def belongs_to_block(means: np.ndarray, block: Block, covisibility: Covisibility) -> np.ndarray:
    """Return which of n means ``[n,3]`` belong to a block: of all views that see one, its nearest is the block's own.

    Every view that sees something of the block counts.
    """
    sees = covisibility.weights[list(block.own)].sum(0) > 0
    sees[list(block.own)] = True
    owners = owning_views(means, covisibility, np.flatnonzero(sees).tolist())
    return np.isin(owners, block.own)


def shown_in_views(gaussians: Gaussians, scene: Scene) -> np.ndarray:
    """Return which of n Gaussians take part in some pixel of half-size pictures of a scene's views, ``[n]``."""
    photos, splats = blank_photos(scene.cameras, 2), prepare_splats(gaussians)

    def one_view(view: int) -> np.ndarray:
        return contributions(plan_view(splats, **photos.camera(view)))[1] >= LEAST_WEIGHT

    shown = np.zeros(len(gaussians), bool)
    for by_view in in_turn(one_view, range(len(photos))):
        shown |= by_view
    return shown


def join_reports(given: Scene, gaussians: Gaussians, parts: Sequence[Part], options: CompactOptions) -> CompactReport:
    """Report the whole: PSNR of the blocks weighted by their views, seconds added up, notes of all."""
    run = current_record()
    records = [run, *(record for part in parts for record in (part.record, part.fit_record))]
    seconds: dict[str, float] = {}
    for record in records:
        for name, value in record.seconds.items():
            seconds[name] = seconds.get(name, 0.0) + value
    sizes = [len(part.block.own) for part in parts]

    def mean(values: Sequence[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return None if len(known) < len(values) else float(np.average(known, weights=sizes))

    blocks = [
        {
            "views": len(part.block.own), "shared_views": len(part.block.shared), "num_start": len(part.gaussians),
            "psnr_input_views": part.psnr_after, "fit": part.fit_record.choices.get("fit"),
        }
        for part in parts
    ]  # fmt: skip
    scored = sum(part.fit_record.choices.get("scored_views", 0) for part in parts)
    before, after = mean([part.psnr_before for part in parts]), mean([part.psnr_after for part in parts])
    worse = describe_loss("the result", before, after)
    notes = list(dict.fromkeys(text for record in records for text in record.notes))
    return CompactReport(
        num_input=given.num_gaussians, num_output=len(gaussians), seconds=seconds, psnr_before=before,
        psnr_after=after, choices=run.choices | {"blocks": blocks, "scored_views": scored},
        notes=notes if worse is None else [*notes, worse], options=options.to_dict(),
        peak_memory_bytes=peak_memory(), worse=worse,
    )  # fmt: skip
