"""Find the cameras and photos of a ``.ply``, and read them at a size that memory has room for."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.alignment import estimate_cameras, estimate_focal
from gsmerge.io.bounds import check_file
from gsmerge.io.cameras.camera_file import (
    CameraFile,
    missing_intrinsics,
    sizes_of,
    to_cameras,
    undistort_photos,
)
from gsmerge.io.cameras.npz_files import holds_images
from gsmerge.io.cameras.re10k import SUFFIX as CHUNK
from gsmerge.io.cameras.read import (
    CAMERA_PLACES,
    SHARP,
    find_cameras,
    find_other_cameras,
    read_cameras,
    read_sharp,
)
from gsmerge.io.formats.ply import PlyScene
from gsmerge.io.photo_files import (
    IMAGE_SUFFIXES,
    Photos,
    PhotoTransform,
    Size,
    change_photos,
    decode_alpha,
    decode_image,
    decode_images,
    decode_mask,
    find_image,
    image_size,
    keep_photos,
    list_images,
    match_images,
    match_masks,
    natural_key,
    photo_size,
    resize_to,
    same_shape,
)
from gsmerge.kernels.matrices import matmul
from gsmerge.kernels.pictures import count_bars
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, LargePhotos, StrPath

# The first that exists wins; then the folder's only .ply.
PLY_PLACES = ("scene.ply", "gaussians.ply", "gs_ply/0000.ply", "point_cloud.ply")
SCENES_PLACE = "gaussians"  # where DepthSplat and its relatives write NAME.ply, with the photos in images/NAME
IMAGE_PLACES = ("images", "input", "context", "rgb", "input_images")
MASK_PLACES = ("masks",)
_POINT_CLOUDS = {"input.ply", "points3D.ply", "points.ply", "sparse_pc.ply"}  # of other programs
_RESULT = re.compile(r"\.compact(\.level\d+)?(\.compressed)?\.ply$")
_MAX_BYTES = 2 << 30  # of all photos as floats, before it is known whether the Gaussians belong to pixels
_FLOAT_PIXEL = 12  # bytes
_BAR_SPREAD = 8  # of 255, range of a bar's colours
_ROUNDING = 1e-6  # pixels
_MASK_LEVEL = 191  # of 255: a pixel of a view counts if three quarters of its pixels in the file do


@dataclass(frozen=True)
class SceneFiles:
    """The files of a scene; cameras may be a COLMAP folder, images the ``.npz`` or ``.torch`` that holds them."""

    ply: Path
    cameras: Path | None
    images: Path | None
    masks: Path | None = None  # a folder


def find_scene_files(
    path: StrPath,
    *,
    cameras: StrPath | None = None,
    images: StrPath | None = None,
    masks: StrPath | None = None,
) -> SceneFiles:
    """Find a scene's files; those that the user names are used instead of searching.

    The given folder is searched, then the ``.ply``'s own, then the one above it for ``gs_ply/`` and ``gaussians/``,
    and two above it for ``point_cloud/iteration_n/``; in each the places of ``PLY_PLACES``, ``CAMERA_PLACES``,
    ``IMAGE_PLACES`` and ``MASK_PLACES`` in their order. Without any of these cameras the only file of any name that
    holds some will do. Images inside the cameras' ``.npz`` or ``.torch`` go before a folder, because they are those
    that the model saw.

    Raises:
        SceneError: If there is no ``.ply``, several to choose from, or a named file does not exist.
    """
    path = Path(path)
    ply = _find_ply(path) if os.path.isdir(path) else path
    check_file(ply)
    given = path if ply != path else ply.parent
    folder = Path(os.path.realpath(ply.parent))
    above = [folder.parent] * (folder.name in ("gs_ply", SCENES_PLACE))
    if folder.name.startswith("iteration_") and folder.parent.name == "point_cloud":
        above = [folder.parent.parent]
    roots = list(dict.fromkeys((Path(os.path.realpath(given)), folder, *above)))
    places = (find(root) for find in (find_cameras, find_other_cameras) for root in roots)
    camera_path = _named(cameras) or next((place for place in places if place is not None), None)
    image_path = _named(images)
    if image_path is None and camera_path is not None:
        has_images = camera_path.suffix == CHUNK or (camera_path.suffix == ".npz" and holds_images(camera_path))
        image_path = camera_path if has_images else None
    if image_path is None:
        folders = [root / place for root in roots for place in IMAGE_PLACES]
        if folder.name == SCENES_PLACE:
            folders = [place / ply.stem for place in folders] + folders
        image_path = next((f for f in folders if f.is_dir() and list_images(f)), None)
    mask_path = _named(masks)
    if mask_path is not None and not mask_path.is_dir():
        raise SceneError(mask_path, "expected a folder of masks, found a file")
    if mask_path is None:
        beside = [] if image_path is None else [image_path.parent]
        candidates = (root / place for root in (*beside, *roots) for place in MASK_PLACES)
        mask_path = next((f for f in candidates if f.is_dir() and list_images(f)), None)
    return SceneFiles(ply, camera_path, image_path, mask_path)


def _named(path: StrPath | None) -> Path | None:
    if path is None:
        return None
    if not os.path.exists(path):
        raise SceneError(path, "no such file or folder")
    if not os.path.isdir(path):
        check_file(Path(path))
    return Path(path)


def _find_ply(folder: Path) -> Path:
    named = named_ply(folder)
    plys = other_plys(folder) or other_plys(folder / SCENES_PLACE) if named is None else [named]
    if len(plys) == 1:
        return plys[0]
    if not plys:
        raise SceneError(folder, "expected a .ply file in the folder, found none")
    names = ", ".join(p.name for p in plys[:4])
    raise SceneError(folder, f"expected one .ply file in the folder, found {len(plys)} ({names})", "name one")


def named_ply(folder: Path) -> Path | None:
    """Find the file in a folder that is the scene by its name; None without one."""
    for place in PLY_PLACES:
        if (folder / place).is_file():
            return folder / place
    trained = [p for p in folder.glob("point_cloud/iteration_*/point_cloud.ply") if p.parent.name[10:].isdecimal()]
    return max(trained, key=lambda p: int(p.parent.name[10:]), default=None)


def other_plys(folder: Path) -> list[Path]:
    """List the other files directly in a folder that may be scenes: no results of gsmerge, no point clouds."""
    plys = (p for p in folder.glob("*.ply") if not p.name.startswith(".") and p.name not in _POINT_CLOUDS)
    return sorted(p for p in plys if not _RESULT.search(p.name))


def read_scene_cameras(ply: PlyScene, files: SceneFiles) -> CameraFile:
    """Read the cameras from their file or the ``.ply``, or estimate them for the images; SceneError if all fail.

    Where a file has poses alone, the focal length is estimated.
    """
    if files.cameras is not None:
        stored = read_cameras(files.cameras, scene=files.ply.stem, folder=files.ply.parent)
        if stored.focal is not None:
            return stored
        photos = stored_photos(files, stored)
        estimated = estimate_focal(ply, stored, photos)
        if estimated is None:
            reason = "no focal length fits the Gaussians" if photos is not None else "no photos that show them"
            raise missing_intrinsics(stored.path, f", and {reason}")
        return estimated
    cameras = read_sharp(files.ply)
    if cameras is None and files.images is not None and files.images.is_dir():
        paths = list_images(files.images)
        width, height = image_size(paths[0]) if paths else (0, 0)
        names = [path.relative_to(files.images).as_posix() for path in paths]
        cameras = estimate_cameras(files.ply, ply.gaussians, ply.valid, names, width, height)
    if cameras is None:
        places = ", ".join(place for place in CAMERA_PLACES if len(place) > 1)
        problem = f"no cameras found next to it (looked for {places}, one .torch chunk)"
        raise SceneError(files.ply, problem, "name them with --cameras, or have views placed with --hint order=none")
    return cameras


def stored_photos(files: SceneFiles, camera_file: CameraFile) -> Photos | None:
    """Read the photos of the cameras from a folder, a file that holds them, or where the camera file says; or None."""
    photos = _stored_photos(files, camera_file)
    old, size = photo_size(photos), (int(camera_file.widths[0]), int(camera_file.heights[0]))
    if photos is None or old is None or camera_file.source != SHARP or old == size:
        return photos
    return resize_to(old, size).photos(photos)


def _stored_photos(files: SceneFiles, camera_file: CameraFile) -> Photos | None:
    paths = _photo_paths(files, camera_file)
    if paths is not None or files.images is None:
        return decode_images(paths) if paths else None
    own = files.cameras is not None and os.path.realpath(files.cameras) == os.path.realpath(files.images)
    stored = (camera_file if own else read_cameras(files.images, scene=files.ply.stem)).images
    if own and stored is None and files.images.suffix == CHUNK:
        return None
    if stored is None or len(stored) != len(camera_file):
        count = 0 if stored is None else len(stored)
        raise SceneError(files.images, f"expected {len(camera_file)} images, one per camera, found {count}")
    return stored


def _photo_paths(files: SceneFiles, camera_file: CameraFile) -> list[Path] | None:
    """Find the photo file of every camera; None where there are none, or they are inside another file."""
    if files.images is None:
        folder = Path(camera_file.path).parent
        paths = [path for path in (find_image(folder, name) for name in camera_file.names) if path is not None]
        if not paths and all(name.removeprefix("view ").isdecimal() for name in camera_file.names):
            paths = images_beside(files.ply)  # the format has no names; AnySplat writes its Gaussians among the photos
        return paths if len(paths) == len(camera_file) else None
    return None if files.images.suffix in (".npz", CHUNK) else match_images(files.images, camera_file.names)


def images_beside(ply: Path) -> list[Path]:
    """List the images in the folder of a ``.ply``, without those below it, in the order of :func:`list_images`."""
    named = (path for path in ply.parent.glob("[!.]*") if path.suffix.lower() in IMAGE_SUFFIXES)
    return sorted((path for path in named if path.is_file()), key=lambda path: natural_key(path.name))


def find_large_photos(
    files: SceneFiles,
    camera_file: CameraFile,
    photos: Photos | None,
    size: Size | None,
    transform: PhotoTransform | None,
    cameras: Cameras,
) -> LargePhotos | None:
    """Find the photos at the size of their files, where that is larger than the scene's; None where it is not.

    Files are read again when a photo is asked for; photos inside other files stay in memory. ``photos`` are those
    of :func:`stored_photos`, undistorted; ``size`` is theirs when they were fitted to the rows by ``transform``;
    ``cameras`` are those of the scene's grid, in the order of the camera file.
    """
    paths = _photo_paths(files, camera_file) if photos is not None else None
    stored = photo_size(photos) if paths is None else image_size(paths[0])
    if photos is None or stored is None or size is None:
        return None
    window = _file_window(stored, size, transform, cameras)
    if not window.is_larger:
        return None
    Ks = to_cameras(replace(camera_file, lenses=()), stored).Ks if camera_file.lenses else None

    def read(view: int) -> np.ndarray:
        photo = photos_inside[view] if paths is None else decode_image(paths[view], stored)
        if paths is not None and Ks is not None:
            photo = undistort_photos([photo], Ks[view : view + 1], camera_file.lenses[view : view + 1])[0]
        return photo[window.rows, window.columns]

    photos_inside = photos if paths is None else ()
    width, height = (part.stop - part.start for part in (window.columns, window.rows))
    return LargePhotos(matmul(window.to_file, cameras.Ks), width, height, tuple(range(len(cameras))), read)


def find_masks(
    files: SceneFiles,
    camera_file: CameraFile,
    photos: Photos | None,
    size: Size | None,
    transform: PhotoTransform | None,
    cameras: Cameras,
) -> np.ndarray | None:
    """Read where the photos count, ``[c,h,w]`` bool, from masks and transparency; None where all of them does.

    The arguments are those of :func:`find_large_photos`. A photo without a mask counts wholly.
    """
    paths = _photo_paths(files, camera_file) if photos is not None else None
    stored = photo_size(photos) if paths is None else image_size(paths[0])
    if photos is None or stored is None or size is None:
        return None
    named = [None] * len(camera_file) if files.masks is None else match_masks(files.masks, camera_file.names)
    Ks = to_cameras(replace(camera_file, lenses=()), stored).Ks if camera_file.lenses else None
    window = _file_window(stored, size, transform, cameras)

    def read(view: int) -> np.ndarray | None:
        parts = [None if paths is None else decode_alpha(paths[view])]
        parts += [None if path is None else decode_mask(path) for path in (named[view],)]
        mask = np.full((cameras.height, cameras.width), True)
        for part in (part for part in parts if part is not None):
            whole = cv2.resize(part.astype(np.uint8) * 255, stored, interpolation=cv2.INTER_NEAREST)
            if Ks is not None:
                bent = whole[..., None].repeat(3, -1), Ks[view : view + 1], camera_file.lenses[view : view + 1]
                whole = undistort_photos([bent[0]], *bent[1:])[0][..., 0]
            seen = np.ascontiguousarray(whole[window.rows, window.columns])
            mask &= cv2.resize(seen, mask.shape[::-1], interpolation=cv2.INTER_AREA) > _MASK_LEVEL
        return None if mask.all() else mask

    masks = parallel_map(read, range(len(camera_file)))
    if all(mask is None for mask in masks):
        return None
    whole = np.full((cameras.height, cameras.width), True)
    return np.stack([whole if mask is None else mask for mask in masks])


@dataclass(frozen=True)
class _Window:
    """The part of a photo's file that a view of the grid shows."""

    rows: slice
    columns: slice
    to_file: np.ndarray  # [3,3] from pixels of the grid to those of the part
    is_larger: bool  # whether it has more pixels than the view on both sides


def _file_window(stored: Size, size: Size, transform: PhotoTransform | None, cameras: Cameras) -> _Window:
    """Find the part of files of the size ``stored`` that the grid shows; see :func:`find_large_photos`."""
    fitted = transform or resize_to(size, size)
    scale = np.array([fitted.scale_x, fitted.scale_y]) * size / np.array(stored)
    cut, grid = np.array([fitted.left, fitted.top]), np.array([fitted.width, fitted.height])
    shown = np.array([cameras.width, cameras.height]) / grid  # of unaligned scenes, whose views may be reduced again
    first = np.floor(cut / scale).astype(int)
    last = np.minimum(np.ceil((cut + grid) / scale - _ROUNDING).astype(int), stored)
    to_file = np.eye(3)
    to_file[(0, 1), (0, 1)] = 1 / (scale * shown)
    to_file[:2, 2] = cut / scale - first
    (left, top), (right, bottom) = first.tolist(), last.tolist()
    return _Window(slice(top, bottom), slice(left, right), to_file, bool((scale * shown).max() < 1))


def cut_bars(photos: Photos | None, camera_file: CameraFile) -> tuple[Photos | None, list[str]]:
    """Cut off the bars around photos that have the cameras' shape without them, with a note; or return them as is."""
    size = photo_size(photos)
    shapes = sizes_of(camera_file)
    if photos is None or size is None or not shapes or any(same_shape(one, size) for one in shapes):
        return photos, []
    counts = [count_bars(photos[view], _BAR_SPREAD) for view in range(len(photos))]
    above, below, left, right = (int(count) for count in np.median(counts, 0))
    inner = size[0] - left - right, size[1] - above - below
    if inner == size or not any(same_shape(one, inner) for one in shapes):
        return photos, []

    def cut(_: int, photo: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(photo[above : size[1] - below, left : size[0] - right])

    note = f"the photos of {size[0]} x {size[1]} have bars around pictures of {inner[0]} x {inner[1]}: they are cut off"
    return keep_photos(change_photos(photos, inner, cut)), [note]


def limit_photo_size(
    photos: Photos | None, rows: int, max_side: int, *, unaligned: bool
) -> tuple[Photos | None, list[str]]:
    """Resize photos that are too large for memory to at most ``max_side`` pixels a side, with notes about it.

    Where the file's Gaussians (``rows``) may be the photos' pixels, the photos stay; not where they are known to be
    unaligned.
    """
    size = photo_size(photos)
    if photos is None or size is None:
        return photos, []
    pixels = len(photos) * size[0] * size[1]
    if not unaligned and (_FLOAT_PIXEL * pixels <= _MAX_BYTES or 2 * rows > pixels):
        return photos, []
    transform, notes = _limit(size, max_side)
    return photos if transform is None else keep_photos(transform.photos(photos)), notes


def limit_view_size(
    cameras: Cameras, images: np.ndarray | None, max_side: int
) -> tuple[Cameras, np.ndarray | None, list[str]]:
    """Resize cameras and photos ``[c,h,w,3]`` to sides of at most ``max_side`` pixels; with a note."""
    transform, notes = _limit((cameras.width, cameras.height), max_side)
    if transform is not None:
        cameras = transform.cameras(cameras)
        smaller = None if images is None else transform.photos(images)
        images = None if smaller is None else np.stack([smaller[view] for view in range(len(smaller))])
    return cameras, images, notes


def _limit(size: Size, max_side: int) -> tuple[PhotoTransform | None, list[str]]:
    """Make the transform that brings pictures to ``max_side``, and a note; None where nothing has to be done."""
    if max(size) <= max_side:
        return None, []
    scale = max_side / max(size)
    width, height = (max(1, round(side * scale)) for side in size)
    note = f"views of {size[0]} x {size[1]} are worked on at {width} x {height}"
    return resize_to(size, (width, height)), [f"{note}: no side is longer than {max_side} pixels (max_side)"]
