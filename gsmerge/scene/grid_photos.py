"""Match photos of any size with the views of a grid, whose pictures are its rows' own colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from gsmerge.geometry import correlation
from gsmerge.io.photo_files import PhotoTransform, Size, decode_image, image_size, resize_and_crop, resize_to
from gsmerge.runtime.threads import parallel_map

_TRIMS = (0, 8, 4, 2)  # pixels that exporters cut off at every side, the likely first
_SIDE = 128  # pixels of the pictures' longer side that are compared
_MAX_PHOTOS = 100  # that are looked at
_MIN_ALIKE, _MIN_ALIKE_EACH = 0.7, 0.4  # correlation of greys with the views' on average, and in each
_CLEARLY = 0.02  # by which other photos must be more alike than those in order


def match_photos(pictures: np.ndarray, paths: Sequence[Path]) -> tuple[list[int], PhotoTransform, Size] | None:
    """Choose the photos that show the ``pictures [v,h,w,3]`` of a grid's views, and how they are brought to its size.

    Returns their places in ``paths``, the transform, and the size of the photos that it is for. None where no photos
    show them.
    """
    views, height, width = pictures.shape[:3]
    if not views <= len(paths) <= _MAX_PHOTOS:
        return None
    size = image_size(paths[0])
    transforms = _transforms(size, (width, height))
    ratio = _SIDE / max(width, height)
    small = max(1, round(width * ratio)), max(1, round(height * ratio))
    wanted = [_grey(picture, small) for picture in pictures]

    def compare(path: Path) -> np.ndarray:
        """Return the correlations ``[t,v]`` of a photo under each transform with each view."""
        if image_size(path) != size:
            return np.full((len(transforms), views), -1.0)
        photo = decode_image(path, size)
        greys = [_grey(transform.photos([photo])[0], small) for transform in transforms]
        with np.errstate(invalid="ignore", divide="ignore"):  # pictures of one colour
            return np.nan_to_num([[correlation(grey, view) for view in wanted] for grey in greys])

    alike = np.stack(parallel_map(compare, paths))
    in_order = [range(views)] * (len(paths) == views)
    choices = [(number, list(chosen)) for number in range(len(transforms)) for chosen in in_order]
    choices += [(number, alike[:, number].argmax(0).tolist()) for number in range(len(transforms))]
    options = [(alike[chosen, number, range(views)], number, chosen) for number, chosen in choices]
    options = [option for option in options if len(set(option[2])) == views and _show(option[0])]
    if not options:
        return None
    best = max(float(each.mean()) for each, _, _ in options)
    near = [option for option in options if option[2] == list(range(views)) and option[0].mean() > best - _CLEARLY]
    _, number, chosen = max(near or options, key=lambda option: float(option[0].mean()))
    return chosen, transforms[number], size


def _show(alike: np.ndarray) -> bool:
    """Return whether photos that correlate so much with the views ``[v]`` show them."""
    return bool(alike.mean() >= _MIN_ALIKE and alike.min() >= _MIN_ALIKE_EACH)


def _transforms(size: Size, to: Size) -> list[PhotoTransform]:
    """List the ways in which models bring photos to the size of a grid: squeezed or cropped, and then trimmed."""
    transforms = []
    for trim in _TRIMS:
        whole = to[0] + 2 * trim, to[1] + 2 * trim
        for fitted in (resize_to(size, whole), resize_and_crop(size, whole)):
            left, top = fitted.left + trim, fitted.top + trim
            transforms.append(replace(fitted, width=to[0], height=to[1], left=left, top=top))
    return list(dict.fromkeys(transforms))


def _grey(picture: np.ndarray, size: Size) -> np.ndarray:
    """Return the mean of the colours of a picture ``[h,w,3]`` at a smaller size, as one row."""
    return cv2.resize(picture.mean(2, dtype=np.float32), size, interpolation=cv2.INTER_AREA).reshape(-1)
