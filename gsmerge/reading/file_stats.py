"""Read the state of a scene's files, and find those that change while they are read."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from gsmerge.errors import Doubt, count_words
from gsmerge.io.bounds import walk_files
from gsmerge.reading.scene_files import SceneFiles


def read_stats(files: SceneFiles) -> dict[Path, tuple[int, ...]]:
    """Return the state of each file of a scene, for :func:`list_changed`: size, time of the last change, and inode."""
    roots = [root for scene in (files, *files.more) for root in scene.paths]
    return {path: stat for root in roots for path in list_inner(root) if (stat := _read_stat(path)) is not None}


def list_changed(stats: Mapping[Path, tuple[int, ...]]) -> list[str]:
    """List the files that have changed since their ``stats`` were read; deleted files are not listed."""
    return [str(path) for path, stat in stats.items() if _read_stat(path) not in (None, stat)]


def doubt_changed(stats: Mapping[Path, tuple[int, ...]]) -> list[str]:
    """Return a list with a doubt about a result if files of the result's scene have changed since they were read."""
    changed = list_changed(stats)
    more = f" and {count_words(len(changed) - 1, 'other file')}" if len(changed) > 1 else ""
    problem = "changed during the run; the result is of what was read before"
    return [Doubt(f"{changed[0]}{more} {problem}")] if changed else []


def _read_stat(path: Path) -> tuple[int, ...] | None:
    """Return the size, time of the last change and inode of a file; None if the file cannot be accessed."""
    with suppress(OSError):
        stat = path.stat()
        return stat.st_size, stat.st_mtime_ns, stat.st_ino
    return None


def list_inner(root: Path) -> list[Path]:
    """List all files in a folder, sorted; for a path of a file, list only this file."""
    return sorted(path for path in walk_files(root) if path.is_file()) if root.is_dir() else [root]
