"""Compact a scene from files, and write the result to files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from time import perf_counter
from typing import Any

from gsmerge.compaction.compact import compact_scene
from gsmerge.compaction.outputs import Outputs, add_outputs, frame_notes, refuse_to_replace_cameras
from gsmerge.compaction.report import report_document
from gsmerge.compaction.result import CompactResult
from gsmerge.errors import SceneError
from gsmerge.io import atomic_outputs
from gsmerge.io.formats.arrays import RESULT_COMMENT, result_comments
from gsmerge.io.formats.columns import UNUSED, list_names
from gsmerge.io.formats.ply import is_from_gsmerge
from gsmerge.io.formats.rounding import format_notes
from gsmerge.io.formats.table import Contents
from gsmerge.io.scene_files import SceneFiles, result_cameras, scene_title
from gsmerge.measure.documents import file_sha256
from gsmerge.runtime.memory import release_memory
from gsmerge.runtime.record import Progress, record_run
from gsmerge.runtime.threads import use_threads
from gsmerge.scene.content_hash import doubt_changed, list_changed, read_stats
from gsmerge.scene.exporters import NO_HINTS, ReadHints
from gsmerge.scene.read import Loaded, load_files
from gsmerge.settings.compact import CompactOptions
from gsmerge.settings.reading import OpacityChoice
from gsmerge.types import Scene


def compact_files(
    files: SceneFiles,
    settings: CompactOptions,
    outputs: Outputs,
    *,
    opacity: OpacityChoice = "auto",
    hints: ReadHints = NO_HINTS,
    progress: Progress | None = None,
    hashed: bool = False,
    seconds_before: Mapping[str, float] | None = None,
    on_read: Callable[[Loaded], None] = lambda _: None,
) -> dict[str, Any]:
    """Read a scene, compact it, and write result, levels and cameras: all files or none.

    If ``hashed``, the report has hashes of the input files. ``seconds_before`` has the wall time of the caller's
    earlier steps, by name. ``on_read`` is called with the scene after it was read.

    Returns the report, see :func:`gsmerge.compaction.report.report_document`. Raises SceneError if the scene cannot be
    read or the result cannot be written, and UsageError if the scene lacks something that the settings need.
    """
    start, out, settings = perf_counter(), outputs.result, with_output_name(settings, outputs)
    format_ = outputs.format
    with atomic_outputs(overwrite=outputs.overwrite) as add:
        temporary = add(out)  # before the long work, so that an output that cannot be written ends the run at once
        load = read_input(files, opacity=opacity, hints=hints, hashed=hashed)
        on_read(load)
        views = _list_first_layers(load.scene)
        names = [load.scene.names[view] for view in views]
        cameras_path = outputs.viewer_cameras if views else None
        if cameras_path is not None and cameras_path.exists() and not outputs.overwrite:  # fail before the long work
            refuse_to_replace_cameras(cameras_path, load.scene.cameras[views], names, moved=True)
        read_at = perf_counter()
        with use_threads(settings.threads), record_run(progress):
            result = compact_scene(load.scene, settings)
        if len(result.gaussians) == 0:
            problem = "expected Gaussians that show something, found none that remains after merging"
            raise SceneError(files.ply, problem, "check its scales and opacities")
        result = _pad_to_full(result) if outputs.options.columns == "full" else result
        compacted_at, results = perf_counter(), (result, *result.coarser)
        levels, cameras = [level.gaussians for level in results], result.cameras[views]
        comments = result_comments(result.report.new_views, load.comments)
        contents = Contents(levels, comments, cameras, names, scene_title(files.ply))
        level_files = add_outputs(add, outputs, temporary, contents)  # the first level is the result itself
        notes = [*format_notes(out, result.gaussians), *frame_notes(outputs, cameras), *doubt_changed(load.stats)]
        document = report_document(
            result.report, recognised=load.recognised, output_path=out,
            seconds_before={**(seconds_before or {}), "read": read_at - start},
            seconds_after={"write": perf_counter() - compacted_at},
            coarser=[(path, level.report) for path, level in zip([*level_files][1:], result.coarser, strict=True)],
            notes=[*load.notes, *notes], written_at=level_files, cameras_path=cameras_path,
        )  # fmt: skip
    format_.finish(out)
    return document


def with_output_name(settings: CompactOptions, outputs: Outputs) -> CompactOptions:
    """Return the settings with the name of the output file, because a budget may count the bytes of this file."""
    return replace(settings, budget=replace(settings.budget, output=outputs.result.name))


def _pad_to_full(result: CompactResult) -> CompactResult:
    """Pad the harmonics of a result and its levels with zeros up to degree 3."""
    from gsmerge.compaction.placement import NUM_FULL, pad_harmonics

    coarser = tuple(map(_pad_to_full, result.coarser))
    return replace(result, gaussians=pad_harmonics(result.gaussians, NUM_FULL), coarser=coarser)


def _list_first_layers(scene: Scene) -> list[int]:
    """Return the views, but if several have the same name and camera, and so are layers of one view, only the first."""
    cameras = zip(scene.names, scene.cameras.viewmats, scene.cameras.Ks, strict=True)
    keys = [(name, viewmat.tobytes(), K.tobytes()) for name, viewmat, K in cameras]
    return [view for view, key in enumerate(keys) if key not in keys[:view]]


def read_input(
    files: SceneFiles, *, opacity: OpacityChoice = "auto", hints: ReadHints = NO_HINTS, hashed: bool = False
) -> Loaded:
    """Read a scene from its files, with notes on missing or unusual content.

    If ``hashed``, the files of Gaussians are also hashed. Raises SceneError if the scene cannot be read, or if one of
    its files changes while it is read.
    """
    stats = read_stats(files)
    loaded = load_files(files, opacity=opacity, hints=hints)
    # The scene already has the photos that were inside the camera file, so the copy in ``loaded`` is freed
    cameras = None if loaded.cameras is None else replace(loaded.cameras, images=())
    sha256 = file_sha256(*files.all_plys) if hashed else None
    if changed := list_changed(stats):
        raise SceneError(changed[0], "changed while it was read", "run this again when the file is complete")
    release_memory()
    return replace(loaded, cameras=cameras, stats=stats, sha256=sha256, notes=(*loaded.notes, *_compact_notes(loaded)))


def _compact_notes(loaded: Loaded) -> list[str]:
    """Return notes on columns that the result will lack, and on a scene that is a result already.

    A file of gsmerge is recognised by its header or, in formats without one, by the cameras beside it. A file of
    gsmerge is a result if its header says so, or if it has at most one Gaussian for every two pixels of its views.
    """
    scene, comments, notes = loaded.scene, loaded.info.comments, list[str]()
    unused = " ".join(note for note in loaded.info.adapted if note.startswith(UNUSED))  # columns that a note names
    lost = [name for name in loaded.info.extra_columns if name not in unused]
    if lost:
        notes.append(f"merged Gaussians do not have the columns {list_names(lost)}; gsmerge convert copies them")
    pixels = len(scene) * scene.cameras.height * scene.cameras.width
    is_own = is_from_gsmerge(comments) or result_cameras(loaded.files.ply) is not None
    is_small = is_own and scene.num_gaussians <= pixels / 2
    if is_small or RESULT_COMMENT in comments:
        count = f"{scene.num_gaussians:,} Gaussians for {pixels:,} pixels" if pixels else "no Gaussian per pixel"
        remedy = "start from the original for more detail"
        notes.append(f"the scene is compact already ({count}, written by gsmerge): {remedy}")
    return notes
