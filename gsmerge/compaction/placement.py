"""Bring Gaussians and cameras into the frame of an output: turned, and cut to a degree."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsmerge.errors import SceneError, UsageError
from gsmerge.geometry import IDENTITY, Similarity, normalize, turn_by
from gsmerge.io import output_format
from gsmerge.io.atomic import AddOutput, atomic_outputs
from gsmerge.io.cameras.camera_file import to_cameras
from gsmerge.io.cameras.read import read_cameras
from gsmerge.io.cameras.viewer_cameras import viewer_cameras, viewer_cameras_path
from gsmerge.io.formats.arrays import RESULT_COMMENT, new_views_comment
from gsmerge.io.formats.table import FOLDERS, Contents, NamedPhotos
from gsmerge.io.image_names import match_images
from gsmerge.kernels.matrices import matmul
from gsmerge.settings.placement import AXES, PlacementOptions, parse_triple
from gsmerge.types import Cameras, Gaussians

if TYPE_CHECKING:
    from gsmerge.compaction.result import CompactResult

NUM_FULL = 15  # harmonics above degree 0 up to degree 3
SAME = 1e-5  # relative difference up to which cameras are the same; pixels by a hundred times as much


def pad_harmonics(gaussians: Gaussians, count: int) -> Gaussians:
    """Pad the harmonics above degree 0 with zeros to at least ``count``."""
    missing = max(0, count - gaussians.shN.shape[1])
    return replace(gaussians, shN=np.pad(gaussians.shN, ((0, 0), (0, missing), (0, 0))))


def find_placement(options: PlacementOptions, cameras: Cameras | None, marked: str | None = None) -> Similarity:
    """Find the map from the frame of the scene to that of its file.

    The upward axis is that of the ``cameras``, otherwise that which the file is ``marked`` with, otherwise -y.
    """
    if not options.moves:
        return IDENTITY
    rotation = np.eye(3)
    if options.up is not None:
        upward = _axis(marked or "-y") if cameras is None else -cameras.viewmats[:, 1, :3].sum(0)
        rotation = turn_to(normalize(upward), _axis(options.up))
    if options.rotate is not None:
        rotation = matmul(turn_by(np.array(parse_triple("rotate", options.rotate))), rotation)
    scale = 1.0 if options.scale is None else float(options.scale)
    return Similarity(rotation, scale, np.array(parse_triple("translate", options.translate)))


def _axis(name: str) -> np.ndarray:
    axis = np.zeros(3)
    axis[AXES.index(name) // 2] = -1 if name[0] == "-" else 1
    return axis


def turn_to(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the smallest rotation ``[3,3]`` of a unit vector to another (Rodrigues); about x if they are opposite."""
    cosine = float((start * end).sum())
    if cosine < -1 + 1e-12:
        about = np.eye(3)[0] if abs(start[0]) < 0.9 else np.eye(3)[1]
        about = normalize(about - (about * start).sum() * start)
        return 2 * np.outer(about, about) - np.eye(3)
    x, y, z = np.cross(start, end)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + cross + matmul(cross, cross) / (1 + cosine))


def place(
    gaussians: Gaussians, cameras: Cameras, frame: Similarity, sh_degree: int | None
) -> tuple[Gaussians, Cameras]:
    """Move Gaussians and cameras into a frame, and leave out harmonics above a degree."""
    if sh_degree is not None:
        gaussians = replace(gaussians, shN=gaussians.shN[:, : (sh_degree + 1) ** 2 - 1])
    if frame is IDENTITY:
        return gaussians, cameras
    wide = replace(gaussians, means=gaussians.means.astype(np.float64))  # until they are written
    return frame.move_gaussians(wide), frame.move(cameras)


def add_views(add: AddOutput, path: Path, cameras: Cameras, names: Sequence[str], *, overwrite: bool) -> None:
    """Write cameras for viewers as part of :func:`atomic_outputs`; UsageError if ``path`` has others.

    A file with these cameras, to within rounding, is left as it is: results in several formats share it.
    """
    if overwrite or not path.exists():
        add(path).write_bytes(viewer_cameras(cameras, names).encode())
    elif not _has_cameras(path, cameras, names):
        raise other_cameras(path)


def named_cameras(path: Path, names: Sequence[str]) -> Cameras | None:
    """Read the cameras of a file if they have these names; None for any other file."""
    with suppress(SceneError):
        stored = read_cameras(path)
        return to_cameras(stored) if list(stored.names) == list(names) else None
    return None


def _has_cameras(path: Path, cameras: Cameras, names: Sequence[str]) -> bool:
    """Return whether a file holds these cameras under these names, to within rounding."""
    found, reach = named_cameras(path, names), np.abs(cameras.viewmats[:, :3, 3]).max(initial=1)
    if found is None or (found.width, found.height) != (cameras.width, cameras.height):
        return False
    same_place = np.allclose(found.viewmats, cameras.viewmats, rtol=0, atol=SAME * reach)
    return same_place and np.allclose(found.Ks, cameras.Ks, rtol=SAME, atol=100 * SAME)


def other_cameras(path: Path) -> UsageError:
    """Make the error for an existing file of cameras that belongs to another result."""
    remedy = "name another output, or pass --overwrite to replace it"
    return UsageError(f"{path}: exists already, with other cameras than this result's; {remedy}")


def name_photos(photos: Path | None, names: Sequence[str]) -> NamedPhotos:
    """Name views by their files in a folder of photos, as COLMAP does; otherwise by their names in the camera file.

    Returns each name and its photo, None where that is in no folder.
    """
    if photos is not None and photos.is_dir():
        with suppress(SceneError):
            return [(file.relative_to(photos).as_posix(), file) for file in match_images(photos, names)]
    return [(name.removeprefix("./").removeprefix("images/"), None) for name in names]  # as a transforms.json has them


def save_result(result: CompactResult, path: Path, *, overwrite: bool) -> Path:
    """Write a result as :meth:`gsmerge.CompactResult.save`; return the path of its main file."""
    row = FOLDERS.get(path.name)
    out = path if row is None else path / row.place / row.ending
    chosen = output_format(out, levels=True, cameras=True)
    cameras, levels = result.cameras.numpy(), [result, *result.coarser]
    names = result.names or tuple(f"view {view}" for view in range(len(cameras)))
    if not len(cameras) and chosen.cameras == "needed":
        raise UsageError(f"{out}: expected a scene with cameras, got none")
    new = result.report.new_views
    comments = [RESULT_COMMENT, *([] if new is None else [new_views_comment(new)])]
    contents = Contents(
        [level.gaussians.numpy() for level in (levels if chosen.levels else levels[:1])], comments, cameras,
        name_photos(None, names), out.stem,
    )  # fmt: skip
    with atomic_outputs(overwrite=overwrite) as add:
        chosen.write(add, out, add(out), contents)
        if len(cameras) and not chosen.cameras:
            add_views(add, viewer_cameras_path(out), cameras, names, overwrite=overwrite)
    chosen.finish(out)
    return out
