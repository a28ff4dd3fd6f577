"""Reports of a run: a JSON document with a stable schema, and lines for people."""

from __future__ import annotations

import csv
import hashlib
import html
import io
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsmerge import __version__
from gsmerge.runtime.memory import human_bytes

if TYPE_CHECKING:
    from gsmerge.compaction.result import CompactReport

SCHEMA_VERSION = 1


def file_sha256(*paths: Path) -> str:
    """Return the hexadecimal SHA-256 of a file, or of several, one after the other."""
    digest = hashlib.sha256()
    for path in paths:
        with open(path, "rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def document_head() -> dict[str, Any]:
    """Return the first entries of every JSON document."""
    return {"schema_version": SCHEMA_VERSION, "tool": {"name": "gsmerge", "version": __version__}}


def report_document(
    report: CompactReport,
    *,
    input_paths: Sequence[Path],
    output_path: Path,
    seconds_before: Mapping[str, float],
    seconds_after: Mapping[str, float],
    coarser: Sequence[tuple[Path, CompactReport]] = (),
    recognised: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
    hashed: bool = True,
    written_at: Mapping[Path, Sequence[Path]] | None = None,
    cameras_path: Path | None = None,
) -> dict[str, Any]:
    """Return the report of one ``compact`` run as plain JSON types.

    ``seconds_before`` and ``seconds_after``: wall time by name before the report's stages (imports,
    reading) and after them (writing). ``coarser``: file and report of each further level of detail.
    ``recognised``: facts about the input besides path, bytes and count. ``notes``: of the reader,
    before the report's own. ``hashed``: also hash the input, which takes time on large files.
    ``written_at``: the files of an output, as they are before they are renamed. ``cameras_path``: the file of
    the views for viewers, if any.

    Returns:
        ``schema_version`` 1, within which keys are only ever added. ``unmet``: why a target is not met, or null.
        ``psnr_reference``: what ``psnr_input_views`` are measured against: "photos", or what stands in for them.
        ``psnr_covered``: ``share``, ``before``, ``after`` over the pixels that the input covers, where it lacks some.
        ``worse``: that the result, or the first level that does, shows the photos worse than the input, or null.
    """
    numbers, at = asdict(report), written_at or {}
    return {
        **document_head(),
        "input": {
            "path": os.fspath(input_paths[0]),
            "sha256": file_sha256(*input_paths) if hashed else None,
            "bytes": sum(path.stat().st_size for path in input_paths),
            "num_gaussians": numbers["num_input"],
            **(recognised or {}),
        },
        "output": _file_facts(output_path, report, at),
        "levels": [
            {
                **_file_facts(path, level, at),
                "psnr_input_views": level.psnr_after,
                "psnr_covered": level.covered and asdict(level.covered),
                "seconds": round(sum(level.seconds.values()), 4),
                "choices": level.choices,
                "notes": level.notes,
            }
            for path, level in coarser
        ],
        "viewer_cameras": None if cameras_path is None else os.fspath(cameras_path),
        "ratio": numbers["num_output"] / max(numbers["num_input"], 1),
        "options": dict(report.options),
        "seed": numbers["options"]["seed"],
        "choices": numbers["choices"],
        **seconds_document({**seconds_before, **report.seconds, **seconds_after}),
        "psnr_input_views": {"before": numbers["psnr_before"], "after": numbers["psnr_after"]},
        "psnr_reference": numbers["psnr_reference"],
        "psnr_covered": numbers["covered"],
        "peak_memory_bytes": numbers["peak_memory_bytes"],
        "notes": [*notes, *numbers["notes"]],
        "unmet": numbers["unmet"],
        "worse": next((entry.worse for entry in (report, *(level for _, level in coarser)) if entry.worse), None),
    }


def _file_facts(path: Path, report: CompactReport, at: Mapping[Path, Sequence[Path]]) -> dict[str, Any]:
    num_bytes = sum(file.stat().st_size for file in at.get(path, [path]))
    return {"path": os.fspath(path), "bytes": num_bytes, "num_gaussians": report.num_output}


def to_json(document: Mapping[str, Any]) -> str:
    """Format a document as strict, indented JSON with a closing newline; infinities become null."""
    return json.dumps(finite(document), indent=2, allow_nan=False) + "\n"


def finite(value: Any) -> Any:
    """Return plain JSON types with None in place of infinities and NaN."""
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not (abs(value) < float("inf")):
        return None
    return value


def csv_cell(value: Any) -> Any:
    """Return a value for a CSV table: "" for None; a quote precedes text that a spreadsheet would execute."""
    if value is None:
        return ""
    return f"'{value}" if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r", "\n") else value


def csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Write rows as comma-separated values under a line of column names; keys without a column are ignored."""
    out = io.StringIO()
    writer = csv.DictWriter(out, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: csv_cell(value) for name, value in row.items()} for row in rows)
    return out.getvalue()


def text_table(rows: Sequence[Sequence[str]], indent: str = "") -> list[str]:
    """Write rows as lines for a terminal, with the first column left-aligned and others right-aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [indent + "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows]


def html_table(rows: Sequence[Sequence[str]]) -> str:
    """Write rows as an HTML table for notebooks, with the first column left-aligned and others right-aligned."""

    def cell(text: str, side: str) -> str:
        return f'<td style="text-align:{side}">{html.escape(text)}</td>'

    lines = [cell(row[0], "left") + "".join(cell(text, "right") for text in row[1:]) for row in rows]
    return f"<table>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>"


def summary_lines(document: Mapping[str, Any]) -> list[str]:
    """Return the closing lines of ``compact``: the result, each coarser level, and the curve if it was measured."""
    return [summary_line(document), *level_lines(document), *curve_lines(document)]


def result_table(document: Mapping[str, Any], next_step: str | None = None) -> list[str]:
    """Return the closing table of ``compact`` in a terminal, at most 80 columns wide, with a ``next_step`` if any."""
    before, after, psnr = document["input"], document["output"], document["psnr_input_views"]
    ratio = f"{100 * document['ratio']:.2f} %"
    rows = [
        ("Gaussians", f"{before['num_gaussians']:,}", f"{after['num_gaussians']:,}", ratio),
        ("file", human_bytes(before["bytes"]), human_bytes(after["bytes"]), ""),
    ]
    if psnr["before"] is not None and psnr["after"] is not None:
        views = f"in {document['choices']['scored_views']} of the input views{_against(document)}"
        rows += [("PSNR", f"{psnr['before']:.2f} dB", f"{psnr['after']:.2f} dB", views)]
    if covered := document["psnr_covered"]:
        share = f"on the {100 * covered['share']:.0f} % that the input covers"
        rows += [("", f"{covered['before']:.2f} dB", f"{covered['after']:.2f} dB", share)]
    judged = document["choices"].get("fidelity")
    if judged:
        rows += [("PSNR", "", f"{judged['psnr']:.2f} dB", _judged_by(judged))]
    longest = sorted(document["seconds"].items(), key=lambda item: -item[1])[:2]
    stages = ", ".join(f"{name} {seconds:.1f}" for name, seconds in longest)
    rows += [("time", "", f"{document['total_seconds']:.1f} s", f"most in {stages}")]
    table = [f"  {name:9}  {old:>12}  {new:>12}  {remark}".rstrip() for name, old, new, remark in rows]
    curve = curve_lines(document)
    cameras = document.get("viewer_cameras")
    last = [] if cameras is None else [f"  cameras    {cameras}"]
    last += [] if next_step is None else [f"  next       {next_step}"]
    return [after["path"], *table, *level_lines(document), *curve, *last]


def _judged_by(fidelity: Mapping[str, Any]) -> str:
    return f"against the input from {fidelity['views']} held-out views"


def level_lines(document: Mapping[str, Any]) -> list[str]:
    """Return one line of text for each coarser level of detail."""
    return [
        f"{level['path']}: {level['num_gaussians']:,} Gaussians, {human_bytes(level['bytes'])}"
        + (f"; input views {level['psnr_input_views']:.2f} dB" if level["psnr_input_views"] is not None else "")
        + f"; {level['seconds']:.1f} s"
        for level in document["levels"]
    ]


def curve_lines(document: Mapping[str, Any]) -> list[str]:
    """Return the scene's curve as a small table: quality of short fits on held-out patches of the photos.

    The row nearest the number of Gaussians in the result is marked; the result may lie between two rows.
    """
    points, count = document["choices"].get("curve"), document["output"]["num_gaussians"]
    if not points:
        return []
    perceptual = points[0]["lpips"] is not None
    head = f"{'Gaussians':>12}  {'PSNR':>5}  {'SSIM':>5}" + ("  LPIPS (AlexNet)" if perceptual else "")
    nearest = min(points, key=lambda p: abs(math.log(p["count"] / max(count, 1))))
    rows = [
        f"{p['count']:>12,}  {p['psnr']:5.2f}  {p['ssim']:5.3f}"
        + (f"  {p['lpips']:5.3f}" if perceptual else "")
        + (f"  <- the result has {count:,}" if p is nearest else "")
        for p in points
    ]
    return ["after short fits, on patches of the photos that they left out:", head, *rows]


def summary_line(document: Mapping[str, Any]) -> str:
    """Return the line of the result: counts, ratio, bytes, PSNR, seconds per stage, the cameras beside it."""
    before, after = document["input"], document["output"]
    psnr, path = document["psnr_input_views"], document.get("viewer_cameras")
    cameras = f"; cameras for viewers in {os.path.basename(path)}" if path else ""
    judged = document["choices"].get("fidelity")
    quality = (
        f"; input views {psnr['before']:.2f} -> {psnr['after']:.2f} dB"
        if psnr["before"] is not None and psnr["after"] is not None
        else f"; {judged['psnr']:.2f} dB {_judged_by(judged)}"
        if judged
        else ""
    )
    quality += _against(document)
    if covered := document["psnr_covered"]:
        share = f"on the {100 * covered['share']:.0f} % of their pixels that the input covers"
        quality += f", {covered['before']:.2f} -> {covered['after']:.2f} dB {share}"
    return (
        f"{after['path']}: {before['num_gaussians']:,} -> {after['num_gaussians']:,} Gaussians"
        f" ({100 * document['ratio']:.2f} %), {human_bytes(before['bytes'])} -> {human_bytes(after['bytes'])}"
        f"{quality}; {seconds_line(document)}{cameras}"
    )


def _against(document: Mapping[str, Any]) -> str:
    """Return what PSNR is measured against, unless that is photos."""
    reference = document.get("psnr_reference")
    return "" if reference in (None, "photos") else f" against {reference}"


def seconds_document(seconds: Mapping[str, float]) -> dict[str, Any]:
    """Return the wall time by stage and in total, in the form of all reports."""
    total = round(sum(seconds.values()), 4)
    return {"seconds": {name: round(value, 4) for name, value in seconds.items()}, "total_seconds": total}


def seconds_line(document: Mapping[str, Any]) -> str:
    """Return a report's seconds as text: ``2.3 s (read 0.70, ...)``."""
    stages = ", ".join(f"{name} {value:.2f}" for name, value in document["seconds"].items())
    return f"{document['total_seconds']:.1f} s ({stages})"
