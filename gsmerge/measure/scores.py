"""An evaluation -> a JSON document with a stable schema, a CSV of one row per view, and a table for people."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any

from gsmerge.measure.evaluate import Evaluation, Quality, ResultScores
from gsmerge.report import document_head, human_bytes

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
    for each view), notes. Keys are only ever added within one schema version.
    """
    return {
        **document_head(),
        "reference": evaluation.reference,
        "num_views": dict(evaluation.num_views),
        "results": [_result(one, evaluation.num_views, files.get(one.name, {})) for one in evaluation.results],
        "notes": [*notes, *evaluation.notes],
    }


def _result(one: ResultScores, splits: Mapping[str, int], file: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "name": one.name,
        **file,
        "num_gaussians": one.num_gaussians,
        "ratio": one.ratio,
        "render_seconds": round(one.render_seconds, 5),
        "mean": {split: _flat(*one.mean(split)) for split in splits},
        "views": [
            {"split": s.split, "view": s.view, "visible_share": s.visible, **_flat(s.full, s.masked)}
            for s in one.scores
        ],
    }


def _flat(full: Quality, masked: Quality) -> dict[str, float | None]:
    return {**asdict(full), **{name + MASKED: value for name, value in asdict(masked).items()}}


def evaluation_csv(document: Mapping[str, Any]) -> str:
    """One row for each result and view; empty where something was not measured."""
    out = io.StringIO()
    writer = csv.DictWriter(out, CSV_COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for result in document["results"]:
        same = {"schema_version": document["schema_version"], "result": result["name"]}
        same |= {name: result[name] for name in ("num_gaussians", "ratio")}
        for view in result["views"]:
            writer.writerow({**same, **{key: "" if value is None else value for key, value in view.items()}})
    return out.getvalue()


def evaluation_lines(document: Mapping[str, Any]) -> list[str]:
    """A table for people: one line for each result and split, over the pixels that the input views have seen."""
    means = [mean for result in document["results"] for mean in result["mean"].values()]
    nets = [net for net in ("lpips_vgg", "lpips_alex") if any(mean[net + MASKED] is not None for mean in means)]
    width = max(6, *(len(result["name"]) for result in document["results"]))
    head = f"{'result':{width}}  {'Gaussians':>12}  {'kept':>7}  {'size':>9}  {'ms/view':>8}  {'views':<8} {'PSNR':>6}"
    head += "   SSIM" + "".join(f"  {name.replace('lpips_', 'LPIPS '):>10}" for name in nets)
    lines = [f"against {document['reference']}, over the pixels that the input views have seen", head]
    for result in document["results"]:
        size = human_bytes(result["bytes"]) if "bytes" in result else ""
        for split, mean in result["mean"].items():
            line = f"{result['name']:{width}}  {result['num_gaussians']:>12,}  {100 * result['ratio']:>6.2f}%"
            line += f"  {size:>9}  {1000 * result['render_seconds']:>8.1f}  {split:<8}"
            line += f" {_number(mean['psnr' + MASKED], 2):>6}  {_number(mean['ssim' + MASKED], 3)}"
            lines.append(line + "".join(f"  {_number(mean[name + MASKED], 3):>10}" for name in nets))
    return lines


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
