"""Write evaluations as JSON with a stable schema, as CSV with one row per view, and as tables for people."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any

from gsmerge.method.raster.photos import WHOLE_SHARE
from gsmerge.runtime.documents import csv_text, document_head, note_entries, text_table, wrap_line
from gsmerge.runtime.memory import human_bytes, human_share
from gsmerge.scoring.evaluate import Evaluation, Quality, QualityPair, ResultScores
from gsmerge.scoring.fog import ALL, Fog

Row = Sequence[str]
TextTable = tuple[str, Row, Sequence[Row]]  # heading, columns, rows

SPLIT_WORDS = {"context": "input", "target": "held-out"}  # words for the views of a split
SIMPLE = ("psnr", "ssim")  # measures that are also taken over the pixels that the input covers
SCORE_COLUMNS = {"psnr": "PSNR (dB)", "ssim": "SSIM", "lpips_vgg": "LPIPS VGG", "lpips_alex": "LPIPS AlexNet"}
METRICS = tuple(field.name for field in fields(Quality))
OUTSIDE_COLUMNS = {
    "fog_near": "near fog", "fog_far": "far fog", "holes": "holes", "veil": "veil", "veil_worst": "worst veil",
    "spikes": "spikes", "strokes": "strokes",
}  # fields of Fog  # fmt: skip
# Columns that are left out of a table for a narrow terminal, in this order
OMITTED_FIRST = ("bytes each", "smaller by", "ms/view", "kept")
MASKED_SUFFIX = "_visible"  # suffix of measures over the pixels that the input views have seen
COVERED_SUFFIX = "_covered"  # suffix of measures over the pixels that the input covers
CSV_COLUMNS = (
    "schema_version", "result", "num_gaussians", "ratio", "split", "view", "visible_share",
    *METRICS, *(name + MASKED_SUFFIX for name in METRICS), *(name + COVERED_SUFFIX for name in ("share", *SIMPLE)),
    *OUTSIDE_COLUMNS,
)  # fmt: skip


def evaluation_document(
    evaluation: Evaluation, facts: Mapping[str, Mapping[str, Any]], notes: Sequence[str] = ()
) -> dict[str, Any]:
    """Convert an evaluation to plain JSON types, with further facts on each result, such as path and bytes.

    The document has version, tool, reference, numbers of views, results and notes. A result has its facts, count,
    ratio, render seconds, fog, holes, veils and spikes (null for the input), means by split, and a score for each view.
    ``photo_side`` is present unless 0, ``antialiased`` if all results, or a result, are drawn so, and ``lpips_views``
    if some split has views without LPIPS. Within a schema version keys may be added, but not removed.
    """
    num_views = evaluation.options.lpips_views
    some_lpips = evaluation.options.lpips and num_views and num_views < max(evaluation.num_views.values())
    return {
        **document_head(),
        "reference": evaluation.reference,
        **({"photo_side": evaluation.options.photo_side} if evaluation.options.photo_side else {}),
        **({"antialiased": True} if all(result.antialiased for result in evaluation.results) else {}),
        **({"lpips_views": num_views} if some_lpips else {}),
        "num_views": dict(evaluation.num_views),
        "results": [_result_entries(result, evaluation, facts.get(result.name, {})) for result in evaluation.results],
        **note_entries([*notes, *evaluation.notes]),
    }


def _result_entries(result: ResultScores, evaluation: Evaluation, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a document for one result: its ``facts`` and its scores."""
    return {
        "name": result.name,
        **facts,
        "num_gaussians": result.num_gaussians,
        **({"antialiased": True} if result.antialiased else {}),
        "ratio": result.ratio,
        "render_seconds": round(result.render_seconds, 5),
        **asdict(result.fog.get(ALL, Fog())),
        "fog_by_kind": {kind: asdict(fog) for kind, fog in result.fog.items() if kind != ALL},
        "mean": {
            split: _quality_entries(result.mean(split)) | _covered_entries(*result.mean_covered(split))
            for split in evaluation.num_views
        },
        "views": [
            {
                "split": s.split,
                "view": s.view,
                "visible_share": s.visible,
                **_quality_entries((s.full, s.masked)),
                **_covered_entries(s.covered_share, s.covered),
            }
            for s in result.scores
        ],
    }


def _covered_entries(share: float | None, quality: Quality) -> dict[str, float | None]:
    """Return the entries for the share of the pixels that the input covers, and for the scores over these pixels."""
    return {"share" + COVERED_SUFFIX: share} | {name + COVERED_SUFFIX: getattr(quality, name) for name in SIMPLE}


def _quality_entries(pair: QualityPair) -> dict[str, float | None]:
    """Return the entries for the scores over all pixels, and over the pixels that the input views have seen."""
    full, masked = map(asdict, pair)
    return full | {name + MASKED_SUFFIX: value for name, value in masked.items()}


def evaluation_csv(document: Mapping[str, Any]) -> str:
    """Format the document of an evaluation as CSV with one row per result and view; missing measures are empty."""
    rows = []
    for result in document["results"]:
        shared = {"schema_version": document["schema_version"], "result": result["name"]}
        shared |= {name: result[name] for name in ("num_gaussians", "ratio", *OUTSIDE_COLUMNS)}
        rows += [shared | view for view in result["views"]]
    return csv_text(CSV_COLUMNS, rows)


def evaluation_tables(document: Mapping[str, Any]) -> Iterator[TextTable]:
    """Yield the text tables of an evaluation, each as a heading, columns and rows."""
    results = document["results"]
    sizes = []
    input_size = results[0].get("bytes")
    for result in results:
        size = result.get("bytes")
        bytes_by_attribute = result.get("bytes_by_attribute", {})
        bytes_each = sum(bytes_by_attribute.values()) / max(result["num_gaussians"], 1)
        sizes.append((
            result["name"],
            f"{result['num_gaussians']:,}",
            human_share(result["ratio"]),
            "" if size is None else human_bytes(size),
            "" if result is results[0] or not (size and input_size) else f"{input_size / size:.1f} x",
            f"{bytes_each:.1f}" if bytes_each else "",
            f"{1000 * result['render_seconds']:.1f}",
        ))  # fmt: skip
    yield "Size", ("", "Gaussians", "kept", "file", "smaller by", "bytes each", "ms/view"), sizes
    for split in document["num_views"]:
        yield from _quality_tables(document, split)
    outside = [(result["name"], *(_format_score(result[name]) for name in OUTSIDE_COLUMNS)) for result in results]
    heading = "Faults seen from outside that the input does not have: shares of the picture, less is better"
    yield heading, ("", *OUTSIDE_COLUMNS.values()), [row for row in outside if any(row[1:])]


def _quality_tables(document: Mapping[str, Any], split: str) -> Iterator[TextTable]:
    """Yield two tables of the mean scores over a split's views.

    The first table is over the pixels that the input views have seen, and the second table over the pixels that the
    input covers. The second table has no rows if the input covers nearly all pixels.
    """
    results = document["results"]
    count = document["num_views"][split]
    quality = "Quality" if "target" in document["num_views"] else "No view was held out: quality"
    views = f"{quality} of {count} {SPLIT_WORDS[split]} view{'s' * (count > 1)}"
    means = [(result["name"], result["mean"][split]) for result in results]
    # The heading ends with the options that change scores
    seen = f"against {document['reference']}, over the pixels that the input views have seen"
    seen += ", rendered antialiased" if document.get("antialiased") else ""
    seen += f", of photos with at most {document['photo_side']} pixels per side" if "photo_side" in document else ""
    seen += f", LPIPS on {document['lpips_views']} views" if "lpips_views" in document else ""
    yield f"{views}, {seen}", ("", *SCORE_COLUMNS.values()), [(name, *_format_figures(mean)) for name, mean in means]
    input_mean = next(iter(results[0]["mean"].values()))  # over the input views, if they are measured
    lacks_pixels = (input_mean["share" + COVERED_SUFFIX] or 1) < WHOLE_SHARE
    heading = f"{views}, over the pixels that have Gaussians of the input"
    yield heading, ("", "of all", *(SCORE_COLUMNS[name] for name in SIMPLE)), [
        (name, f"{100 * mean['share' + COVERED_SUFFIX]:.0f} %", *_format_figures(mean, SIMPLE, COVERED_SUFFIX))
        for name, mean in (means if lacks_pixels else [])
    ]  # fmt: skip


def _format_figures(
    score: Mapping[str, Any], names: Iterable[str] = METRICS, suffix: str = MASKED_SUFFIX
) -> Iterator[str]:
    """Yield the values ``NAME + suffix`` of a score as text, for each of ``names``; missing values become ""."""
    for name in names:
        yield _format_score(score[name + suffix], 2 if name == "psnr" else 3)


def _format_score(value: float | None, digits: int = 3) -> str:
    """Format a number; "" for None."""
    return "" if value is None else f"{value:.{digits}f}"


def evaluation_lines(document: Mapping[str, Any], columns: int | None = None) -> list[str]:
    """Format the tables of an evaluation as lines for a terminal that is ``columns`` letters wide; None: unlimited."""
    lines = list[str]()
    for heading, columns_of_table, all_rows in evaluation_tables(document):
        if not all_rows:
            continue
        filled = [i for i in range(len(columns_of_table)) if i == 0 or any(row[i] for row in all_rows)]
        head = [columns_of_table[i] for i in filled]
        rows = [[row[i] for i in filled] for row in all_rows]
        omitted_first = [head.index(name) for name in OMITTED_FIRST if name in head]
        lines += wrap_line(heading, columns, 2)
        lines += text_table([head, *rows], "  ", letters=columns, omitted_first=omitted_first)
    return lines
