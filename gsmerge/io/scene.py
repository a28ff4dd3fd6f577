"""From files to a scene with one Gaussian per pixel, verified."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsmerge.errors import SceneError
from gsmerge.io.alignment.fill import fill_from_depths
from gsmerge.io.alignment.fit_cameras import fit_cameras
from gsmerge.io.alignment.grid import as_pinholes
from gsmerge.io.alignment.layouts import MAY_BE_LOOSE
from gsmerge.io.alignment.mismatch import count_problem, misaligned, other_grid
from gsmerge.io.alignment.poses import poses_note, reread, seen_poses, with_poses
from gsmerge.io.alignment.recover import Recovery, recover
from gsmerge.io.alignment.rotations import from_xyzw, likely_rotations, read_rotations
from gsmerge.io.alignment.scatter import to_grid
from gsmerge.io.alignment.score import Clues
from gsmerge.io.alignment.similarity import SAME, Frame
from gsmerge.io.alignment.unaligned import looks_like_a_grid
from gsmerge.io.alignment.verify import Alignment, check_alignment, explain_misalignment
from gsmerge.io.cameras.camera_file import CameraFile, select_views
from gsmerge.io.cameras.estimate import SOURCE as ESTIMATED
from gsmerge.io.cameras.nerfstudio import seen_in_dataparser
from gsmerge.io.exporters import Exporter, find_exporter, recognise
from gsmerge.io.exporters.voxels import is_padding
from gsmerge.io.formats.ply import OpacityChoice, PlyInfo, PlyScene, ply_notes, read_ply
from gsmerge.io.hints import AUTO, ReadHints, make_hints
from gsmerge.io.photo_size import lighter_photos, lighter_views
from gsmerge.io.scene_files import SceneFiles, find_scene_files
from gsmerge.io.views import cameras_of, stored_photos
from gsmerge.runtime.threads import use_threads
from gsmerge.types import Cameras, Gaussians, PixelScene, UnalignedScene

_MIN_CORRELATION = 0.5


@dataclass(frozen=True)
class Views:
    """All views of the camera file, in the frame of the Gaussians and at the size of the scene's pictures.

    Args:
        cameras: The c cameras.
        images: ``[c,h,w,3]`` photos, or None.
        names: Names of the c views.
        used: Which of them the scene has, each once, in its order.
    """

    cameras: Cameras
    images: Tensor | None
    names: tuple[str, ...]
    used: tuple[int, ...]


@dataclass(frozen=True)
class SceneLoad:
    """A scene and how it came about.

    Args:
        scene: The scene: one Gaussian per pixel, or a loose one where no pixels were found.
        ply: What was found in the ``.ply``.
        files: The files that were read.
        cameras: The cameras in the order of the views, as their file has them; None where there are none.
        alignment: How well every view's Gaussians project into their own pixels; None for a loose scene.
        recovery: Which reading of the rows won, and by how much; None for a loose scene.
        problem: Why no pixels were found, in one sentence; None where they were.
        exporters: The exporters that may have written the file, or the one that was told.
        notes: What was adapted or looks odd, one sentence each, without a full stop.
        views: All views that there are cameras of, also those that the scene does not have.
    """

    scene: PixelScene | UnalignedScene
    ply: PlyInfo
    files: SceneFiles
    cameras: CameraFile | None
    alignment: Alignment | None
    recovery: Recovery | None
    problem: str | None
    exporters: tuple[Exporter, ...]
    notes: tuple[str, ...]
    views: Views

    def pixel_scene(self) -> PixelScene:
        """The scene, for those who need one Gaussian per pixel.

        Raises:
            SceneError: If no pixels were found; says why.
        """
        if isinstance(self.scene, PixelScene):
            return self.scene
        raise SceneError(self.ply.path, self.problem or "expected one Gaussian per pixel")


def read_scene(
    path: str | os.PathLike[str],
    *,
    cameras: str | os.PathLike[str] | None = None,
    images: str | os.PathLike[str] | None = None,
    opacity: OpacityChoice = "auto",
    **hints: Any,
) -> PixelScene | UnalignedScene:
    """Read a scene: ``.ply``, cameras, and images where there are any.

    Which row belongs to which pixel is found by measuring (docs/reference/exporters.md).

    Args:
        path: The ``.ply``, or a folder that has it.
        cameras: Camera file or folder; None looks beside the ``.ply``.
        images: Folder of images, or an ``.npz`` that holds them; None looks beside the ``.ply``.
        opacity: How opacities are stored; see :func:`gsmerge.io.read_ply`.
        **reading: Fields of :class:`gsmerge.io.ReadHints`: ``exporter``, ``quats``, ``order``, ``scene_scale``,
            ``max_side``.

    Returns:
        One Gaussian per pixel; a :class:`gsmerge.types.UnalignedScene` where the rows belong to no pixels.

    Raises:
        SceneError: If a file is missing or damaged, or the Gaussians are not those of the cameras' views.
        ValueError: If an argument is none of the possible ones.

    Example:
        >>> scene = read_scene("scene.ply")  # doctest: +SKIP
    """
    return load_scene(path, cameras=cameras, images=images, opacity=opacity, **hints).scene


def load_scene(
    path: str | os.PathLike[str],
    *,
    cameras: str | os.PathLike[str] | None = None,
    images: str | os.PathLike[str] | None = None,
    opacity: OpacityChoice = "auto",
    **hints: Any,
) -> SceneLoad:
    """:func:`read_scene` with everything that was found on the way."""
    chosen = make_hints(hints)
    return load_files(find_scene_files(path, cameras=cameras, images=images), opacity=opacity, hints=chosen)


def load_files(files: SceneFiles, *, opacity: OpacityChoice = "auto", hints: ReadHints = AUTO) -> SceneLoad:
    """:func:`load_scene` for files that are found already."""
    with use_threads():  # torch's own threads wait for one another, on a busy machine for longer than they work
        return align_scene(read_ply_with_hints(files.ply, opacity=opacity, hints=hints), files, hints=hints)


def read_ply_with_hints(path: Path, *, opacity: OpacityChoice, hints: ReadHints) -> PlyScene:
    """The file's rows, with opacities as told, or as the told exporter stores them."""
    told = find_exporter(hints.exporter)
    return read_ply(path, opacity=opacity if told is None or opacity != "auto" else told.opacity)


def align_scene(
    ply: PlyScene,
    files: SceneFiles,
    camera_file: CameraFile | None = None,
    *,
    hints: ReadHints = AUTO,
    photos: bool = True,
) -> SceneLoad:
    """Put Gaussians, cameras and images together and find out which row belongs to which pixel.

    Args:
        ply: The Gaussians.
        files: Where the cameras and images are.
        camera_file: The cameras, if they are read already.
        hints: What is told instead of found.
        photos: Whether to look for photos.

    Raises:
        SceneError: As :func:`read_scene`.
    """
    if camera_file is None and files.cameras is None and hints.order == "none":
        return _without_cameras(ply, files, hints)
    read = cameras_of(ply, files) if camera_file is None else camera_file
    told = find_exporter(hints.exporter)
    known = told.order if told is not None else read.order
    order = known if hints.order == "auto" else hints.order
    read, pictures, notes = as_pinholes(read, stored_photos(files, read) if photos else None)
    pictures, smaller = lighter_photos(pictures, len(ply.gaussians), hints.max_side, loose=order == "none")
    notes += smaller
    fitted = fit_cameras(ply, read, pictures, order=order, scale=hints.scene_scale)
    clues, recovery, read = fitted.clues, fitted.recovery, fitted.camera_file
    notes += fitted.notes
    if recovery is None:
        return _loose(ply, files, read, clues, hints, (*ply_notes(ply.info), *notes))
    best = recovery.best
    exporters = (told,) if told is not None else recognise(ply.info, best.layout, best.frame, read.source)
    moved = with_poses(clues.cameras, best.frame.move_cameras(clues.viewmats))
    in_frame = clues.cameras if best.frame is SAME else moved
    scene = to_grid(ply.gaussians, ply.valid, best.layout, in_frame, clues.images, read.names)
    scene, filled = _filled(scene, recovery, clues.depths)
    scene, turned = _with_rotations(scene, hints, exporters)
    views = Views(in_frame, clues.images, read.names, tuple(dict.fromkeys(best.layout.views)))
    if best.layout.per_pixel == 1:
        read = select_views(read, best.layout.views)
    if read.source == ESTIMATED:
        notes.append("no cameras were given: poses and focal length are estimated from the Gaussians' own grid")
    notes += _layout_notes(recovery, clues) + filled + turned + _colour_notes(scene)
    alignment = check_alignment(scene.gaussians, scene.cameras, scene.stored)
    said = (*ply_notes(ply.info), *notes)
    return SceneLoad(scene, ply.info, files, read, alignment, recovery, None, exporters, said, views)


def _filled(
    scene: PixelScene, recovery: Recovery, depths: Callable[[], np.ndarray | None]
) -> tuple[PixelScene, list[str]]:
    """Pixels that were dropped for being far, put back from the depth maps beside the cameras; and a note of it."""
    layout = recovery.best.layout
    maps = depths() if layout.kind == "box+depth" else None
    if maps is None:
        return scene, []
    full = fill_from_depths(scene, maps[list(layout.views)])
    count = int(full.valid.sum()) - int(scene.valid.sum())
    return full, [f"{count:,} pixels that the exporter dropped are put back from the depth maps"] if count else []


def _with_rotations(scene: PixelScene, hints: ReadHints, exporters: Sequence[Exporter]) -> tuple[PixelScene, list[str]]:
    """Rotations as told, as the told exporter stores them, or as the surface says; and a note where that was it."""
    if hints.quats != "auto":
        return read_rotations(scene, hints.quats), []
    if hints.exporter != "auto":
        return read_rotations(scene, exporters[0].quats), []
    if any(not exporter.check_rotations for exporter in exporters):
        return scene, []
    choice, words = likely_rotations(scene)
    return read_rotations(scene, choice), [words] if words else []


def _layout_notes(recovery: Recovery, clues: Clues) -> list[str]:
    """How the pixels were found, unless the file was simply in order."""
    layout, frame = recovery.best.layout, recovery.best.frame
    if layout.is_plain and frame is SAME and len(layout.views) == len(clues.cameras):
        if layout.views == tuple(clues.labellings[0]):
            return []
        if layout.views == tuple(clues.labellings[1]):
            return ["views are in the order of the image names, not of the camera file"]
    notes = [f"read as: {recovery.words}"]
    used = len(set(layout.views))
    return notes + ([f"{used} of {len(clues.cameras)} views are in the file"] if used < len(clues.cameras) else [])


def _loose(
    ply: PlyScene, files: SceneFiles, camera_file: CameraFile, clues: Clues, hints: ReadHints, notes: tuple[str, ...]
) -> SceneLoad:
    """The scene without pixels, if the cameras see it.

    Raises:
        SceneError: If they do not, or if other cameras or another reading of them would make it one with pixels.
    """
    cameras, images = clues.cameras, clues.images
    views, width, height = len(cameras), cameras.width, cameras.height
    problem, remedy = count_problem(ply.info, views, width, height), other_grid(ply.info.count, views, width, height)
    if clues.order not in MAY_BE_LOOSE:
        if len(ply.gaussians) == views * width * height:
            alignment = check_alignment(ply.gaussians, cameras, ply.valid)
            reason = explain_misalignment(ply.gaussians, cameras, ply.valid, camera_file.convention)
            if reason or looks_like_a_grid(ply.gaussians, ply.valid, cameras):
                raise misaligned(camera_file, alignment, reason)
            problem = f"expected one Gaussian per pixel, found {ply.info.count} rows that are in no known order"
        if _lacks_cameras(clues):
            raise SceneError(ply.info.path, problem, remedy)
    if clues.scale is not None:
        scaled = Frame(np.eye(3), clues.scale, np.zeros(3))
        cameras = with_poses(cameras, scaled.move_cameras(clues.viewmats))
    cameras, camera_file, said = _seen(ply, files, camera_file, cameras, images, (problem, remedy))
    notes += said
    told = find_exporter(hints.exporter)
    exporters = (told,) if told is not None else recognise(ply.info, None, None, camera_file.source)
    gaussians, padding = _loose_rows(ply, hints)
    cameras, images, smaller = lighter_views(cameras, images, hints.max_side)
    notes += tuple(smaller)
    scene = UnalignedScene(gaussians, cameras, images, camera_file.names)
    lost = "the rows belong to no pixels that could be found: unaligned"
    if told is not None:
        lost += f"; only those of {told.name} were looked for, as told; --exporter auto looks for all"
    all_views = Views(cameras, images, camera_file.names, tuple(range(len(cameras))))
    return SceneLoad(
        scene, ply.info, files, camera_file, None, None, problem, exporters, (*notes, *padding, lost), all_views
    )


def _loose_rows(ply: PlyScene, hints: ReadHints) -> tuple[Gaussians, list[str]]:
    """The finite rows without those that only fill a file up to its size; and a note of these."""
    keep = ply.valid & ~is_padding(ply.gaussians)
    count = int(ply.valid.sum()) - int(keep.sum())
    gaussians = ply.gaussians[keep]
    if hints.quats == "xyzw":
        gaussians = replace(gaussians, quats=from_xyzw(gaussians.quats))
    return gaussians, [f"{count:,} rows that only fill the file up are left out"] if count else []


def _seen(
    ply: PlyScene,
    files: SceneFiles,
    camera_file: CameraFile,
    cameras: Cameras,
    images: Tensor | None,
    problem: tuple[str, str],
) -> tuple[Cameras, CameraFile, tuple[str, ...]]:
    """Cameras that see Gaussians without pixels: as they stand, moved as nerfstudio does, or read in another way.

    Raises:
        SceneError: If none of these does; says why there are no pixels.
    """
    moved = seen_in_dataparser(files, ply.gaussians, ply.valid, cameras, images)
    if moved is not None:
        there, _, note = moved
        return there, replace(camera_file, viewmats=there.viewmats), (note,)
    poses, seen, said = seen_poses(ply.gaussians, ply.valid, cameras, images, camera_file.convention)
    if not seen.ok:
        raise SceneError(ply.info.path, f"{problem[0]}; {seen.words}", problem[1])
    if poses is None:
        return cameras, camera_file, (said,) if said else ()
    note = poses_note(poses, camera_file.convention)
    return with_poses(cameras, poses.viewmats), reread(camera_file, poses.convention), (note,)


def _without_cameras(ply: PlyScene, files: SceneFiles, hints: ReadHints) -> SceneLoad:
    """Gaussians alone: views are placed later."""
    none = Cameras(torch.empty(0, 4, 4, dtype=torch.float64), torch.empty(0, 3, 3, dtype=torch.float64), 1, 1)
    told = find_exporter(hints.exporter)
    exporters = (told,) if told is not None else recognise(ply.info, None, None, "")
    gaussians, padding = _loose_rows(ply, hints)
    scene = UnalignedScene(gaussians, none, None, ())
    problem = "expected one Gaussian per pixel, found no cameras that have any"
    said = (*ply_notes(ply.info), *padding)
    return SceneLoad(scene, ply.info, files, None, None, None, problem, exporters, said, Views(none, None, (), ()))


def _lacks_cameras(clues: Clues) -> bool:
    """Whether the first views are in order, and there are more of them than cameras."""
    pixels = len(clues.cameras) * clues.cameras.width * clues.cameras.height
    if len(clues.gaussians) <= pixels or len(clues.gaussians) % (clues.cameras.width * clues.cameras.height):
        return False
    first = replace(clues, gaussians=clues.gaussians[:pixels], valid=clues.valid[:pixels], order="view-major")
    return recover(first) is not None


def _colour_notes(scene: PixelScene) -> list[str]:
    """A note if the images do not look like the Gaussians: likely in another order, or of another scene."""
    if scene.images is None:
        return []
    step = max(1, scene.pixels_per_view // 5000)
    colours = scene.gaussians.sh0.reshape(len(scene), -1, 3)[:, ::step].mean(-1)
    photos = scene.images.reshape(len(scene), -1, 3)[:, ::step].mean(-1)
    valid = scene.stored.reshape(len(scene), -1)[:, ::step]
    odd = [
        name
        for name, colour, photo, ok in zip(scene.names, colours, photos, valid, strict=True)
        if _correlation(colour[ok], photo[ok]) < _MIN_CORRELATION
    ]
    return [f"{len(odd)} of {len(scene)} images do not look like their Gaussians, for example {odd[0]}"] if odd else []


def _correlation(a: Tensor, b: Tensor) -> float:
    """Pearson's correlation, 1 where one of the two hardly varies."""
    if len(a) < 16 or min(float(a.std()), float(b.std())) < 0.01:
        return 1.0
    return float(torch.corrcoef(torch.stack([a, b]))[0, 1])
