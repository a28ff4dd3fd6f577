"""Find and read the photos of a scene's views.

Names and folders propose a file for each camera. The content of the photos decides which photo belongs to which view,
and in which orientation (:mod:`gsmerge.photos.assign`).
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePath

import numpy as np

from gsmerge.cameras import ESTIMATED
from gsmerge.errors import Doubt, SceneError
from gsmerge.io.cameras.camera_file import CameraFile, select_views, sizes_of
from gsmerge.io.cameras.embedded import SHARP
from gsmerge.io.cameras.read import read_cameras
from gsmerge.io.cameras.table import FFGS
from gsmerge.io.first_bytes import CONVERT
from gsmerge.io.image_names import IMAGE_SUFFIXES, find_image, list_images, natural_order, propose_images
from gsmerge.io.photo_files import (
    WHOLE,
    Part,
    PhotoArrays,
    Size,
    decode_image,
    decode_images,
    decode_photos,
    decode_small,
    image_size,
    orientation_turn,
    part_size,
    same_shape,
)
from gsmerge.io.scene_files import SceneFiles
from gsmerge.kernels.pictures import turn_picture
from gsmerge.photos.assign import Assigner, Assignment, Candidates, assign_photos
from gsmerge.photos.colors import cut_blocks
from gsmerge.photos.grid_fit import WHOLE_FIT, GridFit, PartFit, choose_fit, has_bars, list_fits
from gsmerge.photos.offsets import OFFSET_PIXELS, correlate_parts
from gsmerge.photos.photo_folders import capture_folder, count_pixels, find_named_photos
from gsmerge.photos.pictures import Pairs, ViewPictures, show_views
from gsmerge.photos.scores import stands_out
from gsmerge.raster.photos import row_pictures, shrink_pictures
from gsmerge.runtime.record import list_some
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

UNNAMED = "view 0"  # name of the first camera if its file has no names, or if cameras were estimated from rows


@dataclass(frozen=True, eq=False)
class ScenePhotos:
    """The photos of c cameras, all of one size, and their files."""

    pictures: PhotoArrays = ()  # [h,w,3] uint8 each, black for a camera without a photo; empty without photos
    paths: tuple[Path | None, ...] = ()  # None for a camera without a photo; empty if the photos are inside a file
    turns: tuple[int, ...] = ()  # orientation of each file, 0 to 7; see gsmerge.kernels.pictures.turn_picture
    part: Part = WHOLE  # the part of each upright photo that is used

    def __len__(self) -> int:
        return len(self.pictures)

    @property
    def absent(self) -> list[int]:
        """Numbers of the cameras without a photo."""
        return [view for view, path in enumerate(self.paths) if path is None]

    @property
    def file_size(self) -> Size | None:
        """Most frequent size of the used part of upright photos; of several, the largest; None without photos."""
        sizes = [
            part_size(_upright_size(path, turn), self.part)
            for path, turn in zip(self.paths, self.turns, strict=True)
            if path is not None
        ]
        return max(set(sizes), key=lambda size: (sizes.count(size), size[0] * size[1])) if sizes else None


@dataclass(frozen=True)
class Proposal:
    """Files that may be photos of c cameras, and the file that is proposed for each camera."""

    folder: Path
    pool: tuple[Path, ...]  # all files
    named: tuple[int | None, ...]  # for each camera, the index of its file in the pool; None without a proposed file
    exact: bool  # True: names propose the files; False: their order does
    faults: tuple[str | None, ...] = ()  # for each camera, why its photo cannot be used; None for no fault
    by_names: bool = False  # True: the folder was found by the names of its files
    fit: PartFit = WHOLE_FIT  # the part of each photo that is used
    notes: tuple[str, ...] = ()  # notes on the used part

    def tag(self, photo: int) -> int:
        """Return the orientation, 0 to 7, in the tag of a file of the pool."""
        return orientation_turn(self.pool[photo])

    @property
    def paths(self) -> list[Path | None]:
        """The proposed file of each camera."""
        return [None if photo is None else self.pool[photo] for photo in self.named]

    @property
    def choice(self) -> list[Assignment | None]:
        """The proposed file of each camera, in the orientation in which it is stored."""
        return [None if photo is None else Assignment(photo, 0) for photo in self.named]

    def without_views(self, cameras: Sequence[int]) -> Proposal:
        """Return a copy in which ``cameras`` have a fault: a camera is unknown if its view has no Gaussians."""
        faults = list(self.faults)
        for camera in cameras:
            path = self.paths[camera]
            name = f"view {camera}" if path is None else _short_path(path, self)
            faults[camera] = f"{name}: its camera is unknown, since no Gaussian belongs to it"
        return replace(self, faults=tuple(faults))

    def without_files(self, faults: Mapping[Path, str]) -> Proposal:
        """Return a copy without the files in ``faults``, which maps files to the reasons why they cannot be used.

        The reason becomes a fault of the cameras for which the file was proposed.
        """
        pool = tuple(path for path in self.pool if path not in faults)
        ids = {path: number for number, path in enumerate(pool)}
        camera_faults = (
            fault if path not in faults or path is None else f"{_short_path(path, self)}: {faults[path]}"
            for path, fault in zip(self.paths, self.faults, strict=True)
        )
        named = (None if path is None else ids.get(path) for path in self.paths)
        return replace(self, pool=pool, named=tuple(named), faults=tuple(camera_faults))

    def without_unreadable(self, *, decode: bool) -> Proposal:
        """Return a copy without proposed files whose headers (with ``decode``, whose pixels) cannot be read."""
        paths = [path for path in dict.fromkeys(self.paths) if path is not None]
        faults = parallel_map(lambda path: _find_fault(path, decode=decode), paths)
        return self.without_files({path: fault for path, fault in zip(paths, faults, strict=True) if fault})

    def without_broken(self) -> Proposal | None:
        """Return a copy without the proposed files that cannot be decoded; None if all or none can be decoded."""
        sound = self.without_unreadable(decode=True)
        return None if len(sound.pool) == len(self.pool) or not any(sound.choice) else sound

    def select_views(self, cameras: Sequence[int]) -> Proposal:
        """Return a copy for ``cameras`` alone."""
        named = tuple(self.named[camera] for camera in cameras)
        return replace(self, named=named, faults=tuple(self.faults[camera] for camera in cameras))


@dataclass(frozen=True, eq=False)
class ViewPhotos:
    """The photo of each view of a scene, as the content of the photos shows it."""

    proposal: Proposal  # the files; views with a guessed camera have a fault
    chosen: list[Assignment | None]  # for each view, its file and orientation; None without a photo
    explain_most: bool  # True: the proposed photos explain most views
    may_be_parts: bool  # True: only a part of each photo may show its view
    fit: GridFit | None  # how files are resized and cropped to the grid of rows; None if cameras are not estimated


def is_without_names(camera_file: CameraFile) -> bool:
    """Return whether cameras were estimated and have no names of photos yet, so that photos may have any size."""
    return camera_file.source == ESTIMATED and camera_file.names[0] == UNNAMED


def propose_photos(files: SceneFiles, camera_file: CameraFile) -> Proposal | None:
    """Propose a photo file for every camera by names, or if no name fits, by order if there is one file per camera.

    Files that cannot be read are left out. None if there are no files of photos.
    """
    names = camera_file.names
    if files.images is None and "images" not in files.named:
        folder, pool, named = _find_photos_near(files, camera_file)
    elif files.images is not None and files.images.is_dir():
        folder, pool = files.images, list_images(files.images)
        named = propose_images(folder, pool, names, count_pixels)
    else:  # the user wants no photos, or the photos are inside a file
        return None
    better = None  # another folder, in which more cameras have a photo by name
    if "images" not in files.named and len(known := {*named} - {None}) < len(names) and names[0] != UNNAMED:
        roots = dict.fromkeys(path.absolute() for path in (capture_folder(Path(camera_file.path)), files.root) if path)
        better = find_named_photos([*roots], camera_file, len(known))
        folder, pool, named = better or (folder, pool, named)
    exact = any(named) and camera_file.source != ESTIMATED
    if not any(named) and len(pool) == len(names):
        named = list(pool)
    if not pool:
        return None
    faults = tuple(
        _describe_missing_file(folder, name) if exact and path is None else None
        for name, path in zip(names, named, strict=True)
    )
    ids = {path: number for number, path in enumerate(pool)}
    photos = tuple(None if path is None else ids.get(path) for path in named)
    proposal = Proposal(folder, tuple(pool), photos, exact, faults, by_names=better is not None)
    return proposal.without_unreadable(decode=False)


def _find_photos_near(files: SceneFiles, camera_file: CameraFile) -> tuple[Path, list[Path], list[Path | None]]:
    """Find photos near the camera file: the files that it names, or files beside the ``.ply``.

    Returns the folder of the photos, all files, and for each camera the file of its name, or None.
    """
    path, names = Path(camera_file.path), camera_file.names
    folder = capture_folder(path)
    named = [find_image(folder, name, path, option=files.photo_option) for name in names]
    pool = list(dict.fromkeys(path for path in named if path is not None))
    are_numbers = all(name.removeprefix("view ").isdecimal() for name in names)  # the cameras have no names of photos
    if not pool and are_numbers:
        folder = files.ply.parent  # AnySplat writes its Gaussians among the photos
        beside = (path for path in folder.glob("[!.]*") if path.suffix.lower() in IMAGE_SUFFIXES)
        pool = natural_order(path for path in beside if path.is_file())
    return folder, pool, named


def _describe_missing_file(folder: Path, name: str) -> str:
    """Say that a file does not exist; also name a file of the same stem whose format is not read, if there is one."""
    inner, same_stem = PurePath(name), set[str]()
    for place in {folder, folder if inner.is_absolute() or ".." in inner.parts else folder / inner.parent}:
        with suppress(OSError, ValueError):
            same_stem |= {file for file in os.listdir(place) if PurePath(file).stem == inner.stem}
    unread = {file for file in same_stem if PurePath(file).suffix.lower() not in IMAGE_SUFFIXES}
    short = inner.relative_to(folder.name) if inner.is_relative_to(folder.name) else inner  # without the folder's name
    if not unread:
        return f"{short}: no such file"
    return f"{short}: no such file, and the format of {min(unread)} is not read; {CONVERT}"


def _find_fault(path: Path, *, decode: bool = False) -> str | None:
    """Return why the header of an image file (with ``decode``, its pixels) cannot be read; None if it can be read."""
    try:
        size = image_size(path)
        if decode:
            decode_image(path, size)
    except SceneError as error:
        return f"{error.problem}; {CONVERT}" if error.remedy == CONVERT else error.problem
    return None


def stored_photos(files: SceneFiles, camera_file: CameraFile) -> PhotoArrays:
    """Read the photos of all cameras, from files of their names or from one file that has all photos.

    Returns no photos if none exist. SceneError if a photo is missing or cannot be read, or if two photos differ in
    size.
    """
    proposal = propose_photos(files, camera_file)
    if proposal is None:
        if files.images is not None and files.images.is_dir():
            raise SceneError(files.images, f"expected photos of {len(camera_file)} cameras, found none")
        return photos_inside(files, camera_file)
    if None in proposal.named:
        if files.images is None:  # photos that nobody named may be incomplete
            return ()
        view = proposal.named.index(None)
        reason = proposal.faults[view] or f"{camera_file.names[view]}: no such file"
        raise SceneError(proposal.folder, f"expected a photo for each of {len(camera_file)} cameras, found {reason}")
    return decode_images([proposal.pool[photo] for photo in proposal.named if photo is not None])


def photos_inside(files: SceneFiles, camera_file: CameraFile) -> PhotoArrays:
    """Read the photos from the one file that has all photos; return no photos if the scene has no such file."""
    if files.images is None or files.images.is_dir():
        return ()
    same_file = files.cameras is not None and os.path.realpath(files.cameras) == os.path.realpath(files.images)
    stored = (camera_file if same_file else read_cameras(files.images)).images
    if len(stored) != len(camera_file):
        raise SceneError(files.images, f"expected {len(camera_file)} images, one per camera, found {len(stored)}")
    return stored


def read_photos(proposal: Proposal, chosen: Sequence[Assignment | None], camera_file: CameraFile) -> ScenePhotos:
    """Read the chosen photo of each camera upright, and resize it to the size of most photos.

    Photos of a camera file of SHARP are resized to the size of their camera. SceneError if a photo cannot be read, or
    if its aspect ratio differs from that of most photos.
    """
    paths = tuple(None if assignment is None else proposal.pool[assignment.photo] for assignment in chosen)
    turns = tuple(0 if assignment is None else assignment.orientation for assignment in chosen)
    photos = ScenePhotos(paths=paths, turns=turns, part=proposal.fit.part)
    size = photos.file_size
    if size is None:
        return ScenePhotos()
    if camera_file.source == SHARP:
        size = int(camera_file.widths[0]), int(camera_file.heights[0])
    for path, turn in zip(paths, turns, strict=True):
        used_size = size if path is None else part_size(_upright_size(path, turn), photos.part)
        if camera_file.source != SHARP and not same_shape(used_size, size):
            width, height = used_size
            problem = f"expected photos with one aspect ratio, found {width} x {height} and {size[0]} x {size[1]}"
            raise SceneError(proposal.folder, problem)
    return replace(photos, pictures=decode_photos(paths, turns, proposal.fit.stretch(size), proposal.fit.part))


def select_one_shape(camera_file: CameraFile, proposal: Proposal) -> tuple[CameraFile, Proposal, list[str]] | None:
    """Leave out photos that lack the aspect ratio of most photos, and views whose cameras lack it.

    A camera without a size has the aspect ratio of its photo. Returns the cameras and the photos of all other views,
    and a doubt if views are left out. None if there are no photos, if all photos have one aspect ratio, or if fewer
    than two views would remain.
    """
    paths = proposal.paths
    sizes = {path: image_size(path) for path in paths if path is not None}
    if not sizes:
        return None
    (width, height), _ = Counter(sizes[path] for path in paths if path is not None).most_common(1)[0]
    shape = f"the aspect ratio of {width} x {height}"
    # the photos with another aspect ratio, and their sizes as text
    others = {path: "{} x {}".format(*size) for path, size in sizes.items() if not same_shape(size, (width, height))}
    camera_sizes = list(zip(camera_file.widths.tolist(), camera_file.heights.tolist(), strict=True))
    # a size of 1 pixel means that the camera has no size
    used = [
        view
        for view, (path, size) in enumerate(zip(paths, camera_sizes, strict=True))
        if (same_shape(size, (width, height)) if min(size) > 1 else path not in others)
    ]
    if len(used) < 2 or (len(used) == len(paths) and not others):
        return None
    unused = [camera_file.names[view] for view in range(len(paths)) if view not in used]
    doubt = f"{len(unused)} of {len(paths)} views are left out, since they do not have {shape}: {list_some(unused)}"
    fewer = proposal.without_files({path: f"{size}, not {shape}" for path, size in others.items()})
    return select_views(camera_file, used), fewer.select_views(used), [Doubt(doubt)] if unused else []


def _upright_size(path: Path, turn: int) -> Size:
    """Return the size of a photo after it is turned to the orientation ``turn``."""
    width, height = image_size(path)
    return (height, width) if turn % 2 else (width, height)


def _list_candidates(proposal: Proposal, fit: GridFit | None) -> Candidates:
    """Make candidates of the files of a proposal, read small, and fitted to a grid by ``fit`` if it is given."""

    def read(photo: int) -> np.ndarray:
        """Read a small version of a photo, and cut out the part that is used."""
        try:
            small = decode_small(proposal.pool[photo], OFFSET_PIXELS)
        except SceneError:  # an unreadable photo is black and fits no view
            small = np.zeros((OFFSET_PIXELS, OFFSET_PIXELS, 3), np.float32)
        small = proposal.fit.cut(small)
        return small if fit is None else fit.cut(small)

    return Candidates(read, len(proposal.pool), proposal.tag)


def assign_to_views(scene: Scene, proposal: Proposal, camera_file: CameraFile, *, read: bool) -> ViewPhotos:
    """Assign files to the views of a scene; see :func:`gsmerge.photos.assign.assign_photos`.

    A view gets no photo if its camera is only a guess, because cameras were estimated and the view has no Gaussians.

    Args:
        scene: The scene.
        proposal: The files.
        camera_file: The cameras of the views.
        read: True if the proposed files were read, and are the photos of the scene. If False, small versions are read.
    """
    fit = _fit_to_grid(scene, proposal) if is_without_names(camera_file) and proposal.pool else None
    guessed = list[int]()
    if camera_file.source == ESTIMATED and scene.pixels is not None:
        guessed = np.flatnonzero(~scene.pixels.shown.any((1, 2))).tolist()
    proposal, images = proposal.without_views(guessed), scene.images
    candidates = stored = _list_candidates(proposal, fit)
    if read and images is not None:
        view_of_photo = {photo: view for view, photo in enumerate(proposal.named) if photo is not None}
        candidates = replace(stored, read=lambda photo: images[view_of_photo[photo]])
    # a view whose mask leaves out all pixels is compared as a whole
    masks = None if scene.masks is None else scene.masks | ~scene.masks.any((1, 2), keepdims=True)
    show = partial(show_views, replace(scene, masks=masks))
    assigned, explain_most = assign_photos(show, candidates, proposal.named, exact=proposal.exact, stored=stored)
    chosen = [None if view in guessed else assignment for view, assignment in enumerate(assigned)]
    return ViewPhotos(proposal, chosen, explain_most, not explain_most or has_bars(images), fit)


def _fit_to_grid(scene: Scene, proposal: Proposal) -> GridFit:
    """Find how the photos that show a scene's views were resized and cropped to the grid of its rows."""
    fits = list_fits((scene.cameras.width, scene.cameras.height))
    shown, chosen = show_views(scene, OFFSET_PIXELS), list[np.ndarray | None]()
    assigner = Assigner(partial(show_views, scene), _list_candidates(proposal, None))
    for view, likely in assigner.list_likely(range(len(scene)), range(len(proposal.pool))).items():
        photos = [turn_picture(assigner.candidates.read(photo), turn) for photo, turn in likely]
        scores = [float(correlate_parts(shown, view, fits[0].cut(photo)).mean()) for photo in photos]
        chosen.append(photos[int(np.argmax(scores))] if photos else None)
    return choose_fit(shown, chosen, fits) if any(photo is not None for photo in chosen) else fits[0]


def has_other_shape(proposal: Proposal, camera_file: CameraFile) -> bool:
    """Return True if the first proposed photo, upright or turned, has another aspect ratio than all cameras.

    Another aspect ratio is expected if the cameras' source is known to resize or crop photos; the result is False then.
    """
    photo, shapes = next((photo for photo in proposal.named if photo is not None), None), sizes_of(camera_file)
    if photo is None or not shapes or camera_file.photo_map is not None or camera_file.source in (FFGS, SHARP):
        return False
    size = proposal.fit.stretch(part_size(image_size(proposal.pool[photo]), proposal.fit.part))
    return not any(same_shape(shape, turned) for shape in shapes for turned in (size, size[::-1]))


def has_nearer_colors(scene: Scene, other: Scene) -> bool:
    """Return whether a scene's colours are nearer to its photos than the colours of the scene ``other`` are."""
    images = scene.images
    assert images is not None

    def measure_errors(shown: ViewPictures) -> np.ndarray:
        """Return the differences ``[n]`` between blocks of pictures and the same blocks of the scene's photos."""
        return cut_blocks(Pairs(shrink_pictures(images, *shown.weights.shape[2:0:-1]), shown)).errors()

    return stands_out(
        measure_errors(show_views(other, OFFSET_PIXELS)) - measure_errors(show_views(scene, OFFSET_PIXELS))
    )


def name_by_photos(camera_file: CameraFile, photos: ViewPhotos) -> CameraFile:
    """Name estimated cameras by the photos of their views, and adapt the cameras to the ``fit`` of the photos.

    Cameras that were read from a file stay as they are.
    """
    if camera_file.source != ESTIMATED:
        return camera_file
    proposal, chosen = photos.proposal, photos.chosen
    files = [None if assignment is None else proposal.pool[assignment.photo] for assignment in chosen]
    names = [
        name if file is None else _short_path(file, proposal)
        for name, file in zip(camera_file.names, files, strict=True)
    ]
    turns = [0 if assignment is None else assignment.orientation for assignment in chosen]
    photo_size = ScenePhotos(paths=tuple(files), turns=tuple(turns), part=proposal.fit.part).file_size
    named = replace(camera_file, names=tuple(names))
    return named if photos.fit is None or photo_size is None else photos.fit.cameras(named, photo_size)


def _short_path(path: Path, proposal: Proposal) -> str:
    """Return the path of a file relative to the folder of photos, or the names of its folder and file if outside it."""
    folder = proposal.folder
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else f"{path.parent.name}/{path.name}"


def describe_assignment(photos: ViewPhotos, camera_file: CameraFile, *, are_pixels: bool) -> list[str]:
    """Describe where the assigned photos differ from names and tags, and why views have no photo.

    ``are_pixels`` is explained at :func:`_describe_spare`.
    """
    proposal, chosen = photos.proposal, photos.chosen
    folders = dict.fromkeys(str(proposal.pool[assignment.photo].parent) for assignment in chosen if assignment)
    place = f"photos are read from {list_some([*folders])}, whose files have the names of the cameras"
    count, notes = len(chosen), [place] if proposal.by_names else []
    turned = [
        _short_path(proposal.pool[assignment.photo], proposal)
        for assignment in chosen
        if assignment is not None and assignment.orientation != proposal.tag(assignment.photo)
    ]
    if turned:
        text = f"{len(turned)} of {count} photos are turned or mirrored relative to their orientation tags"
        notes.append(f"{text}: {list_some(turned)}")
    moved = [
        f"photo {_short_path(proposal.pool[assignment.photo], proposal)}"
        f" for view {camera_file.names[view].removeprefix('view ')}"
        for view, assignment in enumerate(chosen)
        if assignment is not None and assignment.photo != proposal.named[view]
    ]
    if moved:
        names = "names" if proposal.exact else "their order"
        notes.append(f"photos are matched with views by their content, not by {names}: {list_some(moved)}")
    notes += _describe_spare(proposal, chosen, are_pixels=are_pixels)
    missing = [view for view, assignment in enumerate(chosen) if assignment is None]
    if not missing:
        return notes
    reasons = [_explain_absence(proposal, view, camera_file.names[view]) for view in missing]
    return [*notes, Doubt(f"photos of {len(missing)} of {count} views are left out: {list_some(reasons, '; ')}")]


def _explain_absence(proposal: Proposal, view: int, name: str) -> str:
    """Say why the camera of a view has no photo."""
    path = proposal.paths[view]
    if path is None:
        return proposal.faults[view] or f"{name}: no photo shows this view"
    return proposal.faults[view] or f"{_short_path(path, proposal)}: shows something else than its camera"


def _describe_spare(proposal: Proposal, chosen: Sequence[Assignment | None], *, are_pixels: bool) -> list[str]:
    """Note the photos without a camera in the folders of the used photos, since they may show other parts of the scene.

    If each Gaussian belongs to a pixel of a view (``are_pixels``), the cameras of the views see the whole scene. With
    ``are_pixels``, photos without a camera are noted only if names propose photos, and if fewer photos lack a camera
    than are used.
    """
    used = [proposal.pool[assignment.photo] for assignment in chosen if assignment is not None]
    named = [proposal.pool[photo] for photo in proposal.named if photo is not None]
    folders, stems = {path.parent for path in used}, {path.stem for path in (*used, *named)}
    spare = [path for path in proposal.pool if path.parent in folders and path.stem not in stems]
    if not spare or (are_pixels and (not proposal.exact or len(spare) >= len(used))):
        return []
    count = f"{len(spare)} of {len(spare) + len(used)} photos {'has' if len(spare) == 1 else 'have'} no camera"
    names = list_some([_short_path(path, proposal) for path in spare])
    return [f"{count} and {'is' if len(spare) == 1 else 'are'} not used: {names}"]


def describe_missing(names: Sequence[str], stored: CameraFile | SceneError | None, *, is_right: bool) -> str | None:
    """Say which views have no camera in a file, which is why all cameras are estimated instead of read from the file.

    Returns None if there is no such file, if it cannot be read, or if its cameras may be those of another scene.

    Args:
        names: Names of the views. A view has the name of its photo, if a photo shows it.
        stored: The cameras of the file, or why the file cannot be read; None if there is no file.
        is_right: True if the cameras of the file see the Gaussians. Otherwise the cameras are taken for those of the
            scene only if every camera has the name of a view.
    """
    if not isinstance(stored, CameraFile):
        return None
    known, count = {PurePath(name).stem for name in stored.names}, len(names) - len(stored)
    lacking = [name for name in names if PurePath(name).stem not in known]
    are_named = len(lacking) == count > 0
    if not (are_named or is_right):
        return None
    examples = f" ({list_some(lacking)})" if are_named else ""
    text = f"{count} of {len(names)} views {'has' if count == 1 else 'have'} no camera in {stored.path}{examples}"
    return f"{text}: the poses and focal length of all views are estimated from the Gaussians' own grid"


def explain_mismatch(proposal: Proposal, camera_file: CameraFile) -> SceneError:
    """Return the error that no photo shows any view, with the names of the photos that cannot be used."""
    views = f"the {len(camera_file)} views of {camera_file.widths[0]} x {camera_file.heights[0]} pixels"
    photos = "none that shows one of them"
    if has_other_shape(proposal, camera_file) and camera_file.source != ESTIMATED:
        width, height = image_size(next(proposal.pool[photo] for photo in proposal.named if photo is not None))
        shape = " (2 : 1 as 360-degree panoramas have)" if width == 2 * height else ""
        photos = f"{width} x {height}{shape}, of which no part shows one of them"
    faults = [fault for fault in proposal.faults if fault is not None]
    reasons = f" ({list_some(faults, '; ')})" if faults else ""
    problem = f"expected photos of {views}, found {photos}{reasons}"
    return SceneError(proposal.folder, problem, "name their folder with --images")


def without_photo(scene: Scene, views: Sequence[int]) -> Scene:
    """Return a scene with pictures of its Gaussians in place of the photos of ``views``; their pixels do not count."""
    if scene.images is None:
        return scene
    images, ids = scene.images.copy(), list(views)
    shape = len(scene), scene.cameras.height, scene.cameras.width
    masks = np.ones(shape, bool) if scene.masks is None else scene.masks.copy()
    masks[ids] = False
    images[ids] = (
        row_pictures(scene)[ids]
        if scene.has_own_pixels
        else show_views(replace(scene, masks=None), max(shape))[ids].pictures
    )
    return replace(scene, images=images, masks=masks)
