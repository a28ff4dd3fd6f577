"""Explain in one sentence, with a remedy, why rows are not the pixels of their cameras."""

from __future__ import annotations

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.reading.alignment.resection import projective_error
from gsmerge.reading.alignment.score import Alignment, AlignmentInput, check_pairs, sample_pixels
from gsmerge.reading.alignment.unaligned import MAX_FRONT_RATIO, MIRRORED, UNMIRROR, check_cameras, is_mirrored
from gsmerge.types import Cameras, Gaussians


def refuse_other_cameras(inputs: AlignmentInput, camera_file: CameraFile) -> None:
    """Raise SceneError if the rows are all pixels in order, but not the pixels of most of the file's cameras.

    If the photos have the colours of the rows, no error is raised, because the views may just be in another order.
    """
    cameras = inputs.cameras
    if len(inputs.gaussians) != len(cameras) * cameras.width * cameras.height:
        return  # the rows cannot be all pixels in order
    pairs = sample_pixels(inputs.gaussians, cameras, inputs.valid)
    alignment = check_pairs(pairs, cameras)
    first_view = pairs.select(pairs.views == 0)
    if float(np.nanmedian([*alignment.median_px, np.inf])) < alignment.limit_px:
        return  # most of the cameras fit
    max_multiple = 4.0  # rows nearer than this multiple of the limit are the pixels of some projective camera
    are_pixels = projective_error(first_view.points, first_view.pixels) < max_multiple * alignment.limit_px
    check = check_cameras(inputs.gaussians, inputs.valid, cameras, inputs.images, foremost=True)
    if are_pixels and not check.color_ratio <= MAX_FRONT_RATIO:
        if is_mirrored(inputs):
            raise SceneError(camera_file.path, f"expected cameras of the Gaussians, found {MIRRORED}", UNMIRROR)
        raise misalignment_error(camera_file.path, alignment, None)


def misalignment_error(path: str, alignment: Alignment, reason: str | None) -> SceneError:
    """Make the SceneError for rows that do not lie in the pixels, although there are as many rows as pixels.

    ``reason`` names another order of rows that fits, see :func:`explain_misalignment`; None if no order fits.
    """
    percent = f"{100 * alignment.share_in_front:.0f}"
    in_front = "" if percent == "100" else f" and only {percent} % in front of their camera"
    problem = (
        f"expected every view's Gaussians within {alignment.limit_px:g} px of their own pixels, "
        f"found a median of up to {alignment.worst_px:.1f} px{in_front}"
    )
    unknown = "no other convention fits either: give the cameras that belong to the Gaussians"
    return SceneError(path, problem, f"{reason}: convert one to the other" if reason else unknown)


def explain_misalignment(gaussians: Gaussians, cameras: Cameras, valid: np.ndarray) -> str | None:
    """Describe another order, in which the rows would be the pixels of the cameras; None if no order fits.

    ``valid [n]`` is True for rows that are visible Gaussians.
    """
    views = len(cameras)
    width = cameras.width
    height = cameras.height
    rows = np.arange(len(gaussians))
    orders = {
        "row, column, view (view fastest)": rows.reshape(height, width, views).transpose(2, 0, 1),
        "view, column, row (column-major)": rows.reshape(views, width, height).transpose(0, 2, 1),
    }
    for name, grid in orders.items():
        order = grid.reshape(-1)
        if check_pairs(sample_pixels(gaussians[order], cameras, valid.reshape(-1)[order]), cameras).ok:
            return f"the Gaussians fit in the order {name}"
    return None
