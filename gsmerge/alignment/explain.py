"""Explain why rows are no pixels of their cameras: what their number is, or in what other way the cameras fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.alignment.cameras import describe_reading, other_conventions
from gsmerge.alignment.frames import ray_directions, scale_by, solve_frame, usual_frames
from gsmerge.alignment.layouts import MAY_BE_UNALIGNED, exact_layouts, plain_layout, subsample
from gsmerge.alignment.resection import projective_error
from gsmerge.alignment.score import (
    MAX_CHECKED,
    Alignment,
    AlignmentInput,
    check_alignment,
    check_pairs,
    find_correspondences,
    sample_pixels,
)
from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import CameraFile, Convention
from gsmerge.io.formats.read import FileInfo
from gsmerge.io.photo_files import ASPECT_TOLERANCE
from gsmerge.kernels.matrices import transform
from gsmerge.types import Cameras, Gaussians

_SOME_CAMERA = 4.0  # times the limit, within which rows are pixels of some camera
_ORDERS = {  # in which rows may be instead, by the order of their layout
    "view-fastest": "in the order row, column, view (view fastest)",
    "column-major": "in the order view, column, row (column-major)",
    "reversed": "with the views in reverse order",
}


def explain_count(ply: FileInfo, inputs: AlignmentInput, camera_file: CameraFile) -> SceneError:
    """Return the SceneError for rows that are not pixels, or raise it if the cameras rather than the rows are wrong."""
    cameras, count = inputs.cameras, len(inputs.gaussians)
    views, width, height = len(cameras), cameras.width, cameras.height
    expected = f"{views} x {height} x {width} = {views * height * width} (views x height x width)"
    problem = f"expected one Gaussian per pixel, {expected}, found {ply.count}"
    size = views * width * height
    if inputs.order not in MAY_BE_UNALIGNED and count == size:
        rows = inputs.gaussians, cameras, inputs.valid
        alignment, pairs = check_alignment(*rows), sample_pixels(*rows)
        reason = explain_misalignment(*rows, camera_file.convention)
        first = pairs.select(pairs.views == 0)
        if reason or projective_error(first.points, first.pixels) < _SOME_CAMERA * alignment.limit_px:
            raise misalignment_error(camera_file.path, alignment, reason)
        problem = f"expected one Gaussian per pixel, found {ply.count} Gaussians in no known order"
    elif inputs.order not in MAY_BE_UNALIGNED and count > size and count % (width * height) == 0:
        moved = (frame.move(cameras) for frame in usual_frames(cameras, inputs.scale))
        if any(check_alignment(inputs.gaussians[:size], each, inputs.valid[:size]).ok for each in moved):
            raise SceneError(ply.path, problem, _count_remedy(ply.count, cameras))  # more views than cameras
    return SceneError(ply.path, problem, _count_remedy(ply.count, cameras))


def _count_remedy(count: int, cameras: Cameras) -> str:
    """Name the simple reading that the number of Gaussians has instead."""
    views, width, height = len(cameras), cameras.width, cameras.height
    pixels = width * height
    if count % (views * pixels) == 0:
        return f"that is {count // (views * pixels)} Gaussians per pixel"
    if count % pixels == 0:
        return f"that is {count // pixels} views of this size: give the cameras of just those"
    if count == views * (width - 16) * (height - 16):
        return f"that is {height - 16} x {width - 16} per view: 8 pixels were trimmed at every border"
    each = count / views
    guess = round((each * width / height) ** 0.5)
    for w in range(max(1, guess - 14), guess + 15):
        h = each / w
        if h == round(h) and h and abs(w * height / (h * width) - 1) < ASPECT_TOLERANCE:
            return f"that is {round(h)} x {w} per view: give cameras and images of that size"
    if count < views * pixels:
        return "pixels were dropped or merged: give cameras in the frame of the file, or export all pixels"
    return "give the cameras and images that belong to it"


def misalignment_error(path: str, alignment: Alignment, reason: str | None) -> SceneError:
    """Make the SceneError for rows as many as pixels, which fit no layout or several."""
    if alignment.ok:
        found = f"several that do, to {alignment.worst_px:.1f} px"
        problem = f"expected one order of the Gaussians that fits the pixels, found {found}"
        return SceneError(path, problem, "name their order with --hint order=NAME")
    problem = (
        f"expected every view's Gaussians within {alignment.limit_px:g} px of their own pixels, "
        f"found a median of up to {alignment.worst_px:.1f} px and "
        f"{100 * alignment.share_in_front:.0f} % in front of their camera"
    )
    unknown = "no other convention fits either: give the cameras that belong to the Gaussians"
    return SceneError(path, problem, f"{reason}: convert one to the other" if reason else unknown)


def explain_misalignment(
    gaussians: Gaussians, cameras: Cameras, valid: np.ndarray, convention: Convention
) -> str | None:
    """Name another convention of the cameras, or order of the rows, that fits the scene; None if none does."""
    pairs = sample_pixels(gaussians, cameras, valid)
    input_viewmats = cameras.viewmats
    readings = [
        (describe_reading(poses.convention, convention), poses.viewmats)
        for poses in other_conventions(input_viewmats, convention)
    ]
    transposed = input_viewmats.copy()
    transposed[:, :3, :3] = input_viewmats[:, :3, :3].transpose(0, 2, 1)
    transposed[:, :3, 3] = -transform(transposed[:, :3, :3], cameras.centres)
    readings.append(("the cameras fit with their rotations transposed", transposed))
    flips = (1, "y axis flipped (rows counted from the bottom)"), (0, "x axis flipped (mirrored images)")
    for axis, words in flips:
        mirrored = input_viewmats.copy()
        mirrored[:, axis] *= -1
        readings.append((f"the cameras fit with the {words}", mirrored))
    frame = solve_frame(pairs.points, ray_directions(pairs, cameras), np.eye(3), shifted=False)
    if frame is not None:
        text = f"the cameras fit with their {scale_by(frame.scale).description}"
        readings.append((text, frame.move_viewmats(input_viewmats)))
    for reason, viewmats in readings:
        if check_pairs(pairs, replace(cameras, viewmats=viewmats)).ok:
            return reason
    size = len(cameras), cameras.width, cameras.height
    full = [grid for grid in exact_layouts(len(gaussians), *size) if grid.kind == "full" and grid.per_pixel == 1]
    plain = plain_layout(*size)
    for layout in (*full, replace(plain, order="reversed", views=plain.views[::-1])):
        pairs = find_correspondences(gaussians.means, valid.reshape(-1), subsample(layout, MAX_CHECKED))
        if layout.order in _ORDERS and check_pairs(pairs, cameras).ok:
            return f"the Gaussians fit {_ORDERS[layout.order]}"
    swapped = replace(cameras, width=cameras.height, height=cameras.width)
    if check_alignment(gaussians, swapped, valid).ok:
        return "the cameras fit with width and height swapped"
    return None
