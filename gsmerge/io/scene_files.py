"""Find the cameras and photos of a ``.ply``, and read them at a size that memory has room for."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.alignment import estimate_cameras
from gsmerge.io.bounds import check_file
from gsmerge.io.cameras.camera_file import CameraFile, to_cameras, undistort_photos
from gsmerge.io.cameras.embedded import holds_cameras
from gsmerge.io.cameras.npz_files import holds_images
from gsmerge.io.cameras.re10k import SUFFIX as CHUNK
from gsmerge.io.cameras.read import CAMERA_PLACES, SHARP, find_cameras, read_cameras, read_sharp
from gsmerge.io.formats.ply import PlyScene
from gsmerge.io.photo_files import (
    Photos,
    PhotoTransform,
    Size,
    decode_image,
    decode_images,
    find_image,
    image_size,
    keep_photos,
    list_images,
    match_images,
    photo_size,
    resize_to,
)
from gsmerge.kernels.matrices import matmul
from gsmerge.types import Cameras, LargePhotos, StrPath

# The first that exists wins; then the folder's only .ply.
PLY_PLACES = ("scene.ply", "gaussians.ply", "gs_ply/0000.ply", "point_cloud.ply")
IMAGE_PLACES = ("images", "input", "context", "rgb", "input_images")
_POINT_CLOUDS = {"input.ply", "points3D.ply", "points.ply", "sparse_pc.ply"}  # of other programs
_RESULT = re.compile(r"\.compact(\.level\d+)?(\.compressed)?\.ply$")
_MAX_BYTES = 2 << 30  # of all photos as floats, before it is known whether the Gaussians belong to pixels
_FLOAT_PIXEL = 12  # bytes
_ROUNDING = 1e-6  # pixels


@dataclass(frozen=True)
class SceneFiles:
    """The files of a scene.

    Cameras may be a COLMAP folder or the ``.ply`` that holds its own, images the ``.npz`` or ``.torch`` that holds
    them.
    """

    ply: Path
    cameras: Path | None
    images: Path | None


def find_scene_files(
    path: StrPath,
    *,
    cameras: StrPath | None = None,
    images: StrPath | None = None,
) -> SceneFiles:
    """Find a scene's files; cameras and images that the user names are used instead of searching.

    Cameras inside the ``.ply`` go before others beside it.

    The given folder is searched, then the ``.ply``'s own, then the one above it for ``gs_ply/`` and two above it
    for ``point_cloud/iteration_n/``; in each the places of ``PLY_PLACES``, ``CAMERA_PLACES`` and ``IMAGE_PLACES``
    in their order. Images inside the cameras' ``.npz`` or ``.torch`` go before a folder, because they are those
    that the model saw.

    Raises:
        SceneError: If there is no ``.ply``, several to choose from, or a named file does not exist.
    """
    path = Path(path)
    ply = _find_ply(path) if os.path.isdir(path) else path
    check_file(ply)
    given = path if ply != path else ply.parent
    folder = Path(os.path.realpath(ply.parent))
    above = [folder.parent] * (folder.name == "gs_ply")
    if folder.name.startswith("iteration_") and folder.parent.name == "point_cloud":
        above = [folder.parent.parent]
    roots = list(dict.fromkeys((Path(os.path.realpath(given)), folder, *above)))
    camera_path = _named(cameras) or (ply if holds_cameras(ply) else None)
    camera_path = camera_path or next((c for c in map(find_cameras, roots) if c is not None), None)
    image_path = _named(images)
    if image_path is None and camera_path is not None:
        has_images = camera_path.suffix == CHUNK or (camera_path.suffix == ".npz" and holds_images(camera_path))
        image_path = camera_path if has_images else None
    if image_path is None:
        folders = (root / place for root in roots for place in IMAGE_PLACES)
        image_path = next((f for f in folders if f.is_dir() and list_images(f)), None)
    return SceneFiles(ply, camera_path, image_path)


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
    plys = other_plys(folder) if named is None else [named]
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
    """Read the cameras from their file or the ``.ply``, or estimate them for the images; SceneError if all fail."""
    if files.cameras is not None:
        return read_cameras(files.cameras, scene=files.ply.stem)
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
        return paths if len(paths) == len(camera_file) else None
    return None if files.images.suffix in (".npz", CHUNK) else match_images(files.images, camera_file.names)


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
    fitted = transform or resize_to(size, size)
    scale = np.array([fitted.scale_x, fitted.scale_y]) * size / np.array(stored)
    cut, grid = np.array([fitted.left, fitted.top]), np.array([fitted.width, fitted.height])
    shown = np.array([cameras.width, cameras.height]) / grid  # of unaligned scenes, whose views may be reduced again
    if (scale * shown).max() >= 1:
        return None
    first = np.floor(cut / scale).astype(int)
    last = np.minimum(np.ceil((cut + grid) / scale - _ROUNDING).astype(int), stored)
    to_file = np.eye(3)
    to_file[(0, 1), (0, 1)] = 1 / (scale * shown)
    to_file[:2, 2] = cut / scale - first
    rows, columns = slice(first[1], last[1]), slice(first[0], last[0])
    Ks = to_cameras(replace(camera_file, lenses=()), stored).Ks if camera_file.lenses else None

    def read(view: int) -> np.ndarray:
        photo = photos_inside[view] if paths is None else decode_image(paths[view], stored)
        if paths is not None and Ks is not None:
            photo = undistort_photos([photo], Ks[view : view + 1], camera_file.lenses[view : view + 1])[0]
        return photo[rows, columns]

    photos_inside = photos if paths is None else ()
    width, height = (int(side) for side in last - first)
    return LargePhotos(matmul(to_file, cameras.Ks), width, height, tuple(range(len(cameras))), read)


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
