"""Find scenes in folders of any layout, by patterns and in lists."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from zipfile import BadZipFile

from gsmerge.errors import SceneError, UsageError
from gsmerge.io import SCENE_SUFFIXES
from gsmerge.io.archives import open_archive
from gsmerge.io.bounds import read_budget, read_lines
from gsmerge.io.formats.ply import header_content
from gsmerge.io.formats.table import STATE_ENDING, may_hold_gaussians
from gsmerge.io.image_names import natural_order
from gsmerge.io.no_gaussians import find_remedy
from gsmerge.io.scene_files import IMAGE_PLACES, PLY_PLACES, TRAINED_PLACES, list_plys, named_ply, other_plys
from gsmerge.values.words import count_words

NamedScene = tuple[Path, Path | None]  # a scene, and the folder that the user named; None if that was the scene itself
MAX_FOLDERS = 100_000  # folders without a scene after the last scene; a link into a system's folders leads to more
_JOB_BYTES = 700  # memory for each scene of a list
SCENE_NAMES = {Path(place).parts[0] for place in (*PLY_PLACES, *TRAINED_PLACES)}
SCENE_PARTS = SCENE_NAMES | {Path(place).parts[0] for place in IMAGE_PLACES}


def scene_plys(scene: Path) -> list[Path]:
    """List the Gaussian files of a scene, given one of them or their folder; empty if the folder cannot be read."""
    with suppress(SceneError, OSError):
        return list_plys(scene) if os.path.isdir(scene) else [scene]
    return []


def main_file(scene: Path) -> Path:
    """Find the file that identifies a scene; the folder itself if several files could, or if it cannot be read."""
    if not os.path.isdir(scene):
        return scene
    with suppress(OSError):  # reading the scene reports the reason
        plys = other_plys(scene)
        return named_ply(scene) or (plys[0] if len(plys) == 1 else scene)
    return scene


def find_scenes(arguments: Sequence[str], out: Path) -> Iterator[Path]:
    """Yield the scenes of :func:`find_named_scenes`."""
    return (scene for scene, _ in find_named_scenes(arguments, out))


def find_named_scenes(arguments: Sequence[str], out: Path) -> Iterator[NamedScene]:
    """Yield the scenes of all arguments, in natural order within each argument; a scene may come twice.

    A folder that cannot be read counts as a scene, so that reading it reports the reason. SceneError if an argument
    does not exist, has no scene, or has too many folders without a scene; UsageError if it is the output folder.
    """
    skip = os.path.realpath(out)
    for argument in arguments:
        path, search = Path(argument), _Search(skip)
        if path.is_dir():
            if os.path.realpath(path) == skip:
                raise UsageError(
                    f"{out}: expected another folder for the results than for the scenes; name another --output"
                )
            yield from _require_some(search.walk(path), argument, "in the folder")
        elif path.suffix in (*SCENE_SUFFIXES, STATE_ENDING) and path.is_file():
            yield path, None
        elif glob.has_magic(argument) and not path.exists():
            yield from _require_some(_matches(argument, search), argument, "that match")
        elif path.is_file():
            yield from _require_some(_listed(path, search), argument, "in the list")
        else:
            raise SceneError(path, "no such file or folder", "name a folder, a pattern, a .ply, or a list of them")


def _require_some(scenes: Iterator[NamedScene], argument: str, where: str) -> Iterator[NamedScene]:
    """Yield the scenes; SceneError if there are none."""
    first_scene = next(scenes, None)
    if first_scene is None:
        raise SceneError(argument, f"expected scenes {where}, found none", _remedy(Path(argument)))
    yield first_scene
    yield from scenes


def _remedy(folder: Path) -> str:
    """Return the remedy for a folder in which no scene was found."""
    if not os.path.isdir(folder):
        return ""
    file = next(iter(list_plys(folder)), None)
    if file is None:
        return find_remedy(folder)
    is_result = file.suffix == ".ply"  # the search lists all other .ply; it does not list the meta.json of a .sog
    return f"{file} is a result of gsmerge; name this file to compact it" if is_result else f"name {file}"


@dataclass
class _Search:
    """Search of one argument; it enters each folder once, even if several links lead to it."""

    skip: str  # real path of the output folder, which is not searched
    seen: set[str] = field(default_factory=set)  # real paths of the folders entered so far
    num_empty: int = 0  # folders since the last scene

    def walk(self, top: Path) -> Iterator[NamedScene]:
        """Yield the scenes in a folder, or the folder itself if it has a scene file with a usual name."""
        unreadable: list[NamedScene] = []  # reading such a folder reports the reason

        def note_error(error: OSError) -> None:
            unreadable.append((Path(error.filename), top))

        for folder, folders, files in os.walk(top, followlinks=True, onerror=note_error):
            yield from unreadable
            unreadable.clear()
            current, names, real = Path(folder), [*folders, *files], os.path.realpath(folder)
            if real == self.skip or real in self.seen:
                folders.clear()
                continue
            self.seen.add(real)
            self.num_empty += 1
            if self.num_empty > MAX_FOLDERS:
                problem = f"expected scenes, found more than {MAX_FOLDERS:,} folders without one"
                raise SceneError(folder, problem, "name the folders of the scenes, or a list of them")
            is_scene = _is_scene(current, names)
            omitted = SCENE_PARTS if is_scene else ()
            folders[:] = natural_order(name for name in folders if not name.startswith(".") and name not in omitted)
            scenes = [current] if is_scene else _other_scenes(current, names)
            scenes += [current / name for name in natural_order(files) if not is_scene and _is_packed(current / name)]
            self.num_empty = 0 if scenes else self.num_empty
            yield from ((scene, top) for scene in scenes)
        yield from unreadable


def _is_packed(path: Path) -> bool:
    """Return whether a file is a zip archive with Gaussians, which counts as a scene so that its reader refuses it."""
    if path.suffix != ".zip" or path.with_suffix("").exists():  # it is unpacked already
        return False
    with suppress(OSError, SceneError, BadZipFile), open_archive(path) as archive:
        return any(name.endswith(SCENE_SUFFIXES) for name in archive.namelist())
    return False


def _other_scenes(folder: Path, names: list[str]) -> list[Path]:
    """List the scenes in a folder that is no scene itself; the folder if it cannot be read any more.

    ``names``: files and folders in the folder.
    """
    if SCENE_NAMES.isdisjoint(names) and not any(name.endswith(SCENE_SUFFIXES) for name in names):
        return []
    with suppress(OSError):
        scenes = other_plys(folder)
        if scenes or os.path.isdir(folder):
            return scenes
    return [folder]  # reading it reports the reason


def _is_scene(folder: Path, names: list[str]) -> bool:
    """Return whether a folder that contains these names is a scene."""
    try:
        if SCENE_NAMES.isdisjoint(names):
            return False
        if named_ply(folder) is not None:
            return True
        if other_plys(folder):
            return False
        # a file with a usual name but without Gaussians fails alone
        return [header_content(path) for path in list_plys(folder)] == ["other"]
    except (SceneError, OSError):  # reading the scene reports the reason
        return True


def _matches(pattern: str, search: _Search) -> Iterator[NamedScene]:
    """Yield the scenes that match a pattern, and those in matching folders; links are not followed into folders."""
    anchor = Path(pattern).anchor
    found = Path(anchor).glob(os.path.relpath(pattern, anchor) if anchor else pattern)
    named = Path(pattern).parts  # other parts with a dot in front are hidden
    for name in natural_order(str(p) for p in found if all(part[:1] != "." or part in named for part in p.parts)):
        path = Path(name)
        if path.is_dir():
            yield from search.walk(path)
        elif may_hold_gaussians(path) and search.skip not in map(str, Path(os.path.realpath(path)).parents):
            yield path, None


def _listed(file: Path, search: _Search) -> Iterator[NamedScene]:
    """Yield the scenes of a list, whose paths are relative to its folder; a missing scene fails when it is read."""
    budget, lines = read_budget(file), dict[str, None]()
    for line in read_lines(file):
        if "\0" in line:
            raise SceneError(file, "expected a text file with one path per line, found no text")
        if line.startswith("{"):
            raise SceneError(
                file, "expected a list of scenes, one path per line, found JSON", "name the folder of the scene"
            )
        lines[line.strip()] = None
        budget.check_memory(_JOB_BYTES * len(lines), count_words(len(lines), "scene"))
    for entry in lines:
        if not entry or entry.startswith("#"):
            continue
        path = file.parent / os.path.expanduser(entry)
        if not os.path.isdir(path):
            yield path, None
        elif os.path.realpath(path) not in search.seen:
            scenes = search.walk(path)
            yield next(scenes, (path, path))
            yield from scenes
