"""The photos of a scene's views: files that names propose, assigned by what they show, and read as the views show them.

Names and folders propose a file for each camera; what the photos show decides (:mod:`gsmerge.evidence.assign`).
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from gsmerge.alignment import ESTIMATED
from gsmerge.errors import SceneError
from gsmerge.evidence.assign import Assigner, Assignment, Candidates, assign_photos
from gsmerge.evidence.offsets import SIDE, correlate_parts
from gsmerge.evidence.pictures import ViewPictures, show_views
from gsmerge.evidence.rays import find_on_rays
from gsmerge.evidence.scores import stands_out
from gsmerge.frame import canonicalise
from gsmerge.io.cameras.camera_file import CameraFile, select_views
from gsmerge.io.cameras.embedded import SHARP
from gsmerge.io.cameras.read import read_cameras
from gsmerge.io.cameras.table import CHUNK
from gsmerge.io.first_bytes import CONVERT
from gsmerge.io.formats.table import is_frame
from gsmerge.io.image_names import IMAGE_SUFFIXES, find_image, list_images, natural_key, propose_images
from gsmerge.io.photo_files import (
    PhotoArrays,
    Size,
    decode_image,
    decode_images,
    decode_small,
    decode_views,
    image_size,
    orientation_turn,
    same_shape,
)
from gsmerge.kernels.pictures import is_mirrored, turn_picture
from gsmerge.raster.photos import row_pictures
from gsmerge.runtime.plugins import LazyFunction
from gsmerge.runtime.record import list_some
from gsmerge.runtime.threads import parallel_map
from gsmerge.scene.estimate_cameras import GridFit, choose_fit, list_fits
from gsmerge.scene.files import SceneFiles
from gsmerge.types import Scene

_READ_IMAGES = LazyFunction("gsmerge.io.formats.depth_maps", "read_images")
_MODEL_FOLDERS = ("0", "sparse", "colmap")  # of COLMAP, in a scene's folder; a model may also lie in that itself
UNNAMED = "view 0"  # name of the first camera where a format, or rows alone, have no names
_REDUCED = "images_*"  # folders of smaller copies, as programs name them by how many times smaller they are
SEEN_PLACE = "images_resized"  # where WorldMirror writes what it saw; into "images" it squeezes tall photos


@dataclass(frozen=True, eq=False)
class ScenePhotos:
    """The photos of c cameras, of one size, and their files."""

    pictures: PhotoArrays = ()  # [h,w,3] uint8, black where a camera has none; empty where there are none
    paths: tuple[Path | None, ...] = ()  # None where no file shows a camera's view; empty where they are in no files
    turns: tuple[int, ...] = ()  # how each file is turned; see gsmerge.kernels.pictures.turn_picture
    notes: tuple[str, ...] = ()  # what was done for them, one sentence each

    def __len__(self) -> int:
        return len(self.pictures)

    @property
    def absent(self) -> list[int]:
        """Cameras without a photo."""
        return [view for view, path in enumerate(self.paths) if path is None]

    @property
    def file_size(self) -> Size | None:
        """Size of the photos as the views show them, before they were reduced; None where they are in no files."""
        sizes = [_turned_size(path, turn) for path, turn in zip(self.paths, self.turns, strict=True) if path]
        return max(set(sizes), key=lambda size: (sizes.count(size), size[0] * size[1])) if sizes else None


@dataclass(frozen=True)
class Proposal:
    """Files of photos, and what their names say of c cameras."""

    folder: Path
    pool: tuple[Path, ...]
    named: tuple[int | None, ...]  # of each camera: a file of the pool, None where names propose none
    exact: bool  # whether names, and not their order, propose them
    faults: tuple[str | None, ...] = ()  # of each camera: which file cannot be read, and why; None for none

    @cached_property
    def tags(self) -> Sequence[int]:
        """Turns that the tags of orientation of all files ask for."""
        return _Tags(self.pool)

    @property
    def choice(self) -> list[Assignment | None]:
        """The files as they are proposed, as they are stored."""
        return [None if photo is None else Assignment(photo, 0) for photo in self.named]

    def without_views(self, cameras: Sequence[int]) -> Proposal:
        """Return a copy that says of cameras without Gaussians why they have no photo."""
        faults = list(self.faults)
        for camera in cameras:
            photo = self.named[camera]
            which = f"view {camera}" if photo is None else _inside(self.pool[photo], self)
            faults[camera] = f"{which}: no Gaussian shows where it was taken"
        return replace(self, faults=tuple(faults))

    def without_broken(self) -> Proposal | None:
        """Return a copy without the proposed files that cannot be decoded; None where all can be, or none."""
        named = [None if photo is None else self.pool[photo] for photo in self.named]
        sound = _keep_sound(replace(self, named=()), named, decode=True)
        return None if len(sound.pool) == len(self.pool) or not any(sound.choice) else sound


def propose_photos(files: SceneFiles, camera_file: CameraFile) -> Proposal | None:
    """Propose the photo file of every camera by its name; None where photos are in another file or nowhere.

    Files that cannot be read are left out.
    """
    names = camera_file.names
    if files.images is not None:
        if not files.images.is_dir():
            return None
        folder, pool = files.images, list_images(files.images)
        named = propose_images(folder, pool, names, _count_pixels)
    else:
        if "images" in files.named:
            return None
        place = Path(camera_file.path)
        folder = place if place.is_dir() and place.name not in _MODEL_FOLDERS else place.parent
        named = [find_image(folder, name) for name in names]
        pool = list(dict.fromkeys(path for path in named if path is not None))
        nameless = all(name.removeprefix("view ").isdecimal() for name in names)
        if not pool:
            pool, named = _find_reduced(folder, names)
            named = named or [None] * len(names)
        if not pool and nameless:
            folder, pool = files.ply.parent, images_beside(files.ply)  # AnySplat writes its Gaussians among the photos
    exact = any(named) and camera_file.source != ESTIMATED
    if not any(named) and len(pool) == len(names):
        named = list(pool)
    if not pool:
        return None
    faults = tuple(
        _describe_missing(folder, name) if exact and path is None else None
        for name, path in zip(names, named, strict=True)
    )
    return _keep_sound(Proposal(folder, tuple(pool), (), exact, faults), named)


def _find_reduced(folder: Path, names: Sequence[str]) -> tuple[list[Path], list[Path | None]]:
    """Find photos in the folders of smaller copies, ``images_2`` and so on: those of the first that has any."""
    reduced = [place for place in folder.glob(_REDUCED) if place.name.rpartition("_")[2].isdecimal() and place.is_dir()]
    for place in sorted(reduced, key=lambda place: natural_key(place.name)):
        pool = list_images(place)
        named = propose_images(place, pool, names, _count_pixels)
        if any(named):
            return pool, named
    return [], []


def _describe_missing(folder: Path, name: str) -> str:
    """Say that a file does not exist, and which one of its name is in no format that is read."""
    inner, others = PurePath(name), set[str]()
    for place in {folder, folder if inner.is_absolute() or ".." in inner.parts else folder / inner.parent}:
        with suppress(OSError, ValueError):
            others |= {each for each in os.listdir(place) if PurePath(each).stem == inner.stem}
    others = {each for each in others if PurePath(each).suffix.lower() not in IMAGE_SUFFIXES}
    shown = inner.relative_to(folder.name) if inner.is_relative_to(folder.name) else inner
    if not others:
        return f"{shown}: no such file"
    return f"{shown}: no such file, and {min(others)} is in no format that is read; {CONVERT}"


def _keep_sound(proposal: Proposal, named: Sequence[Path | None], *, decode: bool = False) -> Proposal:
    """Return a proposal of the ``named`` files without those that cannot be read, by their headers or decoded."""
    paths = list(dict.fromkeys(path for path in named if path is not None))
    faults = parallel_map(lambda path: _find_fault(path, decode=decode), paths)
    broken = {path: fault for path, fault in zip(paths, faults, strict=True) if fault is not None}
    of_cameras = tuple(
        f"{_inside(path, proposal)}: {broken[path]}" if path in broken and path is not None else before
        for path, before in zip(named, proposal.faults or [None] * len(named), strict=True)
    )
    pool = tuple(path for path in proposal.pool if path not in broken)
    ids = {path: number for number, path in enumerate(pool)}
    places = tuple(None if path is None else ids.get(path) for path in named)
    return replace(proposal, pool=pool, named=places, faults=of_cameras)


def _count_pixels(path: Path) -> int:
    """Count the pixels of an image file; 0 where it cannot be read."""
    try:
        width, height = image_size(path)
    except SceneError:
        return 0
    return width * height


def _find_fault(path: Path, *, decode: bool = False) -> str | None:
    """Return why an image file cannot be read, by its header, or decoded; None for a sound one."""
    try:
        size = image_size(path)
        if decode:
            decode_image(path, size)
    except SceneError as error:
        return f"{error.problem}; {CONVERT}" if error.remedy == CONVERT else error.problem
    return None


def images_beside(ply: Path) -> list[Path]:
    """List the images directly in the folder of a ``.ply``, in the order of :func:`list_images`."""
    named = (path for path in ply.parent.glob("[!.]*") if path.suffix.lower() in IMAGE_SUFFIXES)
    return sorted((path for path in named if path.is_file()), key=lambda path: natural_key(path.name))


def stored_photos(files: SceneFiles, camera_file: CameraFile) -> PhotoArrays:
    """Read the photos of all cameras by their names, or from a file that holds them; empty where there are none.

    SceneError if one is missing or cannot be read, or two differ in size.
    """
    proposal = propose_photos(files, camera_file)
    if proposal is None:
        if files.images is not None and files.images.is_dir():
            raise SceneError(files.images, f"expected images of {len(camera_file)} cameras, found none")
        return photos_inside(files, camera_file)
    if None in proposal.named:
        if files.images is None:
            return ()
        view = proposal.named.index(None)
        reason = proposal.faults[view] or f"{camera_file.names[view]}: no such file"
        raise SceneError(proposal.folder, f"expected a photo for each of {len(camera_file)} cameras, found {reason}")
    return decode_images([proposal.pool[photo] for photo in proposal.named if photo is not None])


def photos_inside(files: SceneFiles, camera_file: CameraFile) -> PhotoArrays:
    """Read the photos that a file holds; empty without such a file."""
    if files.images is None or files.images.is_dir():
        return ()
    if is_frame(files.images):
        return _READ_IMAGES(files.plys)
    same_file = files.cameras is not None and os.path.realpath(files.cameras) == os.path.realpath(files.images)
    stored = (camera_file if same_file else read_cameras(files.images, scene=files.ply.stem)).images
    without = same_file and files.images.suffix == CHUNK and not len(stored)
    if not without and len(stored) != len(camera_file):
        raise SceneError(files.images, f"expected {len(camera_file)} images, one per camera, found {len(stored)}")
    return stored


def read_photos(
    proposal: Proposal, chosen: Sequence[Assignment | None], camera_file: CameraFile, notes: Sequence[str] = ()
) -> ScenePhotos:
    """Read the chosen photo of each camera, turned, all at the size that most have; of SHARP at its camera's.

    SceneError if one cannot be read, or has another shape.
    """
    paths = tuple(None if each is None else proposal.pool[each.photo] for each in chosen)
    turns = tuple(0 if each is None else each.orientation for each in chosen)
    size = ScenePhotos((), paths, turns).file_size
    if size is None:
        return ScenePhotos()
    if camera_file.source == SHARP:
        size = int(camera_file.widths[0]), int(camera_file.heights[0])
    for path, turn in zip(paths, turns, strict=True):
        if path is not None and camera_file.source != SHARP and not same_shape(_turned_size(path, turn), size):
            width, height = _turned_size(path, turn)
            problem = f"expected images of one shape, found {width} x {height} and {size[0]} x {size[1]}"
            raise SceneError(proposal.folder, problem)
    return ScenePhotos(decode_views(paths, turns, size), paths, turns, tuple(notes))


def select_one_shape(camera_file: CameraFile, proposal: Proposal) -> tuple[CameraFile, Proposal, str] | None:
    """Select the views whose photos have the shape that most have; None where all have, or one view alone is left.

    Returns their cameras and photos, and a note on the others.
    """
    paths = [None if photo is None else proposal.pool[photo] for photo in proposal.named]
    if not any(paths):
        return None
    stored = zip(camera_file.widths.tolist(), camera_file.heights.tolist(), strict=True)
    sizes = [size if path is None else image_size(path) for path, size in zip(paths, stored, strict=True)]
    usual = Counter(size for size, path in zip(sizes, paths, strict=True) if path is not None).most_common(1)[0][0]
    used = [view for view, size in enumerate(sizes) if min(size) <= 1 or same_shape(size, usual)]
    if len(used) in (1, len(sizes)):
        return None
    others = [
        f"{camera_file.names[view]} ({size[0]} x {size[1]})" for view, size in enumerate(sizes) if view not in used
    ]
    shape = f"have another shape than {usual[0]} x {usual[1]} and are left out"
    note = f"{len(others)} of {len(sizes)} views {shape}: {list_some(others)}"
    unused = {paths[view] for view in range(len(sizes)) if view not in used}
    pool = tuple(path for path in proposal.pool if path not in unused)
    faults = tuple(proposal.faults[view] for view in used)
    fewer = replace(proposal, pool=pool, named=(), faults=faults)
    return select_views(camera_file, used), _keep_sound(fewer, [paths[view] for view in used]), note


def _turned_size(path: Path, turn: int) -> Size:
    width, height = image_size(path)
    return (height, width) if turn % 2 else (width, height)


class _Tags(Sequence[int]):
    """Turns that tags of orientation ask for, read when they are asked for, once."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths, self._turns = paths, dict[int, int]()

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, photo: Any) -> Any:
        if photo not in self._turns:
            self._turns[photo] = orientation_turn(self._paths[photo])
        return self._turns[photo]


def _list_candidates(proposal: Proposal, fit: GridFit | None) -> Candidates:
    """Make candidates of the files, read small, and brought to the pixels of a grid by ``fit``."""

    def read(photo: int) -> np.ndarray:
        try:
            small = decode_small(proposal.pool[photo], SIDE)
        except SceneError:  # which shows nothing
            small = np.zeros((SIDE, SIDE, 3), np.float32)
        return small if fit is None else fit.cut(small)

    return Candidates(read, len(proposal.pool), proposal.tags)


def assign_to_views(
    scene: Scene,
    cameras: Sequence[int],
    proposal: Proposal,
    *,
    read: bool,
    guessed: Sequence[int] = (),
    fit: GridFit | None = None,
) -> list[Assignment | None]:
    """Assign files to the views of a scene, each with its camera; see :func:`gsmerge.evidence.assign.assign_photos`.

    ``read``: whether the scene has the photos that names propose; other files are read small, and brought to the pixels
    of a grid by ``fit``. A photo with Gaussians of its colours on its rays stays, whatever their depths make of
    drawings. Cameras that no view has keep what names propose; ``guessed`` ones have no photo.
    """
    views = [list(cameras).index(camera) for camera in dict.fromkeys(cameras)]  # layers of a camera have one photo
    named = [proposal.named[cameras[view]] for view in views]
    stored, images = _list_candidates(proposal, fit), scene.images
    candidates = stored
    if read and images is not None:
        places = {photo: view for view, photo in zip(views, named, strict=True) if photo is not None}
        candidates = replace(stored, read=lambda photo: images[places[photo]])

    masks = None if scene.masks is None else scene.masks | ~scene.masks.any((1, 2), keepdims=True)

    def show(side: int) -> ViewPictures:
        return show_views(replace(scene, masks=masks), side)[views]

    assigned = assign_photos(show, candidates, named, exact=proposal.exact, stored=stored)
    chosen, usual = proposal.choice, proposal.choice
    for view, each in zip(views, assigned, strict=True):
        chosen[cameras[view]] = each
    left = [
        view
        for view, photo, each in zip(views, named, assigned, strict=True)
        if photo is not None and (each is None or each.photo != photo)
    ]
    if left and read and images is not None:
        given = [view for view, photo in zip(views, named, strict=True) if photo is not None]
        right = find_on_rays(canonicalise(scene)[0], given, [images[view] for view in given])
        for view in {*left} & {view for view, stands in zip(given, right, strict=True) if stands}:
            chosen[cameras[view]] = usual[cameras[view]]
    return [None if camera in guessed else each for camera, each in enumerate(chosen)]


def list_guessed(scene: Scene, camera_file: CameraFile) -> list[int]:
    """List the views without Gaussians, of which cameras that are estimated from Gaussians are guesses."""
    if camera_file.source != ESTIMATED or scene.pixels is None:
        return []
    return np.flatnonzero(~scene.pixels.shown.any((1, 2))).tolist()


def fit_to_grid(scene: Scene, proposal: Proposal) -> GridFit:
    """Find how the photos of a pool that show a scene's views were brought to the grid of its rows."""
    simple, *others = list_fits((scene.cameras.width, scene.cameras.height))
    views = range(len(scene))
    shown, chosen = show_views(scene, SIDE), list[np.ndarray | None]()
    assigner = Assigner(partial(show_views, scene), _list_candidates(proposal, None))
    for view, likely in assigner.list_likely(views, range(len(proposal.pool))).items():
        photos = [turn_picture(assigner.candidates.read(photo), turn) for photo, turn in likely]
        alike = [float(correlate_parts(shown, view, simple.cut(photo)).mean()) for photo in photos]
        chosen.append(photos[int(np.argmax(alike))] if photos else None)
    return choose_fit(shown, chosen, (simple, *others)) if any(photo is not None for photo in chosen) else simple


def shows_better(scene: Scene, other: Scene) -> bool:
    """Return whether photos of a scene are more like what its Gaussians show than those of another reading of it."""
    if len(scene) != len(other):
        return False
    scores = list[np.ndarray]()
    for each in (scene, other):
        shown, images = show_views(each, SIDE), each.images
        assert images is not None
        scores.append(np.concatenate([correlate_parts(shown, view, images[view]) for view in range(len(each))]))
    return stands_out(scores[0] - scores[1])


def name_by_photos(
    camera_file: CameraFile, proposal: Proposal, chosen: Sequence[Assignment | None], fit: GridFit | None
) -> CameraFile:
    """Name estimated cameras by the photos that show their views, and note how these were brought to the grid."""
    if camera_file.source != ESTIMATED:
        return camera_file
    files = [None if each is None else proposal.pool[each.photo] for each in chosen]
    names = [
        name if file is None else _inside(file, proposal) for name, file in zip(camera_file.names, files, strict=True)
    ]
    turns = [0 if each is None else each.orientation for each in chosen]
    size = ScenePhotos((), tuple(files), tuple(turns)).file_size
    named = replace(camera_file, names=tuple(names))
    return named if fit is None or size is None else fit.cameras(named, size)


def _inside(path: Path, proposal: Proposal) -> str:
    """Return the path of a file inside the folder of photos, or its name."""
    folder = proposal.folder
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else path.name


def describe_assignment(
    proposal: Proposal, chosen: Sequence[Assignment | None], camera_file: CameraFile
) -> tuple[list[str], list[str]]:
    """Describe how photos were assigned otherwise than their names propose: notes, and those on what is not used."""
    count, notes = len(chosen), list[str]()
    moves: dict[str, list[str]] = {"turned": [], "mirrored": []}
    for each in chosen:
        if each is not None and each.orientation != (tag := proposal.tags[each.photo]):
            kind = "turned" if is_mirrored(each.orientation) == is_mirrored(tag) else "mirrored"
            moves[kind].append(_inside(proposal.pool[each.photo], proposal))
    for kind, files in moves.items():
        what = f"lie otherwise in their views than their files say: they were {kind}"
        notes += [f"{len(files)} of {count} photos {what}: {list_some(files)}"] * bool(files)
    moved = [
        f"{camera_file.names[view]}: {_inside(proposal.pool[each.photo], proposal)}"
        for view, each in enumerate(chosen)
        if each is not None and each.photo != proposal.named[view]
    ]
    if moved:
        names = "names" if proposal.exact else "their order"
        notes.append(f"photos are matched with views by what they show, not by {names}: {list_some(moved)}")
    notes += _describe_spare(proposal, chosen)
    without = [view for view, each in enumerate(chosen) if each is None]
    if not without:
        return notes, []
    reasons = [_explain(proposal, view, camera_file.names[view]) for view in without]
    return notes, [f"photos of {len(without)} of {count} views are left out: {list_some(reasons, '; ')}"]


def _explain(proposal: Proposal, view: int, name: str) -> str:
    """Say why a camera has no photo."""
    fault = proposal.faults[view]
    if fault is not None:
        return fault
    photo = proposal.named[view]
    if photo is None:
        return f"{name}: none shows it"
    return f"{_inside(proposal.pool[photo], proposal)}: shows something else"


def _describe_spare(proposal: Proposal, chosen: Sequence[Assignment | None]) -> list[str]:
    """Note photos beside those that are used that have no camera, where most have one."""
    used = [proposal.pool[each.photo] for each in chosen if each is not None]
    named = [proposal.pool[photo] for photo in proposal.named if photo is not None]
    folders, stems = {path.parent for path in used}, {path.stem for path in (*used, *named)}
    spare = [path for path in proposal.pool if path.parent in folders and path.stem not in stems]
    if not proposal.exact or not 0 < len(spare) < len(used):
        return []
    which = list_some([_inside(path, proposal) for path in spare])
    return [f"photos without a camera are not used, {len(spare)} of {len(spare) + len(used)}: {which}"]


def describe_unused(proposal: Proposal, camera_file: CameraFile) -> str:
    """Describe that none of the photos is used."""
    problem, _ = refuse_photos(proposal, camera_file)
    verb = "not used" if camera_file.source == ESTIMATED else "left out"
    return f"the photos in {proposal.folder} are {verb}: {problem}"


def refuse_photos(proposal: Proposal, camera_file: CameraFile) -> tuple[str, str]:
    """Say that none of the photos shows any view, and what to do."""
    what = f"photos of the {len(camera_file)} views of {camera_file.widths[0]} x {camera_file.heights[0]} pixels"
    faults = [fault for fault in proposal.faults if fault is not None]
    reasons = f" ({list_some(faults, '; ')})" if faults else ""
    return f"expected {what}, found none that shows any of them{reasons}", "name the folder of the photos with --images"


def without_photo(scene: Scene, views: Sequence[int]) -> Scene:
    """Return a scene whose ``views`` have no photo: what its Gaussians show stands there, and no pixel counts."""
    if not views or scene.images is None:
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
