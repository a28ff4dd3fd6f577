"""Read a scene from its files: a :class:`gsmerge.types.Scene` with the pixel of every row if rows have pixels."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from gsmerge.alignment import (
    ESTIMATED,
    MAY_BE_UNALIGNED,
    Alignment,
    AlignmentResult,
    Recovery,
    align,
    check_pixels,
    read_rotations,
)
from gsmerge.arguments import check_arguments
from gsmerge.errors import SceneError
from gsmerge.geometry import move_views
from gsmerge.io.cameras.camera_file import CameraFile, as_pinholes, at_own_size, select_views, to_cameras
from gsmerge.io.cameras.dataparser import read_dataparser
from gsmerge.io.cameras.read import read_depths
from gsmerge.io.formats.arrays import FLAT_COMMENT, RESULT_COMMENT
from gsmerge.io.formats.read import FileInfo, GaussianFile, file_notes, kept_comments, read_gaussians, read_parts
from gsmerge.io.image_names import IMAGE_SUFFIXES, describe_unread
from gsmerge.io.photo_files import NO_IMAGES, as_floats, photo_array, photo_size
from gsmerge.runtime.threads import use_threads
from gsmerge.scene.exporters import (
    AUTO,
    Exporter,
    ReadHints,
    choose_exporters,
    find_cameras_of_model,
    find_exporter,
    make_hints,
)
from gsmerge.scene.files import IMAGE_PLACES, SceneFiles, find_scene_files, result_cameras
from gsmerge.scene.masks import NO_MASKS, Masks, check_masks
from gsmerge.scene.photos import (
    SEEN_PLACE,
    UNNAMED,
    Proposal,
    ScenePhotos,
    assign_to_views,
    describe_assignment,
    describe_unused,
    fit_to_grid,
    list_guessed,
    name_by_photos,
    photos_inside,
    propose_photos,
    read_photos,
    refuse_photos,
    select_one_shape,
    shows_better,
    stored_photos,
    without_photo,
)
from gsmerge.scene.rows import color_from_photos, set_rotations, take_gaussians, use_depths
from gsmerge.scene.views import cut_bars, find_larger_and_masks, limit_photo_size, limit_view_size, read_scene_cameras
from gsmerge.settings.reading import NONE, OpacityChoice
from gsmerge.types import NO_CAMERAS, Cameras, LargePhotos, Scene, StrPath
from gsmerge.words import count_words


@dataclass(frozen=True, eq=False)
class SceneViews:
    """All c views of the camera file, in the frame of the Gaussians and at the size of the scene's pictures."""

    cameras: Cameras
    images: np.ndarray  # ``[c,h,w,3]`` photos; [0,...] without any
    names: tuple[str, ...]
    of_scene: tuple[int, ...]  # for each view of the scene, its index among these c views

    @property
    def used(self) -> tuple[int, ...]:
        """Indices of the views that the scene has, each once, in the scene's order."""
        return tuple(dict.fromkeys(self.of_scene))


@dataclass(frozen=True)
class Loaded:
    """A scene, with all facts about its files and how they were read."""

    scene: Scene  # with pixels if the rows have them
    info: FileInfo
    files: SceneFiles
    # the cameras as stored in their file, in the order of the views; None without cameras, or if they do not fit
    cameras: CameraFile | None
    views: SceneViews  # all views of the camera file, including those that the scene does not have
    exporters: tuple[Exporter, ...]  # the exporters that may have written the file, or the one that the caller named
    notes: tuple[str, ...]  # adapted or unusual content, one sentence each, without a full stop
    # how well every view's Gaussians project into their own pixels; None if rows have no pixels
    alignment: Alignment | None = None
    recovery: Recovery | None = None  # the layout of rows that fits best, and by how much; None without pixels
    problem: str | None = None  # why the rows have no pixels, in one sentence; None if they have
    # how far each camera was moved to its Gaussians; empty if none was moved
    moves: Sequence[dict[str, Any]] = ()
    joined: Sequence[dict[str, Any]] = ()  # where each of several joined scenes lies; empty for one scene
    left_out: str | None = None  # the note on files beside the scene that do not belong to it

    def pixel_scene(self) -> Scene:
        """Return the scene; SceneError with the reason if it does not have one Gaussian per pixel."""
        if self.scene.has_own_pixels:
            return self.scene
        raise SceneError(self.info.path, self.problem or "expected one Gaussian per pixel")

    def without_photos(self) -> Loaded:
        """Return a copy without the photos of all views, which frees their memory; the scene keeps its own photos."""
        cameras = None if self.cameras is None else replace(self.cameras, images=())
        return replace(self, cameras=cameras, views=replace(self.views, images=NO_IMAGES))

    def with_left_out(self, notes: Sequence[str]) -> Loaded:
        """Return a copy with notes on files that were found beside the scene and are not used."""
        left_out = "; ".join(filter(None, (self.left_out, *notes))) or None
        return replace(self, notes=(*self.notes, *notes), left_out=left_out) if notes else self

    @property
    def comments(self) -> tuple[str, ...]:
        """Comments of the file's header that a result copies; not the comment on 2D Gaussians, since results are 3D."""
        return tuple(comment for comment in kept_comments(self.info) if comment != FLAT_COMMENT)

    @property
    def recognised(self) -> dict[str, Any]:
        """Facts about the input for a report."""
        cameras, recovery, info = self.scene.cameras, self.recovery, self.info
        facts: dict[str, Any] = {"num_views": len(cameras), "height": cameras.height, "width": cameras.width}
        facts |= {"num_photos": len(self.scene.photo_views)}
        facts |= {"exporters": [entry.name for entry in self.exporters], "rows": recovery and recovery.description}
        facts |= {"moved_cameras": list(self.moves), "bytes": info.file_bytes}
        if self.files.parts:
            facts["parts"] = [str(path) for path in self.files.parts]
        if self.joined:
            num_bytes = sum(os.stat(file["path"]).st_size for file in self.joined if file["joined"])
            facts |= {"files": list(self.joined), "bytes": num_bytes}
        facts |= {"layout": info.layout, "sh_degree": info.sh_degree, "opacity_encoding": info.opacity_encoding}
        return facts | {"num_nonfinite": info.num_nonfinite, "left_out": self.left_out}


@check_arguments
def read_scene(
    path: StrPath,
    *more: StrPath,
    cameras: StrPath | None = None,
    images: StrPath | None = None,
    masks: StrPath | None = None,
    protect: StrPath | None = None,
    opacity: OpacityChoice = "auto",
    **hints: Any,
) -> Scene:
    """Read a scene: its ``.ply``, and its cameras and images if there are any.

    The pixel of each row is found by measuring which order of rows fits the cameras (docs/reference/exporters.md).

    Args:
        path: The ``.ply``, or a folder that has it.
        *more: Other scenes of the same place. They are joined with the first one, in its frame (docs/guide/sharp.md).
        cameras: Camera file or folder, or "none". None: search beside the ``.ply``, and warn if the cameras do not fit.
        images: Folder of images, an ``.npz`` that holds images, or "none". None: search as for cameras.
        masks: Folder of images with the names of the photos, dark where a photo does not count, or "none". None: use
            the folder ``masks`` beside the photos, and the photos' transparency. Lighter greys are weights in a fit.
        protect: Folder of images with the names of the photos, white where a text or a face has to stay sharp; see
            :attr:`Scene.importance`.
        opacity: How opacities are stored; see :func:`gsmerge.io.read_gaussians`.
        **hints: ``exporter``, ``quats``, ``scales``, ``order``, ``scene_scale``, ``max_side``, see
            :class:`gsmerge.settings.reading.ReadHints`.

    Returns:
        The scene; its ``pixels`` are None if the pixels of the rows are unknown.

    Raises:
        SceneError: If a file is missing or damaged, or the Gaussians do not belong to the views of named cameras.
        ValueError: If an argument has a value that is not possible.

    Example:
        >>> scene = gsmerge.read_scene("demo/scene.ply", cameras="demo/transforms.json")
        >>> len(scene), scene.num_gaussians
        (5, 7680)
    """
    load = load_scene(
        path, *more, cameras=cameras, images=images, masks=masks, protect=protect, opacity=opacity, **hints
    )
    if load.left_out is not None:
        warnings.warn(load.left_out, stacklevel=2)
    return load.scene


def load_scene(
    path: StrPath,
    *more: StrPath,
    cameras: StrPath | None = None,
    images: StrPath | None = None,
    masks: StrPath | None = None,
    protect: StrPath | None = None,
    opacity: OpacityChoice = "auto",
    **hints: Any,
) -> Loaded:
    """Read a scene as :func:`read_scene` does, and return it with all facts about its files."""
    read_hints = make_hints(hints)
    named = {"cameras": cameras, "images": images, "masks": masks, "protect": protect}
    first, *others = (find_scene_files(scene_path, **named) for scene_path in (path, *more))
    return load_files(replace(first, more=tuple(others)), opacity=opacity, hints=read_hints)


def load_files(files: SceneFiles, *, opacity: OpacityChoice = "auto", hints: ReadHints = AUTO) -> Loaded:
    """Read a scene as :func:`load_scene` does, from the files that :func:`find_scene_files` found."""
    with use_threads():
        scenes = (replace(files, more=()), *files.more)
        loads = [
            align_scene(read_gaussian_file(source, opacity=opacity, hints=hints), source, hints=hints)
            for source in scenes
        ]
    return loads[0] if len(loads) == 1 else _join_loads(loads, files)


def _join_loads(loads: Sequence[Loaded], files: SceneFiles) -> Loaded:
    """Join several scenes of the same place to one, with the notes of all."""
    from gsmerge.alignment.registration.join import join_scenes

    joined = join_scenes([load.scene for load in loads], [load.files.ply for load in loads])
    scene, used = joined.scene, [loads[i] for i in joined.used]
    notes = [f"{name}: {text}" for name, load in zip(joined.names, loads, strict=True) for text in load.notes]
    return replace(
        used[0],
        scene=scene,
        info=replace(used[0].info, num_nonfinite=sum(load.info.num_nonfinite for load in used)),
        files=files,
        views=SceneViews(scene.cameras, photo_array(scene.images), scene.names, tuple(range(len(scene)))),
        exporters=tuple(dict.fromkeys(exporter for load in used for exporter in load.exporters)),
        notes=(*notes, *joined.notes),
        alignment=check_pixels(scene),
        moves=[move for load in used for move in load.moves],
        joined=joined.facts,
        left_out="; ".join(load.left_out for load in loads if load.left_out is not None) or None,
    )


def read_gaussian_file(files: SceneFiles, *, opacity: OpacityChoice, hints: ReadHints) -> GaussianFile:
    """Read the Gaussians of a scene's files.

    A named exporter that writes logits decides the encoding of opacities, unless ``opacity`` does.
    """
    exporter = find_exporter(hints.exporter)
    # An exporter of raw opacities does not decide: they are recognised, and some of its versions write logits
    if exporter is not None and exporter.opacity == "logit" and opacity == "auto":
        opacity = "logit"
    encodings: dict[str, Any] = {"opacity": opacity, "scales": hints.scales}
    return read_parts(files.parts, **encodings) if files.parts else read_gaussians(files.ply, **encodings)


def align_scene(ply: GaussianFile, files: SceneFiles, *, hints: ReadHints = AUTO, photos: bool = True) -> Loaded:
    """Combine Gaussians, cameras and photos to a scene, with the pixel of every row if rows have pixels.

    If the scene can only be read without some files that were found beside it, these are left out, with a note.
    SceneError as in :func:`read_scene`. ``photos=False``: search no photos.
    """
    try:
        return _align(ply, files, read_scene_cameras(ply, files), hints=hints, photos=photos)
    except SceneError as error:
        cause = SceneError(error.path, error.problem, error.remedy)  # a copy: the traceback keeps arrays in memory
    for fewer in files.without_found(cause.path):
        with suppress(SceneError):
            load = _align(ply, fewer, read_scene_cameras(ply, fewer), hints=hints, photos=photos)
            if _is_usable(load, fewer, files, cause):
                return _note_left_out(load, files, cause)
    if "cameras" not in files.named:
        _check_hints(ply, hints)
    options = [f"--{name} {NONE}" for name in ("cameras", "images") if name in files.named and getattr(files, name)]
    read_alone = f"{' and '.join(options)} reads the Gaussians alone" if options else ""
    raise SceneError(cause.path, cause.problem, "; ".join(filter(None, (cause.remedy, read_alone))))


def _is_usable(load: Loaded, fewer: SceneFiles, files: SceneFiles, cause: SceneError) -> bool:
    """Return whether a scene that was read from ``fewer`` files replaces the scene that could not be read.

    Photos that the caller named must be in it. If only photos are left out, either they caused the error, or the rows
    must have pixels, since without photos cameras of another scene may see these Gaussians as well.
    """
    if "images" in files.named and files.images is not None and load.scene.images is None:
        return False
    if fewer.cameras != files.cameras or fewer.masks != files.masks:
        return True
    photo_failed = Path(cause.path).suffix.lower() in IMAGE_SUFFIXES
    folder_failed = files.images != files.cameras and cause.path == str(files.images)
    return load.scene.has_own_pixels or photo_failed or folder_failed


def _note_left_out(load: Loaded, files: SceneFiles, cause: SceneError) -> Loaded:
    """Add a note to a scene that was read without some ``files``; it says which files are left out, and why."""
    names = [str(files.cameras)] if load.files.cameras != files.cameras else []
    if load.files.masks != files.masks:
        names.append(f"the masks in {files.masks}")
    photos = f"the photos in {files.images or files.ply.parent}"
    repeated = tuple(text for text in load.notes if text.startswith(f"{photos} are not used"))
    without_photos = load.files.named != files.named and files.images not in (files.cameras, None)
    if repeated or without_photos or not names:
        names.append(photos)
    is_known = cause.path in map(str, (files.ply, files.ply.parent, files.cameras, files.images, files.masks))
    where = "" if is_known else f"{cause.path}: "
    verb = "is" if names == [str(files.cameras)] else "are"
    remedy = cause.remedy or _name_files(load, files)
    note = " ".join(f"{' and '.join(names)} {verb} left out: {where}{cause.problem}; {remedy}".split())
    return replace(load, notes=(note, *(text for text in load.notes if text not in repeated)), left_out=note)


def _name_files(load: Loaded, files: SceneFiles) -> str:
    """Return the remedy for files that are left out: the options that name others, or none."""
    option, value = "cameras", "FILE"
    if load.files.cameras == files.cameras:
        option, value = ("masks" if load.files.masks != files.masks else "images"), "FOLDER"
    return f"pass --{option} {value}, or --{option} {NONE}"


def _align(
    ply: GaussianFile, files: SceneFiles, camera_file: CameraFile | None, *, hints: ReadHints, photos: bool = True
) -> Loaded:
    """Combine Gaussians, cameras and photos as :func:`align_scene`; SceneError if any file cannot be used."""
    if camera_file is None:
        return _without_cameras(ply, files, hints)
    proposal = propose_photos(files, camera_file) if photos else None
    if proposal is None:
        inside = photos_inside(files, camera_file) if photos else ()
        load = _combine(ply, files, camera_file, ScenePhotos(inside), hints)
        lacks_photos = photos and "images" not in files.named and load.scene.images is None
        is_result = RESULT_COMMENT in ply.info.comments or result_cameras(files.ply)  # films beside it are clips of it
        unread = describe_unread(files.ply.parent, IMAGE_PLACES) if lacks_photos and not is_result else []
        return replace(load, notes=(*load.notes, *unread))
    load = _assign_of_one_shape(ply, files, camera_file, proposal, hints)
    resized = proposal.folder.parent / SEEN_PLACE
    if proposal.folder == resized or files.images is None or not resized.is_dir() or load.scene.images is None:
        return load
    return _prefer_resized(load, ply, replace(files, images=resized), camera_file, hints)


def _prefer_resized(
    load: Loaded, ply: GaussianFile, files: SceneFiles, camera_file: CameraFile, hints: ReadHints
) -> Loaded:
    """Return the scene with the photos that WorldMirror resized if they fit its Gaussians better, else ``load``.

    ``files`` have the folder of these photos.
    """
    with suppress(SceneError):  # they may be of other views
        proposal = propose_photos(files, camera_file)
        resized = None if proposal is None else _assign(ply, files, camera_file, proposal, hints)
        if resized is not None and resized.scene.images is not None and shows_better(resized.scene, load.scene):
            text = f"photos are read from {SEEN_PLACE}, since they fit the Gaussians better"
            return replace(resized, notes=(*resized.notes, text))
    return load


def _assign_of_one_shape(
    ply: GaussianFile, files: SceneFiles, camera_file: CameraFile, proposal: Proposal, hints: ReadHints
) -> Loaded:
    """Combine as :func:`_assign`; if that fails, leave out photos or views whose shape is not that of most photos."""
    try:
        return _assign(ply, files, camera_file, proposal, hints)
    except SceneError:
        fewer = select_one_shape(camera_file, proposal)
        if fewer is not None:
            cameras, photos, left_out = fewer
            with suppress(SceneError):
                return _assign(ply, files, cameras, photos, hints).with_left_out(left_out)
        raise


def _assign(
    ply: GaussianFile, files: SceneFiles, camera_file: CameraFile, proposal: Proposal, hints: ReadHints
) -> Loaded:
    """Combine Gaussians and cameras with the photos that names propose, or with other photos that show the views.

    Notes name photos that cannot be read, and views without a photo. SceneError if no photo shows any view.
    """
    load, cause, fit = None, None, None
    is_grid = camera_file.source == ESTIMATED and camera_file.names[0] == UNNAMED  # photos may have any size
    while load is None and cause is None and not is_grid and any(photo is not None for photo in proposal.named):
        try:
            load = _combine(ply, files, camera_file, read_photos(proposal, proposal.choice, camera_file), hints)
        except SceneError as error:
            fewer = proposal.without_broken() if error.path in map(str, proposal.pool) else None
            proposal, cause = (proposal, error) if fewer is None else (fewer, None)
    try:
        base = load or _combine(ply, files, replace(camera_file, lenses=()), ScenePhotos(), hints)
    except SceneError as error:
        raise cause or error from None
    if is_grid and proposal.pool:
        fit = fit_to_grid(base.scene, proposal)
    guessed, is_read = list_guessed(base.scene, camera_file), load is not None
    proposal = proposal.without_views(guessed)
    chosen = assign_to_views(base.scene, base.views.of_scene, proposal, read=is_read, guessed=guessed, fit=fit)
    if not any(chosen):
        if (refusal := refuse_photos(files, proposal, camera_file, cause)) is not None:
            raise refusal
        bare = base if load is None else _combine(ply, files, camera_file, ScenePhotos(), hints)
        return bare.with_left_out([describe_unused(proposal, camera_file)])
    described, left_out = describe_assignment(proposal, chosen, camera_file)
    if load is None or chosen != proposal.choice:
        camera_file = name_by_photos(camera_file, proposal, chosen, fit)
        load = _combine(ply, files, camera_file, read_photos(proposal, chosen, camera_file), hints)
    return replace(load, notes=(*load.notes, *described)).with_left_out(left_out)


def _combine(
    ply: GaussianFile, files: SceneFiles, camera_file: CameraFile, photos: ScenePhotos, hints: ReadHints
) -> Loaded:
    """Combine Gaussians, cameras and their photos; SceneError if any of them cannot be used."""
    order = _choose_order(ply, camera_file, hints)
    pinholes, pictures, notes = as_pinholes(camera_file, photos.pictures)
    pinholes = at_own_size(pinholes, photo_size(pictures))
    notes += [camera_file.focal] if camera_file.focal else []
    without_bars, bar_notes = cut_bars(pictures, camera_file)
    limited, size_notes = limit_photo_size(without_bars, len(ply.gaussians), hints.max_side, unaligned=order == "none")
    depths = cache(partial(read_depths, Path(camera_file.path)))
    if files.is_state and files.cameras == files.ply:  # the cameras of a state fit its Gaussians
        problem = "expected one Gaussian per pixel, found the Gaussians of a state"
        cameras = to_cameras(pinholes, photo_size(limited))
        result = AlignmentResult(None, cameras, as_floats(limited), pinholes, problem=problem)
    else:
        frames = partial(read_dataparser, files.ply, files.cameras)
        result = align(ply, pinholes, limited, order=order, scale=hints.scene_scale, depths=depths, frames=frames)
    notes += [*bar_notes, *size_notes, *result.notes]
    if result.pixel_ids is None:
        _check_hints(ply, hints)
        cameras, images, size_notes = limit_view_size(result.cameras, result.images, hints.max_side)
        result = replace(result, cameras=cameras, images=images)
        notes += size_notes
    size, had_bars = photo_size(limited), without_bars is not pictures
    unused = [f"--{name}" for name in ("masks", "protect") if getattr(files, name) is not None]
    if unused and (had_bars or not size):
        reason = "the photos have bars, which are cut off" if size else "there are no photos"
        notes.append(f"the pictures of {' and '.join(unused)} are not used, since {reason}")
    if had_bars:  # photos with bars have neither larger files nor masks
        return _make_load(ply, files, hints, result, notes, absent=photos.absent, depths=depths)
    large, masks, mask_notes = find_larger_and_masks(files, camera_file, photos, size, result.transform, result.cameras)
    return _make_load(ply, files, hints, result, [*notes, *mask_notes], large, masks, photos.absent, depths)


def _choose_order(ply: GaussianFile, camera_file: CameraFile, hints: ReadHints) -> str:
    """Choose the order of the rows: by the hints, by the named exporter, or by the format of the cameras."""
    exporter = find_exporter(hints.exporter)
    if hints.order != "auto":
        return hints.order
    order = camera_file.order if exporter is None else exporter.order
    return "none" if order == "auto" and RESULT_COMMENT in ply.info.comments else order  # results have no pixels


def _without_cameras(ply: GaussianFile, files: SceneFiles, hints: ReadHints) -> Loaded:
    """Make a scene without views, since views are placed later; a note says that photos are not used."""
    advice = find_cameras_of_model(ply.info)
    notes = [advice] if advice else []
    _check_hints(ply, hints)
    if files.images is not None:
        reason = "there are no cameras, such as a transforms.json or a COLMAP model; name them with --cameras"
        if "cameras" in files.named:
            reason = f"only cameras show which views they have, and --cameras {NONE} leaves cameras out"
        notes += [f"the photos in {files.images} are not used: {reason}"]
    problem = "expected one Gaussian per pixel, found no cameras"
    return _make_load(ply, files, hints, AlignmentResult(None, NO_CAMERAS, NO_IMAGES, None, problem=problem), notes)


def _check_hints(ply: GaussianFile, hints: ReadHints) -> None:
    """Raise SceneError for rows without pixels if a hint describes the pixels' order or rotations."""
    given = [] if hints.order in ("auto", *MAY_BE_UNALIGNED) else [f"order={hints.order}"]
    given += [f"quats={hints.quats}"] if hints.quats in ("camera", "xyzw-root") else []
    if given:
        problem = f"expected rows that are pixels of views, as --hint {given[0]} says, found rows without pixels"
        raise SceneError(ply.info.path, problem, "leave the hint out, or name the cameras that fit with --cameras")


def _make_load(
    ply: GaussianFile,
    files: SceneFiles,
    hints: ReadHints,
    result: AlignmentResult,
    notes: Sequence[str],
    large: LargePhotos | None = None,
    masks: Masks = NO_MASKS,
    absent: Sequence[int] = (),
    depths: Callable[[], np.ndarray | None] = lambda: None,
) -> Loaded:
    """Make the scene from rows, their pixels and the views, with notes on how it was read.

    ``absent``: indices of the cameras without a photo. ``depths`` reads the depth maps beside the cameras.
    """
    camera_file, layout, views = result.camera_file, result.layout, list(result.views)
    scene, more = _make_scene(ply, files, result, large, masks)
    frame = None if result.recovery is None else result.recovery.best.frame
    source = "" if camera_file is None else camera_file.source
    exporters, alignment = choose_exporters(hints.exporter, ply.info, layout, frame, source), None
    if layout is None or frame is None:
        scene = read_rotations(scene, hints.quats)
        if camera_file is not None and hints.exporter != "auto":
            remedy = f"only those of the given exporter {hints.exporter} were tried; --hint exporter=auto tries all"
            more.append(f"the rows are the pixels of no views in any known order: {remedy}")
    else:
        assert camera_file is not None, "pixels belong to cameras"
        scene, depth_notes = use_depths(scene, depths, layout, frame.scale)
        scene, rotation_notes = set_rotations(scene, hints, exporters, frame)
        more += [*depth_notes, *rotation_notes]
        if result.given is not None:
            scene = move_views(scene, result.given[views])
            result = replace(result, cameras=replace(result.cameras, viewmats=result.given))
        alignment = check_pixels(scene)
        if layout.per_pixel == 1:
            camera_file = select_views(camera_file, views)
    load = Loaded(
        scene=without_photo(scene, [view for view, camera in enumerate(views) if camera in absent]),
        info=ply.info,
        files=files,
        cameras=camera_file,
        views=SceneViews(result.cameras, result.images, _camera_names(result), tuple(views)),
        exporters=exporters,
        notes=(*files.notes, *file_notes(ply.info), *notes, *more),
        alignment=alignment,
        recovery=result.recovery,
        problem=result.problem,
        moves=result.moves,
    )
    return load.with_left_out(result.left_out)


def _make_scene(
    ply: GaussianFile, files: SceneFiles, result: AlignmentResult, large: LargePhotos | None, masks: Masks
) -> tuple[Scene, list[str]]:
    """Make the scene of the visible Gaussians and the views to which rows belong; also return notes.

    ``large`` and ``masks`` belong to all views of the camera file.
    """
    views, camera_names = list(result.views), _camera_names(result)
    gaussians, pixels = take_gaussians(ply, result)
    num_faint = int(ply.valid.sum()) - len(gaussians)
    faint = "fainter than 1/255, which nothing draws, set aside"
    notes = [count_words(num_faint, "Gaussian", faint)] if num_faint else []
    cameras, images = result.cameras, result.images
    if views != list(range(len(cameras))):
        cameras, images = cameras[views], images[views] if len(images) else images
    gaussians = color_from_photos(gaussians, pixels, images, files)
    large = None if large is None else large[views]
    masks, mask_notes = check_masks(masks[views], files)
    photos = images if len(images) else None
    names = tuple(camera_names[view] for view in views)
    scene = Scene(gaussians, cameras, photos, pixels, names, large, masks.counts, masks.importance)
    return scene, [*notes, *mask_notes]


def _camera_names(result: AlignmentResult) -> tuple[str, ...]:
    """Return the names of all views of the camera file; empty without cameras."""
    return () if result.camera_file is None else result.camera_file.names


def move_cameras_to_scene(ply: GaussianFile, files: SceneFiles, *, hints: ReadHints, photos: bool) -> Loaded:
    """Move a file's cameras into the frame of the Gaussians if pixels or colours show that frame; else keep them.

    ``photos``: read photos, and raise SceneError if named ones cannot be read; False: leave photos out. SceneError if
    named cameras have no size.
    """
    with suppress(SceneError):
        camera_file = read_scene_cameras(ply, files)
        if camera_file is None:
            return _without_cameras(ply, files, hints)
        for with_photos in [True] if photos else [True, False]:  # photos can show the frame even if they are not kept
            with suppress(SceneError):
                return _align(ply, files, camera_file, hints=hints, photos=with_photos)
        return _keep_stored_cameras(ply, files, camera_file, hints=hints, photos=photos)
    return align_scene(ply, files, hints=hints, photos=photos)  # leaves out unreadable files that were not named


def _keep_stored_cameras(
    ply: GaussianFile, files: SceneFiles, camera_file: CameraFile, *, hints: ReadHints, photos: bool
) -> Loaded:
    """Return the scene with its cameras as their file stores them, with a note.

    Cameras that were not named and do not see the Gaussians are left out.
    """
    from gsmerge.alignment import check_cameras  # few scenes need it

    pictures = stored_photos(files, camera_file) if photos else ()
    cameras = to_cameras(camera_file, photo_size(pictures))
    if "cameras" not in files.named and not check_cameras(ply.gaussians, ply.valid, cameras, NO_IMAGES).ok:
        return align_scene(ply, files, hints=hints, photos=photos)
    note = "the cameras do not fit the Gaussians; they stay as stored in their file"
    as_stored = AlignmentResult(None, cameras, as_floats(pictures), camera_file)
    return replace(_make_load(ply, files, hints, as_stored, [note]), cameras=None)
