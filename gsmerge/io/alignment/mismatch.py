"""Why Gaussians and cameras do not belong together, and what to say then."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gsmerge.errors import SceneError
from gsmerge.io.alignment.poses import other_conventions
from gsmerge.io.alignment.score import Alignment, check_alignment, check_pairs, pixel_limit, sample_pixels
from gsmerge.io.alignment.similarity import Correspondences, candidate_similarities, pixel_errors, solve_pose
from gsmerge.io.cameras.camera_file import C2W_OPENGL, CameraFile, Convention, with_poses
from gsmerge.io.formats.ply import PlyInfo
from gsmerge.io.photos import ASPECT_TOLERANCE
from gsmerge.types import Cameras, Gaussians


def count_problem(ply: PlyInfo, cameras: Cameras) -> str:
    """That the number of rows is not that of the pixels."""
    views, width, height = len(cameras), cameras.width, cameras.height
    return (
        f"expected one Gaussian per pixel, {views} x {height} x {width} = {views * height * width} "
        f"(views x height x width), found {ply.count}"
    )


def count_remedy(count: int, cameras: Cameras) -> str:
    """Which simple reading the number of Gaussians has instead."""
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


def misalignment_error(camera_file: CameraFile, alignment: Alignment, reason: str | None) -> SceneError:
    """That the rows would be enough, but do not lie on the rays of their pixels."""
    problem = (
        f"expected every view's Gaussians within {alignment.limit_px:g} px of their own pixels, "
        f"found a median of up to {alignment.worst_px:.1f} px and "
        f"{100 * alignment.share_in_front:.0f} % in front of their camera"
    )
    unknown = "no other convention fits either: give the cameras that belong to the .ply"
    return SceneError(camera_file.path, problem, f"{reason}: convert one to the other" if reason else unknown)


def explain_misalignment(
    gaussians: Gaussians, cameras: Cameras, valid: Tensor, convention: Convention = C2W_OPENGL
) -> str | None:
    """The other reading of the cameras or of the row order under which the scene would fit, in words; None without any.

    Gaussians, cameras (read under ``convention``) and ``valid`` are as for :func:`check_alignment`.
    """
    pairs = sample_pixels(gaussians, cameras, valid)
    for reason, viewmats in _other_viewmats(pairs, cameras, convention):
        if check_pairs(pairs, with_poses(cameras, viewmats)).ok:
            return reason
    for reason, order in _other_orders(len(cameras), cameras.height, cameras.width):
        if check_alignment(gaussians[order], cameras, valid.reshape(-1)[order]).ok:
            return reason
    swapped = replace(cameras, width=cameras.height, height=cameras.width)
    if check_alignment(gaussians, swapped, valid).ok:
        return "the cameras fit with width and height swapped"
    return None


def looks_like_a_grid(gaussians: Gaussians, valid: Tensor, cameras: Cameras) -> bool:
    """Whether the first view's rows are pixels of some camera, if not of the given one: wrong cameras, then."""
    pairs, K = sample_pixels(gaussians, cameras, valid), cameras.Ks.double().numpy()[:1]
    pairs = pairs.select(pairs.views == 0)
    pose = solve_pose(pairs, 0, K[0])
    if pose is None:
        return False
    # the intrinsics may be what is wrong: a pose that takes most of it up is enough
    limit = 4 * pixel_limit(cameras.width, cameras.height)
    return bool(np.median(pixel_errors(pairs, pose[None], K)) < limit)


def _other_viewmats(
    pairs: Correspondences, cameras: Cameras, convention: Convention
) -> Iterator[tuple[str, np.ndarray]]:
    given = cameras.viewmats.double().numpy()
    for poses in other_conventions(given, convention):
        yield poses.describe(convention), poses.viewmats
    transposed = given.copy()
    transposed[:, :3, :3] = given[:, :3, :3].transpose(0, 2, 1)
    transposed[:, :3, 3] = -np.einsum("vij,vj->vi", transposed[:, :3, :3], cameras.centres.double().numpy())
    yield "the cameras fit with their rotations transposed", transposed
    for axis, words in ((1, "y axis flipped (rows counted from the bottom)"), (0, "x axis flipped (mirrored images)")):
        mirrored = given.copy()
        mirrored[:, axis] *= -1
        yield f"the cameras fit with the {words}", mirrored
    frames = candidate_similarities(pairs, given, cameras.Ks.double().numpy(), effort=1)
    scaled = next((frame for frame in frames if frame.kind == "scaled"), None)
    if scaled is not None:
        yield f"the cameras fit with their {scaled.description}", scaled.move_viewmats(given)


def _other_orders(views: int, height: int, width: int) -> Iterator[tuple[str, Tensor]]:
    """Permutations that bring rows of another order into view-major, row-major order."""
    rows = torch.arange(views * height * width)
    by_pixel, by_column = rows.reshape(height, width, views), rows.reshape(views, width, height)
    yield "the rows fit in the order row, column, view (view fastest)", by_pixel.permute(2, 0, 1).reshape(-1)
    yield "the rows fit in the order view, column, row (column-major)", by_column.permute(0, 2, 1).reshape(-1)
    yield "the rows fit with the views in reverse order", rows.reshape(views, -1).flip(0).reshape(-1)
