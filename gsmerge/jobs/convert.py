"""Convert files of Gaussians from format to format without a fit; the Gaussians may be joined, cleaned and moved."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import Doubt, SceneError, UsageError, name_notes
from gsmerge.frozen import dataclass, field, replace
from gsmerge.io import GaussianFile, file_notes, read_cameras, read_gaussians
from gsmerge.io.cameras.camera_file import CameraFile, to_cameras
from gsmerge.io.cameras.viewer_cameras import viewer_cameras_path
from gsmerge.io.formats.extra_columns import describe_extra_columns, join_extra_columns, read_extra_columns
from gsmerge.io.formats.read_gaussians import FileInfo, kept_comments
from gsmerge.io.formats.rows import RESULT_COMMENT, result_comments, states_vertical_axis, upward_axis
from gsmerge.io.formats.table import Contents, Format
from gsmerge.io.photo_files import read_images
from gsmerge.method.geometry.frame import scene_frame
from gsmerge.method.geometry.transforms import IDENTITY, Similarity, euler_to_rotmat, normalize
from gsmerge.method.kernels.matrices import matmul
from gsmerge.method.stages.clean import clean, describe_counts
from gsmerge.method.stages.pair_merge import merge_neighbors
from gsmerge.method.viewpoints.place_cameras import place_viewpoints
from gsmerge.plan.counts import STREAMED_LEVELS, level_counts
from gsmerge.reading.scene_files import find_scene_files, named_path, result_cameras, scene_title
from gsmerge.results.lost_values import format_notes
from gsmerge.results.outputs import NUM_FULL, Outputs, frame_notes, join_gaussians, pad_harmonics, write_outputs
from gsmerge.runtime.documents import document_head, note_entries
from gsmerge.runtime.memory import human_bytes
from gsmerge.runtime.record import report_progress
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.files import AXES, PlacementOptions, parse_triple
from gsmerge.settings.reading import NONE, ColorChoice, OpacityChoice, ScaleChoice
from gsmerge.settings.stages import CleanOptions
from gsmerge.types import NO_CAMERAS, Cameras, Gaussians, StrPath, make_scene


@dataclass(frozen=True)
class ConvertOptions:
    """What ``gsmerge convert`` reads and writes, and how."""

    inputs: Sequence[Path]  # Several inputs are joined in this order
    outputs: Outputs
    cameras: StrPath | None = None  # In the frame of the first input; None: if this is a result, its own cameras
    images: StrPath | None = None  # Photos of these cameras, which show where the sky is
    opacity: OpacityChoice = "auto"
    scales: ScaleChoice = "auto"
    colors: ColorChoice = "auto"
    clean: CleanOptions = field(default_factory=CleanOptions)
    placement: PlacementOptions = field(default_factory=PlacementOptions)


def convert_files(options: ConvertOptions) -> dict[str, Any]:
    """Convert files of Gaussians and write the result, with cameras if they are known: all files or none.

    Returns the document of ``gsmerge convert``. Raises SceneError if a file cannot be read or written, or if no
    Gaussian remains; UsageError for an ending that cannot be written, and for dropping the sky without photos.
    """
    outputs, format_ = options.outputs, options.outputs.format
    with use_threads():
        files, steps = list[GaussianFile](), len(options.inputs) + 1
        for path in options.inputs:
            report_progress(f"convert: {path.name}", len(files), steps)
            files.append(read_gaussians(path, opacity=options.opacity, scales=options.scales, colors=options.colors))
        # Indexing copies, so files without invalid rows are not indexed
        gaussians = join_gaussians([f.gaussians if f.valid.all() else f.gaussians[f.valid] for f in files])
        stored, camera_notes = _find_cameras(options)
        cameras = None if stored is None else to_cameras(stored)
        count = len(gaussians)
        rows, dropped = _clean_joined(gaussians, options, stored)
        gaussians = gaussians if len(rows) == count else gaussians[rows]
        if len(gaussians) == 0:
            problem = f"expected Gaussians that are kept, found none of {count:,}"
            raise SceneError(options.inputs[0], problem, "find the extent of the scene with gsmerge inspect")
        frame = find_placement(options.placement, cameras, upward_axis(files[0].info.comments))
        if options.placement.sh_degree is not None:
            gaussians = replace(gaussians, shN=gaussians.shN[:, : (options.placement.sh_degree + 1) ** 2 - 1])
        if frame is not IDENTITY:  # means stay in float64 until the file is written
            gaussians = frame.move_gaussians(replace(gaussians, means=gaussians.means.astype(np.float64)))
        moved_cameras = NO_CAMERAS if cameras is None else frame.move_cameras(cameras)
        largest = max(float(np.abs(gaussians.means).max()), float(gaussians.scales.max()))
        if options.placement.moves and not 1e-30 < largest < 1e30:  # numbers in files have 32 bits
            problem = f"expected coordinates of 1e-30 to 1e30, the largest would be {largest:.0e}"
            raise UsageError(f"--scale, --translate: {problem}")
    gaussians = pad_harmonics(gaussians, NUM_FULL) if outputs.options.columns == "full" else gaussians
    infos = [file.info for file in files]
    all_columns, missing = join_extra_columns([read_extra_columns(file.info)[file.valid] for file in files])
    columns = all_columns[rows]
    named_notes = [name_notes(path.name, file_notes(info)) for path, info in zip(options.inputs, infos, strict=True)]
    notes = [*file_notes(infos[0])] if len(files) == 1 else [*chain(*named_notes)]
    notes += [*camera_notes, *describe_extra_columns(columns, missing, format_, moves=options.placement.moves)]
    if "unseen" in options.clean.drops:
        notes += _unseen_notes(options, dropped["unseen"], count, None if stored is None else stored.path)
    names = () if stored is None else stored.names
    notes += format_notes(outputs.result, gaussians, moved_cameras)
    comments, comment_notes = _join_comments(infos, format_, moves=options.placement.moves)
    notes += comment_notes
    if any(RESULT_COMMENT in info.comments for info in infos):
        comments = result_comments(None, comments)
    report_progress(f"convert: {outputs.result.name}", steps - 1, steps)
    levels = [gaussians]
    for level_count in level_counts(len(gaussians), STREAMED_LEVELS) if format_.levels == "inside" else ():
        levels.append(merge_neighbors(levels[-1], level_count))
    notes += frame_notes(outputs, moved_cameras)
    contents = Contents(levels, comments, moved_cameras, names, scene_title(options.inputs[0]), extra_columns=columns)
    num_bytes, camera_path = write_outputs(outputs, contents), outputs.viewer_cameras if len(moved_cameras) else None
    facts = {"path": str(outputs.result), "bytes": num_bytes, "num_gaussians": len(gaussians), "format": format_.ending}
    inputs = [{"path": str(info.path), "bytes": info.file_bytes, "num_gaussians": info.count} for info in infos]
    input_cameras = None if stored is None else str(stored.path)
    earlier_cameras = viewer_cameras_path(outputs.result)
    if camera_path is None and not format_.has_cameras and earlier_cameras.is_file():
        notes.append(f"{earlier_cameras} is of an earlier file of that name, not of this one: delete it")
    return {
        **document_head(), "inputs": inputs, "cameras": input_cameras, "dropped": dropped, "output": facts,
        "viewer_cameras": camera_path and str(camera_path), **note_entries(notes),
    }  # fmt: skip


def _join_comments(infos: Sequence[FileInfo], format_: Format, *, moves: bool) -> tuple[list[str], list[str]]:
    """Return the header comments that all files have, and notes about the other comments, which the output lacks.

    If the scene moves, comments about its frame are no longer true, and are left out.
    """
    file_comments = [
        [comment for comment in kept_comments(info) if not (moves and states_vertical_axis(comment))] for info in infos
    ]
    all_comments = list(dict.fromkeys(chain(*file_comments)))
    shared = [comment for comment in all_comments if all(comment in comments for comments in file_comments)]
    unshared = [comment for comment in all_comments if comment not in shared]
    notes = [f"not all files have the mark {comment!r}, so the joined file has not" for comment in unshared]
    lost = [] if format_.marks is None else [comment for comment in shared if comment not in format_.marks]
    return shared, [*notes, *(f"{format_.ending} cannot store the mark {comment!r}" for comment in lost)]


def conversion_line(document: dict[str, Any]) -> str:
    """Describe the document of :func:`convert_files` in one line of text."""
    before = sum(entry["num_gaussians"] for entry in document["inputs"])
    after = document["output"]
    total = "" if after["num_gaussians"] == before and not document["dropped"] else f" of {before:,}"
    reasons = describe_counts(document["dropped"], placed=document["cameras"] is None)
    left_out = f" (left out: {reasons})" if reasons else ""
    camera_path = document["viewer_cameras"]
    cameras = f"; cameras in {Path(camera_path).name}" if camera_path else ""
    count = f"{after['num_gaussians']:,}{total} Gaussians{left_out}"
    size = human_bytes(after["bytes"])
    return f"{after['path']}: {count}, {size}{cameras}"


def _unseen_notes(options: ConvertOptions, unseen: int, count: int, cameras: StrPath | None) -> list[str]:
    """Return a note about ``--drop unseen`` if no cameras are known, or if ``unseen`` exceeds half of ``count``."""
    if cameras is None:
        likely = None if options.cameras == NONE else find_scene_files(options.inputs[0]).cameras
        remedy = "" if options.cameras == NONE else f"; name them with --cameras {likely or 'FILE'}"
        return [f"drop unseen: without cameras, views are placed around and inside the scene{remedy}"]
    if 2 * unseen > count:
        share = f"{100 * unseen / count:.0f} % of the Gaussians"
        return [f"drop unseen: the cameras in {cameras} do not show {share}; are they those of this scene?"]
    return []


def _find_cameras(options: ConvertOptions) -> tuple[CameraFile | None, list[str]]:
    """Return the cameras that the options name, or else those of the first input if it is a result, and notes.

    If the cameras of the first input cannot be read, a note says so, and None is returned in place of cameras.
    """
    named = options.cameras
    first_input = options.inputs[0]
    path = result_cameras(first_input) if named is None else named_path(named)
    try:
        return None if path is None else read_cameras(path), []
    except SceneError as error:
        if named is not None or path == first_input:
            raise
        text = f"{path} is left out: {error.problem}; name other cameras with --cameras, or pass none"
        return None, [Doubt(text)]


def _clean_joined(
    gaussians: Gaussians, options: ConvertOptions, stored: CameraFile | None
) -> tuple[np.ndarray, dict[str, int]]:
    """Crop the Gaussians, and drop the kinds that the options name.

    Returns the rows that remain, and the number of dropped Gaussians by reason.
    """
    drops = options.clean.drops
    if not {"sky", "unseen"} & set(drops) or len(gaussians) == 0:
        return clean(gaussians, options.clean, None, None, lambda g: g)
    photos = named_path(options.images)
    images = None
    cameras = None
    if "sky" in drops and (stored is None or photos is None):
        problem = "expected photos and their cameras, which show where the sky is"
        raise UsageError(f"--drop sky: {problem}; give --images")
    if stored is not None and photos is not None:
        images = read_images(photos, stored.names)
        cameras = to_cameras(stored, (images.shape[2], images.shape[1]))
    elif stored is not None:
        cameras = to_cameras(stored)
    placed = place_viewpoints(gaussians) if cameras is None else cameras
    frame = scene_frame(make_scene(gaussians, placed))
    canonical = frame.enter(replace(gaussians, means=gaussians.means.astype(np.float64)))
    return clean(canonical, options.clean, frame.enter_cameras(placed), images, frame.leave)


def find_placement(options: PlacementOptions, cameras: Cameras | None, marked: str | None = None) -> Similarity:
    """Return the map from the frame of the scene to the frame of the output file.

    The upward axis of the scene is the mean upward axis of the ``cameras``. Without cameras it is ``marked``, the axis
    that the header of the input file names, or else -y.
    """
    if not options.moves:
        return IDENTITY
    rotation = np.eye(3)
    if options.up is not None:
        upward = _axis(marked or "-y") if cameras is None else -cameras.viewmats[:, 1, :3].sum(0)
        rotation = rotation_between(normalize(upward), _axis(options.up))
    if options.rotate is not None:
        rotation = matmul(euler_to_rotmat(np.array(parse_triple("rotate", options.rotate))), rotation)
    scale = 1.0 if options.scale is None else float(options.scale)
    return Similarity(rotation, scale, np.array(parse_triple("translate", options.translate)))


def _axis(name: str) -> np.ndarray:
    """Return the unit vector ``[3]`` of an axis such as ``"y"`` or ``"-y"``."""
    axis = np.zeros(3)
    axis[AXES.index(name) // 2] = -1 if name[0] == "-" else 1
    return axis


def rotation_between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the rotation ``[3,3]`` by the smallest angle from one unit vector to another (Rodrigues' formula)."""
    cosine = float((start * end).sum())
    if cosine < -1 + 1e-12:  # opposite vectors: turn by 180 degrees about any axis that is perpendicular to them
        axis = np.eye(3)[0] if abs(start[0]) < 0.9 else np.eye(3)[1]
        axis = normalize(axis - (axis * start).sum() * start)
        return 2 * np.outer(axis, axis) - np.eye(3)
    x, y, z = np.cross(start, end)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + cross + matmul(cross, cross) / (1 + cosine))
