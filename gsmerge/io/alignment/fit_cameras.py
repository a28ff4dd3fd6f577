"""Fitting cameras and photos to the rows: as they are, at another size, or with the poses read in another way."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.alignment.grid import GridFit, other_grids, photo_grid, small_photos_error
from gsmerge.io.alignment.layouts import MAY_BE_UNALIGNED
from gsmerge.io.alignment.move_cameras import MovedCameras, recover_moved
from gsmerge.io.alignment.poses import choose_fit, find_aligned_poses, other_conventions
from gsmerge.io.alignment.recover import MARGIN, Recovery, recover
from gsmerge.io.alignment.score import AlignmentInput, color_error
from gsmerge.io.cameras.camera_file import CameraFile, with_convention
from gsmerge.io.cameras.npz_files import read_depths
from gsmerge.io.formats.ply import PlyScene
from gsmerge.io.photos import Photos, PhotoTransform, as_floats, natural_key, photo_size

_LARGE = 2  # times as many pixels as rows: likely photos of another size than the grid's
_ALIKE, _ALIKE_PX = 1.15, 0.02  # two fits of one grid between which only the photos' colours can decide
_MAX_TRIED = 6  # fits that only the number of rows speaks for and that are tried with all frames


@dataclass(frozen=True)
class CameraFit:
    """Cameras and photos at the size of the grid, and which row is which pixel."""

    inputs: AlignmentInput
    recovery: Recovery | None  # None where the rows belong to no pixels that could be recovered
    camera_file: CameraFile  # as it was read in the end
    notes: list[str]  # what was adapted
    transform: PhotoTransform | None = None  # what was done to the photos
    moved: MovedCameras | None = None  # the cameras of the input where they were moved to their Gaussians


@dataclass(frozen=True)
class _Source:
    """All but the cameras: Gaussians, photos and their size, and what the caller says about the rows."""

    ply: PlyScene
    photos: Photos | None
    size: tuple[int, int] | None
    order: str
    scale: float | None


def fit_cameras(
    ply: PlyScene, camera_file: CameraFile, photos: Photos | None, *, order: str = "auto", scale: float | None = None
) -> CameraFit:
    """Find the size, the transform of the photos and the convention of the poses under which the rows are pixels.

    ``photos`` are c uint8 ones of one size; ``order`` and ``scale`` are those of :class:`AlignmentInput`. SceneError if
    sizes do not agree, or several conventions fit.
    """
    source = _Source(ply, photos, photo_size(photos), order, scale)
    try:
        plain, problem = photo_grid(camera_file, source.size), None
    except SceneError as error:
        plain, problem = None, error
    searched = order == "none"
    if not searched and (plain is None or len(plain.cameras) * math.prod(plain.size) > _LARGE * len(ply.gaussians)):
        searched, other_size = True, _other_size(source, camera_file)
        if other_size is not None:
            return other_size
    if plain is None:
        both = _other_size_and_poses(source, camera_file) if order not in MAY_BE_UNALIGNED else None
        if both is not None:
            return both
        raise problem or SceneError(camera_file.path, "expected the image size of the cameras, found none")
    inputs, notes = _make_input(source, camera_file, plain), list(plain.notes)
    recovery = recover(inputs)
    if recovery is None and order not in MAY_BE_UNALIGNED:
        reading = recover_moved(inputs, camera_file)
        if reading is not None:
            moved, recovery = reading
            inputs, notes = replace(inputs, cameras=moved.cameras), [*notes, moved.note]
            return CameraFit(inputs, recovery, camera_file, notes, plain.transform, moved)
    if recovery is None and not searched:
        other_size = _other_size(source, camera_file)
        if other_size is not None:
            return other_size
    other_poses = find_aligned_poses(inputs, camera_file) if recovery is None else None
    if other_poses is not None:
        poses, recovery = other_poses
        notes.append(f"{poses.describe(camera_file.convention)}: read so")
        inputs = replace(inputs, cameras=replace(inputs.cameras, viewmats=poses.viewmats))
        camera_file = with_convention(camera_file, poses.convention)
    if recovery is None and order not in MAY_BE_UNALIGNED:
        both = _other_size_and_poses(source, camera_file)
        if both is not None:
            return both
        small = small_photos_error(ply.info, camera_file, source.size)
        if small is not None:
            raise small
    return CameraFit(inputs, recovery, camera_file, notes, plain.transform)


def _make_input(source: _Source, camera_file: CameraFile, fit: GridFit, *, photos: bool = True) -> AlignmentInput:
    """The scene with the cameras of one fit; without photos where only positions matter."""
    fitted = source.photos if photos else None
    if fitted is not None and fit.transform is not None:
        fitted = fit.transform.photos(fitted)
    names, ply = camera_file.names, source.ply
    return AlignmentInput(
        gaussians=ply.gaussians,
        valid=ply.valid,
        cameras=fit.cameras,
        images=None if fitted is None else as_floats(fitted),
        labellings=[list(range(len(names))), sorted(range(len(names)), key=lambda i: natural_key(names[i]))],
        depths=partial(read_depths, Path(camera_file.path)),
        order=source.order,
        scale=source.scale,
    )


def _other_size(source: _Source, camera_file: CameraFile, *, exact_frames: bool = False) -> CameraFit | None:
    """The fit at another size that puts the Gaussians nearest to their pixels; None where grids of two sizes do.

    Those that only the number of rows speaks for are tried in the frame of the cameras first, because there may be
    many; with ``exact_frames`` all are tried in that frame only.
    """
    recovered: list[tuple[GridFit, Recovery]] = []
    guesses: list[GridFit] = []
    make_input = partial(_make_input, source, camera_file)

    def try_fit(fit: GridFit, *, exact_frames: bool) -> None:
        recovery = recover(make_input(fit, photos=False), exact_frames=exact_frames)
        if recovery is not None:
            recovered.append((fit, recovery))

    for fit in other_grids(source.ply.info, camera_file, source.size):
        if recovered and fit.rank > recovered[0][0].rank:
            break
        if fit.guessed:
            guesses.append(fit)
        try_fit(fit, exact_frames=fit.guessed or exact_frames)
    for fit in guesses[:_MAX_TRIED] if not (recovered or exact_frames) else []:
        try_fit(fit, exact_frames=False)
    if not recovered:
        return None
    grid, best = min(((fit.size, recovery.best) for fit, recovery in recovered), key=lambda one: one[1].worst_px)
    px = best.worst_px
    exact = best.layout.kind != "pruned"  # what lacks pixels fits into grids of nearly its size as well
    others = (recovery for fit, recovery in recovered if fit.size != grid)
    if exact and any(other.best.worst_px < MARGIN * max(px, 1e-3) for other in others):
        return None
    near = max(_ALIKE * px, px + _ALIKE_PX)
    alike = [(fit, r) for fit, r in recovered if fit.size == grid and r.best.worst_px <= near]
    fits = [
        CameraFit(make_input(fit), recovery, camera_file, list(fit.notes), fit.transform) for fit, recovery in alike
    ]
    if len(fits) == 1:
        return fits[0]
    errors = [color_error(fit.inputs, recovery.best.layout) for fit, (_, recovery) in zip(fits, alike, strict=True)]
    return fits[int(np.argmin(np.nan_to_num(errors, nan=1.0)))]


def _other_size_and_poses(source: _Source, camera_file: CameraFile) -> CameraFit | None:
    """The one fit at another size, with the poses read in another way; only where no pixel and no frame is missing.
    SceneError if several readings fit alike.
    """
    fits = []
    for poses in other_conventions(camera_file.viewmats, camera_file.convention):
        fit = _other_size(source, with_convention(camera_file, poses.convention), exact_frames=True)
        if fit is not None and fit.recovery is not None:
            fits.append((poses, fit.recovery.best.worst_px, fit))
    best = choose_fit(camera_file, fits)
    if best is None:
        return None
    poses, fit = best
    return replace(fit, notes=[*fit.notes, f"{poses.describe(camera_file.convention)}: read so"])
