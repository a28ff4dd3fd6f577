"""Find scenes in any layout, and name the files of their results."""

from __future__ import annotations

import glob
import os
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from gsmerge.batch.batch_options import BatchOptions
from gsmerge.budget import AUTO
from gsmerge.compact_file import level_output
from gsmerge.errors import SceneError, UsageError
from gsmerge.io import SCENE_SUFFIXES, SceneFiles
from gsmerge.io.bounds import read_text
from gsmerge.io.content_hash import stem_of
from gsmerge.io.formats.ply_file import header_counts
from gsmerge.io.scene_files import IMAGE_PLACES, PLY_PLACES, named_ply, other_plys
from gsmerge.options import CompactOptions
from gsmerge.runtime.estimate import memory_bytes

SCENE_PARTS = {Path(place).parts[0] for place in PLY_PLACES} | {"point_cloud", *IMAGE_PLACES}


class Work(Protocol):
    """Work on a scene other than compacting it with the settings of the batch."""

    @property
    def settings(self) -> CompactOptions:
        """Settings that the time is estimated from."""

    def key(self, options: BatchOptions) -> str:
        """Digest everything that the result depends on."""

    def run(self, files: SceneFiles, options: BatchOptions, out: Path) -> tuple[dict[str, Any], list[Path]]:
        """Do the work, and return the report, with the keys of a record's, and the written files."""


@dataclass(frozen=True)
class Job:
    """One scene of a batch."""

    index: int  # its place in the list
    scene: str  # a ``.ply``, or the folder of one
    output: str  # name of the result in the output folder
    num_gaussians: int  # by the header of its file; 0 where it cannot be read
    num_rest: int = 0  # columns of higher harmonics, likewise
    work: Work | None = None  # what is done with it; None: it is compacted with the settings of the batch

    @property
    def memory(self) -> int:
        """Bytes that the scene may take, within a factor of about two."""
        return memory_bytes(self.num_gaussians, photos=True, num_rest=self.num_rest)


def find_jobs(given: Sequence[str], out: Path, options: BatchOptions, own: Collection[str] = ()) -> list[Job]:
    """List all scenes, each once, and where their results go in the output folder.

    ``given`` are folders, which are searched except for ``out``; patterns; ``.ply`` files; text files with one of
    these per line. ``own`` has the real paths of former results, which are no scenes. SceneError if something does
    not exist or has no scene, UsageError if two scenes would be written to one file, or one over another.
    """
    jobs: list[Job] = []
    owners: dict[str, str] = {}
    inputs: set[str] = set()
    for scene in find_scenes(given, out):
        ply = main_file(scene)
        real = os.path.realpath(ply)
        if real in inputs or real in own:
            continue
        inputs.add(real)
        job = Job(len(jobs), str(scene), output_name(options, scene, len(jobs)), *header_counts(ply))
        for name in result_names(job.output, options):
            if name in owners:
                raise UsageError(
                    f"{out / name}: expected a file of its own for each scene, would be that of {owners[name]} and of"
                    f" {scene}; tell them apart with --name, such as '{{parent}}-{{stem}}.ply'"
                )
            owners[name] = str(scene)
        jobs.append(job)
    for name in owners:
        if os.path.realpath(out / name) in inputs:
            raise UsageError(f"{out / name}: is one of the scenes, and would be replaced; name another --output")
    return jobs


def result_names(output: str, options: BatchOptions) -> list[str]:
    """Return the names of a result and of its further levels of detail."""
    return [output, *(str(level_output(Path(output), level)) for level in range(1, options.settings.budget.levels))]


def main_file(scene: Path) -> Path:
    """Find the file that identifies a scene; the folder itself where several files could."""
    if not scene.is_dir():
        return scene
    plys = other_plys(scene)
    return named_ply(scene) or (plys[0] if len(plys) == 1 else scene)


def output_name(options: BatchOptions, scene: Path, index: int) -> str:
    """Return the name of a scene's result in the output folder."""
    whole = Path(os.path.abspath(scene))
    stem = stem_of(whole).removesuffix(".compressed")  # which is the scene's format, not its result's
    own = options.settings.decode
    values = {"stem": stem, "parent": whole.parent.name, "index": index, "k": own.k if own.k != AUTO else own.max_k}
    try:
        return os.path.normpath(options.output.format(**values))
    except ValueError as error:  # a format that fits numbers only
        raise UsageError(f"--name: {options.output!r} does not fit {values}: {error}") from error


def find_scenes(given: Sequence[str], out: Path) -> Iterator[Path]:
    """Yield the scenes of the arguments, in their order and sorted within each; some may come twice.

    SceneError if an argument does not exist or has no scene, UsageError if it is the output folder.
    """
    skip = os.path.realpath(out)
    for argument in given:
        path = Path(argument)
        if path.is_dir():
            if os.path.realpath(path) == skip:
                raise UsageError(f"{out}: expected another folder for the results than that of the scenes; name one")
            yield from _require_some(_walk(path, skip), argument, "in the folder")
        elif path.suffix in SCENE_SUFFIXES and path.is_file():
            yield path
        elif glob.has_magic(argument) and not path.exists():
            yield from _require_some(_matches(argument, skip), argument, "that match")
        elif path.is_file():
            yield from _require_some(_listed(path, skip), argument, "in the list")
        else:
            raise SceneError(path, "no such file or folder", "name a folder, a pattern, a .ply, or a list of them")


def _require_some(scenes: Iterator[Path], argument: str, where: str) -> Iterator[Path]:
    """Yield the scenes; SceneError if there are none."""
    first = next(scenes, None)
    if first is None:
        raise SceneError(argument, f"expected scenes {where}, found none")
    yield first
    yield from scenes


def _walk(folder: Path, skip: str, above: tuple[str, ...] = ()) -> Iterator[Path]:
    """Yield the scenes in a folder, which is one itself if it has a file of a usual name."""
    real = os.path.realpath(folder)
    if real == skip or real in above:  # a link to a folder above would never end
        return
    is_scene = named_ply(folder) is not None
    files = [] if is_scene else other_plys(folder)
    yield from [folder] if is_scene else files
    try:
        with os.scandir(folder) as entries:
            inside = sorted(entry.name for entry in entries if entry.is_dir() and not entry.name.startswith("."))
    except OSError as error:
        raise SceneError(folder, f"cannot be read ({error.strerror})") from error
    for name in inside:
        if not (is_scene and name in SCENE_PARTS):
            yield from _walk(folder / name, skip, (*above, real))


def _matches(pattern: str, skip: str) -> Iterator[Path]:
    for name in sorted(glob.iglob(pattern, recursive=True)):
        path = Path(name)
        if path.is_dir():
            yield from _walk(path, skip)
        elif path.suffix in SCENE_SUFFIXES:
            yield path


def _listed(file: Path, skip: str) -> Iterator[Path]:
    """Yield the scenes of a list, relative to its folder; a missing one fails when it is read."""
    text = read_text(file)
    if "\0" in text:
        raise SceneError(file, "expected a text file with one path per line, found no text")
    for line in text.splitlines():
        entry = line.strip()
        if not entry or entry.startswith("#"):
            continue
        path = file.parent / entry
        if path.is_dir() and os.path.realpath(path) != skip:
            yield from list(_walk(path, skip)) or [path]
        else:
            yield path
