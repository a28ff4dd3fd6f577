"""Cameras, photos and rows brought together: as they stand, at another size, or with the poses read in another way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.alignment.grid import Fit, Photos, as_is, mapped, photo_size, small_photos
from gsmerge.io.alignment.layouts import MAY_BE_LOOSE
from gsmerge.io.alignment.poses import aligned_poses, check_one_fits, other_readings, poses_note, reread, with_poses
from gsmerge.io.alignment.recover import MARGIN, Recovery, recover
from gsmerge.io.alignment.score import Clues, color_error
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.cameras.da3 import read_depths
from gsmerge.io.formats.ply import PlyScene
from gsmerge.io.photos import as_tensor, natural_key

_LARGE = 2  # times as many pixels as rows: likely photos of another size than the grid's
_ALIKE, _ALIKE_PX = 1.15, 0.02  # two fits of one grid that only the photos' colours can tell apart
_MOST = 6  # fits that only the number of rows speaks for and that are tried with all frames


@dataclass(frozen=True)
class Fitted:
    """What was found.

    Args:
        clues: The cameras and photos at the size of the grid.
        recovery: Which row is which pixel; None where the rows belong to no pixels that could be found.
        camera_file: The cameras as they were read in the end.
        notes: What was adapted.
    """

    clues: Clues
    recovery: Recovery | None
    camera_file: CameraFile
    notes: list[str]


@dataclass(frozen=True)
class _Given:
    """All but the cameras: Gaussians, photos and their size, and what is told."""

    ply: PlyScene
    photos: Photos | None
    size: tuple[int, int] | None
    order: str
    scale: float | None


def fit_cameras(
    ply: PlyScene, camera_file: CameraFile, photos: Photos | None, *, order: str = "auto", scale: float | None = None
) -> Fitted:
    """Find the size, the mapping of the photos and the convention of the poses under which the rows are pixels.

    Args:
        ply: The Gaussians.
        camera_file: The cameras.
        photos: c uint8 photos of one size, or None.
        order: Of the rows, where it is told.
        scale: Of the Gaussians' world in units of the cameras', where it is told.

    Raises:
        SceneError: If sizes do not agree, or several conventions fit.
    """
    given = _Given(ply, photos, photo_size(photos), order, scale)
    clues_of, size = partial(_clues, given, camera_file), given.size
    try:
        plain, problem = as_is(camera_file, size), None
    except SceneError as error:
        plain, problem = None, error
    searched = order == "none"
    if not searched and (plain is None or _is_large(ply, plain)):
        searched = True
        found = _other_size(given, camera_file)
        if found is not None:
            return Fitted(found[0], found[1], camera_file, list(found[2].notes))
    if plain is None:
        both = _other_size_and_poses(given, camera_file) if order not in MAY_BE_LOOSE else None
        if both is not None:
            return both
        raise problem or SceneError(camera_file.path, "expected the image size of the cameras, found none")
    clues, notes = clues_of(plain), list(plain.notes)
    recovery = recover(clues)
    if recovery is None and not searched:
        found = _other_size(given, camera_file)
        if found is not None:
            return Fitted(found[0], found[1], camera_file, list(found[2].notes))
    other = aligned_poses(clues, camera_file) if recovery is None else None
    if other is not None:
        poses, recovery = other
        notes.append(poses_note(poses, camera_file.convention))
        clues = replace(clues, cameras=with_poses(clues.cameras, poses.viewmats))
        camera_file = reread(camera_file, poses.convention)
    if recovery is None and order not in MAY_BE_LOOSE:
        both = _other_size_and_poses(given, camera_file)
        if both is not None:
            return both
        small = small_photos(ply.info, camera_file, size)
        if small is not None:
            raise small
    return Fitted(clues, recovery, camera_file, notes)


def _is_large(ply: PlyScene, plain: Fit) -> bool:
    pixels = len(plain.cameras) * plain.cameras.width * plain.cameras.height
    return pixels > _LARGE * len(ply.gaussians)


def _clues(given: _Given, camera_file: CameraFile, one: Fit, *, photos: bool = True) -> Clues:
    """What there is, the cameras as one fit has them; without photos where only positions are looked at."""
    brought = given.photos if photos else None
    if brought is not None and one.mapping is not None:
        brought = one.mapping.photos(brought)
    images = None if brought is None else as_tensor(brought)
    depths: Callable[[], np.ndarray | None] = partial(read_depths, Path(camera_file.path))
    labellings, ply = _labellings(camera_file.names), given.ply
    return Clues(ply.gaussians, ply.valid, one.cameras, images, labellings, depths, given.order, given.scale)


def _labellings(names: Sequence[str]) -> list[list[int]]:
    """Orders that the views may be in: that of the camera file, and that of the images' names."""
    return [list(range(len(names))), sorted(range(len(names)), key=lambda i: natural_key(names[i]))]


def _other_size(
    given: _Given, camera_file: CameraFile, *, exact_frames: bool = False
) -> tuple[Clues, Recovery, Fit] | None:
    """The fit at another size that puts the Gaussians nearest to their pixels; None where grids of two sizes do.

    Those that only the number of rows speaks for are tried in the frame of the cameras first: there may be many.

    Args:
        given: All but the cameras.
        camera_file: The cameras.
        exact_frames: Try all of them only so.
    """
    found: list[tuple[Fit, Recovery]] = []
    guesses: list[Fit] = []
    clues_of = partial(_clues, given, camera_file)
    for one in mapped(given.ply.info, camera_file, given.size):
        if found and one.rank > found[0][0].rank:
            break
        if one.guessed:
            guesses.append(one)
        recovery = recover(clues_of(one, photos=False), exact_frames=one.guessed or exact_frames)
        found += [] if recovery is None else [(one, recovery)]
    for one in guesses[:_MOST] if not (found or exact_frames) else []:
        recovery = recover(clues_of(one, photos=False))
        found += [] if recovery is None else [(one, recovery)]
    if not found:
        return None
    best = min(found, key=lambda f: f[1].best.worst_px)
    px = best[1].best.worst_px
    exact = best[1].best.layout.kind != "pruned"  # what lacks pixels fits into grids of nearly its size as well
    if exact and any(_grid(f) != _grid(best) and f[1].best.worst_px < MARGIN * max(px, 1e-3) for f in found):
        return None
    near = max(_ALIKE * px, px + _ALIKE_PX)
    alike = [f for f in found if _grid(f) == _grid(best) and f[1].best.worst_px <= near]
    brought = [(clues_of(one), recovery, one) for one, recovery in alike]
    if len(brought) == 1:
        return brought[0]
    return min(brought, key=lambda f: np.nan_to_num(color_error(f[0], f[1].best.layout), nan=1.0))


def _other_size_and_poses(given: _Given, camera_file: CameraFile) -> Fitted | None:
    """The one fit at another size, with the poses read in another way; only where no pixel and no frame is missing.

    Raises:
        SceneError: If several readings fit alike.
    """
    found = []
    for poses in other_readings(camera_file.viewmats.double().numpy(), camera_file.convention):
        one = _other_size(given, reread(camera_file, poses.convention), exact_frames=True)
        found += [] if one is None else [(poses, one)]
    check_one_fits(camera_file, [(poses, one[1]) for poses, one in found])
    if not found:
        return None
    poses, (clues, recovery, fit) = min(found, key=lambda one: one[1][1].best.worst_px)
    notes = [*fit.notes, poses_note(poses, camera_file.convention)]
    return Fitted(clues, recovery, reread(camera_file, poses.convention), notes)


def _grid(found: tuple[Fit, Recovery]) -> tuple[int, int]:
    return found[0].cameras.width, found[0].cameras.height
