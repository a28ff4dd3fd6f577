"""The cameras and photos of a scene: read, turned, cut, at a size that memory has room for; masks and larger files."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from gsmerge.alignment import ESTIMATED
from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import CameraFile, sizes_of, to_cameras, undistort_photos
from gsmerge.io.cameras.embedded import SHARP
from gsmerge.io.cameras.read import CHUNK, read_cameras, read_sharp_camera
from gsmerge.io.formats.read import GaussianFile
from gsmerge.io.formats.table import is_frame
from gsmerge.io.image_names import IMAGE_SUFFIXES, find_image, match_images, match_masks, natural_key
from gsmerge.io.photo_files import (
    Photos,
    PhotoTransform,
    Size,
    as_floats,
    change_photos,
    decode_alpha,
    decode_image,
    decode_images,
    decode_mask,
    image_size,
    keep_photos,
    photo_size,
    quarter_turns,
    resize_to,
    same_shape,
)
from gsmerge.kernels.matrices import matmul
from gsmerge.kernels.pictures import count_bars
from gsmerge.runtime.plugins import LazyFunction
from gsmerge.runtime.threads import parallel_map
from gsmerge.scene.files import SceneFiles
from gsmerge.settings.extend import SUFFIX
from gsmerge.types import Cameras, LargePhotos

_READ_IMAGES = LazyFunction("gsmerge.io.formats.depth_maps", "read_images")
_SEEN_PLACE = "images_resized"  # where WorldMirror writes what it saw
_MODEL_FOLDERS = ("0", "sparse", "colmap")  # of COLMAP, in a scene's folder; a model may also lie in that itself
_SHOWS_BETTER = 0.8  # of the colours' distance from other photos
_MAX_BYTES = 2 << 30  # of all photos as floats, before it is known whether the Gaussians belong to pixels
_FLOAT_PIXEL = 12  # bytes
_BAR_SPREAD = 8  # of 255, range of a bar's colours
_ROUNDING = 1e-6  # pixels
_MAX_MASKED = 0.98  # share of the pixels of photos that masks may leave out
_MASK_LEVEL = 191  # of 255: a pixel of a view counts if three quarters of its pixels in the file do


def read_scene_cameras(ply: GaussianFile, files: SceneFiles) -> CameraFile | None:
    """Read a scene's cameras from their file or the ``.ply``, or estimate them; None if there are none.

    If a file has only poses, the focal length is estimated; SceneError if that fails.
    """
    stored = None
    if files.cameras is not None:
        stored = read_cameras(files.cameras, scene=files.ply.stem, folder=files.ply.parent)
        if stored.focal is not None:
            return stored
    if stored is None and files.is_state:
        return None
    sharp = read_sharp_camera(files.ply) if stored is None and "cameras" not in files.named else None
    if sharp is not None:
        return sharp
    from gsmerge.scene.estimate_cameras import estimate_cameras, estimate_focal, estimate_grid  # few files need it

    if stored is not None:
        return estimate_focal(ply, stored, stored_photos(files, stored))
    if files.images is None:
        beside = [] if "images" in files.named else images_beside(files.ply)
        return estimate_grid(ply, files.ply, beside, files.ply.parent)
    return estimate_cameras(ply, files.ply, files.images) if files.images.is_dir() else estimate_grid(ply, files.ply)


def choose_photos(ply: GaussianFile, files: SceneFiles, camera_file: CameraFile) -> tuple[SceneFiles, list[str]]:
    """Choose the photos that the model saw if the photos beside them do not show the scene, with a note.

    WorldMirror squeezes tall photos into ``images``, and crops them in ``images_resized``. Photos that none of the
    views of an estimated grid was found in are left out.
    """
    usual = files.images
    unnamed = camera_file.source == ESTIMATED and camera_file.names[0] == "view 0"
    if unnamed and usual is not None and usual.is_dir():
        grid = f"{len(camera_file)} views of {camera_file.widths[0]} x {camera_file.heights[0]} pixels"
        note = f"the photos in {usual} are not used: they do not show the {grid} whose grid the Gaussians are"
        return replace(files, images=None), [note]
    if usual is None or usual.name == _SEEN_PLACE or not (usual.parent / _SEEN_PLACE).is_dir():
        return files, []
    seen = usual.parent / _SEEN_PLACE

    from gsmerge.alignment import check_cameras

    def ratio(images: Path) -> float:
        photos = stored_photos(replace(files, images=images), camera_file)
        cameras = to_cameras(camera_file, photo_size(photos))
        return check_cameras(ply.gaussians, ply.valid, cameras, as_floats(photos)).color_ratio

    try:
        better = ratio(seen) < _SHOWS_BETTER * ratio(usual)
    except SceneError:  # photos of other views
        return files, []
    note = f"photos are those of {_SEEN_PLACE}: their colours are those of the Gaussians, those of {usual.name} are not"
    return (replace(files, images=seen), [note]) if better else (files, [])


def stored_photos(files: SceneFiles, camera_file: CameraFile) -> Photos:
    """Read the photos of the cameras from a folder, from a file that holds them, or from where the camera file says.

    Empty where there are none.
    """
    paths = _photo_paths(files, camera_file)
    photos = decode_images(paths) if paths else _photos_inside(files, camera_file)
    photos = _turn_photos(photos, _photo_turns(files, camera_file))
    old, size = photo_size(photos), (int(camera_file.widths[0]), int(camera_file.heights[0]))
    if old is None or camera_file.source != SHARP or old == size:
        return photos
    return resize_to(old, size).photos(photos)


def _photos_inside(files: SceneFiles, camera_file: CameraFile) -> Photos:
    """Read the photos that a file holds; empty without such a file."""
    if files.images is None:
        return ()
    if is_frame(files.images):
        return _READ_IMAGES(files.plys)
    same_file = files.cameras is not None and os.path.realpath(files.cameras) == os.path.realpath(files.images)
    stored = (camera_file if same_file else read_cameras(files.images, scene=files.ply.stem)).images
    without = same_file and files.images.suffix == CHUNK and not len(stored)
    if not without and len(stored) != len(camera_file):
        raise SceneError(files.images, f"expected {len(camera_file)} images, one per camera, found {len(stored)}")
    return stored


def _photo_turns(files: SceneFiles, camera_file: CameraFile) -> int:
    """Return the quarter turns by the orientation tag, which only SHARP applies among the models."""
    paths = _photo_paths(files, camera_file) if camera_file.source == SHARP else []
    turns = quarter_turns(paths[0]) if paths else 0
    if turns % 2 == 0 or not paths:
        return turns
    width, height = image_size(paths[0])
    K = camera_file.Ks[0]
    aspect = K[1, 1] / K[0, 0]  # of the photo as it was read, whose pixels are square
    as_turned = height / width / aspect
    as_stored = width / height / aspect
    return turns if max(as_turned, 1 / as_turned) < max(as_stored, 1 / as_stored) else 0


def _turn_photos(photos: Photos, turns: int) -> Photos:
    """Turn photos by quarter turns, counterclockwise."""
    if turns == 0:
        return photos
    size = photo_size(photos)

    def turn(_: int, photo: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(np.rot90(photo, turns))

    return change_photos(photos, turn, size[::-1] if size and turns % 2 else size)


def _photo_paths(files: SceneFiles, camera_file: CameraFile) -> list[Path]:
    """Find the photo file of every camera; empty where there are none, or they are inside another file."""
    if files.images is None:
        if "images" in files.named:
            return []
        place = Path(camera_file.path)
        folder = place if place.is_dir() and place.name not in _MODEL_FOLDERS else place.parent
        paths = [path for path in (find_image(folder, name) for name in camera_file.names) if path is not None]
        if (
            not paths
            and camera_file.source != ESTIMATED
            and all(name.removeprefix("view ").isdecimal() for name in camera_file.names)
        ):
            paths = images_beside(files.ply)  # the format has no names; AnySplat writes its Gaussians among the photos
        return paths if len(paths) == len(camera_file) else []
    return [] if files.images.suffix in (".npz", CHUNK, SUFFIX) else match_images(files.images, camera_file.names)


def images_beside(ply: Path) -> list[Path]:
    """List the images directly in the folder of a ``.ply``, in the order of :func:`list_images`."""
    named = (path for path in ply.parent.glob("[!.]*") if path.suffix.lower() in IMAGE_SUFFIXES)
    return sorted((path for path in named if path.is_file()), key=lambda path: natural_key(path.name))


def find_larger_and_masks(
    files: SceneFiles,
    camera_file: CameraFile,
    photos: Photos,
    size: Size | None,
    transform: PhotoTransform | None,
    cameras: Cameras,
) -> tuple[LargePhotos | None, np.ndarray | None, list[str]]:
    """Find the photos at full file size, if that is larger than the scene's, and masks of the pixels that count.

    Files are read again when a photo is asked for; photos inside other files stay in memory. ``photos`` are the
    undistorted photos of :func:`stored_photos`; ``size`` is their size and ``transform`` how they were fitted to the
    rows; ``cameras`` are the scene's, in the order of the camera file. Masks ``[c,h,w]`` bool come from files and from
    transparency; None if all pixels count. Also returns notes.
    """
    file_size = photo_size(photos)
    if file_size is None or size is None:
        return None, None, []
    paths = _photo_paths(files, camera_file)
    file_size = image_size(paths[0]) if paths else file_size
    turns = _photo_turns(files, camera_file)
    stored = file_size[::-1] if turns % 2 else file_size
    window = _file_window(stored, size, transform, cameras)
    lenses = camera_file.lenses if paths else ()
    Ks = to_cameras(replace(camera_file, lenses=()), stored).Ks if lenses else None

    def cut(view: int, picture: np.ndarray) -> np.ndarray:
        """Undistort and turn a picture given as in the photo's file, and crop it to the view."""
        if Ks is not None:
            picture = undistort_photos([picture], Ks[view : view + 1], lenses[view : view + 1])[0]
        return np.ascontiguousarray(np.rot90(picture, turns)[window.rows, window.columns])

    def read(view: int) -> np.ndarray:
        return cut(view, decode_image(paths[view], file_size) if paths else photos[view])

    large = None
    if window.is_larger:
        width, height = (part.stop - part.start for part in (window.columns, window.rows))
        large = LargePhotos(matmul(window.to_file, cameras.Ks), width, height, tuple(range(len(cameras))), read)
    names = [path.as_posix() for path in paths] or list(camera_file.names)
    named, notes = _match_masks(files, names)
    alphas: Sequence[Path | None] = paths or [None] * len(names)

    def read_parts(view: int) -> list[np.ndarray]:
        """Read the mask, which is upright, and the photo's transparency, which is as stored."""
        mask, photo = named[view], alphas[view]
        parts = [None if photo is None else decode_alpha(photo)]
        parts += [None if mask is None else np.rot90(decode_mask(mask, photo), -turns)]
        return [part for part in parts if part is not None]

    return large, _read_masks(read_parts, len(names), file_size, cameras, cut), notes


def _match_masks(files: SceneFiles, names: Sequence[str]) -> tuple[Sequence[Path | None], list[str]]:
    """Find the masks of photos, with a note; in a folder that the user did not name, only by matching names."""
    if files.masks is None:
        return [None] * len(names), []
    try:
        return match_masks(files.masks, names), []
    except SceneError as error:
        if "masks" in files.named:
            raise
        return [None] * len(names), [f"masks are not used: {error.path}: {error.problem}"]


def _read_masks(
    read_parts: Callable[[int], list[np.ndarray]],
    count: int,
    size: Size,
    cameras: Cameras,
    cut: Callable[[int, np.ndarray], np.ndarray],
) -> np.ndarray | None:
    """Read the masks of photos with the given file ``size``; ``cut`` crops a mask to the view."""
    shape = cameras.height, cameras.width

    def read(view: int) -> np.ndarray | None:
        mask = np.full(shape, True)
        for part in read_parts(view):
            whole = cv2.resize(part.astype(np.uint8) * 255, size, interpolation=cv2.INTER_NEAREST)
            seen = cut(view, whole[..., None].repeat(3, -1))[..., 0]
            mask &= cv2.resize(seen, shape[::-1], interpolation=cv2.INTER_AREA) > _MASK_LEVEL
        return None if mask.all() else mask

    masks = parallel_map(read, range(count))
    if all(mask is None for mask in masks):
        return None
    return np.stack([np.full(shape, True) if mask is None else mask for mask in masks])


def check_masks(masks: np.ndarray | None, files: SceneFiles) -> tuple[np.ndarray | None, list[str]]:
    """Note the share of the photos that masks leave out; SceneError if masks from files leave out nearly all."""
    if masks is None:
        return None, []
    share = float(1 - masks.mean())
    if share < _MAX_MASKED:
        count = int((~masks.all((1, 2))).sum())
        return masks, [f"masks leave out {100 * share:.0f} % of the photos; of {len(masks)}, {count} have one"]
    if files.masks is None:
        return None, ["the photos are transparent nearly everywhere, which is not taken for masks"]
    problem = f"expected masks that are bright where photos count, found {100 * share:.0f} % dark"
    if "masks" not in files.named:
        return None, [f"masks are not used: {files.masks}: {problem}; name them with --masks"]
    raise SceneError(files.masks, problem, "invert them, or name another folder with --masks")


@dataclass(frozen=True)
class _Window:
    """The part of a photo's file that a view of the grid shows."""

    rows: slice
    columns: slice
    to_file: np.ndarray  # [3,3] from pixels of the grid to those of the part
    is_larger: bool  # whether it has more pixels than the view on both sides


def _file_window(stored: Size, size: Size, transform: PhotoTransform | None, cameras: Cameras) -> _Window:
    """Find the part of files with the size ``stored`` that the grid shows; see :func:`find_larger_and_masks`."""
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


def cut_bars(photos: Photos, camera_file: CameraFile) -> tuple[Photos, list[str]]:
    """Cut off bars around photos if the rest has the cameras' shape, with a note; otherwise change nothing."""
    size = photo_size(photos)
    shapes = sizes_of(camera_file)
    if size is None or not shapes or camera_file.photo_map is not None:
        return photos, []
    if any(same_shape(shape, size) for shape in shapes):
        return photos, []
    counts = [count_bars(photos[view], _BAR_SPREAD) for view in range(len(photos))]
    above, below, left, right = (int(count) for count in np.median(counts, 0))
    inner = size[0] - left - right, size[1] - above - below
    if inner == size or not any(same_shape(shape, inner) for shape in shapes):
        return photos, []

    def cut(_: int, photo: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(photo[above : size[1] - below, left : size[0] - right])

    note = f"the photos of {size[0]} x {size[1]} have bars around pictures of {inner[0]} x {inner[1]}: they are cut off"
    return keep_photos(change_photos(photos, cut, inner)), [note]


def limit_photo_size(photos: Photos, rows: int, max_side: int, *, unaligned: bool) -> tuple[Photos, list[str]]:
    """Resize photos that are too large for memory to at most ``max_side`` pixels per side, with notes.

    Photos whose pixels may be the ``rows`` Gaussians of the file keep their size, unless they are known to be
    ``unaligned``.
    """
    size = photo_size(photos)
    if size is None:
        return photos, []
    pixels = len(photos) * size[0] * size[1]
    if not unaligned and (_FLOAT_PIXEL * pixels <= _MAX_BYTES or 2 * rows > pixels):
        return photos, []
    transform, notes = _limit(size, max_side)
    return photos if transform is None else keep_photos(transform.photos(photos)), notes


def limit_view_size(cameras: Cameras, images: np.ndarray, max_side: int) -> tuple[Cameras, np.ndarray, list[str]]:
    """Resize cameras and photos ``[c,h,w,3]`` to at most ``max_side`` pixels per side; with a note."""
    transform, notes = _limit((cameras.width, cameras.height), max_side)
    if transform is not None:
        cameras, smaller = transform.cameras(cameras), transform.photos(images)
        pictures = np.array([smaller[view] for view in range(len(smaller))], images.dtype)
        images = pictures.reshape(-1, cameras.height, cameras.width, 3)
    return cameras, images, notes


def _limit(size: Size, max_side: int) -> tuple[PhotoTransform | None, list[str]]:
    """Make the transform that resizes pictures to ``max_side``, and a note; None if they are small enough."""
    if max(size) <= max_side:
        return None, []
    scale = max_side / max(size)
    width, height = (max(1, round(side * scale)) for side in size)
    note = f"views of {size[0]} x {size[1]} are worked on at {width} x {height}"
    return resize_to(size, (width, height)), [f"{note}: no side is longer than {max_side} pixels (max_side)"]
