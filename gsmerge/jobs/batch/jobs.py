"""Make the jobs of a batch. A job is a scene with the call that makes its result."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from string import Formatter
from typing import Any

from gsmerge.errors import SceneError, UsageError
from gsmerge.frozen import dataclass, replace
from gsmerge.io import OUTPUT_FORMATS
from gsmerge.io.formats.table import estimate_counts
from gsmerge.io.formats.write import level_output
from gsmerge.jobs.batch.find import count_links, find_named_scenes, main_file, scene_plys
from gsmerge.jobs.content_hash import content_hash, digest, fill_template, list_files, scene_name
from gsmerge.reading.checkpoint import load_checkpoint
from gsmerge.reading.scene_files import SceneFiles, find_scene_files
from gsmerge.results.outputs import Outputs
from gsmerge.run import compact_files
from gsmerge.runtime.documents import SCHEMA_VERSION, file_sha256
from gsmerge.runtime.memory import memory_bytes
from gsmerge.runtime.record import list_some
from gsmerge.settings.budget import AUTO
from gsmerge.settings.compact import CHECKPOINTS, CompactOptions
from gsmerge.settings.reading import NONE, OpacityChoice, ReadHints
from gsmerge.settings.setting import Settings, setting
from gsmerge.settings.stages import Engine
from gsmerge.types import StrPath
from gsmerge.version import __version__

FIELDS = ("stem", "parent", "index", "k")
PLACE_OPTIONS = ("cameras", "images", "masks", "protect")  # options that say where files of a scene are

DISTINGUISH = "distinguish them with --name, such as '{parent}-{stem}.ply'"


@dataclass(frozen=True)
class BatchOptions(Settings):
    """Settings of :func:`gsmerge.jobs.batch.find_jobs` and :func:`gsmerge.jobs.batch.run_batch`."""

    settings: CompactOptions = setting(CompactOptions(), "Settings of each scene.")
    opacity: OpacityChoice = setting("auto", "How all files store opacity.")
    hints: ReadHints = setting(ReadHints(), "Hints for reading, the same for all files.")
    cameras: str | None = setting(None, "Cameras: one path for all scenes, or a pattern in which {scene}, {parent} and "
        "{stem} are replaced by those of each scene.",
        "By default the cameras beside each scene; `none`: without.")  # fmt: skip
    images: str | None = setting(None, "Folder of the photos: a path or such a pattern.")
    masks: str | None = setting(None, "Folder of their masks: a path or such a pattern.")
    protect: str | None = setting(
        None, "Folder of images, white where a text or a face has to stay sharp: a path or such a pattern."
    )
    output: str = setting("{stem}.ply", "Name of each result in the output folder, whose ending sets the format. "
        "{stem} (the scene's name), {parent} (the folder it is in), {index} (its place in the list, from 0) and {k} "
        "are replaced.")  # fmt: skip
    jobs: int | None = setting(None, "Number of scenes to run at the same time.",
        "By default as many as processors and free memory allow.",
        least=1)  # fmt: skip
    overwrite: bool = setting(False, "Compact all scenes again, and also replace files that were not written by a "
        "batch with these settings.")  # fmt: skip
    engine: str = setting("local", "Where scenes are compacted, see `Engine`.")
    address: str | None = setting(None, "Address of the Ray cluster, see `Engine`.")

    def __post_init__(self) -> None:
        """Raise ValueError for an engine or an output pattern that is not possible."""
        super().__post_init__()
        Engine(self.engine, self.address)
        try:
            names = {name for _, name, _, _ in Formatter().parse(self.output) if name is not None}
            example = self.output.format(**dict.fromkeys(FIELDS, 1)) if names <= set(FIELDS) else ""
        except (ValueError, LookupError):
            example = ""  # refused below
        is_inside = not example.startswith(("/", "~", ".")) and "\\" not in example and ".." not in example.split("/")
        if not (is_inside and example.lower().endswith(OUTPUT_FORMATS)):
            placeholders = ", ".join(f"{{{name}}}" for name in FIELDS)
            endings = ", ".join(OUTPUT_FORMATS)
            expected = (
                f"a name inside the output folder, not hidden, that ends in {endings} and has only {placeholders}"
            )
            raise ValueError(f"output: expected {expected} in braces, got {self.output!r}")


@dataclass(frozen=True)
class CompactCall:
    """The call that makes a result as ``gsmerge compact`` does."""

    settings: CompactOptions
    opacity: OpacityChoice
    hints: ReadHints

    def key(self, files: SceneFiles) -> str:
        """Return the key of a result, which tells whether an earlier result of these ``files`` can be kept.

        The key has two digests with a dot between them. The first digest is of the scene's files and the version of
        gsmerge, and the second digest is of the settings.
        """
        settings = self.settings.to_dict()
        del settings["threads"]
        checkpoint = Path(self.settings.checkpoint)
        if self.settings.checkpoint not in CHECKPOINTS and checkpoint.is_file():  # its path does not change the result
            settings["checkpoint"] = file_sha256(checkpoint)
        without = [name for name in sorted(files.named) if getattr(files, name) is None]
        reading = {"opacity": self.opacity, **vars(self.hints), "without": without}
        version = {"tool_version": __version__, "schema_version": SCHEMA_VERSION}
        scene = digest({"scene": content_hash(list_files(files)), **version})
        return f"{scene}.{digest({'settings': settings, 'reading': reading})}"

    def run(self, files: SceneFiles, outputs: Outputs, threads: int) -> tuple[dict[str, Any], list[Path]]:
        """Compact a scene. Return the report, and the paths of the result, its coarser levels and its cameras."""
        document = compact_files(
            files, replace(self.settings, threads=threads), outputs,
            opacity=self.opacity, hints=self.hints, hashed=True,
        )  # fmt: skip
        written = [*(level["path"] for level in document["levels"]), document["viewer_cameras"]]
        return document, [outputs.result, *map(Path, filter(None, written))]


@dataclass(frozen=True)
class Job:
    """A scene of a batch, and the call that makes its result."""

    scene: str  # path of a file of Gaussians or of its folder
    outputs: tuple[str, ...]  # names of the result and of its coarser levels in the output folder
    call: CompactCall
    num_gaussians: int  # estimated from the headers or the sizes of the scene's files; 0 if they cannot be read
    num_rest: int = 0  # values of higher harmonics of a Gaussian, estimated in the same way
    cameras: StrPath | None = None  # None for those beside the scene
    images: StrPath | None = None  # None for those beside the scene
    masks: StrPath | None = None  # None for those beside the photos
    protect: StrPath | None = None  # None if nothing has to stay sharper
    within: Path | None = None  # folder that the user named; the search for cameras and photos goes up to it
    clash: str | None = None  # why the result cannot have its name, unless a record says that this scene has it

    @property
    def output(self) -> str:
        """Name of the result in the output folder."""
        return self.outputs[0]

    @property
    def memory(self) -> int:
        """Estimate the memory of the call in bytes, up to a factor of about three."""
        return memory_bytes(self.num_gaussians, num_rest=self.num_rest)

    def find_files(self) -> SceneFiles:
        """Find the files of the scene, or raise SceneError if there are none."""
        places = {name: getattr(self, name) for name in PLACE_OPTIONS}
        return find_scene_files(Path(self.scene), **places, within=self.within)


def find_jobs(
    arguments: Sequence[str],
    out: Path,
    options: BatchOptions,
    results: Collection[str] = (),
    lookalikes: list[str] | None = None,
) -> list[Job]:
    """Find all scenes, and return a job for each.

    Args:
        arguments: Folders, patterns, ``.ply`` files, and text files with one of these per line.
        out: The output folder, which is not searched.
        options: Settings of the batch.
        results: Real paths of former results, which are not scenes.
        lookalikes: List to which the folders that look like scenes are appended, for :func:`describe_lost`.

    If several paths lead to a scene, the path with the fewest links names it. If another result or a scene has the name
    of a result, the job has a ``clash``. Raises SceneError if an argument does not exist or has no scene, if cameras,
    photos or masks for all scenes do not exist, or if networks cannot be used.
    """
    if options.settings.checkpoint not in CHECKPOINTS:
        load_checkpoint(options.settings.checkpoint)  # fail once, not for each scene
    call = CompactCall(options.settings, options.opacity, options.hints)
    patterns = {name: getattr(options, name) for name in PLACE_OPTIONS}
    for name, place in patterns.items():  # a missing path for all scenes fails here, because each scene would fail
        if place not in (None, NONE) and "{" not in place and not os.path.exists(place):
            remedy = f"for one beside each scene pass --{name} '{{parent}}/{place}'"
            raise SceneError(place, "no such file or folder", "" if os.path.isabs(place) else remedy)
    jobs: list[Job] = []
    scenes_by_output: dict[str, list[str]] = {}  # name of an output -> the scenes whose results would have it
    inputs: set[str] = set()  # real paths of the scenes' main files
    scenes = [(main_file(scene), scene, within) for scene, within in find_named_scenes(arguments, out, lookalikes)]
    for file, scene, within in sorted(scenes, key=lambda entry: count_links(entry[0])):
        real_path = os.path.realpath(file)
        if real_path in inputs or real_path in results:
            continue
        inputs.add(real_path)
        output = output_name(options, scene, len(jobs))
        levels = range(1, options.settings.budget.levels)
        outputs = output, *(level_output(Path(output), level).as_posix() for level in levels)
        for name in outputs:  # on Windows A.ply and a.ply are one file
            scenes_by_output.setdefault(os.path.normcase(name), []).append(str(scene))
        places: dict[str, Any] = {
            name: pattern if pattern == NONE else fill_template(pattern, scene) for name, pattern in patterns.items()
        }
        jobs.append(Job(str(scene), outputs, call, *estimate_counts(scene_plys(scene)), **places, within=within))
    return [replace(job, clash=_find_clash(job, out, scenes_by_output, inputs)) for job in jobs]


def _find_clash(
    job: Job, out: Path, scenes_by_output: Mapping[str, Sequence[str]], inputs: Collection[str]
) -> str | None:
    """Return why a result cannot have its name, or None if no other result and no scene has the name."""
    for name in job.outputs:
        scenes = scenes_by_output[os.path.normcase(name)]
        if len(scenes) > 1:
            return (
                f"{out / name}: expected a different name for each result, would be that of"
                f" {list_some(scenes, ' and ')}; {DISTINGUISH}"
            )
        if os.path.realpath(out / name) in inputs:
            return f"{out / name}: is one of the scenes and would be replaced; name another --output"
    return None


def output_name(options: BatchOptions, scene: Path, index: int) -> str:
    """Return the name of a scene's result in the output folder."""
    path = Path(os.path.abspath(scene))
    stem = scene_name(path).removesuffix(".compressed")  # the result may have another format than the scene
    decode = options.settings.decode
    k = decode.k if decode.k != AUTO else decode.max_k
    values = {"stem": stem, "parent": path.parent.name, "index": index, "k": k}
    try:
        return Path(os.path.normpath(options.output.format(**values))).as_posix()
    except ValueError as error:  # such as {stem:03d}, which is for numbers only
        raise UsageError(f"--name: {options.output!r} does not fit {values}: {error}") from error
