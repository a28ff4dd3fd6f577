"""Examine candidates: what shows that cameras, and the photos beside them, belong to the Gaussians, or do not.

:func:`examine` raises no SceneError, since an error is evidence, too.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np

from gsmerge.errors import Doubt, SceneError, attempt
from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.camera_file import CameraFile, select_views
from gsmerge.io.formats.read_gaussians import GaussianFile
from gsmerge.io.formats.rows import RESULT_COMMENT
from gsmerge.io.image_names import IMAGE_PLACES, describe_unread
from gsmerge.io.photo_files import as_floats, photo_size, resize_to
from gsmerge.method.compare.offsets import OFFSET_PIXELS, correlate_parts
from gsmerge.method.compare.similarity import stands_out
from gsmerge.method.compare.view_pictures import show_views
from gsmerge.reading.alignment import CameraCheck, UnseenError
from gsmerge.reading.candidates import WITHOUT_LENS, Views
from gsmerge.reading.choose import Evidence, blames_photos, choose_photos, needs_bare
from gsmerge.reading.exporters import ReadHints
from gsmerge.reading.loaded import Loaded
from gsmerge.reading.make_scene import make_scene, place_no_views, place_views
from gsmerge.reading.photos.photo_parts import choose_part, has_bars
from gsmerge.reading.photos.scene_photos import (
    NO_PHOTOS,
    ScenePhotos,
    assign_to_views,
    describe_assignment,
    explain_mismatch,
    has_other_shape,
    have_fewer_pixels,
    is_without_names,
    keep_one_shape,
    name_by_photos,
    read_photos,
    select_photos,
)
from gsmerge.reading.scene_files import SceneFiles, result_cameras
from gsmerge.runtime.record import list_some

Measure = Callable[[CameraFile, ScenePhotos], Evidence]
MeasureBare = Callable[[CameraFile], Evidence]  # without photos, whatever lenses the cameras have


def examine(ply: GaussianFile, views: Views, hints: ReadHints) -> Evidence:
    """Examine cameras with the photos that may show their views, and without photos if these do not."""
    camera_file = views.camera_file
    photos = views.photos
    files = views.files
    stored = None if camera_file is None else replace(camera_file, images=())
    start = Evidence(views.candidate, stored=stored, photo_place=views.place)
    if views.error is not None:
        return _with_error(start, views.error)
    if photos.by_names:
        files = replace(files, images=photos.folder)
    if camera_file is None:
        return _measure(start, ply, files=files, hints=hints, cameras=None, photos=NO_PHOTOS)
    measure = partial(_measure, start, ply, files, hints)
    if views.photo_error is None and not photos.named:  # there are no photos, or they are in one file
        alone = measure(camera_file, photos)
        is_result = RESULT_COMMENT in ply.info.comments or result_cameras(files.ply)  # films beside a result show it
        if alone.error is not None or alone.has_photos or not views.is_searched or "images" in files.named or is_result:
            return alone
        return replace(alone, notes=(*alone.notes, *describe_unread(files.ply.parent, IMAGE_PLACES)))
    measure_bare = cache(lambda cameras: measure(replace(cameras, lenses=()), NO_PHOTOS))  # once, whatever its lenses
    found: Evidence | SceneError | None = views.photo_error
    if found is None:
        found = attempt(_examine_photos, measure, measure_bare, camera_file, photos)
    shown = _with_error(start, found) if isinstance(found, SceneError) else found
    if blames_photos(shown, views):
        return replace(shown, error=explain_mismatch(photos, camera_file))
    return choose_photos(shown, measure_bare(camera_file), views) if needs_bare(shown, views) else shown


def _with_error(start: Evidence, error: SceneError) -> Evidence:
    """Return the evidence of an error, with what the cameras see if the error says so."""
    return replace(start, error=error, sight=error.sight if isinstance(error, UnseenError) else None)


def _measure(
    start: Evidence,
    ply: GaussianFile,
    files: SceneFiles,
    hints: ReadHints,
    cameras: CameraFile | None,
    photos: ScenePhotos,
) -> Evidence:
    """Add to the evidence what a scene with these cameras and photos shows, or the error that prevents a scene."""

    def make() -> tuple[Loaded, CameraCheck | None]:
        """Make the scene; also return what the cameras see, if it was measured."""
        if cameras is None:
            placed = place_no_views(ply, files, hints)
        else:
            pictures = read_photos(photos, cameras) if photos.named else photos
            placed = place_views(ply, files, hints, cameras, pictures)
        return make_scene(ply, placed, hints), placed.result.sight

    made = attempt(make)
    if isinstance(made, SceneError):
        return _with_error(start, made)
    load, sight = made
    way = start.candidate.way
    notes_on_way = [f"the cameras in {files.cameras} are read {way}, since they fit the Gaussians so"] if way else []
    return replace(
        start,
        are_pixels=load.scene.has_own_pixels,
        share_near=None if load.alignment is None else load.alignment.share_near,
        sight=sight,
        num_views=len(load.scene),
        names=load.scene.names,
        own_views=load.own_views,
        has_photos=load.scene.images is not None,
        num_shown=len(load.scene.photo_views),
        better_ways=(WITHOUT_LENS,) if _fits_without_lens(load) else (),
        notes=(*notes_on_way, *load.notes),
        load=load,
    )


def _fits_without_lens(load: Loaded) -> bool:
    """Return whether photos fit the views of a scene better as they are stored than undistorted, part by part."""
    source = load.source
    images = load.scene.images
    if source is None or images is None or source.size is None or not source.camera_file.lenses:
        return False
    pictures = source.photos.pictures
    stored_size = photo_size(pictures)
    if stored_size is None:
        return False
    if stored_size != source.size:
        pictures = resize_to(stored_size, source.size).photos(pictures)
    if source.transform is not None:
        pictures = source.transform.photos(pictures)
    shown = show_views(replace(load.scene, masks=None), OFFSET_PIXELS)
    gains = [
        correlate_parts(shown, view, as_floats([pictures[view]])[0]) - correlate_parts(shown, view, images[view])
        for view in load.scene.photo_views
    ]
    return stands_out(np.concatenate(gains))


@dataclass(frozen=True, eq=False)
class PhotoTrial:
    """A scene with the photos that names propose, or without photos, and the photos that show its views."""

    base: Evidence  # on the scene
    proposed: ScenePhotos  # without the photos that turned out to be damaged
    checked: ScenePhotos  # the photo of each view, by content
    error: SceneError | None  # why the scene does not have the proposed photos
    are_read: bool  # True: the scene has them


def _try_photos(
    measure: Measure, measure_bare: MeasureBare, camera_file: CameraFile, photos: ScenePhotos
) -> PhotoTrial:
    """Make a scene with proposed photos, or if these cannot be used, without; let its views decide on their photos.

    Photos whose shape their cameras do not have are not tried if Gaussians lie in the pixels of these cameras. Raises
    SceneError if neither can be made.
    """
    base = None
    error = None
    has_shape = any(camera_file.lenses) or not has_other_shape(photos, camera_file, as_named=True)
    is_proposed = any(photos.named) and not is_without_names(camera_file)
    if is_proposed and (has_shape or not measure_bare(camera_file).are_pixels):
        base = measure(camera_file, photos)
        error = base.error
    are_read = base is not None and error is None
    if base is None or error is not None:
        base = measure_bare(camera_file)
    if base.error is not None:
        raise error or base.error
    if are_read and base.load is not None and base.load.source is not None:
        photos = photos.without_files(base.load.source.photos.damaged)
    checked = assign_to_views(base.scene, photos, camera_file, read=are_read)
    return PhotoTrial(base, photos, checked, error, are_read)


def _examine_photos(
    measure: Measure, measure_bare: MeasureBare, camera_file: CameraFile, photos: ScenePhotos
) -> Evidence:
    """Examine cameras with the photos that names propose, or with other photos that show its views.

    1. If the photos have another shape than the cameras, parts of the photos are used if they show the views.
    2. The scene is made with the proposed photos, or if these photos cannot be used, without photos.
    3. The views of this scene decide which photo belongs to a view. Parts of photos are used if the parts fit better.
    4. If the views show photos other than the proposed ones, the scene is made again.
    5. Views without a photo are left out if the others explain the Gaussians as well: a camera file may have more.

    Notes name photos that cannot be read, and views without a photo. Raises SceneError if no photo shows a view.
    """
    camera_file, photos, doubts = keep_one_shape(camera_file, photos)
    shapes_differ = not is_without_names(camera_file) and has_other_shape(photos, camera_file)
    part = None
    if shapes_differ:  # 1.
        bare = measure_bare(camera_file)
        found = None if bare.error is not None else attempt(choose_part, bare.scene, photos, camera_file)
        part = found if isinstance(found, ScenePhotos) else None
    trial = _try_photos(measure, measure_bare, camera_file, part or photos)  # 2.
    if part is None and not shapes_differ:  # 3.
        shows_most = trial.checked.explain_most and not has_bars(trial.base.scene.images)
        if not shows_most or have_fewer_pixels(trial.checked, camera_file):  # perhaps crops
            fit = trial.checked.grid_fit
            part = choose_part(trial.base.scene, trial.proposed, camera_file, fit, explain_most=shows_most)
        trial = trial if part is None else _try_photos(measure, measure_bare, camera_file, part)
    checked = trial.checked
    evidence = trial.base
    is_wrong_shape = shapes_differ and part is None
    if not any(checked.paths) or (is_wrong_shape and not checked.explain_most):
        # an error of photos of another shape says nothing, unless lenses may have changed the shape
        says_why = not is_wrong_shape or any(camera_file.lenses)
        raise trial.error if says_why and trial.error is not None else explain_mismatch(checked, camera_file)
    if not trial.are_read or (checked.paths, checked.turns) != (trial.proposed.paths, trial.proposed.turns):  # 4.
        evidence = measure(name_by_photos(camera_file, checked), checked)
        if evidence.error is not None:
            raise evidence.error
    fewer = _leave_out_idle(evidence, measure, measure_bare, camera_file, photos)
    if fewer is not None:  # 5.
        return fewer
    described = describe_assignment(checked, camera_file, are_pixels=trial.base.are_pixels)
    notes = (*checked.notes, *evidence.notes, *described, *doubts)
    return replace(evidence, notes=notes, photos_explain=checked.explain_most)


def _leave_out_idle(
    evidence: Evidence, measure: Measure, measure_bare: MeasureBare, camera_file: CameraFile, photos: ScenePhotos
) -> Evidence | None:
    """Examine cameras without those that have no photo, and no Gaussians at most of their pixels.

    None if there are none, or if fewer Gaussians lie near pixels of the other cameras than of all.
    """
    scene = evidence.scene
    without_photo = sorted({*range(len(scene))} - {*scene.photo_views})
    if not without_photo or not evidence.are_pixels or not photos.named:
        return None
    shares = scene.get_pixels().shown.mean((1, 2))
    idle = [view for view in without_photo if shares[view] <= 0.5]
    used = [view for view in range(len(scene)) if view not in idle]
    if not idle or not used:
        return None
    found = attempt(
        _examine_photos, measure, measure_bare, select_views(camera_file, used), select_photos(photos, used)
    )
    if (
        isinstance(found, SceneError)
        or len(found.scene.gaussians) < len(scene.gaussians)
        or (found.share_near or 0) < (evidence.share_near or 0)
    ):
        return None
    doubt = f"{len(idle)} of {len(scene)} cameras have no photos and are left out, as the others explain all Gaussians"
    doubt += f": {list_some([scene.names[view] for view in idle])}"
    return replace(found, notes=(*found.notes, Doubt(doubt)))
