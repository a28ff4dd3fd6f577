"""The report of a run, as an object, as a JSON document with a stable schema, and as lines of text."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsmerge.errors import Doubt, count_words, list_doubts
from gsmerge.frozen import asdict, dataclass, replace
from gsmerge.io.formats.rows import ExpectedScores, describe_gain
from gsmerge.method.raster.metrics import psnr_figure, psnr_words
from gsmerge.runtime.documents import document_head, note_entries, seconds_document, seconds_line, text_table, wrap_line
from gsmerge.runtime.memory import human_bytes, human_share


@dataclass(frozen=True)
class Covered:
    """PSNR over the pixels of the input views that the input covers, if it does not cover all.

    Args:
        share: Share of the scored pixels that the input covers. If the input file has rows for only some pixels, it
            covers these pixels. Any other input covers the pixels in which its opacity is at least a half.
        before: Mean PSNR (dB) of the covered pixels, rendered from the input.
        after: Mean PSNR (dB) of the covered pixels, rendered from the result.
    """

    share: float
    before: float
    after: float


def compared_psnr(
    covered: Covered | None, before: float | None, after: float | None
) -> tuple[float | None, float | None]:
    """Return the PSNR (dB) of the input and of the result, for comparing the two.

    If the input does not cover all pixels, the PSNR is over the pixels that the input covers.
    """
    return (before, after) if covered is None else (covered.before, covered.after)


@dataclass(frozen=True)
class PhotoFiles:
    """PSNR on the photos as they are in their files, if a run changed any photo.

    Args:
        before: Mean PSNR (dB) of the input views, rendered from the input.
        after: Mean PSNR (dB) of the input views, rendered from the result.
    """

    before: float
    after: float


@dataclass(frozen=True)
class NewViews(ExpectedScores):
    """Expected PSNR (dB) of new views of a scene, as a trial predicts it."""

    views: int  # Number of left-out photos on which the trial measured

    def to_dict(self) -> dict[str, float]:
        """Return the numbers, rounded for a report, by name."""
        return {name: round(value, 4) for name, value in asdict(self).items()}


@dataclass(frozen=True)
class CompactReport:
    """Report of a run.

    Args:
        num_input: Gaussians in the scene.
        num_output: Gaussians in the result.
        seconds: Wall time of each stage.
        psnr_before: Mean PSNR (dB) of the input views, rendered from the input; None if neither photos nor pixels are
            known. The PSNR is measured on a tenth of the pixels of at most eight views, unless a quality was asked for,
            or the result may be worse than the input. The gain on this sample is off by .3 dB (rms);
            :func:`gsmerge.evaluate` is exact.
        new_views: Expected PSNR of new views, estimated on photos that a short fit left out; None with fewer than four
            photos, in drafts, and in blocks.
        psnr_after: Like ``psnr_before``, but rendered from the result. If the format of the output rounds positions
            visibly, the rounded Gaussians are rendered.
        choices: Decisions of the stages (count, curve, search, merge, scores, clusters, fit). ``pruned`` says by how
            many Gaussians the result is smaller than allowed, because no view shows more Gaussians. Without photos and
            pixels, ``fidelity`` has the ``psnr`` (dB) against renders of the input, and the number of ``views`` of
            these renders. ``held_out`` is true if the views were placed because the scene has no cameras.
        notes: Warnings about the input and notes about what was adapted to it, one sentence each.
        options: All settings by flat name.
        peak_memory_bytes: Largest resident memory of the process so far.
        unmet: Why a target that was asked for is not met, and how near the result came; None if the target is met.
        worse: A warning that the result is worse than the input, which is also among the notes; None if the result is
            not worse, or if this cannot be measured. The result is worse if it shows the scene's own photos more than
            .5 dB worse than the input, or if ``is_far`` is true. If ``fidelity`` is measured, the result is worse if
            its ``psnr`` is below 30 dB. docs/reference/report.md lists all cases.
        psnr_reference: What the PSNR of the input views is measured against: "photos" or "the model's own pixels"; None
            if the PSNR is not measured.
        covered: PSNR over the pixels that the input covers; None if the input covers at least 98 % of all pixels.
        is_far: The result is clearly worse than the input. Either the result's pictures differ from the photos more
            than twice as much as the input's pictures do. Or, between the views, the result's pictures differ from the
            input's pictures more than twice as much as the input's pictures differ from the photos.
        photo_files: PSNR on the photos as they are in their files; None if the run changed no photo.
        protected: PSNR over the pixels that ``protect`` marks, and their share of all pixels; None without such pixels.

    Example:
        >>> report = gsmerge.compact("demo", effort="draft", budget=300).report
        >>> report.num_input, report.num_output
        (7680, 300)
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
    worse: str | None = None
    covered: Covered | None = None
    psnr_reference: str | None = None
    new_views: NewViews | None = None
    photo_files: PhotoFiles | None = None
    protected: Covered | None = None
    is_far: bool = False

    def __repr__(self) -> str:
        share = human_share(self.num_output / max(1, self.num_input))
        facts = [f"Gaussians {self.num_input:,} -> {self.num_output:,} ({share})"]
        if new := self.new_views:
            facts += [f"PSNR of new views, {describe_gain(new.low, new.high)} from {new.before:.1f} dB"]
        if self.psnr_before is not None and self.psnr_after is not None:
            ends = (psnr_figure(psnr, self.choices) for psnr in (self.psnr_before, self.psnr_after))
            facts += [f"PSNR of its own views {' -> '.join(ends)}"]
        if fidelity := self.choices.get("fidelity"):
            facts += [f"PSNR {psnr_words(fidelity['psnr'])} {_describe_fidelity_views(fidelity)}"]
        facts += [f"time {sum(self.seconds.values()):.1f} s"]
        return f"CompactReport({'; '.join(facts)})"

    @property
    def doubts(self) -> list[str]:
        """The notes that make the result doubtful."""
        return list_doubts(self.notes)

    def with_worse(self, worse: str) -> CompactReport:
        """Return the report with the doubt ``worse``, which says that the result is worse than its input."""
        return replace(self, notes=[*self.notes, Doubt(worse, "worse")], worse=worse)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain JSON types, by the names of its fields, with ``doubts``."""
        return asdict(self) | {"doubts": self.doubts}


def report_document(
    report: CompactReport,
    *,
    recognised: Mapping[str, Any],
    output_path: Path,
    seconds_before: Mapping[str, float],
    seconds_after: Mapping[str, float],
    coarser: Sequence[tuple[Path, CompactReport]] = (),
    notes: Sequence[str] = (),
    written_at: Mapping[Path, Sequence[Path]] | None = None,
    cameras_path: Path | None = None,
) -> dict[str, Any]:
    """Return the report of one ``compact`` run as plain JSON types.

    Args:
        report: The report of the result.
        recognised: Facts about the input.
        output_path: The file of the result.
        seconds_before: Wall time by name before the stages of the report, such as imports and reading.
        seconds_after: Wall time by name after these stages, such as writing.
        coarser: File and report of each coarser level of detail.
        notes: Notes from reading and writing, which come before those of the report.
        written_at: The temporary files of each output, whose bytes are counted if they are not renamed yet.
        cameras_path: The file of cameras for viewers, if any.

    Returns:
        The keys of the document, which docs/reference/report.md describes. The keys are those of
        :class:`CompactReport`, partly under other names, and facts about the files. ``worse`` is the warning of the
        result or, if it has none, of a level. Within a ``schema_version`` keys are only added.
    """
    numbers = asdict(report)
    at = written_at or {}
    return {
        **document_head(),
        "input": {**recognised, "num_gaussians": numbers["num_input"]},
        "output": _file_facts(output_path, report, at),
        "levels": [
            {
                **_file_facts(path, level, at),
                "psnr_input_views": level.psnr_after,
                "psnr_covered": level.covered and asdict(level.covered),
                "psnr_photo_files": level.photo_files and asdict(level.photo_files),
                "psnr_protected": level.protected and asdict(level.protected),
                "seconds": round(sum(level.seconds.values()), 4),
                "choices": level.choices,
                **note_entries(level.notes),
            }
            for path, level in coarser
        ],
        "viewer_cameras": None if cameras_path is None else os.fspath(cameras_path),
        "ratio": numbers["num_output"] / max(numbers["num_input"], 1),
        "options": dict(report.options),
        "seed": numbers["options"]["seed"],
        "choices": numbers["choices"],
        **seconds_document({**seconds_before, **report.seconds, **seconds_after}),
        "new_views": None if report.new_views is None else report.new_views.to_dict(),
        "psnr_input_views": {"before": numbers["psnr_before"], "after": numbers["psnr_after"]},
        "psnr_reference": numbers["psnr_reference"],
        "psnr_covered": numbers["covered"],
        "psnr_photo_files": numbers["photo_files"],
        "psnr_protected": numbers["protected"],
        "peak_memory_bytes": numbers["peak_memory_bytes"],
        **note_entries([*notes, *report.notes, *(Doubt(level.worse) for _, level in coarser if level.worse)]),
        "unmet": numbers["unmet"],
        "worse": next((entry.worse for entry in (report, *(level for _, level in coarser)) if entry.worse), None),
    }


def _file_facts(path: Path, report: CompactReport, at: Mapping[Path, Sequence[Path]]) -> dict[str, Any]:
    """Return path, bytes and number of Gaussians of an output.

    ``at`` has the temporary files of outputs that are not renamed yet.
    """
    num_bytes = sum(file.stat().st_size for file in at.get(path, [path]))
    return {"path": os.fspath(path), "bytes": num_bytes, "num_gaussians": report.num_output}


def result_table(document: Mapping[str, Any], next_step: str | None = None, *, columns: int | None = None) -> list[str]:
    """Return the lines that ``compact`` prints at its end: the path, a table, and the command to run next, if any.

    Lines are broken at ``columns`` characters, except for paths and ``next_step``, which people copy.
    """
    files = (document["input"], document["output"])
    psnr = document["psnr_input_views"]
    choices = document["choices"]
    reference = document.get("psnr_reference")
    pictures = "its own photos" if reference in (None, "photos") else str(reference)  # to which the result was fitted
    # A row has a name, the value before and after, and a short explanation
    counts = [f"{file['num_gaussians']:,}" for file in files]
    sizes = [human_bytes(file["bytes"]) for file in files]
    rows = [("Gaussians", counts[0], counts[1], human_share(document["ratio"])), ("file", sizes[0], sizes[1], "")]
    if new := document["new_views"]:
        gain = f"{describe_gain(new['low'], new['high'])}, by {new['views']} photos left out"
        rows += [("new views", f"{new['before']:.1f} dB", f"{new['after']:.1f} dB", gain)]
    on_files = document.get("psnr_photo_files")
    if on_files and psnr["after"] is not None and all(f"{on_files[name]:.2f}" == f"{psnr[name]:.2f}" for name in psnr):
        on_files = None  # both numbers are printed equal to the PSNR on the changed photos
    scores = {
        "all of them" if choices.get("scored_all") else "by a sample": None if None in psnr.values() else psnr,
        "on the {:.0f} % that have Gaussians": document["psnr_covered"],
        "on its photos as their files have them": on_files,
        "on the {:.1f} % that are protected": document.get("psnr_protected"),
    }
    for words, score in scores.items():
        if score:
            name = pictures if score is psnr else ""
            about = words.format(100 * score.get("share", 0))
            rows += [(name, psnr_figure(score["before"], choices), psnr_figure(score["after"], choices), about)]
    if fidelity := choices.get("fidelity"):
        rows += [("PSNR", "", psnr_words(fidelity["psnr"]), _describe_fidelity_views(fidelity))]
    if pruned := choices.get("pruned"):
        rows += [("not used", "", f"{pruned:,}", "Gaussians of the limit: no view shows more")]
    longest = sorted(document["seconds"].items(), key=lambda item: -item[1])[:2]
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in longest)
    rows += [("time", "", seconds_line(document), f"most in {stages}")]
    figures = text_table([row[:3] for row in rows], "  ")
    # a broken line continues in the column of its explanation or, in a narrow terminal, in the column of its first
    # value
    indent = len(figures[0]) + 2 if (columns or 80) > 2 * len(figures[0]) + 4 else 13
    lines = [(f"{left}  {row[3]}".rstrip(), indent) for left, row in zip(figures, rows, strict=True)]
    for level in document["levels"]:
        text = f"{level['path']}: {level['num_gaussians']:,} Gaussians, {human_bytes(level['bytes'])}"
        if level["psnr_input_views"] is not None:
            text += f"; {pictures} {psnr_figure(level['psnr_input_views'], level['choices'])}"
        lines.append((f"{text}; {level['seconds']:.1f} s", 2))
    lines += [(line, 2) for line in curve_lines(document)]
    wrapped = [part for line, indent in lines for part in wrap_line(line, columns, indent)]
    last_texts = {"cameras": document.get("viewer_cameras"), "next": next_step}
    last_lines = [f"  {name:9}  {text}" for name, text in last_texts.items() if text is not None]
    return [document["output"]["path"], *wrapped, *last_lines]


def _describe_fidelity_views(fidelity: Mapping[str, Any]) -> str:
    """Name the views in which the PSNR against the input was measured."""
    return f"from the input in {fidelity['views']} {'held-out' if fidelity['held_out'] else 'of its'} views"


def curve_lines(document: Mapping[str, Any]) -> list[str]:
    """Return the scene's curve as a table: a row for each number of Gaussians, with PSNR and SSIM of a short fit.

    The scores are measured on photos, or patches of photos, that the fits left out. The row nearest to the number of
    Gaussians in the result is marked. Empty if no curve was measured.
    """
    points = document["choices"].get("curve")
    count = document["output"]["num_gaussians"]
    if not points:
        return []
    head = f"{'Gaussians':>12}  {'PSNR':>5}  {'SSIM':>5}"
    requested = count + document["choices"].get("pruned", 0)
    result = f"{requested:,}" if requested == count else f"{requested:,}, of which {count:,} are seen"
    nearest = min(points, key=lambda p: abs(math.log(p["count"] / max(requested, 1))))
    rows = [
        f"{p['count']:>12,}  {p['psnr']:5.2f}  {p['ssim']:5.3f}"
        + (f"  <- nearest to the result: {result}" if p is nearest else "")
        for p in points
    ]
    num_photos = document["choices"].get("curve_left_out")
    scored_on = count_words(num_photos, "photo") if num_photos else "patches of the photos"
    return [f"short fits compare counts, on {scored_on} that they left out:", head, *rows]
