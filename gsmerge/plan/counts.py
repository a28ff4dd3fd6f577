"""Decide the number of Gaussians: by superpixels and K, by budgets, file sizes and devices, or by a quality to keep."""

from __future__ import annotations

from functools import partial

from gsmerge.errors import UsageError
from gsmerge.frozen import replace
from gsmerge.io.formats.measure import measure_bytes
from gsmerge.io.formats.table import PLY, Format, count_for_bytes, output_format
from gsmerge.method.facts.agreement import FEWEST, Agreement
from gsmerge.method.facts.scene_size import SceneSize
from gsmerge.method.pipelines.plan import FileSize
from gsmerge.method.stages.limits import CountLimits, count_for
from gsmerge.runtime.record import note
from gsmerge.settings.budget import AUTO, DEVICES, BudgetOptions, parse_budget, parse_bytes
from gsmerge.settings.compact import OURS, CompactOptions
from gsmerge.settings.stages import SHARE, DecodeOptions, SegmentOptions

# If a scene has neither photos nor pixels, its result has by default at least this PSNR (dB) against the input
FIDELITY_PSNR = 32.5
# If a scene has photos but no pixels, its result by default loses at most this PSNR (dB) on the photos
FIDELITY_LOSS = 0.3
STREAMED_LEVELS = 3  # levels of detail of a lod-meta.json; the coarsest, a sixteenth of the Gaussians, loads at once
LEVEL_FACTOR = 4  # each level of detail has this many times fewer Gaussians than the next finer level
FEW_PIXELS = 1 << 18  # pixels of a few small photos
# A scene has few Gaussians if it has fewer than FEW per pixel of its photos; at most FEW_PIXELS pixels count. In a
# scene of few Gaussians the number of superpixels is a share of the pixels, but at most FEW times the number of
# Gaussians
FEW = 0.5


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


def exact_count(options: BudgetOptions, num_input: int, sh_degree: int) -> int | None:
    """Return the number of Gaussians that a budget or a file size requests; None if neither is given.

    A budget that is a share refers to ``num_input`` Gaussians. ``sh_degree`` decides how many Gaussians fit into a
    file.
    """
    device = DEVICES.get(str(options.budget))
    if device is not None:  # a device requests a number if the option says to fill it, or if the useful number is known
        num_useful = num_input if options.fill else options.most
        return None if num_useful is None else min(device, num_useful)
    if options.budget in (None, AUTO):
        return None
    limit = num_input if options.most is None else options.most
    file = _sized_format(options)
    if file is not None:
        return min(count_for_bytes(file, parse_bytes(str(options.budget)), sh_degree), limit)
    return min(parse_budget(str(options.budget), num_input), limit)


def level_counts(finest: int, num_levels: int, least: int = 1) -> list[int]:
    """Return the numbers of Gaussians of the coarser levels of detail, without numbers below ``least``.

    ``num_levels`` is the number of all levels, of which the finest has ``finest`` Gaussians.
    """
    return [count for level in range(1, num_levels) if (count := finest // LEVEL_FACTOR**level) >= least]


def file_size(options: BudgetOptions, sh_degree: int) -> FileSize | None:
    """Return the file size that a budget in bytes requests for a scene of a degree; None for any other budget.

    Raises UsageError if the size of the output does not follow from the number of its Gaussians.
    """
    file = _sized_format(options)
    if file is None:
        return None
    num_bytes = parse_bytes(str(options.budget))
    return FileSize(
        num_bytes,
        file.ending,
        packed=file.count is None,
        measure=partial(measure_bytes, file),
        count_without_harmonics=count_for_bytes(file, num_bytes, 0) if sh_degree and file.max_degree else None,
    )


def _sized_format(options: BudgetOptions) -> Format | None:
    """Return the format of the output of a budget in bytes; None for any other budget. Raises as :func:`file_size`."""
    if not options.in_bytes:
        return None
    file = output_format(options.output or PLY.ending)
    if not file.gaussian_bytes:
        raise UsageError(f"budget: expected a number or a share of Gaussians for {file.ending}, got {options.budget}")
    return file


def max_allowed(options: BudgetOptions, num_input: int, sh_degree: int) -> int:
    """Return the largest number of Gaussians that budget, file size and device allow, at most ``num_input``.

    ``sh_degree`` decides how many Gaussians fit into a file.
    """
    limits = DEVICES.get(str(options.budget)), exact_count(options, num_input, sh_degree), options.most
    return min([num_input, *(limit for limit in limits if limit is not None)])


def count_limits(
    scene: SceneSize,
    segment: SegmentOptions,
    decode: DecodeOptions,
    budget: BudgetOptions,
    *,
    num_input: int | None = None,
) -> CountLimits:
    """Compute the limits on the number of Gaussians.

    A budget that is a share refers to ``num_input`` Gaussians, or to those of the scene if ``num_input`` is None.
    Raises UsageError if more superpixels are requested than there are pixels, or fewer Gaussians than views.
    """
    count = scene.num_gaussians
    views = scene.num_views
    exact = exact_count(budget, count if num_input is None else num_input, scene.sh_degree)
    if exact is not None:
        exact = min(exact, count)
    max_count = min(max_allowed(budget, count, scene.sh_degree), count if exact is None else exact)
    if max_count < min(views, count):
        remedy = f'; for {max_count} % pass "{max_count}%"' if max_count <= 100 else ""
        raise UsageError(f"budget: expected at least {views}, one for each view, got {max_count}{remedy}")
    per_view = superpixels_per_view(scene, segment) if views else 0
    total = max(1, int(segment.share * count))  # without views, superpixels are a share of the Gaussians
    if views:
        of_views = per_view * count // scene.pixels_per_view if scene.has_own_pixels else per_view * views
        total = max(views, of_views)
    return CountLimits(
        per_view=per_view,
        default=round(total * decode.mean_k),
        min_count=max(1, views),
        max_count=max_count,
        exact=exact,
        num_pixels=views * scene.pixels_per_view,
        num_input=count,
        most=count if budget.most is None else min(count, budget.most),
    )


def superpixels_per_view(scene: SceneSize, segment: SegmentOptions) -> int:
    """Return the number of superpixels per view.

    A share in the option ``superpixels`` is a share of the pixels, or of the Gaussians if views share Gaussians and
    there are fewer Gaussians than pixels. Scenes of few Gaussians (:data:`FEW`) get more superpixels.
    """
    per_view = count_for(segment, scene.height, scene.width)
    if scene.has_own_pixels or segment.per_view is not None:
        return per_view
    count = segment.share * scene.num_gaussians
    if has_few_rows(scene):
        count = max(count, min(segment.share * _few_pixels(scene), FEW * scene.num_gaussians))
    return max(1, min(per_view, int(count / scene.num_views)))


def has_few_rows(scene: SceneSize) -> bool:
    """Return whether Gaussians that belong to no pixels are so few that a share of them could not show the photos."""
    has_photos = not scene.rendered and not scene.has_own_pixels
    return has_photos and scene.num_gaussians < FEW * _few_pixels(scene)


def _few_pixels(scene: SceneSize) -> int:
    """Return the number of pixels of all views, at most ``FEW_PIXELS``."""
    return min(FEW_PIXELS, scene.num_views * scene.pixels_per_view)
