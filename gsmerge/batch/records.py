"""The records of a batch: one JSON line for each scene, on the disk before the next scene begins."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gsmerge.errors import SceneError
from gsmerge.report import document_head, file_sha256
from gsmerge.runtime.jsonl import each_line

RECORDS, SUMMARY = "batch.jsonl", "summary.csv"
DONE, FAILED, SKIPPED = "done", "failed", "skipped"  # of records
# Of outcomes that are not recorded: another process has the scene, its process died, records cannot be written.
BUSY, LOST, STUCK = "busy", "lost", "stuck"
COLUMNS = (
    "scene", "output", "status", "num_input", "num_output", "ratio", "bytes_input", "bytes_output", "psnr_before",
    "psnr_after", "seconds", "peak_memory_bytes", "attempt", "unmet", "error",
)  # fmt: skip


@dataclass(frozen=True)
class DoneResult:
    """A result that is done."""

    key: str  # of the scene's content, the settings and the version
    files: tuple[tuple[str, str], ...]  # name in the output folder and SHA-256 of each file
    failed_since: bool = False  # whether the scene failed when it was compacted again

    def holds(self, folder: Path, key: str) -> bool:
        """Whether it was made from the same content and settings, and every file is unchanged since."""
        paths = [folder / name for name, _ in self.files]
        try:
            if self.key != key or not paths or not all(path.is_file() for path in paths):  # a pipe would never end
                return False
            return all(file_sha256(path) == sha256 for path, (_, sha256) in zip(paths, self.files, strict=True))
        except (OSError, ValueError):  # the latter of a name that no file has
            return False


@dataclass
class RecordIndex:
    """The results in a folder, updated by reading the lines that any process has added."""

    folder: Path  # the output folder
    end: int = 0  # byte up to which its records are read
    known: dict[str, DoneResult] = field(default_factory=dict)  # what is done, by name of the result
    damaged: int = 0  # lines that could not be read

    def read_on(self) -> None:
        """Read the lines that were added since."""
        for end, value in each_line(self.folder / RECORDS, self.end):
            self.end = end
            if value is None or not is_record(value):
                self.damaged += 1
                continue
            output = value["output"]
            if value["status"] == DONE:
                files = tuple((file["path"], file["sha256"]) for file in value["files"])
                self.known[output] = DoneResult(value["key"], files)
            elif value["status"] == FAILED and output in self.known:
                self.known[output] = replace(self.known[output], failed_since=True)

    def result_paths(self) -> set[str]:
        """Real paths of all results."""
        names = [name for known in self.known.values() for name, _ in known.files]
        return {os.path.realpath(self.folder / name) for name in names}


def is_record(value: Mapping[str, Any]) -> bool:
    """Whether a line is a record: anybody may have written it, and one that is none must not stop a batch."""
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
    """A record as a row of the CSV file, with None for unknown values."""
    row: dict[str, Any] = dict.fromkeys(COLUMNS)
    row |= {name: record.get(name) for name in ("scene", "output", "status", "attempt", "error")}
    report = record.get("report")
    if not report:
        return row
    psnr = report["psnr_input_views"]
    files = [*report["levels"], report["output"]]
    return row | {
        "num_input": report["input"]["num_gaussians"],
        "num_output": report["output"]["num_gaussians"],
        "ratio": report["ratio"],
        "bytes_input": report["input"]["bytes"],
        "bytes_output": sum(file["bytes"] for file in files),
        "psnr_before": psnr["before"],
        "psnr_after": psnr["after"],
        "seconds": report["total_seconds"],
        "peak_memory_bytes": report["peak_memory_bytes"],
        "unmet": report["unmet"],
    }


def record(status: str, scene: str, output: str, **facts: Any) -> dict[str, Any]:
    """A record: the keys that every line has, and ``facts``."""
    blank: dict[str, Any] = {"key": None, "files": [], "attempt": 1, "error": None, "report": None}
    place = {"host": socket.gethostname(), "pid": os.getpid()}
    return {**document_head(), "status": status, "scene": scene, "output": output, **blank, **place, **facts}


def written_files(folder: Path, names: Sequence[str]) -> list[dict[str, Any]]:
    """The files of a result, as in its record."""
    return [
        {"path": name, "sha256": file_sha256(folder / name), "bytes": (folder / name).stat().st_size} for name in names
    ]


def each_record(folder: Path) -> Iterator[dict[str, Any]]:
    """The records of a folder in their order, without damaged ones."""
    for _, value in each_line(folder / RECORDS):
        if value is not None and is_record(value):
            yield value


def check_folder(folder: Path) -> None:
    """Make the output folder, and raise a SceneError if records cannot be written to it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / RECORDS).open("ab"):
            pass
    except OSError as error:
        problem = f"cannot be written ({error.strerror})"
        raise SceneError(folder, problem, "name another folder with --output") from error
