"""Write the parts that all reports share: the head of JSON documents, JSON, CSV, tables for people, and seconds."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gsmerge.errors import Doubt, list_doubts
from gsmerge.version import __version__

SCHEMA_VERSION = 2  # version of JSON documents; it increases if programs that read them have to change
MIN_NAME = 12  # least width, in letters, of a table's first column in a narrow terminal


def file_sha256(*paths: Path) -> str:
    """Return the hexadecimal SHA-256 of a file, or of several files read one after the other."""
    digest = hashlib.sha256()
    for path in paths:
        with open(path, "rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def document_head() -> dict[str, Any]:
    """Return the first entries of every JSON document: version of the schema, and name and version of the program."""
    return {"schema_version": SCHEMA_VERSION, "tool": {"name": "gsmerge", "version": __version__}}


def note_entries(notes: Iterable[str]) -> dict[str, Any]:
    """Return two entries of a document: all ``notes``, and the ``doubts`` among these notes."""
    notes = list(notes)
    return {"notes": notes, "doubts": list_doubts(notes)}


def note_lines(notes: Iterable[str]) -> list[str]:
    """Return a line for each note, which begins with "warning" if the note is a doubt, and otherwise with "note"."""
    return [f"{'warning' if isinstance(note, Doubt) else 'note':11}{note}" for note in notes]


def to_json(document: Mapping[str, Any]) -> str:
    """Format a document as indented JSON with a closing newline. Infinities become null, as JSON has none."""
    return json.dumps(finite(document), indent=2, allow_nan=False) + "\n"


def finite(value: Any) -> Any:
    """Convert a value and all its parts to plain JSON types, with None in place of infinities and NaN."""
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not (abs(value) < float("inf")):
        return None
    return value


def csv_cell(value: Any) -> Any:
    """Return a value as it stands in a CSV table: "" for None, and a quote before text that a spreadsheet would run."""
    if value is None:
        return ""
    return f"'{value}" if isinstance(value, str) and value[:1] in ("=", "+", "-", "@", "\t", "\r", "\n") else value


def csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Format rows as comma-separated values under a line of column names; keys without a column are ignored."""
    out = io.StringIO()
    writer = csv.DictWriter(out, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: csv_cell(value) for name, value in row.items()} for row in rows)
    return out.getvalue()


def text_table(
    rows: Sequence[Sequence[str]], indent: str = "", *, letters: int | None = None, omitted_first: Sequence[int] = ()
) -> list[str]:
    """Format rows as lines of text, with the first column left-aligned and the others right-aligned.

    Each line begins with ``indent``. ``letters`` is the width of the terminal; None: unlimited. A table that is too
    wide is reduced until it fits. The columns with the numbers ``omitted_first`` are left out first, in this order. The
    texts of the first column are shortened to ``MIN_NAME`` next. Then further columns are left out, from the last to
    the third.
    """
    max_width = 10_000  # width of a table that is not printed on a terminal
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    room = (letters or max_width) - len(indent)
    shown = list(range(len(widths)))
    for column in (*omitted_first, *reversed(shown[2:])):
        name_width = widths[0] if column in omitted_first else min(widths[0], MIN_NAME)
        if column in shown and name_width + sum(widths[i] + 2 for i in shown[1:]) > room:
            shown.remove(column)
    widths[0] = min(widths[0], max(MIN_NAME, room - sum(widths[i] + 2 for i in shown[1:])))
    cells = [[_cut(row[0], widths[0]).ljust(widths[0]), *(row[i].rjust(widths[i]) for i in shown[1:])] for row in rows]
    return [indent + "  ".join(line) for line in cells]


def _cut(text: str, width: int) -> str:
    """Shorten a text to ``width`` letters by replacing its middle with dots."""
    half = (width - 3) // 2
    return text if len(text) <= width else f"{text[: width - 3 - half]}...{text[-half:]}"


def wrap_line(line: str, columns: int | None, hang: int = 2) -> list[str]:
    """Break a line between words into lines of at most ``columns`` letters, and indent all but the first by ``hang``.

    If ``columns`` is None, the line is not broken.
    """
    if columns is None or len(line) <= columns:
        return [line]
    indent = " " * (hang if hang < columns // 2 else 2)
    return textwrap.wrap(line, columns, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def seconds_document(seconds: Mapping[str, float]) -> dict[str, Any]:
    """Return the entries of a report for the wall time in ``seconds`` by stage and in total."""
    total = round(sum(seconds.values()), 4)
    return {"seconds": {name: round(value, 4) for name, value in seconds.items()}, "total_seconds": total}


def seconds_line(document: Mapping[str, Any]) -> str:
    """Return the total seconds of a report as text."""
    return f"{document['total_seconds']:.1f} s"
