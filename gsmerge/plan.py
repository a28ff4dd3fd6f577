"""The plan of a run: only this module decides what effort, budget, recipe and names of checkpoints mean.

:func:`make_plan` makes all choices for a prepared scene or block. :func:`plan_scene` makes only the choices that need
no computation, for estimates and for scenes in blocks. Each stage gets its own part of the plan, and no stage knows the
options of another.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmerge.errors import UsageError
from gsmerge.fit import photo_scale, start_share
from gsmerge.frozen import dataclass, replace
from gsmerge.geometry.views import REPORT_VIEWS, pick_views, scored_views
from gsmerge.prepare.confirm_depths import FEWEST, Agreement
from gsmerge.prepare.prepared import Prepared
from gsmerge.prepare.row_colors import RENDERS
from gsmerge.prepare.scene_size import SceneSize
from gsmerge.raster.photos import scored_tiles
from gsmerge.runtime.record import RunPart, note, stage
from gsmerge.settings.budget import AUTO
from gsmerge.settings.compact import CHECKPOINTS, COUNTS, OURS, CompactOptions
from gsmerge.settings.fit import GROW_ROUNDS, GROW_STEPS, STEPS, USUAL_SHARE, FitOptions
from gsmerge.settings.setting import flat_settings
from gsmerge.settings.stages import (
    SHARE,
    USUAL_K,
    CleanOptions,
    DecodeOptions,
    MatchOptions,
    PrepareOptions,
    SegmentOptions,
)
from gsmerge.stages.counts import CountLimits, FileSize, count_limits, file_size, has_few_rows, max_allowed
from gsmerge.stages.fit_pairs import choose_power
from gsmerge.stages.pair_merge import POWERS
from gsmerge.stages.segment import SharedTree, SuperpixelChoices
from gsmerge.types import Gaussians, Scene

if TYPE_CHECKING:
    from gsmerge.networks.checkpoint import Checkpoint
    from gsmerge.networks.weights import NetworkWeights
    from gsmerge.raster.photos import PhotoScore

AUTO_STEPS = 2  # with budget auto, steps relative to the usual number: few Gaussians need more steps
SHORT_STEPS = 60  # a fit with at most this many steps still gains from a better start
MOST_STEPS = 2.0  # most steps for more than the usual share of Gaussians per pixel, relative to the usual steps
USUAL_VIEWS = 12  # views up to which the steps of an effort are enough
# If a scene has neither photos nor pixels, its result has by default at least this PSNR (dB) against the input
FIDELITY_PSNR = 32.5
# If a scene has photos but no pixels, its result by default loses at most this PSNR (dB) on the photos
FIDELITY_LOSS = 0.3
NO_FIT = "without cameras a draft has no fit: --effort fast has one"
BLOCK_GAUSSIANS = 8_000_000  # Gaussians of a block's own views, if the number of blocks is automatic
WHOLE_GAUSSIANS = 20_000_000  # Gaussians up to which a scene is compacted in one piece, unless it has many views
BLOCK_VIEWS, WHOLE_VIEWS = 42, 168  # the two limits above as numbers of views, if blocks see little of each other
# Number of candidates that a search usually builds: first, if photos score them; second, if renders of the input do
USUAL_BUILDS, USUAL_BUILDS_OF_RENDERS = 3, 1
# Work of the stages of a build, and of scoring the input, for each view, in steps of a fit
STAGE_STEPS, INPUT_STEPS = 10.0, 3.0
# Cost of the trial that estimates new views, as a share of building the result; cost of building a coarser level of
# detail, as a share of building the next finer level
TRIAL_SHARE, LEVEL_SHARE = 0.25, 0.6
LONE_K = 4  # K if all views have the same camera, because no other view adds Gaussians to a surface


@dataclass(frozen=True)
class Effort:
    """Settings of the stages that an effort such as "draft" stands for."""

    steps: int  # Steps of the full fit
    rectangles: float  # Rectangles per superpixel of `rdseg`
    early_sweeps: int  # Sweeps of `rdseg` before rectangles are merged
    merges: bool = True  # Merge Gaussians of different views
    refines: bool = True  # With `checkpoint="auto"`, run all networks, not only the heads
    prunes: bool = True  # Without a fit, leave out Gaussians that no photo shows
    fits_alone: bool = True  # Fit scenes without cameras, to views that gsmerge places
    large_photos: bool = True  # With `photo_scale="auto"`, allow photos larger than the views
    report_views: int = REPORT_VIEWS  # Number of views for scores that only the report needs


EFFORTS = {
    "draft": Effort(
        36, 1.0, 0, merges=False, refines=False, prunes=False, fits_alone=False, large_photos=False, report_views=3
    ),
    "fast": Effort(55, 1.0, 0, refines=False, large_photos=False),
    "default": Effort(STEPS, 2.0, 0),
    "best": Effort(900, 3.0, 1),
}


@dataclass(frozen=True, eq=False)
class Plan:
    """All decisions about a run, made before the first superpixel is cut."""

    superpixels: SuperpixelChoices  # How each view is cut, and into how many
    match: MatchOptions  # Merging across views
    decode: DecodeOptions  # Gaussians per group
    fit: FitOptions  # Fit to the photos
    merges_pairs: bool  # Merge neighbours pair by pair instead of superpixels
    clean: CleanOptions  # What is left out of the result
    target_psnr: float | None  # PSNR (dB) that the result has to reach; None: no target, or not known yet
    keeps_fidelity: bool  # See :func:`keeps_fidelity`
    max_drop: float | None  # Allowed loss in dB against the best of the curve; None: no target
    auto_count: bool  # The scene's own curve decides the number of Gaussians
    levels: int  # Levels of detail
    output: str  # Name of the output's file, whose format may round values; "": no file
    seed: int  # All random choices depend on this number alone
    settings: dict[str, Any]  # All settings by flat name, for reports
    scored_views: tuple[int, ...] = ()  # Ids of the views in which input and result are scored
    checkpoint: Checkpoint | None = None  # Networks, from a file; None: closed formulas alone
    file_size: FileSize | None = None  # Largest size of the output's file; None: any
    power: float = POWERS[0]  # Power of the masses by which pairs are merged
    free_poses: bool = False  # The options ask the fit to move cameras, even if the scene does not need it
    samples: bool = False  # Only a sample of the pixels is scored, because only the report needs the scores
    new_views: bool = False  # Estimate the quality of new views
    # How another package builds a number of Gaussians; None: gsmerge's own stages build them
    run: Callable[[Prepared, Plan, int], Gaussians] | None = None
    is_trial: bool = False  # The result is only scored on left-out photos, so gaps need not be filled
    before: PhotoScore | None = None  # Score of the input, if the result has to keep its quality on photos
    # [h,w] bool for each scored view: the pixels that the input covers, if it leaves gaps and its renders stand for
    # photos
    covered: tuple[np.ndarray, ...] | None = None

    @property
    def networks(self) -> NetworkWeights | None:
        """Networks that correct the results of the stages; None: closed formulas."""
        return None if self.checkpoint is None else self.checkpoint.networks

    @property
    def network_facts(self) -> dict[str, Any]:
        """Facts about the networks that a report has, by name; empty without networks."""
        return {} if self.checkpoint is None else {"networks": self.checkpoint.facts()}

    @property
    def by_contribution(self) -> bool:
        """Return whether blending weights decide to which superpixel a Gaussian belongs, as in the paper."""
        return self.networks is not None and self.networks.options.makes_children

    @property
    def weakens(self) -> bool:
        """Return whether a group starts with less opacity if other views see surfaces behind it.

        The lower opacity may leave holes, which a long fit closes.
        """
        return self.superpixels.start_share < 1 and self.checkpoint is None

    @property
    def prunes(self) -> bool:
        """Return whether Gaussians that no photo shows are dropped after the fit."""
        return self.fit.min_contribution > 0

    @property
    def has_quality(self) -> bool:
        """Return whether a quality or the scene's curve decides the number of Gaussians."""
        return self.target_psnr is not None or self.max_drop is not None or self.auto_count or self.keeps_fidelity

    @property
    def searches(self) -> bool:
        """Return whether several counts may be built: for a quality, for the file's size, or to clean up a result."""
        return self.has_quality or (self.file_size is not None and self.file_size.packed) or self.clean.asked

    @property
    def limits(self) -> CountLimits:
        """Limits of the number of Gaussians."""
        return self.superpixels.limits

    def with_fixed_cameras(self) -> Plan:
        """Return the plan with a fit that does not move cameras."""
        return replace(self, fit=replace(self.fit, move_cameras=False))

    def with_fit(self, fit: FitOptions) -> Plan:
        """Return the plan with the fit ``fit``, which starts with all Gaussians."""
        return replace(self, fit=fit, superpixels=replace(self.superpixels, start_share=1.0))


def make_plan(
    prepared: Prepared,
    options: CompactOptions,
    checkpoint: Checkpoint | None = None,
    run: Callable[[Prepared, Plan, int], Gaussians] | None = None,
) -> Plan:
    """Make all decisions about a run that the options leave open.

    The networks are also loaded, because some decisions depend on them. ``checkpoint`` has networks to use instead of
    the networks that the options name. ``run`` is the field of :class:`Plan`. Raises UsageError if the scene or the
    networks do not allow what the options ask for.
    """
    check_pictures(prepared, options)
    with stage("prepare"):
        size, budget, cameras = prepared.size, options.budget, prepared.scene.cameras
        checkpoint = checkpoint or load_networks(options, size)
        filled = fill_options(prepared, options)
        has_repeats = len(prepared.scene) < len(prepared.input_scene)
        num_input = prepared.input_scene.num_gaussians if has_repeats else None  # a budget may be a share of it
        plan = plan_scene(size, filled, num_input=num_input, keeps=keeps_fidelity(size, options))
        merges_pairs = plan.merges_pairs and checkpoint is None
        fit = fit_to_pictures(prepared, filled, plan.fit, merges_pairs=merges_pairs)
        if plan.keeps_fidelity and has_few_rows(size):
            few = f"the scene has only {size.num_gaussians:,} Gaussians, fewer than its photos need"
            note(f"{few}; the result has at most half of them, and more may show the photos better: --budget NUMBER")
        # a quality that the user asks for is measured on all pixels, and small views have too few tiles for a sample
        samples = plan.target_psnr is None and not plan.keeps_fidelity
        samples = samples and scored_tiles(0, cameras.width, cameras.height, 2) is not None
        # Views among those whose pictures show the scene. The effort decides how many a report needs; scores that
        # decide the number of Gaussians take more. All views that were placed count
        scored = own_views(prepared)
        if not prepared.reference.placed:
            report_views, num_views = EFFORTS[options.effort].report_views, len(scored)
            chosen = pick_views(num_views, report_views) if samples else scored_views(num_views)
            scored = tuple(scored[i] for i in chosen)
        # all builds of a run share one tree of regions, by which they cut the views
        has_tree = plan.has_quality or plan.levels > 1 or plan.limits.count is not None
        has_tree = has_tree and cuts_views(options, size) and not merges_pairs
        plan = replace(
            plan,
            superpixels=replace(plan.superpixels, shared=SharedTree() if has_tree else None),
            fit=fit,
            merges_pairs=merges_pairs,
            file_size=file_size(budget),
            scored_views=scored,
            samples=samples,
            checkpoint=checkpoint,
            settings=replace(options, decode=plan.decode).to_dict() | {"fit_steps": fit.steps},
            run=run,
            new_views=plan.new_views and prepared.agreement is not None and prepared.can_leave_out,
        )
        if merges_pairs:
            count = plan.limits.count or plan.limits.default
            plan = replace(plan, power=choose_power(count, prepared, fit, plan.seed))
    return plan


def plan_scene(
    size: SceneSize, options: CompactOptions, *, num_input: int | None = None, keeps: bool | None = None
) -> Plan:
    """Make the decisions that follow from the scene's size and the options; UsageError for impossible options.

    Estimates, and scenes in blocks, need no more; :func:`make_plan` adds what follows from the pictures. ``num_input``:
    see :func:`gsmerge.stages.counts.count_limits`. ``keeps``: what :func:`keeps_fidelity` has returned for the options
    of the caller; None: what this function returns for ``options``.
    """
    effort, budget, segment = EFFORTS[options.effort], options.budget, options.segment
    decode = resolve_decode(options, size)
    keeps = keeps_fidelity(size, options) if keeps is None else keeps
    if segment.superpixels == AUTO:  # deciding it would need computation
        segment = replace(segment, superpixels=SHARE)
    segment = replace(
        segment,
        rectangles=effort.rectangles if segment.rectangles is None else segment.rectangles,
        early_sweeps=effort.early_sweeps if segment.early_sweeps is None else segment.early_sweeps,
    )
    limits = count_limits(size, segment, decode, budget, num_input=num_input)
    fit = resolve_fit(options, size, limits)
    match = options.match.match or ("overlap" if effort.merges else "none")
    networks = choose_networks(replace(options, fit=fit), size)
    # Views are cut into superpixels if they have pictures other than renders, or if a setting changes superpixels. A
    # setting of the number of superpixels does not count, because it only says how many Gaussians there are. Without
    # superpixels, neighbouring Gaussians are merged pair by pair
    cuts = size.num_views > 0 and (not size.rendered or options.changes_superpixels)
    # Without a fit, new views look as good as the views of the input, so they need no estimate
    new_views = fit.fit != "none" and options.effort != "draft" if options.new_views is None else options.new_views
    return Plan(
        superpixels=SuperpixelChoices(segment, limits, start_share(fit), None),
        match=replace(options.match, match=match),
        decode=decode,
        fit=fit,
        merges_pairs=options.method == OURS and networks == "none" and not cuts,
        clean=options.clean,
        target_psnr=FIDELITY_PSNR if keeps and size.rendered else budget.target_psnr,
        keeps_fidelity=keeps,
        max_drop=budget.max_drop,
        auto_count=budget.auto,
        levels=budget.levels,
        output=budget.output,
        seed=options.seed,
        settings=options.to_dict() | {"k": decode.k, "match": match, "checkpoint": networks},
        free_poses=options.prepare.poses == "free",
        new_views=new_views,
    )


def is_without_views(scene: Scene, options: CompactOptions) -> bool:
    """Return whether a run works without views: the scene has none, and no option asks for a stage that needs views.

    Without views, Gaussians are merged with their neighbours, by positions and colours alone.
    """
    return len(scene) == 0 and not options.replaces_stages


def note_ignored(scene: Scene, options: CompactOptions) -> None:
    """Add a note on changed settings that have no effect because the scene has no views."""
    kinds = (PrepareOptions, SegmentOptions, MatchOptions, DecodeOptions)
    ignored = options.changed(name for kind in kinds for name in flat_settings(kind) if name not in COUNTS)
    if ignored and is_without_views(scene, options):
        note(f"these settings have no effect without cameras: {', '.join(ignored)}")


def fill_options(prepared: Prepared, options: CompactOptions) -> CompactOptions:
    """Fill in budget, K, superpixels and clean-up if the options leave them to the scene; notes say why."""
    size, agreement = prepared.size, prepared.agreement
    options = resolve_budget(size, options, agreement)
    decode, segment, clean = resolve_decode(options, size), options.segment, options.clean
    if segment.superpixels == AUTO:
        text, why = describe_share(agreement)
        note(f"superpixels: {text} of the pixels, because {why}")
        segment = replace(segment, superpixels=text)
    if "sky" in clean.drops and prepared.reference.name == RENDERS:
        note("drop sky: no photo that is used shows where the sky is, so it is kept")
        clean = replace(clean, drop=",".join(name for name in clean.drops if name != "sky") or None)
    if decode.k != options.decode.k and decode.max_k > USUAL_K:
        note(f"k: {decode.k}, because one camera shows the scene, and no long fit follows")
    return replace(options, decode=decode, segment=segment, clean=clean)


def cuts_views(options: CompactOptions, size: SceneSize) -> bool:
    """Return whether a run cuts views into superpixels, which networks can correct; baselines use no networks."""
    return options.method == OURS and size.num_views > 0


def choose_blocks(scene: SceneSize, options: CompactOptions) -> int:
    """Return the number of blocks for a scene.

    Raises UsageError if the scene cannot be cut into the number that was asked for.
    """
    shared = [] if scene.has_own_pixels else ["a scene whose views have no Gaussians of their own"]
    problems = [*options.uncut, *shared]
    count = wanted_blocks(options, scene.num_gaussians, scene.num_views)
    if options.blocks.blocks == "auto":
        count = 1 if problems else min(scene.num_views, count)
    if count <= 1:
        return 1
    if problems:
        raise UsageError(f"blocks {count}: expected one piece (--set blocks=none) with {problems[0]}")
    if count > scene.num_views:
        raise UsageError(f"blocks {count}: expected at most one for each of {scene.num_views} views")
    return count


def wanted_blocks(options: CompactOptions, num_gaussians: int, num_views: int = 0) -> int:
    """Return the largest number of blocks that a run may have by its options; 1 for a run in one piece.

    If the views alone decide the number, it is an upper limit. A small ``num_views`` does not change the number.
    """
    blocks = options.blocks.blocks
    if blocks != "auto":
        return 1 if blocks == "none" else int(blocks)
    if options.uncut:
        return 1
    if num_gaussians > WHOLE_GAUSSIANS:
        return -(-num_gaussians // BLOCK_GAUSSIANS)
    return 1 if num_views <= WHOLE_VIEWS else -(-num_views // BLOCK_VIEWS)


def keeps_fidelity(scene: SceneSize, options: CompactOptions) -> bool:
    """Return whether the run searches for the fewest Gaussians that keep the quality of the input.

    The run searches if the options do not decide the number, and the scene has no photos or few Gaussians per pixel.
    With few Gaussians per pixel, no usual share of the Gaussians is right: a scene that is compact already needs most
    of its Gaussians, and a scene of many small Gaussians needs only a few. Without photos, the PSNR of the result
    against renders of the input has to be ``FIDELITY_PSNR``. With photos, the PSNR of the result on the photos may be
    ``FIDELITY_LOSS`` dB lower than that of the input. Measurements are in docs/internals/decisions.md.
    """
    # with half a Gaussian per pixel or more, the usual share of the Gaussians is enough to show the photos
    is_dense = scene.has_own_pixels or scene.num_gaussians >= 0.5 * scene.num_views * scene.pixels_per_view > 0
    may_keep = scene.rendered or options.budget.keep or not (is_dense or options.budget.auto)
    return may_keep and options.scene_decides


def check_pictures(prepared: Prepared, options: CompactOptions) -> None:
    """Raise UsageError for settings that need photos if there are none."""
    if prepared.reference.name != RENDERS:
        return
    if options.budget.max_drop is not None:
        problem = f'quality {options.budget.quality}: expected a PSNR against the input, such as "35dB", without photos'
        raise UsageError(f"{problem}; without photos nothing shows the scene better than the input; or give --images")
    if "sky" in options.clean.drops and prepared.input_scene.images is None:
        raise UsageError("drop sky: expected photos, which show where the sky is; name them with --images")


def choose_networks(options: CompactOptions, size: SceneSize) -> str:
    """Return the name of the checkpoint in the options or, if this name is "auto", "shipped" or "none".

    The shipped networks improve the result if no fit follows, and if the views have photos or pixels. With a fit,
    further steps gain more than networks that take the same time (docs/internals/networks.md).
    """
    if options.checkpoint != "auto":
        return options.checkpoint
    gains_from_networks = options.fit.fit == "none" and not size.rendered
    return "shipped" if gains_from_networks else "none"


def load_networks(options: CompactOptions, size: SceneSize) -> Checkpoint | None:
    """Load the networks that a run uses; None if a run uses no networks.

    Raises SceneError if networks are required and cannot be used, and UsageError if they do not fit the options.
    """
    if not cuts_views(options, size):
        if options.checkpoint not in CHECKPOINTS:  # refuse a damaged file, although nothing would use it
            from gsmerge.networks.checkpoint import load_checkpoint

            load_checkpoint(options.checkpoint)
        return None
    name = choose_networks(options, size)
    if name == "none":  # as in most runs, which then need not import the modules of networks
        return None
    from gsmerge.networks.checkpoint import find_checkpoint

    checkpoint, notes = find_checkpoint(name, required=options.require_checkpoint)
    for text in notes:
        note(text)
    if checkpoint is not None:
        if options.checkpoint == "auto" and not EFFORTS[options.effort].refines:
            checkpoint = replace(checkpoint, networks=checkpoint.networks.heads_alone())
        check_networks(checkpoint, options)
    return checkpoint


def check_networks(checkpoint: Checkpoint, options: CompactOptions) -> None:
    """Raise UsageError if networks do not fit the options."""
    outputs = checkpoint.networks.options.outputs
    if options.recipe == "paper" and outputs != "absolute":
        raise UsageError(
            f"recipe paper: expected networks with absolute outputs, {checkpoint.path} has {outputs} ones;"
            " gsmerge lab train --preset paper makes them"
        )
    most, count = checkpoint.networks.options.max_children, options.decode.max_k
    if count > most:
        problem = f"k: expected at most {most} with the absolute outputs of {checkpoint.path}"
        raise UsageError(f"{problem}, got {count}")


def resolve_budget(size: SceneSize, options: CompactOptions, agreement: Agreement | None) -> CompactOptions:
    """Fill in the number of Gaussians beyond which new views gain nothing, with a note.

    The more the views confirm each other's depth, the larger is this number of Gaussians. If the budget is "auto", it
    becomes this number. If the budget is a share, a size or a device, this number is its upper limit.
    """
    budget = options.budget
    is_limit = budget.is_limit and options.method == OURS
    if agreement is None or options.fit.fit == "none" or not (budget.auto or is_limit):
        return options
    text, why = describe_share(agreement)
    if budget.auto:
        note(f"budget: {text} of the input, because {why}")
        return replace(options, budget=replace(budget, budget=text))
    most = max(size.num_views, int(agreement.share * size.num_gaussians))
    if most < max_allowed(budget, size.num_gaussians, size.sh_degree):
        limit = f"limited to {most:,} Gaussians, {text} of the input"
        reason = f"more would not show new views better, because {why}; --set fill=true takes the whole budget"
        note(f"budget {budget.budget}: {limit}; {reason}")
        is_only_count = options.changed_counts == ["budget"]
        if is_only_count and agreement.share <= FEWEST:  # a run without a budget would have the same number
            budget = replace(budget, budget=None)
    return replace(options, budget=replace(budget, most=most))


def describe_share(agreement: Agreement | None) -> tuple[str, str]:
    """Return the useful number of Gaussians as a share of the pixels, such as "10%", and the reason for a note."""
    if agreement is None:
        return SHARE, "depths of several views cannot be compared"
    return f"{100 * agreement.share:.3g}%", f"other views confirm {100 * agreement.confirmed:.0f} % of the pixels"


def resolve_decode(options: CompactOptions, scene: SceneSize) -> DecodeOptions:
    """Choose K if the option is "auto": 4 if all views have the same camera and no long fit follows, otherwise 1.

    A single view has too few Gaussians with K = 1, because it has only 4.4 superpixels per 100 pixels. With several
    cameras, each surface gets Gaussians from several views.
    """
    decode = options.decode
    if decode.k != AUTO:
        return decode
    if not (scene.has_own_pixels and scene.num_cameras == 1):
        return replace(decode, k=USUAL_K)
    decides_count = options.budget.quality is not None or options.changed_counts
    steps = EFFORTS[options.effort].steps if options.fit.fit_steps is None else options.fit.fit_steps
    has_long_fit = options.fit.fit != "none" and steps > SHORT_STEPS
    keeps_k = decides_count or options.replaces_stages or has_long_fit
    return replace(decode, k=USUAL_K if keeps_k else LONE_K)


def resolve_fit(options: CompactOptions, size: SceneSize, limits: CountLimits) -> FitOptions:
    """Fill in the settings of the fit that depend on effort and size.

    In a draft without a fit, Gaussians that no photo shows are kept. A draft of a scene without views has no fit.
    """
    fit, effort, views = options.fit, EFFORTS[options.effort], size.num_views
    if views == 0 and fit.fit_steps is None and not effort.fits_alone:
        fit = replace(fit, fit="none")
    prunes = fit.fit != "none" or effort.prunes
    share = limits.share if fit.share is None and views else fit.share
    return replace(
        fit,
        fit_steps=steps_for(options, views, USUAL_SHARE if share is None else share),
        share=share,
        grow_steps=max(GROW_STEPS, GROW_ROUNDS * views),
        min_contribution=fit.min_contribution if prunes else 0.0,
    )


def steps_for(options: CompactOptions, num_views: int, share: float = USUAL_SHARE) -> int:
    """Return the number of steps of the full fit.

    Unless the options state it, the number follows from effort, number of views and ``share``, the result's number of
    Gaussians per pixel. A step draws one view. Measurements are in docs/internals/large-scenes.md.
    """
    if options.fit.fit_steps is not None:
        return options.fit.fit_steps
    steps = EFFORTS[options.effort].steps * math.sqrt(max(1.0, num_views / USUAL_VIEWS))
    if options.budget.auto:
        return round(AUTO_STEPS * steps)
    return round(min(max(1.0, math.sqrt(share / USUAL_SHARE)), MOST_STEPS) * steps)


def fit_to_pictures(prepared: Prepared, options: CompactOptions, fit: FitOptions, *, merges_pairs: bool) -> FitOptions:
    """Fill in the settings of the fit that depend on the pictures and on other options.

    These settings are the scale of the photos, and whether the fit moves cameras, fills the budget, and keeps Gaussians
    beyond all views. If pairs are merged, the fit is to renders of the input. It allows long thin Gaussians, because
    the input may have them, and is not scored on held-out patches. Gaussians beyond all views, and Gaussians that
    hardly show in any view, are kept, because they belong to the scene.
    """
    scale, moves = 1.0, False
    if fit.fit != "none":
        scale, problem = photo_scale(prepared.scene, fit, auto=EFFORTS[options.effort].large_photos)
        if problem is not None:
            note(problem)
        is_free = options.prepare.poses == "free" or (options.prepare.poses == "auto" and prepared.moved)
        moves = is_free and fit.fit == "full" and prepared.reference.of_views
    fit = replace(
        fit, photo_scale=scale, move_cameras=moves, beyond=options.prepare.extent == "beyond",
        fills=options.budget.is_filled,
    )  # fmt: skip
    if not merges_pairs:
        return fit
    if prepared.reference.placed and fit.fit == "none" and options.fit.fit != "none":
        note(NO_FIT)
    tuning = replace(fit.tuning, max_ratio=math.inf)
    return replace(fit, scored=False, beyond=True, fills=True, min_contribution=0.0, tuning=tuning)


def own_views(prepared: Prepared) -> tuple[int, ...]:
    """Return the views whose pictures show the scene: views that were placed, or views of the input.

    Views of the input are numbered as in the input, where a view may be repeated.
    """
    if not prepared.reference.of_views:
        return prepared.reference.score_views
    return tuple(view for view, place in enumerate(prepared.repeated) if place in prepared.reference.score_views)


def usual_builds(*, has_target: bool, rendered: bool) -> int:
    """Return how many results a run usually builds; ``rendered``: renders of the input stand for photos."""
    return (USUAL_BUILDS_OF_RENDERS if rendered else USUAL_BUILDS) if has_target else 1


def run_parts(prepared: Prepared, plan: Plan) -> list[RunPart]:
    """Return the parts that a run in one piece is expected to have, in their order, after the fits of a curve."""
    views, steps = len(prepared.scene), 0 if plan.fit.fit == "none" else plan.fit.steps
    build = RunPart("build", STAGE_STEPS * views, steps)
    count = usual_builds(has_target=plan.target_psnr is not None, rendered=prepared.reference.name == RENDERS)
    trial = RunPart("trial", TRIAL_SHARE * build.stages, TRIAL_SHARE * steps)
    shares = [1.0] * count + [LEVEL_SHARE**level for level in range(1, plan.levels)]
    return [
        *(RunPart("build", share * build.stages, share * steps) for share in shares),
        RunPart("input", INPUT_STEPS * views), *([trial] if plan.new_views else []),
    ]  # fmt: skip
