"""Read a scene from its files: its Gaussians, the pixels of their rows, its cameras and its photos."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from gsmerge.errors import Doubt, DoubtWarning, SceneError, name_notes, split_notes
from gsmerge.io.cameras.camera_file import CameraFile, to_cameras
from gsmerge.io.formats.read_gaussians import GaussianFile, read_gaussians, read_parts
from gsmerge.io.formats.rows import RESULT_COMMENT
from gsmerge.io.image_names import IMAGE_PLACES, IMAGE_SUFFIXES, describe_unread
from gsmerge.io.photo_files import NO_IMAGES, as_floats, photo_size
from gsmerge.reading.alignment import AlignmentResult, check_cameras, check_pixels
from gsmerge.reading.candidates import read_scene_cameras
from gsmerge.reading.exporters import NO_HINTS, ReadHints, find_exporter, make_hints
from gsmerge.reading.loaded import Loaded
from gsmerge.reading.make_scene import (
    add_larger_and_masks,
    check_hints,
    make_loaded,
    make_scene,
    make_scene_without_views,
)
from gsmerge.reading.photos.grid_fit import WHOLE_FIT
from gsmerge.reading.photos.photo_parts import choose_part, has_bars
from gsmerge.reading.photos.scene_photos import (
    NO_PHOTOS,
    ScenePhotos,
    assign_to_views,
    describe_assignment,
    describe_missing,
    explain_mismatch,
    find_photos,
    has_other_shape,
    is_without_names,
    keep_one_shape,
    name_by_photos,
    read_photos,
    read_stored_photos,
)
from gsmerge.reading.scene_files import SceneFiles, find_scene_files, result_cameras
from gsmerge.reading.take_gaussians import confirm_colors
from gsmerge.runtime.arguments import check_arguments
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.reading import NONE, OpacityChoice
from gsmerge.types import Scene, StrPath

MakeScene = Callable[[CameraFile, ScenePhotos], Loaded]  # may raise SceneError
SUMMED_FACTS = ("file_bytes", "num_nonfinite")  # facts about files that are added up if scenes are joined


class Errors(list[SceneError]):
    """The errors of attempts to read a scene. As a context, it takes the SceneError that its block raises."""

    def __enter__(self) -> None:
        """Begin an attempt."""

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> bool:
        """End an attempt; return whether it raised a SceneError, which is then in this list."""
        if not isinstance(error, SceneError):
            return False
        self.append(type(error)(error.path, error.problem, error.remedy))  # a copy, as the traceback keeps arrays
        return True


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
        *more: Other scenes of the same place, which are joined with the first, in its frame
            (docs/guide/after-a-model.md).
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
    return read_files(replace(first, more=tuple(others)), opacity=opacity, hints=read_hints)


def read_files(files: SceneFiles, *, opacity: OpacityChoice = "auto", hints: ReadHints = NO_HINTS) -> Loaded:
    """Read a scene as :func:`load_scene` does, from the files that :func:`find_scene_files` found."""
    with use_threads():
        loads = [
            align_scene(read_gaussian_file(scene_files, opacity=opacity, hints=hints), scene_files, hints=hints)
            for scene_files in (replace(files, more=()), *files.more)
        ]
    if len(loads) == 1:
        return loads[0]
    # several scenes of the same place become one scene, which has the notes of all scenes
    from gsmerge.reading.alignment.registration.join import join_scenes

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


def align_scene(
    ply: GaussianFile,
    files: SceneFiles,
    *,
    hints: ReadHints = NO_HINTS,
    photos: bool = True,
    keeps_cameras: bool = False,
) -> Loaded:
    """Combine Gaussians, cameras and photos into a scene, with the pixel of every row if rows have pixels.

    The first camera file that certainly fits is used, or else the first that can be read. Cameras and photos that were
    found beside the scene, but do not belong to it, are left out with a note. If no camera file that was found can be
    read, or if rows form more views than it has, cameras are estimated from the rows, unless ``keeps_cameras`` is True.
    Raises SceneError as :func:`read_scene` does. If ``photos`` is False, no photos are searched.

    - In a scene with photos, cameras certainly fit if rows are their pixels, if the photos show the views, or if there
      are no other cameras.
    - In a scene without photos, cameras certainly fit if no other cameras lie in folders below the scene, and if rows
      are pixels of the cameras or the scene has no doubts.
    """
    best: Loaded | None = None
    errors, certainly_fit = Errors(), False
    for choice in files.choices:
        with errors:
            load = _read_views(ply, choice, hints, photos=photos)
            if load.scene.images is None:
                certainly_fit = not files.below and (load.scene.has_own_pixels or not load.doubts)
            else:
                certainly_fit = load.scene.has_own_pixels or load.photos_explain or not files.others
            if certainly_fit or choice.cameras != files.cameras:
                load = replace(load, notes=(*files.describe_choice(choice.cameras), *load.notes))
            best = load if certainly_fit or best is None else best
        if certainly_fit:
            break
    if best is None:
        blames_named = "images" in files.named and Path(errors[0].path).is_relative_to(files.images or files.ply)
        cameras_may_be_wrong = "cameras" not in files.named and not blames_named
    else:
        cameras_may_be_wrong = best.own_views > len(best.scene)  # the rows form a larger grid
    if cameras_may_be_wrong and files.cameras not in (None, files.ply) and not keeps_cameras:
        with suppress(SceneError):
            best = _read_without_cameras(ply, files, hints, best, errors, photos=photos)
    if best is not None:
        return add_larger_and_masks(confirm_colors(best))
    if "cameras" not in files.named:
        check_hints(ply, hints)
    options = [f"--{name} {NONE}" for name in ("cameras", "images") if name in files.named and getattr(files, name)]
    read_alone = f"{' and '.join(options)} reads the Gaussians alone" if options else ""
    raise SceneError(errors[0].path, errors[0].problem, "; ".join(filter(None, (errors[0].remedy, read_alone))))


def _read_without_cameras(
    ply: GaussianFile, files: SceneFiles, hints: ReadHints, best: Loaded | None, errors: Errors, *, photos: bool
) -> Loaded:
    """Read a scene without its camera file, with a note; cameras are estimated from the rows instead.

    ``best`` is the scene with the camera file, which has fewer views than the rows form; or None, for the first of the
    ``errors``. Raises SceneError if the scene cannot be read without the camera file, or only without photos that the
    caller named; returns ``best`` if nothing shows that the camera file lacks views.
    """
    remaining = replace(files, cameras=None, images=None if files.images == files.cameras else files.images)
    load, stored = _read_views(ply, remaining, hints, photos=photos), None
    if load.scene.images is None and "images" in files.named and files.images is not None:
        raise SceneError(files.images, "expected photos of the views, found others")
    with suppress(SceneError):
        stored = read_scene_cameras(ply, files)
    missing = describe_missing(load.scene.names, stored, is_right=best is not None)
    if missing is None:
        return best or _note_left_out(load, files, [str(files.cameras)], errors[0])
    return replace(load, notes=(missing, *split_notes(load.notes, "estimated cameras")[1]))


def _read_views(ply: GaussianFile, files: SceneFiles, hints: ReadHints, *, photos: bool) -> Loaded:
    """Combine a scene's Gaussians with its cameras and photos, if any; raise SceneError if they do not fit together.

    Photos that the caller named are never left out. Other photos that do not fit are left out, with a note, if it is
    certain that the cameras belong to the scene: if rows are pixels of the cameras, if the photos cannot be read, or if
    they were found by the cameras' names. Cameras that merely see the Gaussians may still belong to another scene. If
    ``photos`` is False, no photos are searched.
    """
    camera_file = read_scene_cameras(ply, files)
    if camera_file is None:
        return make_scene_without_views(ply, files, hints)
    found, errors = NO_PHOTOS, Errors()
    with errors:
        found = find_photos(files, camera_file) if photos else NO_PHOTOS
    if errors and ("images" in files.named or files.images == files.cameras):
        raise errors[0]
    if found.by_names:
        files = replace(files, images=found.folder)
    make = partial(make_scene, ply, files, hints)
    if found.named:
        with errors:
            cameras, proposed, doubts = keep_one_shape(camera_file, found)
            load = _make_with_photos(make, cameras, proposed)
            return replace(load, notes=(*load.notes, *doubts))
    if not errors:  # there are no photos, or they are in one file
        load = make(camera_file, found)
        lacks_photos = photos and "images" not in files.named and load.scene.images is None
        is_result = RESULT_COMMENT in ply.info.comments or result_cameras(files.ply)  # films beside a result show it
        notes_on_films = describe_unread(files.ply.parent, IMAGE_PLACES) if lacks_photos and not is_result else []
        return replace(load, notes=(*load.notes, *notes_on_films))
    cause, folder, bare = errors[0], found.folder if found.named else files.images, None
    if "images" in files.named:  # the named photos are blamed, not cameras that were found
        are_blamed = "cameras" not in files.named and cause.path == camera_file.path
        raise explain_mismatch(found, camera_file) if are_blamed else cause
    with errors:
        bare = make(camera_file, NO_PHOTOS)
    is_photo = Path(cause.path).suffix.lower() in IMAGE_SUFFIXES or cause.path == str(folder) or not found.named
    if bare is None or not (bare.scene.has_own_pixels or is_photo or found.by_names):
        raise cause
    return _note_left_out(bare, replace(files, images=folder), [f"the photos in {folder}"], cause)


def _make_with_photos(make: MakeScene, camera_file: CameraFile, photos: ScenePhotos) -> Loaded:
    """Make a scene with the photos that names propose, or with other photos that show its views.

    1. If the photos have another shape than the cameras, parts of the photos are used if they show the views.
    2. The scene is made with the proposed photos, or if these photos cannot be used, without photos.
    3. The views of this scene decide which photo belongs to a view. Parts of photos are used if the parts fit better.
    4. If the views show photos other than the proposed ones, the scene is made again.

    Notes name photos that cannot be read, and views without a photo. Raises SceneError if no photo shows a view.
    """
    has_no_names, pinholes = is_without_names(camera_file), replace(camera_file, lenses=())
    shapes_differ = not has_no_names and has_other_shape(photos, camera_file)
    # 1. Parts of photos of another shape
    parts, base, errors = None, None, Errors()
    if shapes_differ:
        with suppress(SceneError):
            parts = choose_part(make(pinholes, NO_PHOTOS).scene, photos, camera_file)
        if parts is not None:
            return _make_with_photos(make, camera_file, parts)
    # 2. The base: the scene with the proposed photos, or without photos
    if any(photos.named) and not has_no_names:
        with errors:
            read = read_photos(photos, camera_file)
            base = make(camera_file, read)
            photos = photos.without_files(read.damaged)
    are_read = base is not None
    if base is None:
        with errors:
            base = make(pinholes, NO_PHOTOS)
    if base is None:
        raise errors[0]
    # 3. The photo of each view, whole or in part
    checked = assign_to_views(base.scene, photos, camera_file, read=are_read)
    show_most = checked.explain_most and not has_bars(base.scene.images)
    if not show_most and photos.fit == WHOLE_FIT and not shapes_differ:
        parts = choose_part(base.scene, photos, camera_file, checked.grid_fit)
        if parts is not None:
            return _make_with_photos(make, camera_file, parts)
    if not any(checked.paths) or (shapes_differ and not checked.explain_most):
        # an error of photos of another shape says nothing, unless lenses may have changed the shape
        if errors and (not shapes_differ or any(camera_file.lenses)):
            raise errors[0]
        raise explain_mismatch(checked, camera_file)
    # 4. The scene with the photos of its views, unless the same photos were proposed
    load = base
    if not are_read or (checked.paths, checked.turns) != (photos.paths, photos.turns):
        load = make(name_by_photos(camera_file, checked), read_photos(checked, camera_file))
    described = describe_assignment(checked, camera_file, are_pixels=base.scene.has_own_pixels)
    return replace(load, notes=(*checked.notes, *load.notes, *described), photos_explain=checked.explain_most)


def _note_left_out(load: Loaded, files: SceneFiles, left_out: list[str], cause: SceneError) -> Loaded:
    """Return a scene with a doubt which says what is left out, why, and what the user can do.

    ``left_out`` describes the files that are left out. If photos cannot be used without these files, the doubt also
    names the photos, and replaces the notes on photos.
    """
    photo_notes, notes = split_notes(load.notes, "unused photos")
    left_out = [*left_out, *([f"the photos in {files.images or files.ply.parent}"] if photo_notes else [])]
    known_paths = map(str, (files.ply, files.ply.parent, files.cameras, files.images))
    damaged_file = "" if cause.path in known_paths else f"{cause.path}: "
    option, value = ("cameras", "FILE") if left_out[0] == str(files.cameras) else ("images", "FOLDER")
    remedy = cause.remedy or f"pass --{option} {value}, or --{option} {NONE}"
    verb = "is" if left_out == [str(files.cameras)] else "are"
    doubt = f"{' and '.join(left_out)} {verb} left out: {damaged_file}{cause.problem}; {remedy}"
    return replace(load, notes=(Doubt(" ".join(doubt.split())), *notes))


def move_cameras_to_scene(ply: GaussianFile, files: SceneFiles, *, hints: ReadHints, photos: bool) -> Loaded:
    """Read a scene with its cameras moved into the frame of the Gaussians, if pixels or colours show that frame.

    If nothing shows that frame, the cameras stay as stored in their file. If ``photos`` is False, no photos are needed.
    If ``photos`` is True, named photos that cannot be read raise SceneError. Named cameras without a size raise
    SceneError, too.
    """
    for with_photos in dict.fromkeys((True, photos)):  # photos help to find the frame even if they are not needed
        with suppress(SceneError):
            return align_scene(ply, files, hints=hints, photos=with_photos, keeps_cameras=True)
    # The cameras as stored in their file. Cameras that the caller did not name have to see the Gaussians
    with suppress(SceneError):
        camera_file = read_scene_cameras(ply, files)
        if camera_file is not None:
            pictures = read_stored_photos(files, camera_file) if photos else ()
            cameras = to_cameras(camera_file, photo_size(pictures))
            if "cameras" in files.named or check_cameras(ply.gaussians, ply.valid, cameras, NO_IMAGES).ok:
                doubt = Doubt("the cameras do not fit the Gaussians; they stay as stored in their file")
                as_stored = AlignmentResult(None, cameras, as_floats(pictures), camera_file)
                return replace(make_loaded(ply, files, hints, as_stored, [doubt]), cameras=None)
    return align_scene(ply, files, hints=hints, photos=photos)  # this leaves out files that were not named
