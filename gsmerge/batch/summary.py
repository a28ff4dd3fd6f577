"""The summary of a batch: totals, a table, and a CSV file of all scenes."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsmerge.batch.records import COLUMNS, DONE, FAILED, RECORDS, SKIPPED, SUMMARY, each_record, row_of
from gsmerge.io import atomic_output
from gsmerge.report import csv_cell, human_bytes

MAX_LISTED = 20  # scenes in the table, and failures below it


@dataclass
class Totals:
    """A run so far, in a size that does not grow with the number of scenes."""

    total: int  # scenes
    counts: dict[str, int] = field(default_factory=lambda: {DONE: 0, SKIPPED: 0, FAILED: 0})  # of them by status
    num_input: int = 0  # Gaussians in the scenes that were done
    num_output: int = 0  # Gaussians in their results
    bytes_input: int = 0  # bytes of the same
    bytes_output: int = 0  # bytes of the same
    unmet: int = 0  # results that miss their target
    rows: list[dict[str, Any]] = field(default_factory=list)  # the first ones done, as in the CSV file
    failures: list[tuple[str, str]] = field(default_factory=list)  # the first scenes that failed, and why

    def add(self, record: Mapping[str, Any]) -> None:
        """Count a scene."""
        self.counts[record["status"]] += 1
        row = row_of(record)
        if record["status"] == DONE:
            self.num_input += row["num_input"]
            self.num_output += row["num_output"]
            self.bytes_input += row["bytes_input"]
            self.bytes_output += row["bytes_output"]
            self.unmet += bool(row["unmet"])
            self.rows += [row] if len(self.rows) < MAX_LISTED else []
        elif record["status"] == FAILED and len(self.failures) < MAX_LISTED:
            self.failures.append((str(record["scene"]), str(record["error"])))

    @property
    def ended(self) -> int:
        """Scenes that have ended."""
        return sum(self.counts.values())


def write_summary(folder: Path) -> Path:
    """Write the newest state of every scene in the folder; a SceneError if the file cannot be written."""
    records, read = folder / RECORDS, -1
    while (size := records.stat().st_size if records.exists() else 0) != read:  # other runs may add to them meanwhile
        _write_rows(folder / SUMMARY, _newest(folder))
        read = size
    return folder / SUMMARY


def _newest(folder: Path) -> list[dict[str, Any]]:
    """The newest row of every scene, by the name of its result."""
    rows: dict[str, dict[str, Any]] = {}
    done: dict[str, dict[str, Any]] = {}
    for record in each_record(folder):
        row = row_of(record)
        if record["status"] == DONE:
            done[record["output"]] = row
        rows[record["output"]] = done.get(record["output"], row) if record["status"] == SKIPPED else row
    return [rows[output] for output in sorted(rows)]


def _write_rows(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    with (
        atomic_output(path, overwrite=True) as temporary,
        temporary.open("w", newline="", encoding="utf-8", errors="backslashreplace") as file,
    ):
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: csv_cell(value) for name, value in row.items()} for row in rows)


def summary_lines(totals: Totals, path: Path | None) -> list[str]:
    """The table of a run for people."""
    lines = _table(totals.rows)
    more = totals.counts[DONE] - len(totals.rows)
    lines += [f"... and {more:,} more"] if more > 0 else []
    lines += [f"failed: {scene}: {error}" for scene, error in totals.failures]
    more = totals.counts[FAILED] - len(totals.failures)
    lines += [f"... and {more:,} more failed"] if more > 0 else []
    counts = [f"{count:,} {status}" for status, count in totals.counts.items() if count or status == DONE]
    left = totals.total - totals.ended
    line = f"{totals.total:,} scenes: {', '.join(counts)}" + (f", {left:,} left" if left else "")
    if totals.num_input:
        share = 100 * totals.num_output / totals.num_input
        line += (
            f"; {totals.num_input:,} -> {totals.num_output:,} Gaussians ({share:.2f} %),"
            f" {human_bytes(totals.bytes_input)} -> {human_bytes(totals.bytes_output)}"
        )
    line += f"; {totals.unmet:,} missed the target" if totals.unmet else ""
    return [*lines, line + (f"; all in {path}" if path is not None else "")]


def _table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    if not rows:
        return []
    cells = [("result", "Gaussians", "of", "kept", "dB before", "after", "seconds")]
    for row in sorted(rows, key=lambda row: str(row["output"])):
        quality = ["" if row[name] is None else f"{row[name]:.2f}" for name in ("psnr_before", "psnr_after")]
        share = f"{100 * row['ratio']:.2f} %"
        counts = f"{row['num_output']:,}", f"{row['num_input']:,}"
        cells.append((row["output"], *counts, share, *quality, f"{row['seconds']:.1f}"))
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in cells]
