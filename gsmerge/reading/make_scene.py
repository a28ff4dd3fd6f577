"""Make a scene of Gaussians, cameras and photos that were read, with all facts about how they were read."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from gsmerge.errors import Doubt, Note, SceneError, attempt, count_words
from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.camera_file import CameraFile, as_pinholes, to_cameras
from gsmerge.io.cameras.dataparser import read_dataparser
from gsmerge.io.cameras.read_cameras import list_unread
from gsmerge.io.formats.read_gaussians import GaussianFile, file_notes
from gsmerge.io.formats.rows import MAX_STRAY, RESULT_COMMENT
from gsmerge.io.photo_files import NO_IMAGES, as_floats, photo_size
from gsmerge.method.compare.view_pictures import show_views
from gsmerge.method.geometry.transforms import move_views
from gsmerge.method.raster.photos import WHOLE_SHARE, row_pictures
from gsmerge.reading.alignment import AlignmentResult, check_pixels, find_pixels
from gsmerge.reading.choice import make_choice
from gsmerge.reading.exporters import ReadHints, choose_exporters, find_cameras_of_model, find_exporter
from gsmerge.reading.larger_photos import PhotoSource, limit_photo_size, limit_view_size, read_larger_and_masks
from gsmerge.reading.loaded import Loaded
from gsmerge.reading.photos.masks import NO_MASKS, CameraMaskError, check_masks
from gsmerge.reading.photos.scene_photos import ScenePhotos
from gsmerge.reading.scene_files import SceneFiles
from gsmerge.reading.take_gaussians import take_gaussians
from gsmerge.runtime.record import list_some
from gsmerge.settings.reading import NONE
from gsmerge.types import NO_CAMERAS, Scene


@dataclass(frozen=True, eq=False)
class Placed:
    """Cameras and photos beside the Gaussians of a file, before a scene is made of them."""

    files: SceneFiles
    result: AlignmentResult  # the cameras, the photos, and the pixels of the rows
    notes: tuple[str, ...]
    source: PhotoSource | None = None  # the photos as stored; None without views


def place_views(
    ply: GaussianFile, files: SceneFiles, hints: ReadHints, camera_file: CameraFile, photos: ScenePhotos
) -> Placed:
    """Place cameras and photos beside Gaussians. Raises SceneError if the cameras or the photos cannot be used."""
    # the order of the rows is that of the hints, of the named exporter, or of the format of the cameras
    order: str = hints.order
    if order == "auto":
        order = (find_exporter(hints.exporter) or camera_file).order
        if order == "auto" and RESULT_COMMENT in ply.info.comments:
            order = "none"  # results have no pixels
    pinholes, pictures, notes = as_pinholes(camera_file, photos.pictures)
    limited, size_notes = limit_photo_size(pictures, len(ply.gaussians), hints.max_side, unaligned=order == "none")
    if files.is_state and files.cameras == files.ply:  # the cameras of a state fit its Gaussians, so none are aligned
        problem = "expected one Gaussian per pixel, found the Gaussians of a state"
        cameras = to_cameras(pinholes, photo_size(limited))
        result = AlignmentResult(None, cameras, as_floats(limited), pinholes, problem=problem)
    else:
        frames = partial(read_dataparser, files.ply, Path(camera_file.path))
        result = find_pixels(ply, pinholes, limited, order=order, scale=hints.scene_scale, frames=frames)
    photos = photos.without_files(photos.damaged)  # now that all photos were decoded
    notes += [*size_notes, *result.notes]
    if result.pixel_ids is None:
        check_hints(ply, hints)
        cameras, images, size_notes = limit_view_size(result.cameras, result.images, hints.max_side)
        result = replace(result, cameras=cameras, images=images)
        notes += size_notes
    source = PhotoSource(camera_file, photos, photo_size(limited), result.transform)
    return Placed(files, result, tuple(notes), source)


def place_no_views(ply: GaussianFile, files: SceneFiles, hints: ReadHints) -> Placed:
    """Return that a scene has no views; a run places views later. A note says that photos are not used."""
    advice = find_cameras_of_model(ply.info)
    notes = [advice] if advice else []
    check_hints(ply, hints)
    if files.images is not None:
        reason = f"only cameras show which views they have, and --cameras {NONE} leaves cameras out"
        if "cameras" not in files.named:
            unread = [path.name for path in list_unread(files.ply.parent)]
            which = f" (of {list_some(unread)}, none has cameras in a format that is read)" if unread else ""
            reason = (
                f"there are no cameras, such as a transforms.json or a COLMAP model{which}; name them with --cameras"
            )
        notes += [Note(f"the photos in {files.images} are not used: {reason}", "unused photos")]
    problem = "expected one Gaussian per pixel, found no cameras"
    return Placed(files, AlignmentResult(None, NO_CAMERAS, NO_IMAGES, None, problem=problem), tuple(notes))


def make_scene(ply: GaussianFile, placed: Placed, hints: ReadHints) -> Loaded:
    """Make a scene of the visible Gaussians and all views, with all facts about how it was read.

    The scene has no larger photos and no masks yet, see :func:`add_larger_and_masks`.
    """
    files = placed.files
    result = placed.result
    source = placed.source
    absent = [] if source is None else source.photos.absent
    camera_file = result.camera_file
    recovery = result.recovery
    gaussians, pixels = take_gaussians(ply, result)
    num_faint = int(ply.valid.sum()) - len(gaussians)
    faint = count_words(num_faint, "Gaussian", "fainter than 1/255, which nothing draws, set aside")
    photos = result.images if len(result.images) else None
    names = () if camera_file is None else camera_file.names
    cameras = replace(result.cameras, antialiased=ply.info.antialiased)
    scene = Scene(gaussians, cameras, photos, pixels, names)
    last_rows = () if pixels is None else pixels.fronts.max((1, 2))  # -1 for a view without rows
    empty_views = [scene.names[view] for view, row in enumerate(last_rows) if row < 0 and view not in absent]
    views_have = f"{len(empty_views)} of {len(scene)} views {'has' if len(empty_views) == 1 else 'have'}"
    doubts = [Doubt(f"{views_have} no Gaussians: {list_some(empty_views)}")] if empty_views else []
    if hints.quats != "wxyz":
        scene = replace(scene, gaussians=replace(scene.gaussians, quats=np.roll(scene.gaussians.quats, 1, axis=1)))
    if recovery is not None and result.confirmed_viewmats is not None:
        scene = move_views(scene, result.confirmed_viewmats)
    alignment = None if recovery is None else check_pixels(scene)
    if alignment is not None and alignment.share_near < 1 - MAX_STRAY:
        share = f"{100 * (1 - alignment.share_near):.0f} % of the Gaussians lie far from their own pixels"
        doubts.append(Doubt(f"{share}, as rows of a damaged file do; copy or export it again"))
    format_name = "" if camera_file is None else camera_file.source
    order = "none" if recovery is None else recovery.layout.order
    return Loaded(
        scene=without_photo(scene, absent) if absent else scene,
        info=ply.info,
        files=files,
        cameras=camera_file,
        exporters=choose_exporters(hints.exporter, ply.info, order, format_name),
        notes=(*files.notes, *file_notes(ply.info), *doubts, *placed.notes, *([faint] if num_faint else [])),
        alignment=alignment,
        recovery=recovery,
        problem=result.problem,
        moves=result.moves,
        own_views=result.own_views,
        source=source,
    )


def check_hints(ply: GaussianFile, hints: ReadHints) -> None:
    """For rows that have no pixels, raise SceneError if a hint says that rows are pixels."""
    if hints.order not in ("auto", "none"):
        problem = f"expected rows that are pixels of views, as --hint order={hints.order} says, found others"
        raise SceneError(ply.info.path, problem, "leave the hint out, or name the cameras that fit with --cameras")


def add_larger_and_masks(load: Loaded) -> Loaded:
    """Add larger photos and masks to a scene whose cameras and photos are decided, and say why masks are used or not.

    Masks that were found, but cannot be used, are left out with a note. Raises SceneError for masks that the caller
    named, and for masks that the camera file lists if they are photos.
    """
    files = load.files
    source = load.source
    scene = load.scene
    notes = list[str]()
    if source is None:
        return load
    is_plain = "masks" in files.named and files.masks is None  # the user wants no masks
    listed = "masks" not in files.named and any(source.camera_file.masks.values())
    place = f"listed in {Path(source.camera_file.path).name}" if listed else files.masks
    refusal = ""
    if source.size is None:
        refusal = "there are no photos"
        if mask_options := [name for name in ("masks", "protect") if getattr(files, name) is not None]:
            text = f"the pictures of --{' and --'.join(mask_options)} are not used, since {refusal}"
            notes.append(Doubt(text) if files.named.intersection(mask_options) else text)
    read = attempt(read_larger_and_masks, files, source, scene.cameras, is_plain=is_plain)
    if isinstance(read, SceneError):
        refusal = read.problem if read.path == str(place) else f"{Path(read.path).name}: {read.problem}"
        is_protecting = files.protect is not None and Path(read.path).is_relative_to(files.protect)
        is_listed = isinstance(read, CameraMaskError) or Path(read.path) in source.photos.paths
        if "masks" in files.named or is_protecting or is_listed:
            raise _with_choice(read, load, place, refusal)
        remedy = read.remedy or f"pass --masks FOLDER, or --masks {NONE}"
        notes.append(Doubt(f"masks are left out: {read.path}: {read.problem}; {remedy}"))
        without_masks = replace(files, masks=None, named=files.named | {"masks"})
        read = read_larger_and_masks(without_masks, source, scene.cameras)
    large, masks, mask_notes = read
    if place is None and masks.counts is not None:
        place = "transparency"
    checked = attempt(check_masks, masks, files, scene)
    if isinstance(checked, SceneError):
        raise _with_choice(checked, load, place, checked.problem)
    masks, reason, check_notes = checked
    choices = [*load.candidates]
    if place is not None:
        have_names = masks.num_files > 0 or place == "transparency" or masks is NO_MASKS
        reason = refusal or (reason if have_names else "have the name of no photo")
        is_chosen = not refusal and have_names and masks is not NO_MASKS
        choices.append(make_choice(files, "masks", place, reason, chosen=is_chosen, can_be_named=not refusal))
    if listed and files.masks is not None:
        choices.append(make_choice(files, "masks", files.masks, "the camera file names others", chosen=False))
    counts = masks.counts
    if scene.masks is not None:  # some views have no photo, and none of their pixels count
        counts = scene.masks if counts is None else counts & scene.masks
    maps = source.camera_file.depths  # of the model, which saw the views at their own size
    shape = len(scene), scene.cameras.height, scene.cameras.width
    depths = maps if maps is not None and maps.shape == shape and maps.dtype.kind == "f" else None
    if maps is not None and depths is None:
        found = f"{maps.dtype} {list(maps.shape)}, expected floats {list(shape)}, those of the views"
        notes.append(f"the depth maps in {source.camera_file.path} are not used to fill holes: found {found}")
    covered = scene.covered
    is_da3 = [one.name for one in load.exporters] == ["da3"]
    if maps is None and is_da3 and covered is not None and covered.mean() < WHOLE_SHARE:
        share = f"{100 - 100 * covered.mean():.0f} % of the pixels have no Gaussian"
        guess = "those that are added there get guessed depths, since the cameras' file has no depth maps"
        notes.append(f'{share}; {guess}: Depth Anything 3 writes them with export_format="npz-gs_ply"')
    scene = replace(scene, large_photos=large, masks=counts, importance=masks.importance, depths=depths)
    notes = [*load.notes, *notes, *mask_notes, *check_notes]
    return replace(load, scene=scene, source=None, notes=tuple(notes), candidates=tuple(choices))


def _with_choice(error: SceneError, load: Loaded, place: Path | str | None, reason: str) -> SceneError:
    """Put what was tried, the masks among it, into an error about masks, and return the error."""
    error.candidates = load.candidates
    if place is not None:
        choice = make_choice(load.files, "masks", place, reason, chosen=False, can_be_named=False)
        error.candidates += (choice,)
    return error


def without_photo(scene: Scene, views: Sequence[int]) -> Scene:
    """Return a scene with pictures of its Gaussians in place of the photos of ``views``; their pixels do not count."""
    if scene.images is None:
        return scene
    images = scene.images.copy()
    ids = list(views)
    shape = len(scene), scene.cameras.height, scene.cameras.width
    masks = np.ones(shape, bool) if scene.masks is None else scene.masks.copy()
    masks[ids] = False
    images[ids] = (
        row_pictures(scene)[ids]
        if scene.has_own_pixels
        else show_views(replace(scene, masks=None), max(shape))[ids].pictures
    )
    return replace(scene, images=images, masks=masks)
