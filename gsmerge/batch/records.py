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


@dataclass(frozen=True)
class DoneResult:
    """A result that is done."""

    key: str  # of the scene's content, the settings and the version
    files: tuple[tuple[str, str], ...]  # name in the output folder and SHA-256 of each file
    failed_since: bool = False  # whether the scene failed when it was compacted again

    def holds(self, folder: Path, key: str) -> bool:
        """Whether it was made from the same content and settings, and every file is unchanged since."""
        try:
            return self.key == key and all(file_sha256(folder / name) == sha256 for name, sha256 in self.files)
        except OSError:
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
            if value is None:
                self.damaged += 1
                continue
            output, result = value.get("output"), _done_result(value)
            if result is not None:
                self.known[str(output)] = result
            elif value.get("status") == FAILED and output in self.known:
                self.known[output] = replace(self.known[output], failed_since=True)

    def result_paths(self) -> set[str]:
        """Real paths of all results."""
        names = [name for known in self.known.values() for name, _ in known.files]
        return {os.path.realpath(self.folder / name) for name in names}


def _done_result(value: Mapping[str, Any]) -> DoneResult | None:
    """The result of a record; None for one of another kind."""
    if value.get("status") != DONE:
        return None
    try:
        files = tuple((str(file["path"]), str(file["sha256"])) for file in value["files"])
        return DoneResult(str(value["key"]), files) if "output" in value else None
    except (KeyError, TypeError):
        return None


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
        if value is not None and {"status", "scene", "output"} <= value.keys():
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
