"""Read a scene from its files: its Gaussians, the pixels of their rows, its cameras and its photos.

A function returns a :class:`SceneError` instead of raising it if the caller can try to read the scene in another way.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from gsmerge.cameras import NO_CAMERAS_USED, AlignmentResult, align, check_pixels
from gsmerge.errors import Doubt, DoubtWarning, SceneError, name_notes
from gsmerge.geometry.transforms import move_views
from gsmerge.io.cameras.camera_file import CameraFile, as_pinholes, at_own_size, to_cameras
from gsmerge.io.cameras.dataparser import read_dataparser
from gsmerge.io.formats.arrays import MAX_STRAY, RESULT_COMMENT
from gsmerge.io.formats.read import GaussianFile, file_notes, read_gaussians, read_parts
from gsmerge.io.image_names import IMAGE_SUFFIXES, describe_unread
from gsmerge.io.photo_files import NO_IMAGES, as_floats, photo_size
from gsmerge.io.scene_files import IMAGE_PLACES, SceneFiles, find_scene_files, result_cameras
from gsmerge.photos.assign import Assignment
from gsmerge.photos.grid_fit import WHOLE_FIT
from gsmerge.photos.masks import NO_MASKS, CameraMaskError, Masks, check_masks
from gsmerge.photos.parts import choose_part
from gsmerge.photos.scene_photos import (
    Proposal,
    ScenePhotos,
    assign_to_views,
    describe_assignment,
    describe_missing,
    explain_mismatch,
    has_other_shape,
    is_without_names,
    name_by_photos,
    photos_inside,
    propose_photos,
    read_photos,
    select_one_shape,
    stored_photos,
    without_photo,
)
from gsmerge.runtime.record import list_some
from gsmerge.runtime.threads import use_threads
from gsmerge.scene.exporters import (
    NO_HINTS,
    ReadHints,
    choose_exporters,
    find_cameras_of_model,
    find_exporter,
    make_hints,
)
from gsmerge.scene.loaded import Loaded
from gsmerge.scene.rows import confirm_colors, read_rotations, take_gaussians
from gsmerge.scene.views import find_larger_and_masks, limit_photo_size, limit_view_size, read_scene_cameras
from gsmerge.settings.reading import NONE, OpacityChoice
from gsmerge.types import NO_CAMERAS, LargePhotos, Scene, StrPath
from gsmerge.values.arguments import check_arguments
from gsmerge.values.words import count_words

T = TypeVar("T")
MakeScene = Callable[[CameraFile, ScenePhotos], Loaded]  # may raise SceneError
SUMMED_FACTS = ("file_bytes", "num_nonfinite")  # facts about files that are added up if scenes are joined


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
        *more: Other scenes of the same place, which are joined with the first, in its frame (docs/guide/sharp.md).
        cameras: Camera file or folder, or "none". If None, cameras are searched beside the ``.ply``, with a warning if
            they do not fit.
        images: Folder of images, an ``.npz`` that holds images, or "none". If None, images are searched as cameras are.
        masks: Folder of images with the names of the photos, dark where a photo does not count, or "none". If None, the
            masks that ``transforms.json`` names are used, or the folder ``masks`` beside the photos, and the photos'
            transparency. Greys between dark and white weigh a pixel in a fit.
        protect: Folder of images with the names of the photos, white where a text or a face has to stay sharp; see
            :attr:`Scene.importance`.
        opacity: How opacities are stored; see :func:`gsmerge.io.read_gaussians`.
        **hints: ``exporter``, ``quats``, ``scales``, ``colors``, ``order``, ``scene_scale``, ``max_side``,
            see :class:`gsmerge.settings.reading.ReadHints`.

    Returns:
        The scene; its ``pixels`` are None if the pixels of the rows are unknown.

    Raises:
        SceneError: If a file is missing or damaged, or if the Gaussians do not belong to the views of named cameras.
        ValueError: If an argument has a value that is not possible.

    Example:
        >>> scene = gsmerge.read_scene("demo/scene.ply", cameras="demo/transforms.json")
        >>> len(scene), scene.num_gaussians
        (5, 7680)
    """
    load = load_scene(
        path, *more, cameras=cameras, images=images, masks=masks, protect=protect, opacity=opacity, **hints
    )
    for doubt in load.doubts:
        warnings.warn(doubt, DoubtWarning, stacklevel=3)  # the caller: above this function and its decorator
    return replace(load.scene, notes=load.notes)


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


def load_files(files: SceneFiles, *, opacity: OpacityChoice = "auto", hints: ReadHints = NO_HINTS) -> Loaded:
    """Read a scene as :func:`load_scene` does, from the files that :func:`find_scene_files` found."""
    with use_threads():
        loads = [
            align_scene(read_gaussian_file(scene_files, opacity=opacity, hints=hints), scene_files, hints=hints)
            for scene_files in (replace(files, more=()), *files.more)
        ]
    return loads[0] if len(loads) == 1 else _join_loads(loads, files)


def _join_loads(loads: Sequence[Loaded], files: SceneFiles) -> Loaded:
    """Join several scenes of the same place into one scene, which has the notes of all scenes."""
    from gsmerge.cameras.registration.join import join_scenes

    joined = join_scenes([load.scene for load in loads], [load.files.ply for load in loads])
    scene, used = joined.scene, [loads[i] for i in joined.used]
    notes = [text for name, load in zip(joined.names, loads, strict=True) for text in name_notes(name, load.notes)]
    return replace(
        used[0],
        scene=scene,
        info=replace(used[0].info, **{name: sum(getattr(load.info, name) for load in used) for name in SUMMED_FACTS}),
        files=files,
        exporters=tuple(dict.fromkeys(exporter for load in used for exporter in load.exporters)),
        notes=(*notes, *joined.notes),
        alignment=check_pixels(scene),
        moves=[move for load in used for move in load.moves],
        joined=joined.facts,
    )


def read_gaussian_file(files: SceneFiles, *, opacity: OpacityChoice, hints: ReadHints) -> GaussianFile:
    """Read the Gaussians of a scene's files.

    If the hints name an exporter that writes logits, opacities are read as logits, unless ``opacity`` says otherwise.
    """
    exporter = find_exporter(hints.exporter)
    # Raw opacities are not assumed for an exporter that writes them, since some of its versions write logits
    if exporter is not None and exporter.opacity == "logit" and opacity == "auto":
        opacity = "logit"
    encodings: dict[str, Any] = {"opacity": opacity, "scales": hints.scales, "colors": hints.colors}
    return read_parts(files.parts, **encodings) if files.parts else read_gaussians(files.ply, **encodings)


def align_scene(ply: GaussianFile, files: SceneFiles, *, hints: ReadHints = NO_HINTS, photos: bool = True) -> Loaded:
    """Combine Gaussians, cameras and photos into a scene, with the pixel of every row if rows have pixels.

    Cameras and photos that were found beside the scene, but do not belong to it, are left out with a note. Raises
    SceneError as :func:`read_scene` does. If ``photos`` is False, no photos are searched.
    """
    result = _choose_cameras(ply, files, hints, photos=photos)
    lacks_views = isinstance(result, Loaded) and result.own_views > len(result.scene)  # the rows form a larger grid
    cameras_may_be_wrong = lacks_views or (
        isinstance(result, SceneError) and "cameras" not in files.named and not _is_fault_of_named(files, result)
    )
    if cameras_may_be_wrong and files.cameras not in (None, files.ply):
        result = _read_without_cameras(ply, files, hints, result, photos=photos)
    if isinstance(result, Loaded):
        return result
    if "cameras" not in files.named:
        _check_hints(ply, hints)
    options = [f"--{name} {NONE}" for name in ("cameras", "images") if name in files.named and getattr(files, name)]
    read_alone = f"{' and '.join(options)} reads the Gaussians alone" if options else ""
    raise SceneError(result.path, result.problem, "; ".join(filter(None, (result.remedy, read_alone))))


def _read_without_cameras(
    ply: GaussianFile, files: SceneFiles, hints: ReadHints, result: Loaded | SceneError, *, photos: bool
) -> Loaded | SceneError:
    """Read a scene without its camera file, with a note; cameras are estimated from the rows instead.

    ``result`` is the result of reading with the camera file: a scene with fewer views than the rows form, or an error.
    ``result`` is returned if the scene cannot be read without the camera file, or only without photos that the caller
    named.
    """
    remaining = replace(files, cameras=None, images=None if files.images == files.cameras else files.images)
    load = _read_views(ply, remaining, hints, photos=photos)
    needs_photos = "images" in files.named and files.images is not None
    if isinstance(load, SceneError) or (needs_photos and load.scene.images is None):
        return result
    stored = _read_or_error(partial(read_scene_cameras, ply, files))
    missing_cameras = describe_missing(load.scene.names, stored, is_right=isinstance(result, Loaded))
    if missing_cameras is not None:
        return replace(
            load, notes=(missing_cameras, *(note for note in load.notes if not note.startswith(NO_CAMERAS_USED)))
        )
    return _note_left_out(load, files, [str(files.cameras)], result) if isinstance(result, SceneError) else result


def _choose_cameras(ply: GaussianFile, files: SceneFiles, hints: ReadHints, *, photos: bool) -> Loaded | SceneError:
    """Read a scene with its first camera file that certainly fits, or else with the first that can be read.

    If there are several camera files, a note says which one is read. If none can be read, returns the first error.
    """
    loads, errors = list[Loaded](), list[SceneError]()
    for choice in files.choices:
        load = _read_views(ply, choice, hints, photos=photos)
        if isinstance(load, SceneError):
            errors.append(load)
            continue
        with_note = replace(load, notes=(*files.describe_choice(choice.cameras), *load.notes))
        if _cameras_certainly_fit(load, files):
            return with_note
        loads.append(load if choice.cameras == files.cameras else with_note)
    return loads[0] if loads else errors[0]


def _cameras_certainly_fit(load: Loaded, files: SceneFiles) -> bool:
    """Return whether the cameras of a scene certainly fit its Gaussians, so that no other cameras have to be tried.

    - In a scene with photos, cameras certainly fit if rows are their pixels, if the photos show the views, or if there
      are no other cameras.
    - In a scene without photos, cameras certainly fit if no other cameras lie in folders below the scene, and if rows
      are pixels of the cameras or the scene has no doubts.
    """
    if load.scene.images is None:
        return not files.below and (load.scene.has_own_pixels or not load.doubts)
    return load.scene.has_own_pixels or load.photos_explain or not files.others


def _read_or_error(read: Callable[[], T]) -> T | SceneError:
    """Return what ``read`` returns, or the SceneError that it raises."""
    try:
        return read()
    except SceneError as error:
        return type(error)(error.path, error.problem, error.remedy)  # a copy, as the traceback keeps arrays in memory


def _note_left_out(load: Loaded, files: SceneFiles, left_out: list[str], cause: SceneError) -> Loaded:
    """Return a scene with a doubt which says what is left out, why, and what the user can do.

    ``left_out`` describes the files that are left out. If photos cannot be used without these files, the doubt also
    names the photos, and replaces the notes on photos.
    """
    photos = f"the photos in {files.images or files.ply.parent}"
    photo_notes = tuple(text for text in load.notes if text.startswith(f"{photos} are not used"))
    left_out = [*left_out, *([photos] if photo_notes else [])]
    known_paths = map(str, (files.ply, files.ply.parent, files.cameras, files.images))
    damaged_file = "" if cause.path in known_paths else f"{cause.path}: "
    option, value = ("cameras", "FILE") if left_out[0] == str(files.cameras) else ("images", "FOLDER")
    remedy = cause.remedy or f"pass --{option} {value}, or --{option} {NONE}"
    verb = "is" if left_out == [str(files.cameras)] else "are"
    doubt = f"{' and '.join(left_out)} {verb} left out: {damaged_file}{cause.problem}; {remedy}"
    return replace(
        load, notes=(Doubt(" ".join(doubt.split())), *(text for text in load.notes if text not in photo_notes))
    )


def _read_views(ply: GaussianFile, files: SceneFiles, hints: ReadHints, *, photos: bool) -> Loaded | SceneError:
    """Combine a scene's Gaussians with its cameras and photos, if any; return the error if they do not fit together."""
    camera_file = _read_or_error(partial(read_scene_cameras, ply, files))
    if camera_file is None:
        return _make_scene_without_views(ply, files, hints)
    if isinstance(camera_file, SceneError):
        return camera_file
    load = _add_photos(ply, files, camera_file, hints, photos=photos)
    return confirm_colors(load) if isinstance(load, Loaded) else load


def _add_photos(
    ply: GaussianFile, files: SceneFiles, camera_file: CameraFile, hints: ReadHints, *, photos: bool
) -> Loaded | SceneError:
    """Combine Gaussians and cameras with their photos; return the error if the cameras do not see the Gaussians.

    Each photo is a separate file, or one file has all photos. Photos that the caller did not name are left out, with a
    note, if they cannot be read or do not show the views; see :func:`_leave_out_photos`. If ``photos`` is False, all
    photos are left out.
    """
    proposal = _read_or_error(partial(propose_photos, files, camera_file)) if photos else None
    if isinstance(proposal, Proposal) and proposal.by_names:
        files = replace(files, images=proposal.folder)
    inside = _read_or_error(partial(photos_inside, files, camera_file)) if photos and proposal is None else ()
    error = next((value for value in (proposal, inside) if isinstance(value, SceneError)), None)
    if error is not None and ("images" in files.named or files.images == files.cameras):
        return error
    if isinstance(proposal, Proposal):
        return _add_proposed_photos(ply, files, camera_file, proposal, hints)
    scene_photos = ScenePhotos(() if isinstance(inside, SceneError) else inside)
    load = _read_or_error(partial(_make_scene_with_views, ply, files, hints, camera_file, scene_photos))
    if isinstance(load, SceneError):
        return load
    if error is not None:
        return _note_left_out(load, files, [f"the photos in {files.images}"], error)
    lacks_photos = photos and "images" not in files.named and load.scene.images is None
    is_result = RESULT_COMMENT in ply.info.comments or result_cameras(files.ply)  # films beside a result show it
    notes_on_films = describe_unread(files.ply.parent, IMAGE_PLACES) if lacks_photos and not is_result else []
    return replace(load, notes=(*load.notes, *notes_on_films))


def _add_proposed_photos(
    ply: GaussianFile, files: SceneFiles, camera_file: CameraFile, proposal: Proposal, hints: ReadHints
) -> Loaded | SceneError:
    """Combine Gaussians and cameras with all proposed photos, or only with photos of the most frequent aspect ratio.

    If even photos of one aspect ratio cannot be used, all photos are left out; see :func:`_leave_out_photos`.
    """
    make_scene = partial(_make_scene_with_views, ply, files, hints)
    load = _assign_photos(make_scene, camera_file, proposal)
    if isinstance(load, Loaded):
        return load
    if (one_shape := select_one_shape(camera_file, proposal)) is not None:
        remaining_cameras, remaining_photos, doubts = one_shape
        remaining_load = _assign_photos(make_scene, remaining_cameras, remaining_photos)
        if isinstance(remaining_load, Loaded):
            return replace(remaining_load, notes=(*remaining_load.notes, *doubts))
    return _leave_out_photos(ply, files, camera_file, proposal, hints, load)


def _assign_photos(make_scene: MakeScene, camera_file: CameraFile, proposal: Proposal) -> Loaded | SceneError:
    """Make a scene with the photos that names propose, or with other photos that show its views.

    1. If the photos have another shape than the cameras, parts of the photos are used if they show the views.
    2. The scene is read with the proposed photos, or if these photos cannot be used, without photos.
    3. The views of this scene decide which photo belongs to a view. Parts of photos are used if the parts fit better.
    4. If the views show photos other than the proposed ones, the scene is read again.

    Notes name photos that cannot be read, and views without a photo. Returns an error if no photo shows a view.
    """
    has_no_names = is_without_names(camera_file)
    shapes_differ = not has_no_names and has_other_shape(proposal, camera_file)
    make_without_photos = partial(make_scene, replace(camera_file, lenses=()), ScenePhotos())
    # 1. Parts of photos of another shape
    if shapes_differ:
        bare = _read_or_error(make_without_photos)
        if isinstance(bare, Loaded) and (parts := choose_part(bare.scene, proposal, camera_file)) is not None:
            return _assign_photos(make_scene, camera_file, parts)
    # 2. The base: the scene with the proposed photos, or without photos
    proposed: Loaded | SceneError | None = None  # None if no photos are proposed
    if not has_no_names and any(proposal.choice):
        proposed, proposal = _make_with_proposed_photos(make_scene, camera_file, proposal)
    base = proposed if isinstance(proposed, Loaded) else _read_or_error(make_without_photos)
    if isinstance(base, SceneError):
        return proposed or base
    # 3. The photo of each view, whole or in part
    photos = assign_to_views(base.scene, proposal, camera_file, read=base is proposed)
    proposal, chosen = photos.proposal, photos.chosen
    may_be_parts = photos.may_be_parts and proposal.fit == WHOLE_FIT and not shapes_differ
    if may_be_parts and (parts := choose_part(base.scene, proposal, camera_file, photos.fit)) is not None:
        return _assign_photos(make_scene, camera_file, parts)
    if not any(chosen) or (shapes_differ and not photos.explain_most):
        # an error of photos of another shape says nothing, unless lenses may have changed the shape
        if isinstance(proposed, SceneError) and (not shapes_differ or any(camera_file.lenses)):
            return proposed
        return explain_mismatch(proposal, camera_file)
    # 4. The scene with the photos of its views, unless the same photos were proposed
    load: Loaded | SceneError = base
    if base is not proposed or chosen != proposal.choice:
        load = _make_with_photos(make_scene, name_by_photos(camera_file, photos), proposal, chosen)
    if isinstance(load, SceneError):
        return load
    described = describe_assignment(photos, camera_file, are_pixels=base.scene.has_own_pixels)
    return replace(load, notes=(*proposal.notes, *load.notes, *described), photos_explain=photos.explain_most)


def _make_with_proposed_photos(
    make_scene: MakeScene, camera_file: CameraFile, proposal: Proposal
) -> tuple[Loaded | SceneError, Proposal]:
    """Make a scene with all proposed photos, or with those that are not broken; also return the proposal used."""
    load = _make_with_photos(make_scene, camera_file, proposal, proposal.choice)
    unbroken = proposal.without_broken() if isinstance(load, SceneError) else None
    if unbroken is None:
        return load, proposal
    return _make_with_photos(make_scene, camera_file, unbroken, unbroken.choice), unbroken


def _make_with_photos(
    make_scene: MakeScene, camera_file: CameraFile, proposal: Proposal, chosen: Sequence[Assignment | None]
) -> Loaded | SceneError:
    """Make a scene with the chosen photo of each camera."""
    return _read_or_error(lambda: make_scene(camera_file, read_photos(proposal, chosen, camera_file)))


def _leave_out_photos(
    ply: GaussianFile,
    files: SceneFiles,
    camera_file: CameraFile,
    proposal: Proposal,
    hints: ReadHints,
    cause: SceneError,
) -> Loaded | SceneError:
    """Combine Gaussians and cameras without photos, with a note; return ``cause`` if photos must not be left out.

    ``cause`` says why photos and cameras do not fit each other. Photos that the caller named are never left out. Other
    photos are left out if it is certain that the cameras belong to the scene: if rows are pixels of the cameras, if the
    cause is a photo, or if the photos were found by the cameras' names. Cameras that merely see the Gaussians may still
    belong to another scene.
    """
    are_named = "images" in files.named
    if are_named and "cameras" not in files.named and cause.path == camera_file.path:
        return explain_mismatch(proposal, camera_file)  # it blames the named photos, not the cameras that were found
    if are_named or _is_fault_of_named(files, cause):
        return cause
    bare = _read_or_error(partial(_make_scene_with_views, ply, files, hints, camera_file, ScenePhotos()))
    photo_is_cause = Path(cause.path).suffix.lower() in IMAGE_SUFFIXES or cause.path == str(proposal.folder)
    if isinstance(bare, SceneError) or not (bare.scene.has_own_pixels or photo_is_cause or proposal.by_names):
        return cause
    return _note_left_out(bare, replace(files, images=proposal.folder), [f"the photos in {proposal.folder}"], cause)


def _is_fault_of_named(files: SceneFiles, cause: SceneError) -> bool:
    """Return whether an error is about a picture in a folder that the caller named, or about a mask of a camera."""
    folders = (getattr(files, name) for name in ("images", "masks", "protect") if name in files.named)
    return isinstance(cause, CameraMaskError) or any(
        folder is not None and Path(cause.path).is_relative_to(folder) for folder in folders
    )


def _make_scene_with_views(
    ply: GaussianFile, files: SceneFiles, hints: ReadHints, camera_file: CameraFile, photos: ScenePhotos
) -> Loaded:
    """Combine Gaussians, cameras and photos. Raises SceneError if the cameras or the photos cannot be used."""
    order = _choose_row_order(ply, camera_file, hints)
    pinholes, pictures, notes = as_pinholes(camera_file, photos.pictures)
    pinholes = at_own_size(pinholes, photo_size(pictures))
    limited, size_notes = limit_photo_size(pictures, len(ply.gaussians), hints.max_side, unaligned=order == "none")
    if files.is_state and files.cameras == files.ply:  # the cameras of a state fit its Gaussians, so none are aligned
        problem = "expected one Gaussian per pixel, found the Gaussians of a state"
        cameras = to_cameras(pinholes, photo_size(limited))
        result = AlignmentResult(None, cameras, as_floats(limited), pinholes, problem=problem)
    else:
        frames = partial(read_dataparser, files.ply, files.cameras)
        result = align(ply, pinholes, limited, order=order, scale=hints.scene_scale, frames=frames)
    notes += [*size_notes, *result.notes]
    if result.pixel_ids is None:
        _check_hints(ply, hints)
        cameras, images, size_notes = limit_view_size(result.cameras, result.images, hints.max_side)
        result = replace(result, cameras=cameras, images=images)
        notes += size_notes
    size = photo_size(limited)
    mask_options = [name for name in ("masks", "protect") if getattr(files, name) is not None]
    if mask_options and not size:
        text = f"the pictures of --{' and --'.join(mask_options)} are not used, since there are no photos"
        notes.append(Doubt(text) if files.named.intersection(mask_options) else text)
    views = camera_file, photos, size, result.transform, result.cameras  # arguments of find_larger_and_masks
    larger_and_masks = _read_or_error(lambda: find_larger_and_masks(files, *views))
    if isinstance(larger_and_masks, SceneError):
        error = larger_and_masks
        if "masks" in files.named or Path(error.path) in photos.paths or _is_fault_of_named(files, error):
            raise error
        remedy = error.remedy or f"pass --masks FOLDER, or --masks {NONE}"
        notes.append(Doubt(f"masks are left out: {error.path}: {error.problem}; {remedy}"))
        larger_and_masks = find_larger_and_masks(replace(files, masks=None, named=files.named | {"masks"}), *views)
    large, masks, mask_notes = larger_and_masks
    return _make_loaded(ply, files, hints, result, [*notes, *mask_notes], large, masks, photos.absent)


def _choose_row_order(ply: GaussianFile, camera_file: CameraFile, hints: ReadHints) -> str:
    """Choose the order of the rows by the hints, by the named exporter, or by the format of the cameras."""
    if hints.order != "auto":
        return hints.order
    order = (find_exporter(hints.exporter) or camera_file).order
    return "none" if order == "auto" and RESULT_COMMENT in ply.info.comments else order  # results have no pixels


def _make_scene_without_views(ply: GaussianFile, files: SceneFiles, hints: ReadHints) -> Loaded:
    """Make a scene without views; a run places views later. A note says that photos are not used."""
    advice = find_cameras_of_model(ply.info)
    notes = [advice] if advice else []
    _check_hints(ply, hints)
    if files.images is not None:
        reason = (
            f"only cameras show which views they have, and --cameras {NONE} leaves cameras out"
            if "cameras" in files.named
            else "there are no cameras, such as a transforms.json or a COLMAP model; name them with --cameras"
        )
        notes += [f"the photos in {files.images} are not used: {reason}"]
    problem = "expected one Gaussian per pixel, found no cameras"
    return _make_loaded(ply, files, hints, AlignmentResult(None, NO_CAMERAS, NO_IMAGES, None, problem=problem), notes)


def _check_hints(ply: GaussianFile, hints: ReadHints) -> None:
    """For rows that have no pixels, raise SceneError if a hint says that rows are pixels."""
    if hints.order not in ("auto", "none"):
        problem = f"expected rows that are pixels of views, as --hint order={hints.order} says, found others"
        raise SceneError(ply.info.path, problem, "leave the hint out, or name the cameras that fit with --cameras")


def _make_loaded(
    ply: GaussianFile,
    files: SceneFiles,
    hints: ReadHints,
    result: AlignmentResult,
    notes: Sequence[str],
    large: LargePhotos | None = None,
    masks: Masks = NO_MASKS,
    absent: Sequence[int] = (),
) -> Loaded:
    """Make a scene of the visible Gaussians and all views, with all facts about how it was read.

    ``result`` has the cameras, the photos, and the pixels of the rows. ``large`` has the larger photos of the views,
    and ``masks`` the masks of the photos. ``absent`` lists the cameras without a photo.
    """
    camera_file, recovery = result.camera_file, result.recovery
    gaussians, pixels = take_gaussians(ply, result)
    num_faint = int(ply.valid.sum()) - len(gaussians)
    faint = count_words(num_faint, "Gaussian", "fainter than 1/255, which nothing draws, set aside")
    masks, mask_notes = check_masks(masks, files, pixels)
    photos = result.images if len(result.images) else None
    names = () if camera_file is None else camera_file.names
    scene = Scene(gaussians, result.cameras, photos, pixels, names, large, masks.counts, masks.importance)
    last_rows = () if pixels is None else pixels.fronts.max((1, 2))  # -1 for a view without rows
    empty_views = [scene.names[view] for view, row in enumerate(last_rows) if row < 0 and view not in absent]
    views_have = f"{len(empty_views)} of {len(scene)} views {'has' if len(empty_views) == 1 else 'have'}"
    doubts = [Doubt(f"{views_have} no Gaussians: {list_some(empty_views)}")] if empty_views else []
    scene = read_rotations(scene, hints.quats)
    if recovery is not None and result.confirmed_viewmats is not None:
        scene = move_views(scene, result.confirmed_viewmats)
        result = replace(result, cameras=replace(result.cameras, viewmats=result.confirmed_viewmats))
    alignment = None if recovery is None else check_pixels(scene)
    if alignment is not None and alignment.share_near < 1 - MAX_STRAY:
        share = f"{100 * (1 - alignment.share_near):.0f} % of the Gaussians lie far from their own pixels"
        doubts.append(Doubt(f"{share}, as rows of a damaged file do; copy or export it again"))
    source = "" if camera_file is None else camera_file.source
    order = "none" if recovery is None else recovery.layout.order
    return Loaded(
        scene=without_photo(scene, absent) if absent else scene,
        info=ply.info,
        files=files,
        cameras=camera_file,
        exporters=choose_exporters(hints.exporter, ply.info, order, source),
        notes=(*files.notes, *file_notes(ply.info), *doubts, *notes, *([faint] if num_faint else []), *mask_notes),
        alignment=alignment,
        recovery=recovery,
        problem=result.problem,
        moves=result.moves,
        own_views=result.own_views,
    )


def move_cameras_to_scene(ply: GaussianFile, files: SceneFiles, *, hints: ReadHints, photos: bool) -> Loaded:
    """Read a scene with its cameras moved into the frame of the Gaussians, if pixels or colours show that frame.

    If nothing shows that frame, the cameras stay as stored in their file. If ``photos`` is False, no photos are needed.
    If ``photos`` is True, named photos that cannot be read raise SceneError. Named cameras without a size raise
    SceneError, too.
    """
    for with_photos in dict.fromkeys((True, photos)):  # photos help to find the frame even if they are not needed
        load = _choose_cameras(ply, files, hints, photos=with_photos)
        if isinstance(load, Loaded):
            return load
    camera_file = _read_or_error(partial(read_scene_cameras, ply, files))
    if isinstance(camera_file, CameraFile):
        kept = _read_or_error(partial(_keep_stored_cameras, ply, files, camera_file, hints, photos=photos))
        if isinstance(kept, Loaded):
            return kept
    return align_scene(ply, files, hints=hints, photos=photos)  # this leaves out files that were not named


def _keep_stored_cameras(
    ply: GaussianFile, files: SceneFiles, camera_file: CameraFile, hints: ReadHints, *, photos: bool
) -> Loaded | None:
    """Return the scene with the cameras as stored in their file, and a doubt that they do not fit.

    Returns None for cameras that the caller did not name and that do not see the Gaussians.
    """
    from gsmerge.cameras import check_cameras  # few scenes need it

    pictures = stored_photos(files, camera_file) if photos else ()
    cameras = to_cameras(camera_file, photo_size(pictures))
    if "cameras" not in files.named and not check_cameras(ply.gaussians, ply.valid, cameras, NO_IMAGES).ok:
        return None
    doubt = Doubt("the cameras do not fit the Gaussians; they stay as stored in their file")
    as_stored = AlignmentResult(None, cameras, as_floats(pictures), camera_file)
    return replace(_make_loaded(ply, files, hints, as_stored, [doubt]), cameras=None)
