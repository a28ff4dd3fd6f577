"""The summary of a batch: totals, a table, and a CSV file of all scenes."""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from gsmerge.batch.locks import LOCK_TIMEOUT, BusyError, scene_lock
from gsmerge.batch.records import COLUMNS, DONE, FAILED, SKIPPED, SUMMARY, each_record, row_of
from gsmerge.errors import SceneError
from gsmerge.io import atomic_output
from gsmerge.io.atomic import remove_leftovers
from gsmerge.report import csv_cell, human_bytes

T = TypeVar("T")
MAX_LISTED = 20  # scenes in the table, and failures below it


@dataclass
class Totals:
    """A run so far, in a size that does not grow with the number of scenes."""

    total: int  # scenes
    name: str = "scene"  # key of a record that says in messages which one it is
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
            self.failures.append((str(record[self.name]), str(record["error"])))

    @property
    def ended(self) -> int:
        """Scenes that have ended."""
        return sum(self.counts.values())


def write_summary(folder: Path) -> Path:
    """Write the newest state of every scene in the folder, after other runs that are writing it.

    A SceneError if the file cannot be written.
    """
    path = folder / SUMMARY
    deadline = time.monotonic() + LOCK_TIMEOUT
    while True:
        try:
            with scene_lock(folder, [SUMMARY]) as lock:
                remove_leftovers(path)
                _write_rows(path, [row for _, row in sorted(newest_records(folder, row_of).items())])
                lock.finish()
                return path
        except BusyError:
            if time.monotonic() > deadline:
                raise SceneError(path, "another run has been writing it for long", "run the same again") from None
            time.sleep(0.05)


def newest_records(folder: Path, keep: Callable[[dict[str, Any]], T]) -> dict[str, T]:
    """Read what to ``keep`` of the newest record of every result; of a skipped one that of the time it was done."""
    newest: dict[str, T] = {}
    done: dict[str, T] = {}
    for record in each_record(folder):
        output, kept = record["output"], keep(record)
        if record["status"] == DONE:
            done[output] = kept
        newest.pop(output, None)  # a repeated result moves to the end
        newest[output] = done.get(output, kept) if record["status"] == SKIPPED else kept
    return newest


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
