"""Records of a batch, one JSON line per scene written before the next begins, and their summary for people."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from gsmerge.errors import SceneError
from gsmerge.io import atomic_output
from gsmerge.io.bounds import check_file
from gsmerge.io.jsonl import each_line
from gsmerge.report import csv_text, document_head, file_sha256, human_bytes, text_table

RECORDS, SUMMARY = "batch.jsonl", "summary.csv"
DONE, FAILED, SKIPPED = "done", "failed", "skipped"  # of records
# Of outcomes that are not recorded: another process has the scene, records cannot be written.
BUSY, STUCK = "busy", "stuck"
COLUMNS = (
    "scene", "output", "status", "num_input", "num_output", "ratio", "bytes_input", "bytes_output", "psnr_before",
    "psnr_after", "psnr_reference", "covered_share", "psnr_covered_before", "psnr_covered_after", "seconds",
    "peak_memory_bytes", "attempt", "unmet", "worse", "error",
)  # fmt: skip
T = TypeVar("T")
MAX_LISTED = 20  # scenes in the table, and failures below it


@dataclass(frozen=True)
class DoneResult:
    """The record of a finished result."""

    key: str  # of the scene's content, the settings and the version
    files: tuple[tuple[str, str], ...]  # name in the output folder and SHA-256 of each file
    failed_since: bool = False  # whether the scene failed when it was compacted again
    worse: str | None = None  # that it shows its photos worse than its input

    def holds(self, folder: Path, key: str) -> bool:
        """Return whether the key is the same and every file of the result is unchanged."""
        paths = [folder / name for name, _ in self.files]
        try:
            if self.key != key or not paths or not all(path.is_file() for path in paths):  # a pipe would never end
                return False
            return all(file_sha256(path) == sha256 for path, (_, sha256) in zip(paths, self.files, strict=True))
        except (OSError, ValueError):  # the latter of a name that no file has
            return False


@dataclass
class RecordIndex:
    """Index of the finished results in a folder, updated with records that any process has added."""

    folder: Path  # the output folder
    end: int = 0  # byte up to which its records are read
    known: dict[str, DoneResult] = field(default_factory=dict)  # what is done, by name of the result
    damaged: int = 0  # lines that could not be read

    def read_on(self) -> None:
        """Read the records added since the last call."""
        for end, value in each_line(self.folder / RECORDS, self.end):
            self.end = end
            if value is None or not is_record(value):
                self.damaged += 1
                continue
            output = value["output"]
            if value["status"] == DONE:
                files = tuple((file["path"], file["sha256"]) for file in value["files"])
                self.known[output] = DoneResult(value["key"], files, worse=row_of(value)["worse"])
            elif value["status"] == FAILED and output in self.known:
                self.known[output] = replace(self.known[output], failed_since=True)

    def result_paths(self) -> set[str]:
        """Return the real paths of all results."""
        names = [name for result in self.known.values() for name, _ in result.files]
        return {os.path.realpath(self.folder / name) for name in names}


def is_record(value: Mapping[str, Any]) -> bool:
    """Return whether a parsed line is a valid record."""
    try:
        texts = [value["scene"], value["output"]]
        texts += [text for file in value["files"] for text in (file["path"], file["sha256"])]
        if value["status"] == DONE:
            texts.append(value["key"])
            if not value["report"]:
                return False
        cells = row_of(value).values()
        for text in texts:
            os.fsencode(text.replace("\0", "\ud800"))  # neither may be in the name of a file
    except (KeyError, TypeError, AttributeError, ArithmeticError, UnicodeEncodeError):
        return False
    plain = all(isinstance(cell, str | int | float | None) for cell in cells)
    return plain and value["status"] in (DONE, FAILED, SKIPPED)


def row_of(record: Mapping[str, Any]) -> dict[str, Any]:
    """Convert a record to a row of the CSV file, with None for unknown values."""
    row: dict[str, Any] = dict.fromkeys(COLUMNS)
    row |= {name: record.get(name) for name in ("scene", "output", "status", "attempt", "error")}
    report = record.get("report")
    if not report:
        return row
    psnr, covered = report["psnr_input_views"], report.get("psnr_covered") or {}  # former versions have no latter
    files = [*report["levels"], report["output"]]
    return row | {
        "num_input": report["input"]["num_gaussians"],
        "num_output": report["output"]["num_gaussians"],
        "ratio": report["ratio"],
        "bytes_input": report["input"]["bytes"],
        "bytes_output": sum(file["bytes"] for file in files),
        "psnr_before": psnr["before"],
        "psnr_after": psnr["after"],
        "psnr_reference": report.get("psnr_reference"),
        "covered_share": covered.get("share"),
        "psnr_covered_before": covered.get("before"),
        "psnr_covered_after": covered.get("after"),
        "seconds": report["total_seconds"],
        "peak_memory_bytes": report["peak_memory_bytes"],
        "unmet": report["unmet"],
        "worse": report.get("worse"),  # records of former versions lack it
    }


def record(status: str, scene: str, output: str, **facts: Any) -> dict[str, Any]:
    """Make a record: the keys of every record, and ``facts``."""
    blank: dict[str, Any] = {"key": None, "files": [], "attempt": 1, "error": None, "report": None}
    place = {"host": socket.gethostname(), "pid": os.getpid()}
    return {**document_head(), "status": status, "scene": scene, "output": output, **blank, **place, **facts}


def check_folder(folder: Path) -> None:
    """Make the output folder, and check that records can be written to it; SceneError if not."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        records = folder / RECORDS
        if records.exists():
            check_file(records)  # a pipe waits for its reader
        with records.open("ab"):
            pass
    except OSError as error:
        problem = f"cannot be written ({error.strerror})"
        raise SceneError(folder, problem, "name another folder with --output") from error


@dataclass
class Totals:
    """Totals of a run so far, in a size that does not grow with the number of scenes."""

    total: int  # scenes
    name: str = "scene"  # key of a record that says in messages which one it is
    counts: dict[str, int] = field(default_factory=lambda: {DONE: 0, SKIPPED: 0, FAILED: 0})  # of them by status
    num_input: int = 0  # Gaussians in the scenes that were done
    num_output: int = 0  # Gaussians in their results
    bytes_input: int = 0  # bytes of the same
    bytes_output: int = 0  # bytes of the same
    unmet: int = 0  # results that miss their target
    num_worse: int = 0  # results, of this run or skipped, that show their photos worse than their input
    worse: list[tuple[str, str]] = field(default_factory=list)  # the first of them, and what their reports say
    rows: list[dict[str, Any]] = field(default_factory=list)  # the first ones done, as in the CSV file
    failures: list[tuple[str, str]] = field(default_factory=list)  # the first scenes that failed, and why

    def add(self, record: Mapping[str, Any]) -> None:
        """Count the record of one scene."""
        self.counts[record["status"]] += 1
        row = row_of(record)
        worse = row["worse"] or record.get("worse")
        if worse:
            self.num_worse += 1
            self.worse += [(str(record[self.name]), str(worse))] if len(self.worse) < MAX_LISTED else []
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
        """Number of scenes that have finished or failed."""
        return sum(self.counts.values())


def write_summary(folder: Path) -> Path:
    """Write the CSV summary with the newest record of every scene; SceneError if that fails."""
    records, read = folder / RECORDS, -1
    while (size := records.stat().st_size if records.exists() else 0) != read:  # other runs may add to them meanwhile
        rows = [row for _, row in sorted(newest_records(folder, row_of).items())]
        with atomic_output(folder / SUMMARY, overwrite=True) as temporary:
            temporary.write_text(csv_text(COLUMNS, rows), encoding="utf-8", errors="backslashreplace", newline="")
        read = size
    return folder / SUMMARY


def newest_records(folder: Path, keep: Callable[[dict[str, Any]], T]) -> dict[str, T]:
    """Return ``keep(record)`` of every result's newest record; for a skipped result, of its finished record."""
    newest: dict[str, T] = {}
    done: dict[str, T] = {}
    for _, record in each_line(folder / RECORDS):
        if record is None or not is_record(record):
            continue
        output, kept = record["output"], keep(record)
        if record["status"] == DONE:
            done[output] = kept
        newest.pop(output, None)  # a repeated result moves to the end
        newest[output] = done.get(output, kept) if record["status"] == SKIPPED else kept
    return newest


def summary_lines(totals: Totals, path: Path | None) -> list[str]:
    """Format the totals of a run as lines of a table."""
    worse = [f"worse: {scene}: {why}" for scene, why in totals.worse]
    failed = [f"failed: {scene}: {error}" for scene, error in totals.failures]
    lines = list[str]()
    for count, listed, shown, what in (
        (totals.counts[DONE], len(totals.rows), _table(totals.rows), ""),
        (totals.num_worse, len(worse), worse, " worse"),
        (totals.counts[FAILED], len(failed), failed, " failed"),
    ):
        lines += [*shown, *([f"... and {count - listed:,} more{what}"] if count > listed else [])]
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
    line += f"; {totals.num_worse:,} worse than the input" if totals.num_worse else ""
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
    return text_table(cells)
