"""Explain why rows are no pixels: their number, or another convention, order or size under which they would be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.alignment.cameras import other_conventions
from gsmerge.alignment.layouts import MAY_BE_UNALIGNED
from gsmerge.alignment.recovery import recover
from gsmerge.alignment.score import (
    Alignment,
    AlignmentInput,
    candidate_similarities,
    check_alignment,
    check_pairs,
    pixel_errors,
    sample_pixels,
    solve_pose,
)
from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import CameraFile, Convention
from gsmerge.io.formats.ply import PlyInfo
from gsmerge.io.photo_files import ASPECT_TOLERANCE
from gsmerge.kernels.matrices import matmul
from gsmerge.types import Cameras, Gaussians


def explain_count(ply: PlyInfo, inputs: AlignmentInput, camera_file: CameraFile) -> SceneError:
    """Make the SceneError of rows that are no pixels; raise it where other cameras would make pixels of them."""
    cameras, count = inputs.cameras, len(inputs.gaussians)
    views, width, height = len(cameras), cameras.width, cameras.height
    expected = f"{views} x {height} x {width} = {views * height * width} (views x height x width)"
    problem = f"expected one Gaussian per pixel, {expected}, found {ply.count}"
    if inputs.order not in MAY_BE_UNALIGNED:
        if count == views * width * height:
            rows = inputs.gaussians, cameras, inputs.valid
            alignment = check_alignment(*rows)
            reason = explain_misalignment(*rows, camera_file.convention)
            pairs = sample_pixels(*rows)
            pairs = pairs.select(pairs.views == 0)
            pose = None if reason else solve_pose(pairs, 0, cameras.Ks[0])
            # a pose that takes up most of wrong intrinsics, too, shows that the rows are pixels of some camera
            posed = None if pose is None else replace(cameras[:1], viewmats=pose[None])
            is_grid = posed is not None and np.median(pixel_errors(pairs, posed)) < 4 * alignment.limit_px
            if reason or is_grid:
                raise misalignment_error(camera_file.path, alignment, reason)
            problem = f"expected one Gaussian per pixel, found {ply.count} rows that are in no known order"
        elif count > views * width * height and count % (width * height) == 0:
            size = views * width * height
            first = replace(inputs, gaussians=inputs.gaussians[:size], valid=inputs.valid[:size], order="view-major")
            if recover(first) is not None:  # more views than cameras, the first in order
                raise SceneError(ply.path, problem, _count_remedy(ply.count, cameras))
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
        return "pixels were dropped or merged by the exporter, which is not supported"
    return "give the cameras and images that belong to it"


def misalignment_error(path: str, alignment: Alignment, reason: str | None) -> SceneError:
    """Make the SceneError of enough rows that lie on no pixels' rays, or as well on those of others."""
    if alignment.ok:
        problem = f"expected rows that fit the pixels in one way, found several that do, to {alignment.worst_px:.1f} px"
        return SceneError(path, problem, "name the order of the rows with --hint order=NAME")
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
    """Name another reading of cameras or row order under which the scene fits; None without one."""
    pairs = sample_pixels(gaussians, cameras, valid)
    given = cameras.viewmats
    frames = candidate_similarities(pairs, cameras, effort=1)
    others = [(poses.describe(convention), poses.viewmats) for poses in other_conventions(given, convention)]
    transposed = given.copy()
    transposed[:, :3, :3] = given[:, :3, :3].transpose(0, 2, 1)
    transposed[:, :3, 3] = -matmul(transposed[:, :3, :3], cameras.centres[:, :, None])[..., 0]
    others.append(("the cameras fit with their rotations transposed", transposed))
    flips = (1, "y axis flipped (rows counted from the bottom)"), (0, "x axis flipped (mirrored images)")
    for axis, words in flips:
        mirrored = given.copy()
        mirrored[:, axis] *= -1
        others.append((f"the cameras fit with the {words}", mirrored))
    scaled = [f for f in frames if f.kind == "scaled"]
    others += [(f"the cameras fit with their {f.description}", f.move_viewmats(given)) for f in scaled]
    for reason, viewmats in others:
        if check_pairs(pairs, replace(cameras, viewmats=viewmats)).ok:
            return reason
    views, height, width = len(cameras), cameras.height, cameras.width
    rows = np.arange(views * height * width)
    by_pixel, by_column = rows.reshape(height, width, views), rows.reshape(views, width, height)
    for reason, order in (
        ("in the order row, column, view (view fastest)", by_pixel.transpose(2, 0, 1)),
        ("in the order view, column, row (column-major)", by_column.transpose(0, 2, 1)),
        ("with the views in reverse order", rows.reshape(views, -1)[::-1]),
    ):
        order = order.reshape(-1)
        if check_alignment(gaussians[order], cameras, valid.reshape(-1)[order]).ok:
            return f"the rows fit {reason}"
    swapped = replace(cameras, width=cameras.height, height=cameras.width)
    if check_alignment(gaussians, swapped, valid).ok:
        return "the cameras fit with width and height swapped"
    return None
