"""What all reports share: the head of JSON documents, strict JSON, CSV, tables for people, seconds by stage."""

from __future__ import annotations

import csv
import hashlib
import html
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gsmerge import __version__

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


def seconds_document(seconds: Mapping[str, float]) -> dict[str, Any]:
    """Return the wall time by stage and in total, in the form of all reports."""
    total = round(sum(seconds.values()), 4)
    return {"seconds": {name: round(value, 4) for name, value in seconds.items()}, "total_seconds": total}


def seconds_line(document: Mapping[str, Any]) -> str:
    """Return a report's seconds as text: ``2.3 s (read 0.70, ...)``."""
    stages = ", ".join(f"{name} {value:.2f}" for name, value in document["seconds"].items())
    return f"{document['total_seconds']:.1f} s ({stages})"
