"""Write all files of an output, which are Gaussians with their cameras, or none of them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError, UsageError
from gsmerge.frozen import dataclass, field, replace
from gsmerge.io.atomic import AddOutput, atomic_outputs
from gsmerge.io.cameras.camera_file import to_cameras
from gsmerge.io.cameras.read_cameras import read_cameras
from gsmerge.io.cameras.viewer_cameras import is_own_settings, viewer_cameras, viewer_cameras_path, viewer_settings
from gsmerge.io.formats.table import TILESET, Contents, Format, output_format
from gsmerge.method.viewpoints.place_cameras import place_viewpoints
from gsmerge.plan.counts import STREAMED_LEVELS
from gsmerge.settings.compact import OURS, CompactOptions
from gsmerge.settings.files import AXES, FileOptions
from gsmerge.types import Cameras, Gaussians, Scene

# Two cameras are the same if their viewmats and Ks differ by rounding alone. Viewmats may differ by this share of the
# largest translation. Ks may differ by this share of their value, or by a hundred times this number in pixels
CAMERA_TOLERANCE = 1e-5
NUM_FULL = 15  # number of harmonics of the degrees 1 to 3


@dataclass(frozen=True)
class Outputs:
    """The paths of the files of an output, and how they are written."""

    result: Path  # Its name chooses the format; a ``lod-meta.json`` holds all levels, in chunks beside it
    viewer_cameras: Path | None = None  # None: write no cameras beside it. Results in several formats share the file
    overwrite: bool = False  # Replace files that exist
    options: FileOptions = field(default_factory=FileOptions)

    @property
    def format(self) -> Format:
        """The format of the result; UsageError if the name has no ending that can be written."""
        return output_format(self.result)

    @property
    def paths(self) -> list[Path]:
        """The result, and the file that its format always writes beside it, if there is one."""
        beside = self.format.beside_path(self.result)
        return [self.result] if beside is None else [self.result, beside]


def name_outputs(result: Path, options: FileOptions | None = None, *, overwrite: bool = False) -> Outputs:
    """Return the paths of the files of an output. Cameras get a separate file if the format cannot hold cameras.

    Raises UsageError if the name has no ending that can be written, or if the options do not fit the format.
    """
    options = options or FileOptions()
    format_ = output_format(result)
    if options.columns == "full" and not (format_.columns and options.normals):
        raise UsageError(f"columns full: expected a .ply output with normals, got {result.name}")
    if options.place is not None and format_ is not TILESET:
        raise UsageError(f"place: expected {TILESET.ending} as the output, got {result.name}")
    if options.spz_version != FileOptions.spz_version and format_.ending not in (".spz", TILESET.ending):
        raise UsageError(f"spz_version: expected .spz or {TILESET.ending} as the output, got {result.name}")
    is_beside = options.viewer_cameras and not format_.has_cameras
    return Outputs(result, viewer_cameras_path(result) if is_beside else None, overwrite, options)


def pad_harmonics(gaussians: Gaussians, count: int) -> Gaussians:
    """Pad the harmonics above degree 0 with zeros, so that each Gaussian has at least ``count`` of them."""
    missing = max(0, count - gaussians.shN.shape[1])
    return replace(gaussians, shN=np.pad(gaussians.shN, ((0, 0), (0, missing), (0, 0))))


def join_gaussians(parts: Sequence[Gaussians]) -> Gaussians:
    """Join Gaussians of one world frame. Harmonics are padded with zeros to the highest degree of all parts."""
    num_higher = max(gaussians.shN.shape[1] for gaussians in parts)
    return parts[0] if len(parts) == 1 else Gaussians.concat([pad_harmonics(part, num_higher) for part in parts])


def settings_for(outputs: Outputs, settings: CompactOptions, *, has_levels: bool = True) -> CompactOptions:
    """Return the settings of a run with the name of its output, because a budget may count the bytes of this file.

    If ``has_levels`` is false, the format of the output chooses the number of levels. Raises UsageError if there are
    several levels, or a budget in bytes, and the format cannot have these.
    """
    out = outputs.result
    format_ = outputs.format
    if format_.levels == "inside" and settings.method == OURS and not has_levels:
        settings = settings.with_settings({"levels": STREAMED_LEVELS})
    budget = settings.budget
    if not format_.levels and budget.levels > 1:
        kind = format_.about.partition(":")[0]
        raise UsageError(f"{out}: expected one level in {kind}, found --levels {budget.levels}; drop --levels")
    if budget.in_bytes and not format_.gaussian_bytes:
        raise UsageError(f"{out}: expected a --budget in Gaussians for this format, got {budget.budget}")
    if budget.in_bytes and outputs.options.columns == "full":
        raise UsageError(f"columns full: expected a --budget that is a number or a share, got {budget.budget}")
    return replace(settings, budget=replace(budget, output=out.name))


def list_first_layers(scene: Scene) -> list[int]:
    """Return the views, but if several have the same name and camera, and so are layers of one view, only the first."""
    cameras = zip(scene.names, scene.cameras.viewmats, scene.cameras.Ks, strict=True)
    keys = [(name, viewmat.tobytes(), K.tobytes()) for name, viewmat, K in cameras]
    return [view for view, key in enumerate(keys) if key not in keys[:view]]


def write_outputs(outputs: Outputs, contents: Contents) -> int:
    """Write the files of an output; return how many bytes the result and its levels have together."""
    with atomic_outputs(overwrite=outputs.overwrite) as add:
        written = add_outputs(add, outputs, add(outputs.result), contents)
        num_bytes = sum(file.stat().st_size for files in written.values() for file in files)
    outputs.format.finish(outputs.result)
    return num_bytes


def add_outputs(add: AddOutput, outputs: Outputs, temporary: Path, contents: Contents) -> dict[Path, list[Path]]:
    """Write the files of an output in a block of :func:`atomic_outputs`; return the temporary files of each level.

    ``add`` comes from the block, and ``temporary`` is the path that ``add`` has returned for the result. Results in
    several formats share one file of cameras. An existing file with the same cameras, to within rounding, stays
    unchanged, and UsageError is raised if it has other cameras. Viewers of some formats start at the first camera in
    the file, or in a file of settings beside it. If the scene has no camera, one is placed for these viewers. A file of
    settings that exists already stays unchanged, unless gsmerge wrote it and may overwrite files.
    """
    format_ = outputs.format
    gaussians = contents.levels[0]
    has_views = len(contents.cameras) > 0
    contents = replace(contents, options=outputs.options)
    if outputs.viewer_cameras is not None and has_views:
        if outputs.overwrite or not outputs.viewer_cameras.exists():
            content = viewer_cameras(contents.cameras, contents.names)
            add(outputs.viewer_cameras).write_bytes(content.encode())
        else:
            refuse_to_replace_cameras(outputs.viewer_cameras, contents.cameras, contents.names)
    if format_.first_view and outputs.options.viewer_cameras:
        if not has_views:
            contents = replace(contents, cameras=place_viewpoints(gaussians)[:1])
        settings = format_.settings_path(outputs.result)
        if settings is not None and (
            not settings.exists() or (outputs.overwrite and settings.is_file() and is_own_settings(settings))
        ):
            add(settings).write_text(viewer_settings(contents.cameras, gaussians.means), encoding="utf-8")
    return format_.write(add, outputs.result, temporary, contents)


def frame_notes(outputs: Outputs, cameras: Cameras) -> list[str]:
    """Return notes if viewers of the format will not show the scene upright, or not at its place on the globe."""
    format_ = outputs.format
    notes = list[str]()
    if format_ is TILESET and outputs.options.place is None:
        notes.append("without a place the scene lies in the middle of the earth: --set place=LON,LAT,HEIGHT")
    if len(cameras) and (format_.first_view or format_ is TILESET):
        up = -cameras.viewmats[:, 1, :3].mean(0)
        axis = int(np.abs(up).argmax())
        up_axis = AXES[2 * axis + int(up[axis] < 0)]
        if up_axis != "-y":
            problem = f"{up_axis} is upward for the cameras, and -y for viewers of {format_.ending}"
            notes.append(f"{problem}: gsmerge convert --up -y turns the scene")
    return notes


def refuse_to_replace_cameras(path: Path, cameras: Cameras, names: Sequence[str], *, moved: bool = False) -> None:
    """Raise UsageError if an existing file has other cameras than these, to within rounding.

    If ``moved``, poses are not compared, because the run may still move these cameras.
    """
    is_same = False
    with suppress(SceneError):  # a file that cannot be read has no cameras
        file = read_cameras(path)
        farthest = np.abs(cameras.viewmats[:, :3, 3]).max(initial=1)
        stored = to_cameras(file)
        same_views = [*file.names, stored.width, stored.height] == [*names, cameras.width, cameras.height]
        same_poses = same_views and (
            moved or np.allclose(stored.viewmats, cameras.viewmats, rtol=0, atol=CAMERA_TOLERANCE * farthest)
        )
        is_same = same_poses and np.allclose(stored.Ks, cameras.Ks, rtol=CAMERA_TOLERANCE, atol=100 * CAMERA_TOLERANCE)
    if not is_same:
        remedy = "name another output, or pass --overwrite to replace it"
        raise UsageError(f"{path}: exists already, with other cameras than this result's; {remedy}")
