"""A comparison -> a JSON document with a stable schema, its tables, and Markdown."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from gsmerge.measure.comparison import Comparison, SceneCosts, break_even
from gsmerge.measure.scores import MASKED, evaluation_document
from gsmerge.report import document_head, human_bytes

Row = Sequence[str]


def comparison_document(comparison: Comparison, notes: Sequence[str] = ()) -> dict[str, Any]:
    """A comparison as plain JSON types.

    ``schema_version`` 1: tool, before, after (storage, factors, speeds, overdraw, merge seconds, break-even frames),
    quality as of ``evaluate``, notes. Keys are only ever added within one schema version.
    """
    sides = (comparison.before, *comparison.after)
    files = {side.name: {"path": side.storage.path, "bytes": side.storage.bytes} for side in sides}
    quality = evaluation_document(comparison.quality, files)
    return {
        **document_head(),
        "before": _side(comparison.before, comparison.before),
        "after": [_side(side, comparison.before) for side in comparison.after],
        "quality": {name: quality[name] for name in ("reference", "num_views", "results")},
        "notes": [*notes, *quality["notes"]],
    }


def _side(side: SceneCosts, before: SceneCosts) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "name": side.name,
        **asdict(side.storage),
        "bytes_per_gaussian": round(side.storage.bytes_each, 3),
        "overdraw": round(side.overdraw, 3),
        "speeds": [{**asdict(speed), "seconds": round(speed.seconds, 6)} for speed in side.speeds],
    }
    if side is before:
        return facts
    facts["factors"] = {
        "bytes": before.storage.bytes / max(side.storage.bytes, 1),
        "count": before.storage.num_gaussians / max(side.storage.num_gaussians, 1),
        "bytes_per_gaussian": before.storage.bytes_each / max(side.storage.bytes_each, 1e-9),
    }
    facts["merge_seconds"] = merge = side.merge_seconds
    for speed, own, base in zip(facts["speeds"], side.speeds, before.speeds, strict=True):
        speed["speedup"] = base.seconds / own.seconds
        speed["break_even_frames"] = None if merge is None else break_even(merge, base.seconds, own.seconds)
    return facts


def comparison_tables(document: Mapping[str, Any]) -> Iterator[tuple[str, Row, list[Row]]]:
    """Heading, columns and rows of each table, for people."""
    sides = [document["before"], *document["after"]]
    rows: list[Row] = []
    for side in sides:
        factors = side.get("factors")
        cells = [f"{factors[name]:.1f} x" if factors else "" for name in ("bytes", "count", "bytes_per_gaussian")]
        count, each = f"{side['num_gaussians']:,}", f"{side['bytes_per_gaussian']:.1f}"
        rows.append((side["name"], count, each, human_bytes(side["bytes"]), *cells))
    head = ("", "Gaussians", "bytes each", "file", "smaller by", "of it by count", "by bytes each")
    yield "Storage", head, rows
    names = list(dict.fromkeys(name for side in sides for name in side["by_attribute"]))
    rows = [(side["name"], *(human_bytes(side["by_attribute"].get(name, 0)) for name in names)) for side in sides]
    yield "Bytes by attribute", ("", *names), rows
    yield "Rendering", ("", "device", "size", "ms a frame", "faster by", "earned back after"), list(_speed_rows(sides))
    rows = [(side["name"], f"{side['overdraw']:.1f}") for side in sides]
    yield "Overdraw", ("", "Gaussians blended into a pixel"), rows
    yield _quality_table(document["quality"])


def _speed_rows(sides: Sequence[Mapping[str, Any]]) -> Iterator[Row]:
    for side in sides:
        for speed in side["speeds"]:
            threads = f", {speed['threads']} threads" if speed["threads"] else ""
            faster = f"{speed['speedup']:.1f} x" if "speedup" in speed else ""
            frames = speed.get("break_even_frames")
            merge, earned = side.get("merge_seconds"), ""
            if merge is not None:
                earned = "never" if frames is None else f"{frames:,.0f} frames ({merge:.1f} s of merging)"
            size = f"{speed['width']} x {speed['height']}"
            yield side["name"], speed["device"] + threads, size, f"{1000 * speed['seconds']:.1f}", faster, earned


def _quality_table(quality: Mapping[str, Any]) -> tuple[str, Row, list[Row]]:
    digits = {"psnr": 2, "ssim": 3, "lpips_vgg": 3, "lpips_alex": 3}
    rows: list[Row] = []
    for result in quality["results"]:
        for split, mean in result["mean"].items():
            values = [mean[name + MASKED] for name in digits]
            cells = ("-" if v is None else f"{v:.{d}f}" for v, d in zip(values, digits.values(), strict=True))
            rows.append((result["name"], f"{split} ({quality['num_views'][split]})", *cells))
    title = f"Quality against {quality['reference']}, over the pixels that the input views have seen"
    return title, ("", "views", "PSNR (dB)", "SSIM", "LPIPS VGG", "LPIPS AlexNet"), rows


def comparison_markdown(document: Mapping[str, Any]) -> str:
    """The comparison for people, in Markdown."""
    lines = [f"# {_plain(document['before']['path'])}: before and after", ""]
    for title, head, rows in comparison_tables(document):
        lines += [f"## {title}", "", _line(head), _line(["---", *["---:"] * (len(head) - 1)]), *map(_line, rows), ""]
    lines += [f"- {_plain(note)}" for note in document["notes"]]
    return "\n".join(lines).rstrip() + "\n"


def _line(cells: Row) -> str:
    return "| " + " | ".join(_plain(cell).replace("|", "\\|") for cell in cells) + " |"


def _plain(text: str) -> str:
    """Text that is one line and no HTML in Markdown."""
    return " ".join(html.escape(text, quote=False).split())
