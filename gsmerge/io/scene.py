"""From files to a scene: with one Gaussian per pixel, verified, or unaligned."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.alignment.estimate_cameras import SOURCE as ESTIMATED
from gsmerge.io.alignment.fit_cameras import CameraFit, fit_cameras
from gsmerge.io.alignment.layouts import fill_from_depths, to_grid
from gsmerge.io.alignment.recover import Recovery
from gsmerge.io.alignment.rotations import choose_rotations, read_rotations
from gsmerge.io.alignment.score import Alignment, AlignmentInput, check_alignment
from gsmerge.io.alignment.similarity import IDENTITY
from gsmerge.io.cameras.camera_file import CameraFile, as_pinholes, select_views, to_cameras
from gsmerge.io.exporters import Exporter, choose_exporters, find_exporter
from gsmerge.io.formats.ply import OpacityChoice, PlyInfo, PlyScene, ply_notes, read_gaussians
from gsmerge.io.hints import AUTO, ReadHints, make_hints
from gsmerge.io.photos import as_floats, photo_size
from gsmerge.io.scene_files import SceneFiles, find_scene_files
from gsmerge.io.unaligned_scene import make_unaligned, usable_rows
from gsmerge.io.views import find_large_photos, limit_photo_size, read_scene_cameras, stored_photos
from gsmerge.runtime.record import note
from gsmerge.runtime.threads import use_threads
from gsmerge.types import Cameras, Gaussians, LargePhotos, Scene

_MIN_CORRELATION = 0.5  # of a view's base colours with its photo
_COLOR_SAMPLES = 5000  # pixels per view that it is computed from
NO_CAMERAS = Cameras(np.empty((0, 4, 4)), np.empty((0, 3, 3)), 1, 1)


@dataclass(frozen=True)
class Views:
    """All c views of the camera file, in the frame of the Gaussians and at the size of the scene's pictures."""

    cameras: Cameras
    images: np.ndarray | None  # ``[c,h,w,3]`` photos
    names: tuple[str, ...]
    used: tuple[int, ...]  # which of them the scene has, each once, in its order


@dataclass(frozen=True)
class SceneLoad:
    """A scene and how it was read."""

    # the scene: one Gaussian per pixel, or an unaligned one where the rows belong to no pixels
    scene: Scene
    ply: PlyInfo
    files: SceneFiles
    # the cameras in the order of the views, as their file has them; None where there are none
    cameras: CameraFile | None
    views: Views  # all views that there are cameras of, also those that the scene does not have
    exporters: tuple[Exporter, ...]  # the exporters that may have written the file, or the one that the caller named
    notes: tuple[str, ...]  # what was adapted or looks odd, one sentence each, without a full stop
    # how well every view's Gaussians project into their own pixels; None for an unaligned scene
    alignment: Alignment | None = None
    recovery: Recovery | None = None  # which reading of the rows won, and by how much; None for an unaligned scene
    problem: str | None = None  # why the scene is unaligned, in one sentence; None where it is not
    # how far each camera was moved to its Gaussians; empty where none was
    moves: Sequence[dict[str, Any]] = ()

    def pixel_scene(self) -> Scene:
        """The scene, for those who need one Gaussian per pixel. SceneError if it is unaligned; says why."""
        if self.scene.aligned:
            return self.scene
        raise SceneError(self.ply.path, self.problem or "expected one Gaussian per pixel")


def read_scene(
    path: str | os.PathLike[str],
    *,
    cameras: str | os.PathLike[str] | None = None,
    images: str | os.PathLike[str] | None = None,
    opacity: OpacityChoice = "auto",
    **hints: Any,
) -> Scene:
    """Read a scene: ``.ply``, cameras, and images where there are any.

    Which row belongs to which pixel is found by measuring (docs/reference/exporters.md).

    Args:
        path: The ``.ply``, or a folder that has it.
        cameras: Camera file or folder; None looks next to the ``.ply``.
        images: Folder of images, or an ``.npz`` that holds them; None looks next to the ``.ply``.
        opacity: How opacities are stored; see :func:`gsmerge.io.read_gaussians`.
        **hints: Fields of :class:`gsmerge.io.ReadHints`: ``exporter``, ``quats``, ``order``, ``scene_scale``,
            ``max_side``.

    Returns:
        One Gaussian per pixel; a :class:`gsmerge.types.Scene` where the rows belong to no pixels.

    Raises:
        SceneError: If a file is missing or damaged, or the Gaussians are not those of the cameras' views.
        ValueError: If an argument is none of the possible ones.

    Example:
        >>> scene = read_scene("scene.ply")  # doctest: +SKIP
    """
    return load_scene(path, cameras=cameras, images=images, opacity=opacity, **hints).scene


def as_scene(scene: Scene | str | os.PathLike[str]) -> Scene:
    """Return a scene as it is, or read it from a path; notes say what is odd about the file."""
    if isinstance(scene, Scene):
        return scene
    load = load_scene(scene)
    for text in load.notes:
        note(text)
    return load.scene


def load_scene(
    path: str | os.PathLike[str],
    *,
    cameras: str | os.PathLike[str] | None = None,
    images: str | os.PathLike[str] | None = None,
    opacity: OpacityChoice = "auto",
    **hints: Any,
) -> SceneLoad:
    """:func:`read_scene` with everything that was learned on the way."""
    read_hints = make_hints(hints)
    return load_files(find_scene_files(path, cameras=cameras, images=images), opacity=opacity, hints=read_hints)


def load_files(files: SceneFiles, *, opacity: OpacityChoice = "auto", hints: ReadHints = AUTO) -> SceneLoad:
    """:func:`load_scene` of given files."""
    with use_threads():
        return align_scene(read_ply_with_hints(files.ply, opacity=opacity, hints=hints), files, hints=hints)


def read_ply_with_hints(path: Path, *, opacity: OpacityChoice, hints: ReadHints) -> PlyScene:
    """The file's rows, with opacities read as given, or as the given exporter stores them."""
    exporter = find_exporter(hints.exporter)
    return read_gaussians(path, opacity=opacity if exporter is None or opacity != "auto" else exporter.opacity)


def align_scene(
    ply: PlyScene,
    files: SceneFiles,
    camera_file: CameraFile | None = None,
    *,
    hints: ReadHints = AUTO,
    photos: bool = True,
) -> SceneLoad:
    """Put Gaussians, cameras and images together and decide which row belongs to which pixel.

    Raises as :func:`read_scene`. ``camera_file`` has the cameras if they are read already; without ``photos`` none are
    looked for.
    """
    if camera_file is None and files.cameras is None and hints.order == "none":  # views are placed later
        gaussians, notes = usable_rows(ply, hints)
        problem = "expected one Gaussian per pixel, found no cameras that have any"
        return _unaligned(ply, files, None, Scene(gaussians, NO_CAMERAS, None, None, ()), problem, hints, notes)
    exporter = find_exporter(hints.exporter)
    camera_file = read_scene_cameras(ply, files) if camera_file is None else camera_file
    known = camera_file.order if exporter is None else exporter.order
    order = known if hints.order == "auto" else hints.order
    pictures, as_read = stored_photos(files, camera_file) if photos else None, camera_file
    camera_file, pictures, notes = as_pinholes(camera_file, pictures)
    limited, smaller = limit_photo_size(pictures, len(ply.gaussians), hints.max_side, unaligned=order == "none")
    fit = fit_cameras(ply, camera_file, limited, order=order, scale=hints.scene_scale)
    notes += [*smaller, *fit.notes]
    sizes = pictures, photo_size(limited), fit.transform
    if fit.recovery is not None:
        large = find_large_photos(files, as_read, *sizes, fit.inputs.cameras)
        load = _aligned(ply, files, fit, fit.recovery, hints, notes, large)
        return load if fit.moved is None else replace(load, moves=fit.moved.moves)
    scene, camera_file, problem, more = make_unaligned(ply, files, fit, hints)
    scene = replace(scene, large_photos=find_large_photos(files, as_read, *sizes, scene.cameras))
    return _unaligned(ply, files, camera_file, scene, problem, hints, notes + more)


def _aligned(
    ply: PlyScene,
    files: SceneFiles,
    fit: CameraFit,
    recovery: Recovery,
    hints: ReadHints,
    notes: list[str],
    large: LargePhotos | None,
) -> SceneLoad:
    inputs, camera_file = fit.inputs, fit.camera_file
    layout, frame, cameras = recovery.best.layout, recovery.best.frame, inputs.cameras
    exporters = choose_exporters(hints.exporter, ply.info, layout, frame, camera_file.source)
    if frame is not IDENTITY:
        cameras = replace(cameras, viewmats=frame.move_viewmats(inputs.cameras.viewmats))
    views = Views(cameras, inputs.images, camera_file.names, tuple(dict.fromkeys(layout.views)))
    scene = to_grid(ply.gaussians, ply.valid, layout, cameras, inputs.images, camera_file.names)
    scene = replace(scene, large_photos=None if large is None else large[layout.views])
    scene, filled = _fill(scene, recovery, inputs)
    scene, rotated = _with_rotations(scene, hints, exporters)
    if layout.per_pixel == 1:
        camera_file = select_views(camera_file, layout.views)
    if camera_file.source == ESTIMATED:
        notes.append("no cameras were given: poses and focal length are estimated from the Gaussians' own grid")
    notes += _layout_notes(recovery, inputs) + filled + rotated + color_notes(scene)
    alignment = check_alignment(scene.gaussians, scene.cameras, scene.stored)
    text = (*ply_notes(ply.info), *notes)
    return SceneLoad(scene, ply.info, files, camera_file, views, exporters, text, alignment, recovery)


def _unaligned(
    ply: PlyScene,
    files: SceneFiles,
    camera_file: CameraFile | None,
    scene: Scene,
    problem: str,
    hints: ReadHints,
    notes: list[str],
) -> SceneLoad:
    source = "" if camera_file is None else camera_file.source
    exporters = choose_exporters(hints.exporter, ply.info, None, None, source)
    views = Views(scene.cameras, scene.images, scene.names, tuple(range(len(scene))))
    text = (*ply_notes(ply.info), *notes)
    return SceneLoad(scene, ply.info, files, camera_file, views, exporters, text, problem=problem)


def _fill(scene: Scene, recovery: Recovery, inputs: AlignmentInput) -> tuple[Scene, list[str]]:
    """Pixels that were dropped for being far, put back from the depth maps next to the cameras; and a note about it."""
    layout = recovery.best.layout
    maps = inputs.depths() if layout.kind == "box+depth" else None
    if maps is None:
        return scene, []
    full = fill_from_depths(scene, maps[list(layout.views)])
    count = int(full.valid.sum()) - int(scene.valid.sum())
    return full, [f"{count:,} pixels that the exporter dropped are put back from the depth maps"] if count else []


def _with_rotations(scene: Scene, hints: ReadHints, exporters: Sequence[Exporter]) -> tuple[Scene, list[str]]:
    """Rotations read as given, as the given exporter stores them, or as fits the surface; and a note about the last."""
    if hints.quats != "auto":
        return read_rotations(scene, hints.quats), []
    if hints.exporter != "auto":
        return read_rotations(scene, exporters[0].quats), []
    if any(not exporter.check_rotations for exporter in exporters):
        return scene, []
    choice, note = choose_rotations(scene)
    return read_rotations(scene, choice), [note] if note else []


def _layout_notes(recovery: Recovery, inputs: AlignmentInput) -> list[str]:
    """How the rows were read, unless the file was simply in order."""
    layout = recovery.best.layout
    if layout.is_plain and recovery.best.frame is IDENTITY and len(layout.views) == len(inputs.cameras):
        if layout.views == tuple(inputs.labellings[0]):
            return []
        if layout.views == tuple(inputs.labellings[1]):
            return ["views are in the order of the image names, not of the camera file"]
    notes = [f"read as: {recovery.description}"]
    used = len(set(layout.views))
    return notes + ([f"{used} of {len(inputs.cameras)} views are in the file"] if used < len(inputs.cameras) else [])


def color_notes(scene: Scene) -> list[str]:
    """A note if the images do not look like the Gaussians: likely in another order, or of another scene."""
    if scene.images is None:
        return []
    step = max(1, scene.pixels_per_view // _COLOR_SAMPLES)
    colors = scene.gaussians.sh0.reshape(len(scene), -1, 3)[:, ::step].mean(-1)
    photos = scene.images.reshape(len(scene), -1, 3)[:, ::step].mean(-1)
    valid = scene.stored.reshape(len(scene), -1)[:, ::step]
    views = zip(scene.names, colors, photos, valid, strict=True)
    odd = [name for name, color, photo, ok in views if _correlation(color[ok], photo[ok]) < _MIN_CORRELATION]
    return [f"{len(odd)} of {len(scene)} images do not look like their Gaussians, for example {odd[0]}"] if odd else []


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's correlation, 1 where one of the two hardly varies."""
    if len(a) < 16 or min(a.std(ddof=1), b.std(ddof=1)) < 0.01:
        return 1.0
    return float(np.corrcoef(a, b)[0, 1])


@dataclass(frozen=True)
class CamerasInScene:
    """Gaussians and views of one frame."""

    gaussians: Gaussians  # the file's, with rotations read as the scene has them
    views: Views  # of the camera file
    notes: tuple[str, ...]  # what was adapted or looks odd, one sentence each, without a full stop


def place_cameras_in_scene(
    ply: PlyScene, files: SceneFiles, *, hints: ReadHints = AUTO, photos: bool = True
) -> CamerasInScene:
    """Views in the frame of the Gaussians, if their pixels or colours show it; otherwise as their file has them.

    ``photos`` that cannot be read are an error; with False they are left out.

    Raises:
        SceneError: If there are no cameras, or they have no size.
    """
    camera_file = read_scene_cameras(ply, files)
    for with_photos in (True,) if photos else (True, False):
        try:
            load = align_scene(ply, files, camera_file, hints=hints, photos=with_photos)
        except SceneError:
            continue
        aligned = load.scene.aligned
        notes = load.notes if aligned else load.notes[:-1]  # except the one that there are no pixels
        return CamerasInScene(load.scene.file_gaussians, load.views, notes)
    pictures = stored_photos(files, camera_file) if photos else None
    images = None if pictures is None else as_floats(pictures)
    cameras = to_cameras(camera_file, photo_size(pictures))
    views = Views(cameras, images, camera_file.names, tuple(range(len(cameras))))
    note = "the cameras do not fit the Gaussians and stay as their file has them"
    return CamerasInScene(ply.gaussians, views, (*ply_notes(ply.info), note))
