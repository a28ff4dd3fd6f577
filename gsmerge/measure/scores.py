"""An evaluation -> a JSON document with a stable schema, a CSV of one row per view, and a table for people."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any

from gsmerge.measure.align import PoseChange
from gsmerge.measure.evaluate import AlignedScore, Evaluation, Quality, ResultScores, ZoomScore
from gsmerge.report import csv_cell, document_head, human_bytes

ZOOMED = {"psnr": 2, "ssim": 3}  # what is measured at other sizes, with the decimals that people are shown
METRICS = tuple(field.name for field in fields(Quality))
MASKED = "_visible"  # suffix of what is measured over the pixels that the input views have seen
CSV_COLUMNS = (
    "schema_version", "result", "num_gaussians", "ratio", "split", "view", "visible_share",
    *METRICS, *(name + MASKED for name in METRICS),
)  # fmt: skip


def evaluation_document(
    evaluation: Evaluation, files: Mapping[str, Mapping[str, Any]], notes: Sequence[str] = ()
) -> dict[str, Any]:
    """An evaluation as plain JSON types, with what is known of each result's file (path, bytes, bytes by attribute).

    ``schema_version`` 1: tool, reference, views, results (file, count, ratio, render seconds, means by split, a score
    for each view), notes. Means and scores have ``zooms`` where other sizes than the photos' own were asked for,
    those of held-out views ``aligned`` and ``pose_change`` where that was, and ``antialiased`` is there where it is
    true. Keys are only ever added within one schema version.
    """
    return {
        **document_head(),
        "reference": evaluation.reference,
        **({"antialiased": True} if evaluation.options.antialiased else {}),
        "num_views": dict(evaluation.num_views),
        "results": [_result(one, evaluation, files.get(one.name, {})) for one in evaluation.results],
        "notes": [*notes, *evaluation.notes],
    }


def _result(one: ResultScores, evaluation: Evaluation, file: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "name": one.name,
        **file,
        "num_gaussians": one.num_gaussians,
        "ratio": one.ratio,
        "render_seconds": round(one.render_seconds, 5),
        "mean": {split: _mean(one, split, evaluation) for split in evaluation.num_views},
        "views": [
            {
                "split": s.split,
                "view": s.view,
                "visible_share": s.visible,
                **_flat(s.full, s.masked),
                **_zooms(s.zooms),
                **_aligned(s.aligned, s.pose_change),
            }
            for s in one.scores
        ],
    }


def _mean(one: ResultScores, split: str, evaluation: Evaluation) -> dict[str, Any]:
    options = evaluation.options
    sizes = () if options.zoom == (1,) else options.zoom
    ways = options.alignments if split == "target" else ()
    return {
        **_flat(*one.mean(split)),
        **_zooms([ZoomScore(zoom, *one.mean(split, zoom=zoom)) for zoom in sizes]),
        **_aligned([AlignedScore(way, *one.mean(split, align=way)) for way in ways], one.mean_pose_change(split)),
    }


def _aligned(scores: Sequence[AlignedScore], change: PoseChange | None) -> dict[str, Any]:
    """``aligned`` by way and ``pose_change``, where there are any."""
    ways = {"aligned": {one.align: _flat(one.full, one.masked) for one in scores}} if scores else {}
    return ways | ({"pose_change": asdict(change)} if change else {})


def _zooms(scores: Sequence[ZoomScore]) -> dict[str, Any]:
    """``zooms``, where there are any: a list, in the order that was asked for."""
    names = [name + suffix for suffix in ("", MASKED) for name in ZOOMED]
    flat = [(one.zoom, _flat(one.full, one.masked)) for one in scores]
    return {"zooms": [{"zoom": zoom, **{name: score[name] for name in names}} for zoom, score in flat]} if flat else {}


def _flat(full: Quality, masked: Quality) -> dict[str, float | None]:
    return {**asdict(full), **{name + MASKED: value for name, value in asdict(masked).items()}}


def evaluation_csv(document: Mapping[str, Any]) -> str:
    """One row for each result and view; empty where something was not measured.

    Columns such as ``psnr_zoom_0.5`` and ``psnr_visible_zoom_0.5`` follow where other sizes were measured, and such as
    ``psnr_align_pose``, ``pose_degrees`` and ``pose_shift`` where held-out views were aligned.
    """
    rows = []
    for result in document["results"]:
        same = {"schema_version": document["schema_version"], "result": result["name"]}
        same |= {name: result[name] for name in ("num_gaussians", "ratio")}
        rows += [same | _more_columns(view) for view in result["views"]]
    columns = dict.fromkeys(CSV_COLUMNS) | dict.fromkeys(name for row in rows for name in row)
    out = io.StringIO()
    writer = csv.DictWriter(out, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: csv_cell(value) for key, value in row.items()} for row in rows)
    return out.getvalue()


def _more_columns(view: Mapping[str, Any]) -> dict[str, Any]:
    """The score of a view, with a column for each figure at another size or after alignment."""
    row = {key: value for key, value in view.items() if key not in ("zooms", "aligned", "pose_change")}
    for score in view.get("zooms", ()):
        row |= {f"{key}_zoom_{score['zoom']:g}": value for key, value in score.items() if key != "zoom"}
    for way, score in view.get("aligned", {}).items():
        row |= {f"{key}_align_{way}": value for key, value in score.items()}
    return row | {f"pose_{key}": value for key, value in view.get("pose_change", {}).items()}


def evaluation_lines(document: Mapping[str, Any]) -> list[str]:
    """A table for people: one line for each result and split, over the pixels that the input views have seen."""
    means = [mean for result in document["results"] for mean in result["mean"].values()]
    nets = [net for net in ("lpips_vgg", "lpips_alex") if any(mean[net + MASKED] is not None for mean in means)]
    width = max(6, *(len(result["name"]) for result in document["results"]))
    head = f"{'result':{width}}  {'Gaussians':>12}  {'kept':>7}  {'size':>9}  {'ms/view':>8}  {'views':<8} {'PSNR':>6}"
    head += "   SSIM" + "".join(f"  {name.replace('lpips_', 'LPIPS '):>10}" for name in nets)
    how = ", rendered antialiased" if document.get("antialiased") else ""
    lines = [f"against {document['reference']}, over the pixels that the input views have seen{how}", head]
    for result in document["results"]:
        size = human_bytes(result["bytes"]) if "bytes" in result else ""
        for split, mean in result["mean"].items():
            line = f"{result['name']:{width}}  {result['num_gaussians']:>12,}  {100 * result['ratio']:>6.2f}%"
            line += f"  {size:>9}  {1000 * result['render_seconds']:>8.1f}  {split:<8}"
            line += f" {_number(mean['psnr' + MASKED], 2):>6}  {_number(mean['ssim' + MASKED], 3)}"
            lines.append(line + "".join(f"  {_number(mean[name + MASKED], 3):>10}" for name in nets))
    return lines + _zoom_lines(document, width) + _aligned_lines(document, width, nets)


def _zoom_lines(document: Mapping[str, Any], width: int) -> list[str]:
    """PSNR and SSIM at other sizes: a line for each result and split, two columns for each size; empty without them."""
    lines: list[str] = []
    for result in document["results"]:
        for split, mean in result["mean"].items():
            sizes = mean.get("zooms", ())
            if sizes and not lines:
                names = [f"{name} {one['zoom']:g}x" for one in sizes for name in ("PSNR", "SSIM")]
                lines = ["at other sizes, photos resized", f"{'result':{width}}  {'views':<8}"]
                lines[1] += "".join(f" {name:>11}" for name in names)
            if sizes:
                cells = [_number(one[name + MASKED], digits) for one in sizes for name, digits in ZOOMED.items()]
                lines.append(f"{result['name']:{width}}  {split:<8}" + "".join(f" {cell:>11}" for cell in cells))
    return lines


def _aligned_lines(document: Mapping[str, Any], width: int, nets: Sequence[str]) -> list[str]:
    """Figures after alignment: a line for each result and way; empty without them."""
    lines: list[str] = []
    digits = {"psnr": 2, "ssim": 3, **dict.fromkeys(nets, 3)}
    for result in document["results"]:
        mean = result["mean"].get("target", {})
        for way, scores in mean.get("aligned", {}).items():
            cells = [f"  {_number(scores[name + MASKED], places):>10}" for name, places in digits.items()]
            change = mean.get("pose_change") if way == "pose" else None
            moved = f"  {change['degrees']:.2f} degrees, {100 * change['shift']:.2f}% of the depth" if change else ""
            lines.append(f"{result['name']:{width}}  {way:<8}" + "".join(cells) + moved)
    if not lines:
        return []
    names = (name.upper() if name in ZOOMED else name.replace("lpips_", "LPIPS ") for name in digits)
    head = f"{'result':{width}}  {'aligned':<8}" + "".join(f"  {name:>10}" for name in names)
    poses = any("pose_change" in result["mean"].get("target", {}) for result in document["results"])
    return ["held-out views, aligned with their photos", head + ("  cameras moved by (mean)" if poses else ""), *lines]


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
