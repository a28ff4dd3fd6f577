"""Bring Gaussians and cameras into the frame and the files of an output: turned, cut to a degree, as a COLMAP model."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError, UsageError
from gsmerge.geometry import IDENTITY, Similarity, normalize, turn_by
from gsmerge.io import output_format, write_gaussians
from gsmerge.io.atomic import AddOutput, link_file
from gsmerge.io.cameras.camera_file import to_cameras
from gsmerge.io.cameras.colmap_model import files_beside, model_files
from gsmerge.io.cameras.json_files import viewer_cameras
from gsmerge.io.cameras.read import read_cameras
from gsmerge.io.formats.streamed import add_levels
from gsmerge.io.formats.table import COLMAP, HTML, INDEX, MODEL_NAMES
from gsmerge.io.formats.write import NamedPhotos, photo_folder
from gsmerge.io.image_names import match_images
from gsmerge.kernels.matrices import matmul
from gsmerge.measure.visibility import front_rows
from gsmerge.settings.placement import AXES, PlacementOptions, parse_triple
from gsmerge.types import Cameras, Gaussians

NUM_FULL = 15  # harmonics above degree 0 up to degree 3
SAME = 1e-5  # relative difference up to which cameras are the same; pixels by a hundred times as much


def pad_harmonics(gaussians: Gaussians, count: int) -> Gaussians:
    """Pad the harmonics above degree 0 with zeros to at least ``count``."""
    missing = max(0, count - gaussians.shN.shape[1])
    return replace(gaussians, shN=np.pad(gaussians.shN, ((0, 0), (0, missing), (0, 0))))


def find_placement(options: PlacementOptions, cameras: Cameras | None) -> Similarity:
    """Find the map from the frame of the scene to that of its file; the ``cameras`` determine the upward axis."""
    if not options.moves:
        return IDENTITY
    rotation = np.eye(3)
    if options.up is not None:
        axis = np.zeros(3)
        axis[AXES.index(options.up) // 2] = -1 if options.up[0] == "-" else 1
        upward = np.array([0.0, -1.0, 0.0]) if cameras is None else -cameras.viewmats[:, 1, :3].sum(0)
        rotation = turn_to(normalize(upward), axis)
    if options.rotate is not None:
        rotation = matmul(turn_by(np.array(parse_triple("rotate", options.rotate))), rotation)
    scale = 1.0 if options.scale is None else float(options.scale)
    return Similarity(rotation, scale, np.array(parse_triple("translate", options.translate)))


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


def add_result(
    add: AddOutput,
    out: Path,
    first: Path,
    levels: Sequence[Gaussians],
    comments: Sequence[str],
    views: tuple[Cameras, NamedPhotos, str],
    *,
    normals: bool,
    site: bool,
) -> dict[Path, list[Path]]:
    """Write Gaussians, whose file is ``first`` now, and coarser levels of them, each with ``comments`` in its header.

    A COLMAP model and a page have the ``views``, too: cameras, names with photos, and the scene's title. Returns
    the path of each level, in their order, with its files as they are before they are renamed.
    """
    ending = output_format(out, levels=True, cameras=True).ending
    cameras, photos, title = views
    if ending == COLMAP.ending:
        return {out: add_colmap(add, out, first, levels[0], cameras, photos)}
    if ending == HTML.ending:
        from gsmerge.pages.site import add_site, site_contents

        return {out: add_site(add, first, site_contents(levels[0], cameras, title, comments, apart=site))}
    if ending == INDEX:
        (_, finest), *coarser = add_levels(add, out, first, levels, comments)
        return {out: [first, *finest], **dict(coarser)}
    written = {out: [first]}
    for level in range(1, len(levels)):
        path = level_output(out, level)
        written[path] = [add(path)]
    for (file,), gaussians in zip(written.values(), levels, strict=True):
        write_gaussians(file, gaussians, overwrite=True, comments=comments, ending=ending, normals=normals)
    return written


def level_output(output: Path, level: int) -> Path:
    """Return the path of a further level of detail, counted from 1: ``out.ply`` -> ``out.level1.ply``."""
    cut = len(output.name) - len(output_format(output).ending)
    return output.with_name(f"{output.name[:cut]}.level{level}{output.name[cut:]}")


def add_colmap(
    add: AddOutput, path: Path, points: Path, gaussians: Gaussians, cameras: Cameras, photos: NamedPhotos
) -> list[Path]:
    """Write a COLMAP model as part of :func:`atomic_outputs`; ``points`` is the temporary file of ``path``.

    ``photos``: those of :func:`name_photos`, which are linked where trainers look for them unless that folder exists.
    Returns the present paths of all files of the model.
    """
    files, place = [points, *map(add, files_beside(path))], photo_folder(path)
    if not place.exists():
        for name, photo in dict(photos).items():
            if photo is not None:
                link_file(photo, add(place / name))
    names = [name for name, _ in photos]
    contents = model_files(gaussians, cameras, names, front_rows(gaussians, cameras))
    for file, name in zip(files, MODEL_NAMES, strict=True):
        file.write_bytes(contents[name])
    return files


def name_photos(photos: Path | None, names: Sequence[str]) -> NamedPhotos:
    """Name views by their files in a folder of photos, as COLMAP does; otherwise by their names in the camera file.

    Returns each name and its photo, None where that is in no folder.
    """
    if photos is not None and photos.is_dir():
        with suppress(SceneError):
            return [(file.relative_to(photos).as_posix(), file) for file in match_images(photos, names)]
    return [(name.removeprefix("./").removeprefix("images/"), None) for name in names]  # as a transforms.json has them
