"""Find and read the photos of a scene's views.

Names and folders propose a file for each camera. The content of the photos decides which photo belongs to which view,
and in which orientation (:mod:`gsmerge.method.compare.assign_photos`).
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from gsmerge.errors import Doubt, Note, SceneError, attempt
from gsmerge.frozen import dataclass, field, replace
from gsmerge.io.cameras.camera_file import CameraFile, select_views, sizes_of
from gsmerge.io.cameras.programs import SHARP
from gsmerge.io.cameras.read_cameras import read_cameras
from gsmerge.io.cameras.table import FFGS
from gsmerge.io.first_bytes import CONVERT
from gsmerge.io.image_names import (
    IMAGE_SUFFIXES,
    convert_all,
    describe_missing_image,
    find_image,
    is_drawn,
    list_images,
    natural_order,
    propose_images,
)
from gsmerge.io.photo_files import (
    ASPECT_TOLERANCE,
    WHOLE,
    Part,
    PhotoArrays,
    Size,
    decode_images,
    decode_photos,
    decode_small,
    image_size,
    orientation_turn,
    part_size,
    same_shape,
)
from gsmerge.method.compare.assign_photos import Assigner, Candidates, assign_photos
from gsmerge.method.compare.offsets import OFFSET_PIXELS, correlate_parts
from gsmerge.method.compare.view_pictures import ViewPictures, show_views
from gsmerge.method.kernels.pictures import turn_picture
from gsmerge.reading.alignment import CROPPED, ESTIMATED
from gsmerge.reading.photos.grid_fit import WHOLE_FIT, GridFit, PartFit, choose_fit, clear_beyond, list_fits
from gsmerge.reading.scene_files import SceneFiles, list_folders
from gsmerge.runtime.record import list_faults, list_some
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

LEFT_OUT = "images"  # topic of notes on photos that are left out, which is the option that names others
UNNAMED = "view 0"  # name of the first camera if its file has no names, or if cameras were estimated from rows
_CHANNEL_ROUNDING = 1 / 255  # mean difference of channels that rounding to 8 bits may cause
_MODEL_FOLDERS = {"sparse", "colmap", "distorted"}  # names of folders that have COLMAP's models


class MismatchError(SceneError):
    """Raised if no photo shows any view."""


@dataclass(frozen=True, eq=False)
class ScenePhotos:
    """The photo of each of c cameras, and the files from which it is chosen.

    Names or order propose a file for each camera (:func:`find_photos`). The content of the photos then decides
    (:func:`assign_to_views`), and the chosen files are read (:func:`read_photos`). Photos inside another file have only
    ``pictures``.
    """

    folder: Path = Path()
    pool: tuple[Path, ...] = ()  # all files
    named: tuple[Path | None, ...] = ()  # the file that is proposed for each camera; None without one
    exact: bool = False  # True: names propose the files; False: their order does
    by_names: bool = False  # True: the folder was found by the names of its files
    paths: tuple[Path | None, ...] = ()  # the photo of each camera; None for a camera without a photo
    turns: tuple[int, ...] = ()  # orientation of each photo, 0 to 7; see gsmerge.method.kernels.pictures.turn_picture
    faults: tuple[str | None, ...] = ()  # for each camera, why its photo cannot be used; None for no fault
    # Size to which upright photos of several shapes are extended, to the right and below; None: all have one shape
    canvas: Size | None = None
    fit: PartFit = WHOLE_FIT  # the part of each upright photo that is used
    grid_fit: GridFit | None = None  # how files are resized and cropped to the grid of rows, if cameras are estimated
    explain_most: bool = False  # True: the proposed photos explain what most views show
    notes: tuple[str, ...] = ()  # notes on the used part
    pictures: PhotoArrays = ()  # [h,w,3] uint8 each, black for a camera without a photo; empty before they are read
    # Files that turned out to be damaged when their ``pictures`` were decoded, each with the reason; they are black
    damaged: dict[Path, str] = field(default_factory=dict)

    @property
    def absent(self) -> list[int]:
        """Numbers of the cameras without a photo."""
        return [view for view, path in enumerate(self.paths) if path is None]

    @property
    def file_size(self) -> Size | None:
        """Most frequent size of the used part of upright photos; of several, the largest; None without photos."""
        sizes = self.list_sizes()
        return max(set(sizes), key=lambda size: (sizes.count(size), size[0] * size[1])) if sizes else None

    @property
    def parts(self) -> tuple[Part, ...]:
        """The part of the upright photo of each camera that is used."""
        return tuple(WHOLE if size is None else self.part_of(size) for size in self._list_upright())

    def part_of(self, size: Size) -> Part:
        """Return the part of an upright photo of a ``size`` that is used."""
        across, down = np.divide(self.canvas or size, size).tolist()
        left, top, right, bottom = self.fit.part
        return left * across, top * down, right * across, bottom * down

    def list_sizes(self) -> list[Size]:
        """List the size of the used part of each photo when it is upright."""
        return [part_size(size, self.part_of(size)) for size in self._list_upright() if size is not None]

    def _list_upright(self) -> list[Size | None]:
        """List the size of each camera's photo when it is upright; None without a photo."""
        sizes = [None if path is None else image_size(path) for path in self.paths]
        return [size[::-1] if size and turn % 2 else size for size, turn in zip(sizes, self.turns, strict=True)]

    def without_files(self, reasons: Mapping[Path, str]) -> ScenePhotos:
        """Return a copy without files that cannot be used, each with the reason.

        The reason becomes a fault of the cameras for which the file was proposed.
        """
        if not reasons:
            return self
        faults = [*self.faults]
        for view, path in enumerate(self.named):
            if path is not None and path in reasons:
                faults[view] = f"{_short_path(path, self)}: {reasons[path]}"
        pool = tuple(path for path in self.pool if path not in reasons)
        named, paths = (
            tuple(None if path in reasons else path for path in files) for files in (self.named, self.paths)
        )
        return replace(self, pool=pool, named=named, paths=paths, faults=tuple(faults))


NO_PHOTOS = ScenePhotos()


def is_without_names(camera_file: CameraFile) -> bool:
    """Return whether cameras were estimated and have no names of photos yet, so that photos may have any size."""
    return camera_file.source == ESTIMATED and camera_file.names[0] == UNNAMED


def find_photos(files: SceneFiles, camera_file: CameraFile) -> ScenePhotos:
    """Find a photo for every camera by names, or if no name fits, by order if there is one file per camera.

    Files that cannot be read are left out, and so are pictures that gsmerge drew, unless the user names a folder that
    has no others. Photos inside another file are read. The result is :data:`NO_PHOTOS` if there are none.
    """
    names = camera_file.names
    if files.images is None and "images" not in files.named:
        folder, pool, named = _find_photos_near(files, camera_file)
    elif files.images is None:  # the user wants no photos
        return NO_PHOTOS
    elif files.images.is_dir():
        folder = files.images
        pictures = list_images(folder)
        pool = [path for path in pictures if not is_drawn(path)]
        pool = pool or (pictures if "images" in files.named else [])
        named = propose_images(folder, pool, names, count_pixels)
    else:
        same_file = files.cameras is not None and os.path.realpath(files.cameras) == os.path.realpath(files.images)
        stored = (camera_file if same_file else read_cameras(files.images)).images
        if len(stored) != len(names):
            raise SceneError(files.images, f"expected {len(names)} images, one per camera, found {len(stored)}")
        return ScenePhotos(pictures=stored)
    better = None  # another folder, in which more cameras have a photo by name
    if "images" not in files.named and len(known := {*named} - {None}) < len(names) and names[0] != UNNAMED:
        roots = dict.fromkeys(path.absolute() for path in (capture_folder(Path(camera_file.path)), files.root) if path)
        better = find_named_photos([*roots], camera_file, len(known))
        folder, pool, named = better or (folder, pool, named)
    exact = any(named) and camera_file.source != ESTIMATED
    if not any(named) and len(pool) == len(names):
        named = list(pool)
    if not pool:
        return NO_PHOTOS
    faults = tuple(
        describe_missing_image(folder, name) if exact and path is None else None
        for name, path in zip(names, named, strict=True)
    )
    photos = ScenePhotos(
        folder,
        pool=tuple(pool),
        named=tuple(named),
        exact=exact,
        by_names=better is not None,
        paths=tuple(named),
        turns=(0,) * len(names),
        faults=faults,
    )
    paths = list(dict.fromkeys(path for path in named if path is not None))
    reasons = zip(paths, parallel_map(_check_header, paths), strict=True)
    return photos.without_files({path: reason for path, reason in reasons if reason is not None})


def _find_photos_near(files: SceneFiles, camera_file: CameraFile) -> tuple[Path, list[Path], list[Path | None]]:
    """Find photos near the camera file: the files that it names, or files beside the ``.ply``.

    Returns the folder of the photos, all files, and for each camera the file of its name, or None.
    """
    path = Path(camera_file.path)
    names = camera_file.names
    folder = capture_folder(path)
    found = (find_image(folder, name, path, option=files.photo_option) for name in names)
    named = [None if photo is None or is_drawn(photo) else photo for photo in found]
    pool = list(dict.fromkeys(path for path in named if path is not None))
    are_numbers = all(name.removeprefix("view ").isdecimal() for name in names)  # the cameras have no names of photos
    if not pool and are_numbers:
        folder = files.ply.parent  # AnySplat writes its Gaussians among the photos
        beside = (path for path in folder.glob("[!.]*") if path.suffix.lower() in IMAGE_SUFFIXES)
        pool = natural_order(path for path in beside if path.is_file() and not is_drawn(path))
    return folder, pool, named


def capture_folder(cameras: Path) -> Path:
    """Return the folder of a capture: the folder of its camera file, or the folder that has its COLMAP model.

    ``cameras`` is the file or the folder of the model. The model may also be in the folder of the capture itself.
    """
    if not cameras.is_dir():
        return cameras.parent
    places = cameras, *cameras.parents
    return next(place for place in places if not {place.name, place.parent.name} & _MODEL_FOLDERS)


def find_named_photos(
    roots: Sequence[Path], camera_file: CameraFile, num_known: int
) -> tuple[Path, list[Path], list[Path | None]] | None:
    """Find the folder at or below ``roots`` in which most cameras, and more than ``num_known``, have a photo by name.

    Of folders with equally many photos, one is chosen by these criteria in turn: files with the whole names of the
    cameras, with endings; a place below the first root, which is near the cameras; photos with colours, unlike masks
    and depths; photos of the size of the cameras, or of their shape; photos with more pixels.

    Pictures that gsmerge drew are no photos. Returns the folder, the photos of this folder and of the next best ones,
    and the photo of each camera, None without one. Returns None if no folder has photos by name.
    """
    pools = dict[Path, dict[Path, None]]()  # folder -> photos in it and below
    inner = [PurePath(name.replace("\\", "/")) for name in camera_file.names]
    stems = {name.name for name in inner} | {name.stem for name in inner}
    for root in roots:
        for folder, names in list_folders(root):
            photos = [folder / name for name in names if PurePath(name).suffix.lower() in IMAGE_SUFFIXES]
            photos = [path for path in photos if not ({path.name, path.stem} & stems and is_drawn(path))]
            for place in [folder, *(above for above in folder.parents if above.is_relative_to(root))]:
                pools.setdefault(place, {}).update(dict.fromkeys(photos))

    sizes = list(zip(camera_file.widths.tolist(), camera_file.heights.tolist(), strict=True))
    file_names = {PurePath(name).name for name in camera_file.names}

    def rank(folder: Path) -> tuple[Any, ...]:
        """Return a key that sorts better folders first: minus the number of cameras with a photo, then the criteria."""
        proposed = propose_images(folder, list(pools[folder]), camera_file.names, count_pixels)
        first = next(filter(count_pixels, filter(None, proposed)), None)
        if first is None:
            return 0, folder
        camera_size = sizes[proposed.index(first)]
        size = image_size(first)
        has_other_shape = min(camera_size) > 1 and not same_shape(camera_size, size)
        count = len({*proposed} - {None})
        num_exact = sum(path.name in file_names for path in filter(None, proposed))
        look = is_grey(first), size != camera_size, has_other_shape, -count_pixels(first)
        depth = len(pools[folder]), -len(folder.parts), folder  # prefers the innermost of folders with the same photos
        return -count, -num_exact, not folder.is_relative_to(roots[0]), *look, *depth

    max_folders = 4  # folders whose photos are compared with the views
    best = [folder for count, *_, folder in sorted(map(rank, pools)) if -count > num_known][:max_folders]
    if not best:
        return None
    pool = [path for path in dict.fromkeys(path for folder in best for path in pools[folder]) if not is_drawn(path)]
    return best[0], pool, propose_images(best[0], list(pools[best[0]]), camera_file.names, count_pixels)


def is_grey(path: Path) -> bool:
    """Return True if an image file has no colours, like masks and depths; False if it cannot be read."""
    small = attempt(decode_small, path, OFFSET_PIXELS)
    return not isinstance(small, SceneError) and bool(np.ptp(small, axis=-1).mean() <= _CHANNEL_ROUNDING)


def count_pixels(path: Path) -> int:
    """Count the pixels of an image file; 0 if it cannot be read."""
    size = attempt(image_size, path)
    return 0 if isinstance(size, SceneError) else size[0] * size[1]


def _check_header(path: Path) -> str | None:
    """Return why the header of an image file cannot be read; None if it can be read."""
    size = attempt(image_size, path)
    if not isinstance(size, SceneError):
        return None
    return f"{size.problem}; {convert_all(path)}" if size.remedy == CONVERT else size.problem


def read_stored_photos(files: SceneFiles, camera_file: CameraFile) -> PhotoArrays:
    """Read the photos of all cameras, from files of their names or from one file that has all photos.

    Returns no photos if none exist. SceneError if a photo is missing or cannot be read, or if two photos differ in
    size.
    """
    photos = find_photos(files, camera_file)
    if photos is NO_PHOTOS and files.images is not None and files.images.is_dir():
        raise SceneError(files.images, f"expected photos of {len(camera_file)} cameras, found none")
    if not photos.named:
        return photos.pictures
    if None in photos.named:
        if files.images is None:  # photos that nobody named may be incomplete
            return ()
        view = photos.named.index(None)
        reason = photos.faults[view] or f"{camera_file.names[view]}: no such file"
        raise SceneError(photos.folder, f"expected a photo for each of {len(camera_file)} cameras, found {reason}")
    return decode_images([path for path in photos.named if path is not None])


def read_photos(photos: ScenePhotos, camera_file: CameraFile) -> ScenePhotos:
    """Read the photo of each camera upright, and resize it to the size of most photos.

    Photos of a camera file of SHARP are resized to the size of their camera. A damaged photo is black. SceneError if
    the aspect ratio of a photo differs from that of most photos.
    """
    size = photos.file_size
    if size is None:
        return NO_PHOTOS
    if camera_file.source == SHARP:
        size = int(camera_file.widths[0]), int(camera_file.heights[0])
    for width, height in () if camera_file.source == SHARP else photos.list_sizes():
        if not same_shape((width, height), size):
            problem = f"expected photos with one aspect ratio, found {width} x {height} and {size[0]} x {size[1]}"
            raise SceneError(photos.folder, problem)
    damaged = dict[Path, str]()
    pictures = decode_photos(photos.paths, photos.turns, photos.fit.stretch(size), photos.parts, damaged)
    return replace(photos, pictures=pictures, damaged=damaged)


def keep_one_shape(camera_file: CameraFile, photos: ScenePhotos) -> tuple[CameraFile, ScenePhotos, list[str]]:
    """Bring photos of several shapes to one, or leave out those that lack the shape of most photos, and their views.

    If each photo has the shape of its own camera, all are extended to a canvas on which each fits. Otherwise, if all
    cameras have one aspect ratio, all views are kept, and photos may lie on their side. A camera without a size has the
    aspect ratio of its photo. Nothing is left out if fewer than two views would remain. Also return a doubt if views
    are left out, or a note about the canvas.
    """
    sizes = {path: image_size(path) for path in photos.named if path is not None}
    if not sizes:
        return camera_file, photos, []
    (width, height), _ = Counter(sizes[path] for path in photos.named if path is not None).most_common(1)[0]
    camera_sizes = list(zip(camera_file.widths.tolist(), camera_file.heights.tolist(), strict=True))
    are_alike = all(min(size) > 1 and same_shape(size, camera_sizes[0]) for size in camera_sizes)
    pairs = [  # sizes of photo and camera; a size of 1 pixel means that the camera has no size
        (sizes[path], size if min(size) > 1 else sizes[path])
        for path, size in zip(photos.named, camera_sizes, strict=True)
        if path is not None
    ]
    scales = [photo[0] / camera[0] for photo, camera in pairs]
    fits_cameras = all(same_shape(*pair) for pair in pairs) and max(scales) - min(scales) <= ASPECT_TOLERANCE
    are_several = not all(same_shape(photo, (width, height)) for photo, _ in pairs)
    if are_several and fits_cameras and not are_alike and len(pairs) == len(camera_sizes):
        canvas = max(width for (width, _), _ in pairs), max(height for (_, height), _ in pairs)
        sides = [round(side / scales[0]) for side in canvas]
        widths, heights = (np.full_like(camera_file.widths, side) for side in sides)
        count = len({photo for photo, _ in pairs})
        note = f"photos of {count} shapes are extended to {canvas[0]} x {canvas[1]}; what is added does not count"
        return replace(camera_file, widths=widths, heights=heights), replace(photos, canvas=canvas), [note]
    shape = f"the aspect ratio of {width} x {height}"
    others = {  # the photos with another aspect ratio
        path: "{} x {}, not {}".format(*size, shape)
        for path, size in sizes.items()
        if not same_shape(size, (width, height)) and not (are_alike and same_shape(size, (height, width)))
    }
    used = [
        view
        for view, (path, size) in enumerate(zip(photos.named, camera_sizes, strict=True))
        if are_alike or (same_shape(size, (width, height)) if min(size) > 1 else path not in others)
    ]
    if len(used) < 2:
        return camera_file, photos, []
    photos = photos.without_files(others)
    unused = [camera_file.names[view] for view in range(len(camera_sizes)) if view not in used]
    if not unused:
        return camera_file, photos, []
    photos = select_photos(photos, used)
    doubt = f"{len(unused)} of {len(camera_sizes)} views are left out, since they do not have {shape}"
    return select_views(camera_file, used), photos, [Doubt(f"{doubt}: {list_some(unused)}")]


def select_photos(photos: ScenePhotos, views: Sequence[int]) -> ScenePhotos:
    """Return the photos that names propose for ``views``."""
    named = tuple(photos.named[view] for view in views)
    faults = tuple(photos.faults[view] for view in views)
    return replace(photos, named=named, paths=named, turns=(0,) * len(views), faults=faults)


def _list_candidates(photos: ScenePhotos) -> Candidates:
    """Make candidates of the files of photos, read small, cut to the used part, and fitted to a grid if they have one.

    An unreadable photo is black, and fits no view.
    """

    def read(number: int) -> np.ndarray:
        """Read a small version of a photo, and cut out the part that is used."""
        path = photos.pool[number]
        read = attempt(decode_small, path, OFFSET_PIXELS)
        if isinstance(read, SceneError):
            read = np.zeros((OFFSET_PIXELS, OFFSET_PIXELS, 3), np.float32)
        fit = photos.fit if photos.canvas is None else replace(photos.fit, part=photos.part_of(image_size(path)))
        small = fit.cut(read)
        return small if photos.grid_fit is None else photos.grid_fit.cut(small)

    return Candidates(read, len(photos.pool), lambda number: orientation_turn(photos.pool[number]))


def assign_to_views(scene: Scene, photos: ScenePhotos, camera_file: CameraFile, *, read: bool) -> ScenePhotos:
    """Assign files to the views of a scene; see :func:`gsmerge.method.compare.assign_photos.assign_photos`.

    If ``read`` is True, the proposed photos are the photos of the scene. If False, small versions of files are read. A
    view gets no photo if its camera is only a guess, because cameras were estimated and the view has no Gaussians.
    """
    if is_without_names(camera_file) and photos.pool:
        photos = replace(photos, grid_fit=_fit_to_grid(scene, photos))
    guessed = list[int]()
    if camera_file.source == ESTIMATED and scene.pixels is not None:
        guessed = np.flatnonzero(~scene.pixels.shown.any((1, 2))).tolist()
    candidates = stored = _list_candidates(photos)
    ids = {path: number for number, path in enumerate(photos.pool)}
    images = scene.images
    named = [None if path is None else ids[path] for path in photos.named]
    if read and images is not None:
        view_of_photo = {photo: view for view, photo in enumerate(named) if photo is not None}
        candidates = replace(stored, read=lambda photo: images[view_of_photo[photo]])

    def show(side: int) -> ViewPictures:
        """Make pictures of the views, without what lies beyond the photos that are proposed for them."""
        shown = show_views(replace(scene, masks=None), side)
        for view, path in enumerate(photos.named):
            if path is not None:
                clear_beyond(shown.weights[view], photos.part_of(image_size(path)))
        return shown

    assigned, explain_most = assign_photos(show, candidates, named, exact=photos.exact, stored=stored)
    faults = list(photos.faults)
    for view in guessed:
        path = photos.named[view]
        assigned[view] = None
        name = f"view {view}" if path is None else _short_path(path, photos)
        faults[view] = f"{name}: its camera is unknown, since no Gaussian belongs to it"
    paths = tuple(None if assignment is None else photos.pool[assignment.photo] for assignment in assigned)
    turns = tuple(0 if assignment is None else assignment.orientation for assignment in assigned)
    return replace(photos, paths=paths, turns=turns, faults=tuple(faults), explain_most=explain_most)


def _fit_to_grid(scene: Scene, photos: ScenePhotos) -> GridFit:
    """Find how the photos that show a scene's views were resized and cropped to the grid of its rows."""
    fits = list_fits((scene.cameras.width, scene.cameras.height))
    shown = show_views(scene, OFFSET_PIXELS)
    chosen = list[np.ndarray | None]()
    assigner = Assigner(partial(show_views, scene), _list_candidates(photos))
    for view, likely in assigner.list_likely(range(len(scene)), range(len(photos.pool))).items():
        pictures = [turn_picture(assigner.candidates.read(photo), turn) for photo, turn in likely]
        scores = [float(correlate_parts(shown, view, fits[0].cut(picture)).mean()) for picture in pictures]
        chosen.append(pictures[int(np.argmax(scores))] if pictures else None)
    return choose_fit(shown, chosen, fits) if any(picture is not None for picture in chosen) else fits[0]


def has_other_shape(photos: ScenePhotos, camera_file: CameraFile, *, as_named: bool = False) -> bool:
    """Return True if the first proposed photo, upright or turned, has another aspect ratio than all cameras.

    With ``as_named``, photos that lie on their side, and are not turned, have another aspect ratio, too.
    Another aspect ratio is expected if the cameras' source is known to resize or crop photos; the result is False then.
    """
    first = next(filter(None, photos.named), None)
    shapes = sizes_of(camera_file)
    is_known = camera_file.photo_map is not None or camera_file.source in (FFGS, SHARP) or photos.canvas is not None
    if first is None or not shapes or is_known:
        return False
    size = photos.fit.stretch(part_size(image_size(first), photos.fit.part))
    return not any(same_shape(shape, one) for shape in shapes for one in (size, size if as_named else size[::-1]))


def have_fewer_pixels(photos: ScenePhotos, camera_file: CameraFile) -> bool:
    """Return True if photos have fewer pixels than the cameras of their file, so that they may be crops."""
    size = photos.file_size
    is_stored = camera_file.source != ESTIMATED
    return is_stored and size is not None and any(size < shape for shape in sizes_of(camera_file))


def name_by_photos(camera_file: CameraFile, photos: ScenePhotos) -> CameraFile:
    """Name estimated cameras by the photos of their views, and adapt the cameras to the ``grid_fit`` of the photos.

    Cameras that were read from a file stay as they are.
    """
    if camera_file.source != ESTIMATED:
        return camera_file
    names = [
        name if path is None else _short_path(path, photos)
        for name, path in zip(camera_file.names, photos.paths, strict=True)
    ]
    named = replace(camera_file, names=tuple(names))
    size = photos.file_size
    return named if photos.grid_fit is None or size is None else photos.grid_fit.cameras(named, size)


def _short_path(path: Path, photos: ScenePhotos) -> str:
    """Return the path of a file relative to the folder of photos, or the names of its folder and file if outside it."""
    folder = photos.folder
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else f"{path.parent.name}/{path.name}"


def describe_assignment(photos: ScenePhotos, camera_file: CameraFile, *, are_pixels: bool) -> list[str]:
    """Describe where the assigned photos differ from names and tags, and why views have no photo.

    Photos without a camera are noted if they lie in the folders of the used photos, since they may show other parts of
    the scene. If each Gaussian belongs to a pixel of a view (``are_pixels``), the cameras of the views see the whole
    scene; then photos without a camera are noted only if names propose photos, and if fewer photos lack a camera than
    are used.
    """
    used = [(view, path) for view, path in enumerate(photos.paths) if path is not None]
    folders = dict.fromkeys(str(path.parent) for _, path in used)
    place = f"photos are read from {list_some([*folders])}, whose files have the names of the cameras"
    count = len(photos.paths)
    notes = [place] if photos.by_names else []
    if used and is_drawn(used[0][1]):  # then all are, see :func:`find_photos`
        notes.append(Doubt("the photos that were named are pictures that gsmerge drew"))
    turned = [_short_path(path, photos) for view, path in used if photos.turns[view] != orientation_turn(path)]
    if turned:
        text = f"{len(turned)} of {count} photos are turned or mirrored relative to their orientation tags"
        notes.append(f"{text}: {list_some(turned)}")
    moved = [
        f"photo {_short_path(path, photos)} for view {camera_file.names[view].removeprefix('view ')}"
        for view, path in used
        if path != photos.named[view]
    ]
    if moved:
        names = "names" if photos.exact else "their order"
        notes.append(f"photos are matched with views by their content, not by {names}: {list_some(moved)}")
    stems = {path.stem for path in (*photos.paths, *photos.named) if path is not None}
    spare = [path for path in photos.pool if str(path.parent) in folders and path.stem not in stems]
    if spare and not (are_pixels and (not photos.exact or len(spare) >= len(used))):
        names = list_some([_short_path(path, photos) for path in spare])
        total = len(spare) + len(used)
        notes.append(Note(f"no camera belongs to {len(spare)} of {total} photos, so not used: {names}", LEFT_OUT))
    faults = list[str]()
    for view in photos.absent:
        path = photos.named[view]
        name = camera_file.names[view]
        shown = f"{name}: no photo shows this view"
        if path is not None:
            shown = f"{_short_path(path, photos)}: shows something else than its camera"
        faults.append(photos.faults[view] or shown)
    if not faults:
        return notes
    return [*notes, Doubt(f"photos of {len(faults)} of {count} views are left out: {list_faults(faults)}", LEFT_OUT)]


def describe_missing(names: Sequence[str], stored: CameraFile | None, *, is_right: bool) -> str | None:
    """Say which views have no camera in a file, which is why all cameras are estimated instead of read from the file.

    Returns None if there is no such file, if it cannot be read, or if its cameras may be those of another scene.

    Args:
        names: Names of the views. A view has the name of its photo, if a photo shows it.
        stored: The cameras of the file; None if there is no file, or if it cannot be read.
        is_right: True if the cameras of the file see the Gaussians. Otherwise the cameras are taken for those of the
            scene only if every camera has the name of a view.
    """
    if stored is None:
        return None
    known = {PurePath(name).stem for name in stored.names}
    count = len(names) - len(stored)
    lacking = [name for name in names if PurePath(name).stem not in known]
    are_named = len(lacking) == count > 0
    if not (are_named or is_right):
        return None
    text = f"{count} of {len(names)} views {'has' if count == 1 else 'have'} no camera in {stored.path}"
    text += f" ({list_some(lacking)})" if are_named else ""
    return f"{text}: the poses and focal length of all views are estimated from the Gaussians' own grid"


def explain_mismatch(photos: ScenePhotos, camera_file: CameraFile) -> MismatchError:
    """Return the error that no photo shows any view, with the names of the photos that cannot be used."""
    views = f"the {len(camera_file)} views of {camera_file.widths[0]} x {camera_file.heights[0]} pixels"
    found = "none that shows one of them"
    if not any(photos.named):  # neither names nor order propose a file
        photos = replace(photos, named=photos.pool)
    if has_other_shape(photos, camera_file) and camera_file.source != ESTIMATED:
        width, height = image_size(next(filter(None, photos.named)))
        shape = " (2 : 1 as 360-degree panoramas have)" if width == 2 * height else ""
        found = f"{width} x {height}{shape}, of which no part shows one of them"
    faults = [fault for fault in photos.faults if fault is not None]
    reasons = f" ({list_faults(faults)})" if faults else ""
    problem = f"expected photos of {views}, found {found}{reasons}"
    return MismatchError(photos.folder, problem, f"name their folder with --images; {CROPPED}")
