"""numbers -> a JSON document with a stable schema, one line for people, and an estimate beforehand."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

from gsmerge import __version__
from gsmerge.runtime.estimate import COST_FIXED, fit_of, is_robust, memory_bytes, memory_problem, work_seconds
from gsmerge.runtime.memory import machine_memory
from gsmerge.types import Gaussians

SCHEMA_VERSION = 1


@dataclass(frozen=True)
class CompactReport:
    """What a run did.

    Args:
        num_input: Gaussians in the scene.
        num_output: Gaussians in the result.
        seconds: Wall time of each stage.
        psnr_before: Mean PSNR (dB) of the input views, of many some, rendered from the input; None without photos.
        psnr_after: The same from the result.
        choices: What the stages decided (count, curve, merge, scores, clusters, fit).
        notes: Warnings about the input and what was adapted, one sentence each.
        options: All settings by flat name.
        peak_memory_bytes: Largest resident memory of the process so far.
        unmet: Why a target that was asked for is not met, and how far the result got; None if it is.
    """

    num_input: int
    num_output: int
    seconds: dict[str, float]
    psnr_before: float | None
    psnr_after: float | None
    choices: dict[str, Any]
    notes: list[str]
    options: dict[str, Any]
    peak_memory_bytes: int
    unmet: str | None = None


@dataclass(frozen=True)
class CompactResult:
    """The compact Gaussians, in the scene's own world frame, and the report.

    Args:
        gaussians: The Gaussians.
        report: What was done.
        coarser: Further levels of detail, each with a quarter of the Gaussians of the one before.
    """

    gaussians: Gaussians
    report: CompactReport
    coarser: tuple[CompactResult, ...] = ()


def file_sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() if hasattr(hashlib, "file_digest") else _digest(file)


def _digest(file: Any) -> str:
    state = hashlib.sha256()
    while block := file.read(1 << 20):
        state.update(block)
    return state.hexdigest()


def document_head() -> dict[str, Any]:
    """What every JSON document starts with."""
    return {"schema_version": SCHEMA_VERSION, "tool": {"name": "gsmerge", "version": __version__}}


def report_document(
    report: Any,
    *,
    input_path: Path,
    output_path: Path,
    seconds_before: Mapping[str, float],
    seconds_after: Mapping[str, float],
    coarser: Sequence[tuple[Path, Any]] = (),
    recognised: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
    hashed: bool = True,
) -> dict[str, Any]:
    """The report of one ``compact`` as plain JSON types.

    Args:
        report: The :class:`gsmerge.CompactReport`.
        input_path: The ``.ply`` that was read.
        output_path: The ``.ply`` that was written.
        seconds_before: Wall time by name of what came before the report's stages (imports, reading).
        seconds_after: The same for what came after them (writing).
        coarser: File and :class:`gsmerge.CompactReport` of further levels of detail.
        recognised: What is known of the input beside path, bytes and count (layout, views, ...).
        notes: What the reader had to say; the report's own notes follow.
        hashed: Also hash the input, which takes time on large files.

    Returns:
        ``schema_version`` 1: tool, input, output, levels, ratio, options, seed, choices, seconds, psnr, memory, notes,
        and ``unmet``: why a target is not met, or null.
        Keys are only ever added within one schema version.
    """
    numbers = _numbers(report)
    stages = {**seconds_before, **numbers["seconds"], **seconds_after}
    return {
        **document_head(),
        "input": {
            "path": os.fspath(input_path),
            "sha256": file_sha256(input_path) if hashed else None,
            "bytes": input_path.stat().st_size,
            "num_gaussians": numbers["num_input"],
            **(recognised or {}),
        },
        "output": _written(output_path, numbers),
        "levels": [_level(path, _numbers(level)) for path, level in coarser],
        "ratio": numbers["num_output"] / max(numbers["num_input"], 1),
        "options": numbers["options"],
        "seed": numbers["options"]["seed"],
        "choices": numbers["choices"],
        **seconds_document(stages),
        "psnr_input_views": {"before": numbers["psnr_before"], "after": numbers["psnr_after"]},
        "peak_memory_bytes": numbers["peak_memory_bytes"],
        "notes": [*notes, *numbers["notes"]],
        "unmet": numbers["unmet"],
    }


def _numbers(report: Any) -> dict[str, Any]:
    return asdict(report) if is_dataclass(report) and not isinstance(report, type) else dict(report)


def _written(path: Path, numbers: Mapping[str, Any]) -> dict[str, Any]:
    return {"path": os.fspath(path), "bytes": path.stat().st_size, "num_gaussians": numbers["num_output"]}


def _level(path: Path, numbers: Mapping[str, Any]) -> dict[str, Any]:
    """What the report says of a further level of detail."""
    return {
        **_written(path, numbers),
        "psnr_input_views": numbers["psnr_after"],
        "seconds": round(sum(numbers["seconds"].values()), 4),
        "choices": numbers["choices"],
        "notes": numbers["notes"],
    }


def to_json(document: Mapping[str, Any]) -> str:
    """Strict JSON, indented, with a closing newline; infinities become null."""
    return json.dumps(finite(document), indent=2, allow_nan=False) + "\n"


def finite(value: Any) -> Any:
    """Plain JSON types with None in place of infinities and NaN."""
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not (abs(value) < float("inf")):
        return None
    return value


def summary_lines(document: Mapping[str, Any]) -> list[str]:
    """What ``compact`` ends with: a line for the result, one for each further level, and the curve if measured."""
    levels = [
        f"{level['path']}: {level['num_gaussians']:,} Gaussians, {human_bytes(level['bytes'])}"
        + (f"; input views {level['psnr_input_views']:.2f} dB" if level["psnr_input_views"] is not None else "")
        + f"; {level['seconds']:.1f} s"
        for level in document["levels"]
    ]
    return [summary_line(document), *levels, *curve_lines(document["choices"].get("curve", []))]


def curve_lines(points: Sequence[Mapping[str, Any]]) -> list[str]:
    """The scene's curve as a small table: what short fits reach on parts of the photos that they left out."""
    if not points:
        return []
    perceptual = points[0]["lpips"] is not None
    head = f"{'Gaussians':>12}  {'PSNR':>5}  {'SSIM':>5}" + ("  LPIPS (AlexNet)" if perceptual else "")
    rows = [
        f"{p['count']:>12,}  {p['psnr']:5.2f}  {p['ssim']:5.3f}" + (f"  {p['lpips']:5.3f}" if perceptual else "")
        for p in points
    ]
    return ["after short fits, on parts of the photos that they left out:", head, *rows]


def summary_line(document: Mapping[str, Any]) -> str:
    """The line of the result: counts, ratio, bytes, PSNR, seconds per stage."""
    before, after = document["input"], document["output"]
    psnr = document["psnr_input_views"]
    quality = (
        f"; input views {psnr['before']:.2f} -> {psnr['after']:.2f} dB"
        if psnr["before"] is not None and psnr["after"] is not None
        else ""
    )
    return (
        f"{after['path']}: {before['num_gaussians']:,} -> {after['num_gaussians']:,} Gaussians"
        f" ({100 * document['ratio']:.2f} %), {human_bytes(before['bytes'])} -> {human_bytes(after['bytes'])}"
        f"{quality}; {seconds_line(document)}"
    )


def seconds_document(seconds: Mapping[str, float]) -> dict[str, Any]:
    """Wall time by stage and in all, as every report has it."""
    total = round(sum(seconds.values()), 4)
    return {"seconds": {name: round(value, 4) for name, value in seconds.items()}, "total_seconds": total}


def seconds_line(document: Mapping[str, Any]) -> str:
    """``2.3 s (read 0.70, ...)`` of a report."""
    stages = ", ".join(f"{name} {value:.2f}" for name, value in document["seconds"].items())
    return f"{document['total_seconds']:.1f} s ({stages})"


def human_bytes(count: float) -> str:
    """``1234567`` -> ``1.2 MB`` (powers of ten)."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} GB"


def plan_document(
    files: Mapping[str, str | None],
    grid: tuple[int, int, int],
    options: Mapping[str, Any],
    *,
    output_path: Path,
    per_view: int,
    photos: bool,
    threads: int,
    fit_steps: int,
    usual: int,
    wanted: int | None = None,
    notes: Sequence[str] = (),
    count: int | None = None,
    num_rest: int = 0,
) -> dict[str, Any]:
    """What a run would make of a scene, and an estimate of its time and memory.

    Args:
        files: Paths of the ``ply``, the ``cameras`` and the ``images``.
        grid: Views, height and width of the Gaussian grid.
        options: All settings by flat name, as of ``CompactOptions.resolved()``.
        output_path: The ``.ply`` that would be written.
        per_view: Superpixels per view, before a budget deals them out.
        photos: Whether the scene has photos; robust merging and the fit need them.
        threads: Threads that would run.
        fit_steps: Steps of the full fit.
        usual: Gaussians that superpixels and K ask for.
        wanted: Gaussians that a budget asks for; None without one.
        notes: What the reader had to say.
        count: Gaussians of the file; None: one for each pixel of the grid.
        num_rest: Columns of higher harmonics.

    Returns:
        ``schema_version`` 1: the plan; ``estimate`` holds within a factor of about two on a common processor once
        the kernels are compiled.
    """
    views, height, width = grid
    pixels = max(views * height * width, count or 0)
    method, at_most = options["method"], usual if wanted is None else wanted
    at_most = pixels if method.startswith("unmerged") else at_most
    seconds = work_seconds(pixels, height * width, options, photos=photos, fit_steps=fit_steps)
    return {
        **document_head(),
        "dry_run": True,
        "input": {**files, "num_gaussians": count or pixels, "num_views": views, "height": height, "width": width},
        "output": {
            "path": os.fspath(output_path),
            "num_gaussians_at_most": min(count or pixels, at_most),
        },
        "method": method,
        "superpixels_per_view": per_view if wanted is None and options["budget"] != "auto" else None,
        "robust": is_robust(options, photos=photos),
        "fit": fit_of(options, photos=photos),
        "estimate": {
            "seconds": round(COST_FIXED + seconds / max(1, min(threads, views)), 1),
            "memory_bytes": memory_bytes(pixels, photos=photos, num_rest=num_rest),
            "machine_memory_bytes": machine_memory(),
        },
        "options": dict(options),
        "notes": list(notes),
    }


def memory_problems(guess: Mapping[str, Any]) -> list[str]:
    """That an estimated run is not likely to fit into this machine's memory; nothing where it does."""
    problem = memory_problem(guess["memory_bytes"], guess["machine_memory_bytes"])
    return [] if problem is None else [problem]


def plan_lines(plan: Mapping[str, Any]) -> list[str]:
    """The plan for people."""
    found, guess, per_view = plan["input"], plan["estimate"], plan["superpixels_per_view"]
    even = per_view is not None
    superpixels = (
        f"{per_view:,} per view, {plan['options']['k']} Gaussian(s) each" if even else "where the scene needs them"
    )
    steps = [
        f"superpixels  {superpixels}",
        f"merging      {'the best of a family, judged by the photos' if plan['robust'] else 'plain'},"
        f" across views: {plan['options']['match']}",
        f"networks     {plan['options']['checkpoint']}",
    ]
    return [
        f"would read   {found['ply']}: {found['num_views']} views of {found['width']} x {found['height']}",
        f"would write  {plan['output']['path']}: at most {plan['output']['num_gaussians_at_most']:,} Gaussians",
        *(steps if plan["method"] == "gsmerge" else [f"method       {plan['method']}"]),
        f"fit          {plan['fit']}",
        f"estimate     about {guess['seconds']:.0f} s, {human_bytes(guess['memory_bytes'])} of memory",
        *(f"memory       {problem}" for problem in memory_problems(guess)),
        *(f"note         {note}" for note in plan["notes"]),
    ]


def inspection_lines(found: Mapping[str, Any]) -> list[str]:
    """What ``gsmerge.inspect`` found, for people.

    Args:
        found: ``Inspection.to_dict()``.
    """
    parts = ", ".join(f"{name} {human_bytes(size)}" for name, size in found["bytes_by_attribute"].items())
    ignored = _ignored(found)
    low, high = (" ".join(f"{value:.4g}" for value in found[key]) for key in ("box_low", "box_high"))
    size = found["extents"]
    lines = [
        f"file       {found['path']}: {human_bytes(found['bytes'])} ({parts})",
        f"layout     {found['layout']}, {found['format']}; opacity stored {_ENCODINGS[found['opacity_encoding']]}",
        f"dialect    {found['dialect']}",
        f"ignored    {', '.join(ignored)}" if ignored else "",
        f"Gaussians  {found['count']:,}: {found['num_nonfinite']} not finite, {found['num_transparent']:,} transparent,"
        f" {found['num_opaque']:,} opaque, {found['num_saturated']:,} of opacity 0 or 1",
        f"extent     {low}  to  {high}  (1 % to 99 %); {100 * size['share_outliers']:.2g} % beyond ten times that box",
        f"scales     median {size['scale_median']:.3g}, largest {size['scale_max']:.3g} in a scene of"
        f" {size['diagonal']:.3g}; {100 * size['share_huge']:.2g} % above a tenth of it",
        f"cameras    {_cameras(found)}",
        f"images     {found['images'] or 'none found'}",
    ]
    lines += _alignment_lines(found) + _view_lines(found) + _estimate_lines(found)
    said = () if found["alignment_problem"] is None and found["rows"] is None else _SAID_ABOVE
    notes = [note for note in found["notes"] if not note.startswith(said)]
    return [line for line in lines if line] + [f"note       {note}" for note in notes]


def _ignored(found: Mapping[str, Any]) -> list[str]:
    """Columns and elements that mean nothing here; those that hold the camera do."""
    used = _CAMERA_ELEMENTS if found["cameras"] is None and found["camera_format"] else ()
    elements = [name for name in found["extra_elements"] if name not in used]
    return [*found["extra_columns"], *(f"element {name}" for name in elements)]


def _cameras(found: Mapping[str, Any]) -> str:
    if not found["num_views"]:
        return found["cameras"] or "none found"
    inside = set(_CAMERA_ELEMENTS) <= set(found["extra_elements"])
    where = found["cameras"] or ("inside the .ply" if inside else "none found")
    return f"{where}: {found['num_views']} ({found['camera_format']})"


def _alignment_lines(found: Mapping[str, Any]) -> list[str]:
    """Which row is which pixel, and how far from it; or why that is not known."""
    alignment, problem = found["alignment"], found["alignment_problem"]
    if problem is not None and found["estimate"] is None:
        return [f"alignment  not measured: {problem}"]
    if problem is not None:
        return [f"alignment  not one Gaussian per pixel: {problem.removeprefix('expected one Gaussian per pixel, ')}"]
    if alignment is None:
        return []
    worst = max(m for m in alignment["median_px"] if m is not None)
    number = "one Gaussian" if found["per_pixel"] == 1 else f"{found['per_pixel']} Gaussians"
    missing = f", none for {found['num_missing']:,} of them" if found["num_missing"] else ""
    return [
        f"rows       {found['rows']}",
        f"alignment  {number} per pixel, {found['num_views']} x {found['height']} x {found['width']} (views x height x"
        f" width){missing}; median offset {worst:.2f} px in the worst view, {100 * found['alignment_score']:.1f} %"
        " within 1 px",
    ]


def _view_lines(found: Mapping[str, Any]) -> list[str]:
    """What the views show, and which shows least."""
    views, seen = found["coverage"], found["sight"]
    if not views or seen is None:
        return []
    colors = ""
    if seen["color_ratio"] is not None:
        colors = f"; colours {seen['color_ratio']:.2f} times as far from their own pixels as from any others"
    pixelwise = views[0]["share_of_pixels"] is not None
    key, what = ("share_of_pixels", "pixels") if pixelwise else ("share_of_gaussians", "Gaussians")
    shares = [view[key] for view in views]
    least, most = f"{100 * min(shares):.0f}", f"{100 * max(shares):.0f}"
    each = f"{most} % of the {what} in every view"
    if least != most:
        each = f"{least} to {most} % of the {what} per view, least in {views[shares.index(min(shares))]['name']}"
    return [f"coverage   {each}; {100 * seen['share_seen']:.0f} % of the Gaussians seen{colors}"]


def _estimate_lines(found: Mapping[str, Any]) -> list[str]:
    guess = found["estimate"]
    if guess is None:
        return ["compact    would refuse the scene as it is"]
    return [
        f"compact    would give about {guess['num_gaussians']:,} Gaussians ({100 * guess['ratio']:.1f} %),"
        f" {human_bytes(guess['bytes'])}, in about {guess['seconds']:.0f} s with"
        f" {human_bytes(guess['memory_bytes'])} of memory",
        *(f"memory     {problem}" for problem in memory_problems(guess)),
    ]


_CAMERA_ELEMENTS = ("extrinsic", "intrinsic", "image_size")
_SAID_ABOVE = ("read as: ", "the rows belong to no pixels")  # notes that repeat a line of their own
_ENCODINGS = {"logit": "as logits", "raw": "in [0, 1]"}
