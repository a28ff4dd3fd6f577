"""Draw pictures that show people several scenes from the same cameras, side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsmerge.drawing.camera_path import outside_camera
from gsmerge.errors import SceneError
from gsmerge.io import atomic_output
from gsmerge.io.image_names import mark_drawn
from gsmerge.method.raster import render
from gsmerge.method.raster.metrics import psnr, psnr_words
from gsmerge.method.raster.photos import COVERED_TRANSMITTANCE, NEAR_PLANE, WHOLE_SHARE
from gsmerge.types import Cameras, Gaussians

BytePicture = NDArray[np.uint8]  # [h,w,3], sRGB
FACE = cv2.FONT_HERSHEY_SIMPLEX
MAX_SIDES = {".webp": 16383, ".jpg": 65500, ".jpeg": 65500}  # largest side that a format or its encoder takes, pixels
# Height of the label above a picture that is narrower than twice LABEL_WIDTH, pixels. For wider pictures this height is
# multiplied by a whole number
LABEL_HEIGHT = 22
LABEL_WIDTH = 640
LABEL_LEVEL = 32  # grey level of labels, and of cells without a photo
GAP_PIXELS = 4  # pixels between pictures
CHEQUER_LEVELS = 0.4, 0.6  # of the squares of a chequered ground
OUTSIDE_VIEW = "step back"  # name of the outside view


def to_picture(image: np.ndarray) -> BytePicture:
    """Convert a picture ``[h,w,3]``, float in [0, 1], to 8 bits.

    The colours of a transparent picture ``[h,w,4]`` are divided by its alpha, as files store them.
    """
    if image.shape[-1] == 4:
        alpha = image[..., 3:]
        image = np.concatenate([image[..., :3] / np.maximum(alpha, np.float32(1e-6)), alpha], -1)
    return (image.clip(0, 1) * 255).round().astype(np.uint8)


def lay_on_chequer(image: np.ndarray, transmittance: np.ndarray) -> np.ndarray:
    """Lay a picture ``[h,w,3]`` on a chequered ground, which shows where nothing is; float in [0, 1].

    Colours are multiplied by alpha; ``transmittance [h,w]`` is 1 - alpha.
    """
    side = max(8, image.shape[1] // 48)  # of a square, pixels
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    ground = np.where((rows // side + columns // side) % 2, *CHEQUER_LEVELS) * transmittance
    return np.asarray(image + ground[..., None].astype(np.float32))


def save_picture(path: Path, picture: BytePicture, *, overwrite: bool = True) -> None:
    """Write a picture ``[h,w,3]``, or ``[h,w,4]`` with alpha, in the format of the file name.

    SceneError if a side is too long for the format.
    """
    max_side = MAX_SIDES.get(path.suffix.lower(), math.inf)
    height, width = picture.shape[:2]
    if max(height, width) > max_side:
        problem = f"expected at most {max_side:,} pixels per side of a {path.suffix}, got {width} x {height}"
        raise SceneError(path, problem, "name a .png, or lower --size")
    channels = [2, 1, 0, 3][: picture.shape[-1]]  # the order of OpenCV
    _, data = cv2.imencode(path.suffix, np.ascontiguousarray(picture[..., channels]))
    with atomic_output(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(mark_drawn(data.tobytes()))


def label(picture: BytePicture, text: str) -> BytePicture:
    """Put a dark band with one line of text above a picture; shorten the text to fit."""
    factor = max(1, picture.shape[1] // LABEL_WIDTH)
    scale = 0.42 * factor
    text = shorten_text(text, picture.shape[1] - 8, scale, factor)
    band = np.full((factor * LABEL_HEIGHT, picture.shape[1], 3), LABEL_LEVEL, np.uint8)
    cv2.putText(band, text, (4, factor * (LABEL_HEIGHT - 7)), FACE, scale, (235, 235, 235), factor, cv2.LINE_AA)
    return np.concatenate([band, picture])


def shorten_text(text: str, width: int, scale: float, thickness: int) -> str:
    """Shorten a text that OpenCV would draw, with ``scale`` and ``thickness``, wider than ``width`` pixels.

    Parts of the text, which commas separate, are left out from the last on. If the first part alone is too wide, dots
    replace its middle.
    """

    def fits(text: str) -> bool:
        """Return whether OpenCV draws a text within ``width``."""
        return bool(cv2.getTextSize(text, FACE, scale, thickness)[0][0] <= width)

    text = text.encode("utf-8", "replace").decode()  # lone surrogates would crash OpenCV
    while ", " in text and not fits(text):
        text = text.rpartition(", ")[0]
    cut = (f"{text[: kept - kept // 2]}...{text[len(text) - kept // 2 :]}" for kept in range(len(text) - 1, 1, -1))
    return next(filter(fits, (text, *cut)), text[:1])


def view_pictures(
    scenes: Sequence[tuple[str, Gaussians]],
    cameras: Cameras,
    photos: Sequence[np.ndarray | None] | None = None,
    names: Sequence[str] | None = None,
    *,
    masks: Sequence[np.ndarray] | None = None,
    marks: Sequence[bool | None] | None = None,
    background: float | None = 0.0,
    near: float = NEAR_PLANE,
) -> list[list[tuple[str, BytePicture]]]:
    """Render each scene in every view; return a row of pictures for each view, each with a line of text.

    A row begins with the photo ``[h,w,3]``, or with a dark picture if the photo is None. If ``photos`` is None, rows
    have scenes only. The text of a photo has the name of the view. The text of a render has the scene's name, its
    number of Gaussians, and the PSNR against the photo or, if ``photos`` is None, against the render of the first
    scene. ``masks [h,w]`` say which pixels of the photos count; None: all. ``marks`` say which scenes are drawn
    antialiased; None: as the cameras say. If ``background`` is None, pictures lie on a chequered ground, and PSNR are
    measured where the first scene shows something. ``near`` is the depth of the near plane.
    """
    drawn = [
        render(gaussians, cameras, background or 0.0, antialiased=mark, near=near)
        for (_, gaussians), mark in zip(scenes, marks or [None] * len(scenes), strict=True)
    ]
    renders = [one.images.clip(0, 1) for one in drawn]
    views = []
    for row, view in enumerate(names or [f"view {i}" for i in range(len(cameras))]):
        columns = [(f"{name}: {len(g):,}", images[row]) for (name, g), images in zip(scenes, renders, strict=True)]
        photo = None if photos is None else photos[row]
        if photo is not None:
            columns.insert(0, (f"{view}, photo", photo))
        elif photos is not None:
            columns.insert(0, (f"{view}: no photo", np.full_like(renders[0][row], LABEL_LEVEL / 255)))
        if photo is not None or photos is None:
            (_, reference), *compared = columns
            name = "the photo" if photos is not None else scenes[0][0]
            covered = 1 - drawn[0].alphas[row, ..., 0] < COVERED_TRANSMITTANCE
            mask = covered if background is None and 0 < covered.mean() < WHOLE_SHARE else None
            name += "" if mask is None else ", where the scene is"
            if masks is not None and photo is not None and not masks[row].all():
                mask = masks[row]
                name = "the photo, where it counts"
            columns[1:] = [(f"{text}, {psnr_words(psnr(im, reference, mask))} to {name}", im) for text, im in compared]
        if background is None:
            shown = [lay_on_chequer(one.images[row], 1 - one.alphas[row, ..., 0]) for one in drawn]
            columns[-len(scenes) :] = [(text, im) for (text, _), im in zip(columns[-len(scenes) :], shown, strict=True)]
        views.append([(text, to_picture(image)) for text, image in columns])
    return views


def outside_pictures(
    scenes: Sequence[tuple[str, Gaussians]],
    cameras: Cameras,
    *,
    photos: bool,
    marks: Sequence[bool | None] | None = None,
    background: float | None = 0.0,
    near: float = NEAR_PLANE,
) -> list[tuple[str, BytePicture]]:
    """Render each scene from outside the capture; return a row of pictures, each with a line of text.

    The row fits below the rows of :func:`view_pictures`. If these rows begin with ``photos``, the row from outside
    begins with a dark picture, because there is no photo from outside. ``marks``, ``background`` and
    ``near`` are those of :func:`view_pictures`.
    """
    camera, _ = outside_camera(cameras, scenes[0][1].means)
    renders = []
    for (name, gaussians), mark in zip(scenes, marks or [None] * len(scenes), strict=True):
        drawn = render(gaussians, camera, background or 0.0, antialiased=mark, near=near)
        image = drawn.images[0]
        if background is None:
            image = lay_on_chequer(image, 1 - drawn.alphas[0, ..., 0])
        renders.append((f"{name}: {OUTSIDE_VIEW}", to_picture(image)))
    return ([(f"{OUTSIDE_VIEW}: no photo", np.full_like(renders[0][1], LABEL_LEVEL))] if photos else []) + renders


def contact_sheet(views: Sequence[Sequence[tuple[str, BytePicture]]], *, min_width: int = 320) -> BytePicture:
    """Arrange pictures with their texts in a sheet that has a row for each view.

    Pictures narrower than ``min_width`` pixels are enlarged by a whole factor.
    """
    factor = max(1, -(-min_width // views[0][0][1].shape[1]))
    rows = []
    for pictures in views:
        tiles = [(text, np.repeat(np.repeat(picture, factor, 0), factor, 1)) for text, picture in pictures]
        rows.append(_join_with_gaps([label(picture, text) for text, picture in tiles], axis=1))
    return _join_with_gaps(rows, axis=0)


def _join_with_gaps(pictures: Sequence[BytePicture], axis: int) -> BytePicture:
    """Join pictures along an axis, 0 for a column and 1 for a row, with white gaps between them."""
    shape = list(pictures[0].shape)
    shape[axis] = GAP_PIXELS
    gap = np.full(shape, 255, np.uint8)
    with_gaps = [array for picture in pictures for array in (gap, picture)][1:]
    return np.concatenate(with_gaps, axis)
