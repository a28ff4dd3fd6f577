"""Read and make the records of a batch: a line of JSON for each result that was made or failed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, field
from gsmerge.io.bounds import check_file
from gsmerge.io.jsonl import each_line
from gsmerge.runtime.documents import document_head, file_sha256

RECORDS = "batch.jsonl"
# values of `status` in records
DONE = "done"
FAILED = "failed"
SKIPPED = "skipped"  # `status` of a result that was done before, which is reported but not recorded again


@dataclass(frozen=True)
class DoneResult:
    """A result that is done, by its record."""

    key: str  # digest of the scene's files, the settings and the version
    files: list[dict[str, Any]]  # of each file: `path` in the output folder, `sha256` and `bytes`
    scene: str  # path of the scene, as the user gave it
    doubts: tuple[str, ...] = ()  # notes that say why the result may be bad
    unmet: str | None = None  # why the result misses its target, or None

    def holds(self, folder: Path, key: str) -> bool:
        """Return whether a result has the ``key``, and its files in ``folder`` are unchanged."""
        if self.key != key or not self.files:
            return False
        try:
            paths = [folder / file["path"] for file in self.files]
            if not all(path.is_file() for path in paths):  # a pipe could be read for ever
                return False
            return [file_sha256(path) for path in paths] == [file["sha256"] for file in self.files]
        except (OSError, ValueError):  # ValueError: no file can have this name
            return False


@dataclass
class RecordIndex:
    """Results in a folder that are done, according to the records of the folder."""

    folder: Path
    end: int = 0  # byte up to which the records have been read
    results: dict[str, DoneResult] = field(default_factory=dict)  # by name of the result in the folder

    def read_on(self) -> RecordIndex:
        """Read the records that any process has added since the last call, and return this index.

        Damaged lines are skipped.
        """
        for end, line in each_line(self.folder / RECORDS, self.end):
            self.end = end
            with suppress(KeyError, TypeError, AttributeError):  # raised for a line that is not a record
                if line is not None and line["status"] == DONE:
                    files = [
                        {"path": _text(file["path"]), "sha256": file["sha256"], "bytes": file["bytes"]}
                        for file in line["files"]
                    ]
                    doubts = tuple(map(_text, line.get("doubts", ())))
                    unmet = _text(line.get("unmet") or "") or None
                    result = DoneResult(_text(line["key"]), files, _text(line["scene"]), doubts, unmet)
                    self.results[_text(line["output"])] = result
        return self

    def paths(self) -> Iterator[str]:
        """Yield the real paths of all files of results."""
        for result in self.results.values():
            for file in result.files:
                with suppress(ValueError):  # no file can have this name
                    yield os.path.realpath(self.folder / file["path"])


def _text(value: Any) -> str:
    """Return a value that has to be text, or raise TypeError for any other value."""
    if not isinstance(value, str):
        raise TypeError
    return value


def record(status: str, scene: str, output: str, **facts: Any) -> dict[str, Any]:
    """Make a record with all keys. A key that ``facts`` lacks gets an empty value."""
    blank: dict[str, Any] = {"key": None, "files": [], "error": None, "doubts": [], "unmet": None, "report": None}
    return {**document_head(), "status": status, "scene": scene, "output": output, **blank, **facts}


def prepare_folder(folder: Path) -> None:
    """Make the output folder and its file of records, or raise SceneError if records cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        records = folder / RECORDS
        if records.is_symlink():
            problem = "expected a file of records, found a link"
            raise SceneError(records, problem, "remove it, or name another folder with --output")
        if records.exists():
            check_file(records)  # raises for a pipe, in which writing would wait for a reader
        if os.access(folder, os.W_OK) or not records.exists():  # a read-only folder may hold results that are done
            records.touch()
    except OSError as error:
        problem = f"cannot be written ({error.strerror})"
        raise SceneError(folder, problem, "name another folder with --output") from error
