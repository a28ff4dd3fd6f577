"""Find the folder whose files have the names of a scene's cameras, whatever the folder is called."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.image_names import IMAGE_SUFFIXES, propose_images
from gsmerge.io.photo_files import decode_small, image_size, same_shape
from gsmerge.reading.photos.offsets import OFFSET_PIXELS
from gsmerge.reading.scene_files import list_folders

_CHANNEL_ROUNDING = 1 / 255  # mean difference of channels that rounding to 8 bits may cause
_MODEL_FOLDERS = {"sparse", "colmap", "distorted"}  # names of folders that have COLMAP's models


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

    Returns the folder, the photos of this folder and of the next best folders, and the photo of each camera, or None
    for a camera without a photo. Returns None if no folder has photos by name.
    """
    pools = dict[Path, dict[Path, None]]()  # folder -> photos in it and below
    for root in roots:
        for folder, names in list_folders(root):
            photos = [folder / name for name in names if PurePath(name).suffix.lower() in IMAGE_SUFFIXES]
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
        camera_size, size = sizes[proposed.index(first)], image_size(first)
        has_other_shape = min(camera_size) > 1 and not same_shape(camera_size, size)
        count, num_exact = len({*proposed} - {None}), sum(path.name in file_names for path in filter(None, proposed))
        look = is_grey(first), size != camera_size, has_other_shape, -count_pixels(first)
        depth = len(pools[folder]), -len(folder.parts), folder  # prefers the innermost of folders with the same photos
        return -count, -num_exact, not folder.is_relative_to(roots[0]), *look, *depth

    max_folders = 4  # folders whose photos are compared with the views
    best = [folder for count, *_, folder in sorted(map(rank, pools)) if -count > num_known][:max_folders]
    if not best:
        return None
    pool = list(dict.fromkeys(path for folder in best for path in pools[folder]))
    return best[0], pool, propose_images(best[0], list(pools[best[0]]), camera_file.names, count_pixels)


def is_grey(path: Path) -> bool:
    """Return True if an image file has no colours, like masks and depths; False if it cannot be read."""
    with suppress(SceneError):
        return bool(np.ptp(decode_small(path, OFFSET_PIXELS), axis=-1).mean() <= _CHANNEL_ROUNDING)
    return False


def count_pixels(path: Path) -> int:
    """Count the pixels of an image file; 0 if it cannot be read."""
    try:
        width, height = image_size(path)
    except SceneError:
        return 0
    return width * height
