"""Options and facts -> plan: only this package decides what effort, budget, recipe and names of checkpoints mean.

:func:`make_plan` makes all choices for a prepared scene or block. :func:`plan_scene` makes only the choices that need
no computation, for estimates and for scenes in blocks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gsmerge.errors import UsageError
from gsmerge.frozen import replace
from gsmerge.method.facts.pictures import RENDERS
from gsmerge.method.facts.prepared import Prepared
from gsmerge.method.facts.scene_size import SceneSize
from gsmerge.method.fit import start_share
from gsmerge.method.geometry.views import pick_views, scored_views
from gsmerge.method.pipelines.bare_rows import BARE_ROWS
from gsmerge.method.pipelines.pixel_rows import PIXEL_ROWS
from gsmerge.method.pipelines.plan import CountPlan, MergePlan, Pipeline, Plan, ScorePlan
from gsmerge.method.raster.photos import scored_tiles
from gsmerge.method.stages.fit_pairs import choose_power
from gsmerge.method.stages.segment import SharedTree, SuperpixelChoices
from gsmerge.plan.counts import (
    FIDELITY_PSNR,
    count_limits,
    describe_share,
    file_size,
    has_few_rows,
    keeps_fidelity,
    resolve_budget,
)
from gsmerge.plan.efforts import EFFORTS
from gsmerge.plan.fit import fit_to_pictures, resolve_fit
from gsmerge.plan.networks import choose_networks, cuts_views, load_networks
from gsmerge.runtime.record import note, stage
from gsmerge.settings.budget import AUTO
from gsmerge.settings.compact import COUNTS, OURS, CompactOptions
from gsmerge.settings.fit import GROW_STEPS, FitOptions
from gsmerge.settings.setting import flat_settings
from gsmerge.settings.stages import SHARE, USUAL_K, DecodeOptions, MatchOptions, PrepareOptions, SegmentOptions
from gsmerge.types import Scene

if TYPE_CHECKING:
    from gsmerge.method.networks.checkpoint import Checkpoint


LONE_K = 4  # K if all views have the same camera, because no other view adds Gaussians to a surface


def make_plan(
    prepared: Prepared, options: CompactOptions, checkpoint: Checkpoint | None = None, pipeline: Pipeline | None = None
) -> Plan:
    """Make all decisions about a run that the options leave open.

    The networks are also loaded, because some decisions depend on them. ``checkpoint`` has networks to use instead of
    the networks that the options name. ``pipeline`` is that of another package's method. Raises UsageError if the scene
    or the networks do not allow what the options ask for.
    """
    check_pictures(prepared, options)
    with stage("prepare"):
        size = prepared.size
        checkpoint = checkpoint or load_networks(options, size)
        filled = fill_options(prepared, options)
        has_repeats = len(prepared.scene) < len(prepared.input_scene)
        num_input = prepared.input_scene.num_gaussians if has_repeats else None  # a budget may be a share of it
        plan = plan_scene(
            size, filled, num_input=num_input, keeps=keeps_fidelity(size, options),
            has_networks=checkpoint is not None, pipeline=pipeline,
        )  # fmt: skip
        merges_pairs = plan.pipeline == BARE_ROWS
        cuts = cuts_views(options, size)
        fit = fit_to_pictures(prepared, filled, plan.fit, merges_pairs=merges_pairs)
        if plan.count.keeps_fidelity and has_few_rows(size):
            few = f"the scene has only {size.num_gaussians:,} Gaussians, fewer than its photos need"
            note(f"{few}; the result has at most half of them, and more may show the photos better: --budget NUMBER")
        limits = plan.count.limits
        usual = limits.default
        num_superpixels = round(limits.per_view * size.num_views * plan.merge.superpixels.start_share)
        merging = 2  # about half of the superpixels are merged into those of other views
        if options.scene_decides and size.has_own_pixels and num_superpixels > merging * usual:
            share = f"{100 * usual / size.num_gaussians:.2g}%"
            times = f"{limits.num_pixels / size.num_gaussians:.2g} times as many pixels as the file has Gaussians"
            why = f"the photos have {times}, and their superpixels show more of them"
            note(f"the result may have more than {share} of the input, because {why}; --budget {share} keeps to it")
        return replace(
            plan,
            count=replace(plan.count, file_size=file_size(options.budget, size.sh_degree)),
            merge=plan_merge(prepared, plan, fit, checkpoint, merges_pairs=merges_pairs, cuts=cuts),
            fit=fit,
            score=plan_scores(prepared, plan, EFFORTS[options.effort].report_views),
            settings=replace(options, decode=plan.merge.decode).to_dict() | {"fit_steps": fit.steps},
        )


def plan_merge(
    prepared: Prepared, plan: Plan, fit: FitOptions, checkpoint: Checkpoint | None, *, merges_pairs: bool, cuts: bool
) -> MergePlan:
    """Add to the plan of merging the networks, what all builds of a run share, and the power by which pairs are merged.

    All builds of a run share one tree of regions, by which they cut the views. ``cuts``: views are cut at all.
    """
    if merges_pairs:
        count = plan.count.limits.count or plan.count.limits.default
        power = choose_power(count, prepared, fit, plan.seed)
        return replace(plan.merge, checkpoint=checkpoint, power=power)
    has_tree = plan.count.has_quality or plan.count.levels > 1 or plan.count.limits.count is not None
    superpixels = replace(plan.merge.superpixels, shared=SharedTree() if has_tree and cuts else None)
    return replace(plan.merge, superpixels=superpixels, checkpoint=checkpoint)


def plan_scores(prepared: Prepared, plan: Plan, report_views: int) -> ScorePlan:
    """Choose the views in which input and results are scored, among those whose pictures show the scene.

    A report needs ``report_views``, and a sample of their tiles, of which small views have too few. Scores that decide
    the number of Gaussians take more views, and all pixels. All views that were placed count.
    """
    cameras = prepared.scene.cameras
    views = pictured_views(prepared)
    is_whole = len(views) <= report_views and scored_tiles(0, cameras.width, cameras.height, 2) is None
    samples = not (is_whole or plan.count.target_psnr is not None or plan.count.keeps_fidelity)
    if not prepared.reference.placed:
        chosen = pick_views(len(views), report_views) if samples else scored_views(len(views))
        views = tuple(views[i] for i in chosen)
    new_views = plan.score.new_views and prepared.agreement is not None and prepared.can_leave_out
    return replace(plan.score, views=views, samples=samples, new_views=new_views)


def plan_scene(
    size: SceneSize,
    options: CompactOptions,
    *,
    num_input: int | None = None,
    keeps: bool | None = None,
    has_networks: bool = False,
    pipeline: Pipeline | None = None,
) -> Plan:
    """Make the decisions that follow from the scene's size and the options; UsageError for impossible options.

    Estimates, and scenes in blocks, need no more; :func:`make_plan` adds what follows from the pictures. ``num_input``:
    see :func:`gsmerge.plan.counts.count_limits`. ``keeps``: what :func:`keeps_fidelity` has returned for the options
    of the caller; None: what this function returns for ``options``. With ``has_networks``, networks are given, also if
    the options name none. ``pipeline`` is that of another package's method.
    """
    effort = EFFORTS[options.effort]
    budget = options.budget
    segment = options.segment
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
    # Without a fit, new views look as good as the views of the input, so they need no estimate
    new_views = fit.fit != "none" and options.effort != "draft" if options.new_views is None else options.new_views
    return Plan(
        count=CountPlan(
            limits=limits,
            target_psnr=FIDELITY_PSNR if keeps and size.rendered else budget.target_psnr,
            keeps_fidelity=keeps,
            max_drop=budget.max_drop,
            auto_count=budget.auto,
            levels=budget.levels,
        ),
        merge=MergePlan(
            superpixels=SuperpixelChoices(segment, start_share(fit)),
            match=replace(options.match, match=match),
            decode=decode,
        ),
        fit=fit,
        score=ScorePlan(output=budget.output, new_views=new_views),
        clean=options.clean,
        pipeline=pipeline or choose_pipeline(size, options, has_networks=has_networks or networks != "none"),
        seed=options.seed,
        settings=options.to_dict() | {"k": decode.k, "match": match, "checkpoint": networks},
        free_poses=options.prepare.poses == "free",
    )


def choose_pipeline(size: SceneSize, options: CompactOptions, *, has_networks: bool) -> Pipeline:
    """Choose how Gaussians are built: by superpixels, or by pairs of neighbours.

    Views are cut into superpixels if they have pictures other than renders, or if a setting changes superpixels. A
    setting of the number of superpixels does not count, because it only says how many Gaussians there are. Networks
    need superpixels, too. Without superpixels, neighbouring Gaussians are merged pair by pair.
    """
    cuts = size.num_views > 0 and (not size.rendered or options.changes_superpixels)
    return PIXEL_ROWS if cuts or has_networks or options.method != OURS else BARE_ROWS


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
    size = prepared.size
    agreement = prepared.agreement
    options = resolve_budget(size, options, agreement)
    decode = resolve_decode(options, size)
    segment = options.segment
    clean = options.clean
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


def check_pictures(prepared: Prepared, options: CompactOptions) -> None:
    """Raise UsageError for settings that need photos if there are none."""
    if prepared.reference.name != RENDERS:
        return
    if options.budget.max_drop is not None:
        problem = f'quality {options.budget.quality}: expected a PSNR against the input, such as "35dB", without photos'
        raise UsageError(f"{problem}; without photos nothing shows the scene better than the input; or give --images")
    if "sky" in options.clean.drops and prepared.input_scene.images is None:
        raise UsageError("drop sky: expected photos, which show where the sky is; name them with --images")


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
    has_long_fit = options.fit.fit != "none" and steps >= GROW_STEPS
    keeps_k = decides_count or options.replaces_stages or has_long_fit
    return replace(decode, k=USUAL_K if keeps_k else LONE_K)


def pictured_views(prepared: Prepared) -> tuple[int, ...]:
    """Return the views whose pictures show the scene: views that were placed, or views of the input.

    Views of the input are numbered as in the input, where a view may be repeated.
    """
    if not prepared.reference.of_views:
        return prepared.reference.score_views
    return tuple(view for view, place in enumerate(prepared.repeated) if place in prepared.reference.score_views)
