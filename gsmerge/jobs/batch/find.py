"""Find scenes in folders of any layout, by patterns and in lists."""

from __future__ import annotations

import glob
import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from zipfile import BadZipFile

from gsmerge.errors import SceneError, UsageError, count_words
from gsmerge.io import SCENE_SUFFIXES
from gsmerge.io.archives import open_archive
from gsmerge.io.bounds import read_budget, read_lines, suggest_path
from gsmerge.io.cameras.foreign import CAMERA_PLACES
from gsmerge.io.formats.ply import header_content
from gsmerge.io.formats.table import STATE_ENDING, may_hold_gaussians
from gsmerge.io.image_names import IMAGE_PLACES, natural_order
from gsmerge.io.no_gaussians import find_remedy
from gsmerge.reading.scene_files import PLY_PLACES, TRAINED_PLACES, list_plys, named_ply, other_plys
from gsmerge.runtime.arguments import expand_home
from gsmerge.runtime.record import list_some

NamedScene = tuple[Path, Path | None]  # a scene, and the named folder in which it is; None if the user named the scene
MAX_FOLDERS = 100_000  # most folders in a row without a scene; a link into a system's folders leads to more
SCENE_NAMES = {Path(place).parts[0] for place in (*PLY_PLACES, *TRAINED_PLACES)}
SCENE_PARTS = SCENE_NAMES | {Path(place).parts[0] for place in IMAGE_PLACES}
# A folder looks like a scene if a file or folder in it has one of _USUAL_NAMES, with or without .ply. A folder with a
# name in _USUAL_NAMES is a part of a scene
_USUAL_NAMES = {place.split("/")[0].removesuffix(".ply") for place in (*PLY_PLACES, *IMAGE_PLACES, *CAMERA_PLACES)}


def scene_plys(scene: Path) -> list[Path]:
    """List the files of Gaussians of a scene, which is a file or a folder.

    The list is empty if the folder cannot be read.
    """
    with suppress(SceneError, OSError):
        return list_plys(scene) if os.path.isdir(scene) else [scene]
    return []


def main_file(scene: Path) -> Path:
    """Return the file that identifies a scene.

    The folder of the scene is returned if several files could identify the scene, or if the folder cannot be read.
    """
    if not os.path.isdir(scene):
        return scene
    with suppress(OSError):  # whoever reads the scene reports the reason
        plys = other_plys(scene)
        return named_ply(scene) or (plys[0] if len(plys) == 1 else scene)
    return scene


def find_scenes(arguments: Sequence[str], out: Path) -> Iterator[Path]:
    """Yield the scenes of :func:`find_named_scenes` without the folders in which they were found."""
    return (scene for scene, _ in find_named_scenes(arguments, out))


def count_links(path: Path) -> int:
    """Count the symbolic links in a path. Of several paths to a scene, the path with the fewest links names it."""
    return sum(map(os.path.islink, (path.absolute(), *path.absolute().parents)))


def describe_lost(lookalikes: Sequence[str], scenes: Collection[str]) -> list[str]:
    """Return a list with a note about folders beside scenes that look like scenes, but have no Gaussians.

    The list is empty if no folder looks like a scene without Gaussians. ``lookalikes`` are all folders that look like
    scenes, with or without Gaussians. ``scenes`` are all scenes.
    """
    with_gaussians = {str(folder) for scene in scenes for folder in (Path(scene), *Path(scene).parents)}
    with_scenes = {os.path.dirname(folder) for folder in lookalikes if folder in scenes}
    lost = [
        folder
        for folder in lookalikes
        if os.path.dirname(folder) in with_scenes
        and folder not in with_gaussians
        and os.path.basename(folder) not in _USUAL_NAMES
    ]
    return [
        f"no Gaussians are read from {count_words(len(lost), 'folder')} beside the scenes: {list_some(lost)};"
        " inspect says why"
    ] if lost else []  # fmt: skip


def find_named_scenes(arguments: Sequence[str], out: Path, lookalikes: list[str] | None = None) -> Iterator[NamedScene]:
    """Yield the scenes of all arguments, in natural order within each argument. A scene may come twice.

    A folder that cannot be read counts as a scene, and its reader reports the reason. Folders behind links come last.
    The folders that look like scenes are appended to ``lookalikes``. Raises SceneError if an argument does not exist,
    has no scene, or has too many folders without a scene. Raises UsageError if an argument is the output folder
    ``out``.
    """
    skip = os.path.realpath(out)
    for argument in arguments:
        path = Path(argument)
        search = _Search(skip, [] if lookalikes is None else lookalikes)
        if path.is_dir():
            if os.path.realpath(path) == skip:
                raise UsageError(
                    f"{out}: expected another folder for the results than for the scenes; name another --output"
                )
            yield from _require_some(search.walk(path), argument, "in the folder")
        elif path.suffix in (*SCENE_SUFFIXES, STATE_ENDING) and path.is_file():
            yield path, None
        elif glob.has_magic(argument) and not path.exists():
            yield from _require_some(_match_pattern(argument, search), argument, "that match")
        elif path.is_file():
            yield from _require_some(_read_list(path, search), argument, "in the list")
        else:
            remedy = f"name a folder, a pattern, a .ply, or a list of them{suggest_path(path)}"
            raise SceneError(path, "no such file or folder", remedy)


def _require_some(scenes: Iterator[NamedScene], argument: str, where: str) -> Iterator[NamedScene]:
    """Yield the scenes of an argument.

    Raises SceneError without any scene. The text ``where`` tells the user where scenes were expected.
    """
    first_scene = next(scenes, None)
    if first_scene is None:
        remedy = ""
        if os.path.isdir(argument):
            file = next(iter(list_plys(Path(argument))), None)
            if file is None:
                remedy = find_remedy(Path(argument))
            elif file.suffix == ".ply":  # the search leaves out a .ply only if it is a result
                remedy = f"{file} is a result of gsmerge; name this file to compact it"
            else:
                remedy = f"name {file}"
        raise SceneError(argument, f"expected scenes {where}, found none", remedy)
    yield first_scene
    yield from scenes


@dataclass
class _Search:
    """The search for the scenes of one argument.

    The search enters each folder once, even if several links lead to the folder.
    """

    skip: str  # real path of the output folder, which is not searched
    lookalikes: list[str]  # folders that look like scenes, because they have photos, cameras or files with usual names
    seen: set[str] = field(default_factory=set)  # real paths of the folders entered so far
    num_empty: int = 0  # number of folders since the last scene

    def walk(self, top: Path) -> Iterator[NamedScene]:
        """Yield the scenes in a folder and below it, or the folder itself if it is a scene."""
        errors: list[OSError] = []  # one for each folder that cannot be read; such folders count as scenes
        starts = [top]  # the loop appends folders behind links, so that they come last
        for path, subfolders, files in (entry for start in starts for entry in os.walk(start, onerror=errors.append)):
            yield from ((Path(error.filename), top) for error in errors)
            errors.clear()
            folder = Path(path)
            names = [*subfolders, *files]
            real_path = os.path.realpath(path)
            if real_path == self.skip or real_path in self.seen:
                subfolders.clear()  # os.walk enters none of them
                continue
            self.seen.add(real_path)
            is_scene = _is_scene_folder(folder, names)
            subfolders[:] = natural_order(
                name for name in subfolders if not name.startswith(".") and not (is_scene and name in SCENE_PARTS)
            )
            starts += [folder / name for name in subfolders if os.path.islink(folder / name)]
            stems = names if is_scene else [name.lower().split(".ply")[0] for name in names]  # also of scene.ply.part
            if not _USUAL_NAMES.isdisjoint(stems):
                self.lookalikes.append(str(folder))
            scenes = [folder] if is_scene else _other_scenes(folder, names)
            scenes += [folder / name for name in natural_order(files) if not is_scene and _is_packed(folder / name)]
            self.num_empty = 0 if scenes else self.num_empty + 1
            if self.num_empty > MAX_FOLDERS:
                raise SceneError(
                    path, f"expected scenes, found more than {MAX_FOLDERS:,} folders without one",
                    "name the folders of the scenes, or a list of them",
                )  # fmt: skip
            yield from ((scene, top) for scene in scenes)
        yield from ((Path(error.filename), top) for error in errors)


def _is_packed(path: Path) -> bool:
    """Return whether a file is a zip archive with Gaussians.

    An archive with Gaussians counts as a scene, so that the user gets an error about it.
    """
    if path.suffix != ".zip" or path.with_suffix("").exists():  # an archive beside its unpacked folder is not needed
        return False
    with suppress(OSError, SceneError, BadZipFile), open_archive(path) as archive:
        return any(name.endswith(SCENE_SUFFIXES) for name in archive.namelist())
    return False


def _other_scenes(folder: Path, names: list[str]) -> list[Path]:
    """List the files that are scenes, in a folder that is no scene itself.

    ``names`` are the names of the files and folders in this folder. If the folder cannot be read any more, the list has
    the folder, and its reader reports the reason.
    """
    if SCENE_NAMES.isdisjoint(names) and not any(name.endswith(SCENE_SUFFIXES) for name in names):
        return []
    with suppress(OSError):
        scenes = other_plys(folder)
        if scenes or os.path.isdir(folder):
            return scenes
    return [folder]


def _is_scene_folder(folder: Path, names: list[str]) -> bool:
    """Return whether a folder is a scene; ``names`` are the names of the files and folders in it."""
    try:
        if SCENE_NAMES.isdisjoint(names):
            return False
        if named_ply(folder) is not None:
            return True
        if other_plys(folder):
            return False
        # A single file with a usual name but without Gaussians counts as a scene, and its reader says what it lacks
        return [header_content(path) for path in list_plys(folder)] == ["other"]
    except (SceneError, OSError):  # the reader of the folder reports the reason
        return True


def _match_pattern(pattern: str, search: _Search) -> Iterator[NamedScene]:
    """Yield the scenes that match a pattern, and the scenes in folders that match; ``**`` passes through no links."""
    anchor = Path(pattern).anchor
    named = Path(pattern).parts
    paths = Path(anchor).glob(os.path.relpath(pattern, anchor) if anchor else pattern)
    # Hidden files and folders match only if the pattern has their names
    shown = (str(path) for path in paths if all(part[:1] != "." or part in named for part in path.parts))
    for path in sorted(map(Path, natural_order(shown)), key=count_links):
        if path.is_dir():
            yield from search.walk(path)
        elif may_hold_gaussians(path) and search.skip not in map(str, Path(os.path.realpath(path)).parents):
            yield path, None


def _read_list(file: Path, search: _Search) -> Iterator[NamedScene]:
    """Yield the scenes of a text file with one path per line, relative to its folder, and also missing scenes."""
    # a dict keeps each line once, in order
    budget = read_budget(file)
    entries = dict[str, None]()
    job_bytes = 700  # bytes of memory for each scene of a list
    for line in read_lines(file):
        if "\0" in line:
            raise SceneError(file, "expected a text file with one path per line, found no text")
        if line.startswith("{"):
            raise SceneError(
                file, "expected a list of scenes, one path per line, found JSON", "name the folder of the scene"
            )
        entries[line.strip()] = None
        budget.check_memory(job_bytes * len(entries), count_words(len(entries), "scene"))
    named = (entry for entry in entries if entry and not entry.startswith("#"))
    paths = [file.parent / (entry if os.path.lexists(file.parent / entry) else expand_home(entry)) for entry in named]
    for path in sorted(paths, key=count_links):
        if not os.path.isdir(path):
            yield path, None
        elif os.path.realpath(path) not in search.seen:
            scenes = search.walk(path)
            yield next(scenes, (path, path))  # the reader of a folder without a scene says so
            yield from scenes
