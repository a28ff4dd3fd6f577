"""Write Gaussians with their cameras: all files of an output, or none."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError, UsageError
from gsmerge.facts.place_cameras import place_viewpoints
from gsmerge.io import output_format
from gsmerge.io.atomic import AddOutput, atomic_outputs
from gsmerge.io.cameras.camera_file import to_cameras
from gsmerge.io.cameras.read import read_cameras
from gsmerge.io.cameras.viewer_cameras import is_own_settings, viewer_cameras, viewer_cameras_path, viewer_settings
from gsmerge.io.formats.arrays import RESULT_COMMENT, ExpectedScores, new_views_comment
from gsmerge.io.formats.table import TILESET, Contents
from gsmerge.settings.placement import AXES
from gsmerge.types import Cameras, Gaussians

# Cameras are the same up to this difference of their viewmats, relative to the largest translation. Their Ks may differ
# by this share, or by a hundred times this number of pixels
SAME = 1e-5


def add_output(
    add: AddOutput, out: Path, temporary: Path, contents: Contents, *, overwrite: bool
) -> dict[Path, list[Path]]:
    """Write an output as :data:`gsmerge.io.formats.table.WriteOutput`, and settings that start its viewers at a view.

    Without cameras, a camera is placed for formats whose viewers look from it first. Settings that are there already
    stay, unless ``overwrite`` and gsmerge wrote them.
    """
    format_, gaussians = output_format(out, levels=True, cameras=True), contents.levels[0]
    shows = format_.first_view and contents.options.viewer_cameras
    if shows and len(contents.cameras) == 0:
        contents = replace(contents, cameras=place_viewpoints(gaussians)[:1])
    settings = out.with_name(format_.settings.format(stem=out.name.removesuffix(format_.ending)) or out.name)
    is_free = not settings.exists() or (overwrite and settings.is_file() and is_own_settings(settings))
    if format_.settings and shows and is_free:
        add(settings).write_text(viewer_settings(contents.cameras, gaussians.means), encoding="utf-8")
    return format_.write(add, out, temporary, contents)


def frame_notes(out: Path, contents: Contents) -> list[str]:
    """Note that viewers of a format do not show the scene upright, or where it lies on the globe."""
    format_, notes = output_format(out, levels=True, cameras=True), list[str]()
    if format_ is TILESET and contents.options.place is None:
        notes.append("without a place the scene lies in the middle of the earth: --set place=LON,LAT,HEIGHT")
    if len(contents.cameras) and (format_.first_view or format_ is TILESET):
        up = -contents.cameras.viewmats[:, 1, :3].mean(0)
        axis = int(np.abs(up).argmax())
        name = AXES[2 * axis + int(up[axis] < 0)]
        if name != "-y":
            problem = f"{name} is upward for the cameras, and -y for viewers of {format_.ending}"
            notes.append(f"{problem}: gsmerge convert --up -y turns the scene")
    return notes


def add_views(add: AddOutput, path: Path, contents: Contents, *, overwrite: bool) -> None:
    """Write cameras for viewers as part of :func:`atomic_outputs`; UsageError if ``path`` has other cameras.

    If the file has these cameras already, to within rounding, it stays unchanged, because results in several formats
    share it.
    """
    cameras, names = contents.cameras, contents.names
    if overwrite or not path.exists():
        add(path).write_bytes(viewer_cameras(cameras, names).encode())
    else:
        refuse_other_cameras(path, cameras, names)


def refuse_other_cameras(path: Path, cameras: Cameras, names: Sequence[str], *, moved: bool = False) -> None:
    """Raise UsageError if a file has other cameras than these, to within rounding; ``moved``: by names and size."""
    if not _has_cameras(path, cameras, names, moved=moved):
        remedy = "name another output, or pass --overwrite to replace it"
        raise UsageError(f"{path}: exists already, with other cameras than this result's; {remedy}")


def _has_cameras(path: Path, cameras: Cameras, names: Sequence[str], *, moved: bool) -> bool:
    with suppress(SceneError):
        file, farthest = read_cameras(path), np.abs(cameras.viewmats[:, :3, 3]).max(initial=1)
        stored = to_cameras(file)
        same_views = [*file.names, stored.width, stored.height] == [*names, cameras.width, cameras.height]
        same_poses = same_views and (
            moved or np.allclose(stored.viewmats, cameras.viewmats, rtol=0, atol=SAME * farthest)
        )
        return bool(same_poses and np.allclose(stored.Ks, cameras.Ks, rtol=SAME, atol=100 * SAME))
    return False


def write_result(
    out: Path,
    levels: Sequence[Gaussians],
    cameras: Cameras,
    names: Sequence[str],
    new_views: ExpectedScores | None,
    *,
    overwrite: bool,
) -> Path:
    """Write the levels of a result, the finest first, with its cameras; return its path.

    The name chooses the format. Raises UsageError if no format has this ending.
    """
    format_ = output_format(out, levels=True, cameras=True)
    comments = [RESULT_COMMENT, *([] if new_views is None else [new_views_comment(new_views)])]
    stored_levels = [level.numpy() for level in (levels if format_.levels else levels[:1])]
    contents = Contents(stored_levels, comments, cameras, names, out.stem)
    write_contents(out, contents, overwrite=overwrite)
    return out


def write_contents(out: Path, contents: Contents, *, overwrite: bool) -> tuple[int, str | None]:
    """Write an output, and its cameras beside it if its format has none; return its bytes and their path."""
    format_, path = output_format(out, levels=True, cameras=True), viewer_cameras_path(out)
    is_beside = contents.options.viewer_cameras and len(contents.cameras) > 0 and not format_.has_cameras
    with atomic_outputs(overwrite=overwrite) as add:
        written = add_output(add, out, add(out), contents, overwrite=overwrite)
        if is_beside:
            add_views(add, path, contents, overwrite=overwrite)
        num_bytes = sum(file.stat().st_size for files in written.values() for file in files)
    format_.finish(out)
    return num_bytes, str(path) if is_beside else None
