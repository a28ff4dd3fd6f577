"""Explain in one sentence, with a remedy, why rows are not the pixels of their cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.alignment.cameras import describe_other_convention, other_conventions
from gsmerge.alignment.layouts import MAY_BE_UNALIGNED, exact_layouts, subsample
from gsmerge.alignment.resection import projective_error
from gsmerge.alignment.score import (
    MAX_CHECKED,
    Alignment,
    AlignmentInput,
    check_pairs,
    find_correspondences,
    sample_pixels,
)
from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import CameraFile, Convention
from gsmerge.io.formats.read import FileInfo
from gsmerge.types import Cameras, Gaussians

_SOME_CAMERA = 4.0  # rows nearer than this multiple of the limit are the pixels of some projective camera
_ORDERS = {  # other orders of rows in words, by the order of the layout
    "view-fastest": "row, column, view (view fastest)",
    "column-major": "view, column, row (column-major)",
}


def describe_lost_order(ply: FileInfo, cameras: Cameras) -> list[str]:
    """Note rows that are as many as the pixels of the cameras, but in no known order; other files have no pixels."""
    if ply.count != len(cameras) * cameras.width * cameras.height:
        return []
    text = "one for each pixel of the views, but in no known order"
    return [f"the file has {ply.count:,} rows, {text}: depths are not compared between views"]


def count_error(ply: FileInfo, cameras: Cameras) -> SceneError:
    """Make the SceneError for rows that are not the pixels of the cameras."""
    views, width, height = len(cameras), cameras.width, cameras.height
    expected = f"{views} x {height} x {width} = {views * height * width} (views x height x width)"
    actual = f"{ply.count} in no known order" if ply.count == views * height * width else str(ply.count)
    problem = f"expected one Gaussian per pixel, {expected}, found {actual}"
    return SceneError(ply.path, problem, "give the cameras of their views, in the frame of the Gaussians")


def check_frame(inputs: AlignmentInput, camera_file: CameraFile) -> None:
    """Raise SceneError if the rows are in order the pixels of some cameras, but not of the file's cameras."""
    cameras = inputs.cameras
    if inputs.order in MAY_BE_UNALIGNED or len(inputs.gaussians) != len(cameras) * cameras.width * cameras.height:
        return
    pairs = sample_pixels(inputs.gaussians, cameras, inputs.valid)
    alignment, first_view = check_pairs(pairs, cameras), pairs.select(pairs.views == 0)
    if projective_error(first_view.points, first_view.pixels) < _SOME_CAMERA * alignment.limit_px:
        raise misalignment_error(camera_file.path, alignment, None)


def misalignment_error(path: str, alignment: Alignment, reason: str | None) -> SceneError:
    """Make the SceneError for rows that are as many as the pixels and fit no layout, or several if ``alignment`` is ok.

    ``reason``: another convention or order that fits, see :func:`explain_misalignment`.
    """
    if alignment.ok:
        problem = (
            "expected one order of the Gaussians that fits the pixels, found several that fit within"
            f" {alignment.worst_px:.1f} px"
        )
        return SceneError(path, problem, "name their order with --hint order=NAME")
    percent = f"{100 * alignment.share_in_front:.0f}"
    in_front = "" if percent == "100" else f" and only {percent} % in front of their camera"
    problem = (
        f"expected every view's Gaussians within {alignment.limit_px:g} px of their own pixels, "
        f"found a median of up to {alignment.worst_px:.1f} px{in_front}"
    )
    unknown = "no other convention fits either: give the cameras that belong to the Gaussians"
    return SceneError(path, problem, f"{reason}: convert one to the other" if reason else unknown)


def explain_misalignment(
    gaussians: Gaussians, cameras: Cameras, valid: np.ndarray, convention: Convention
) -> str | None:
    """Describe another convention of the cameras or another order of the rows that fits; None if none fits."""
    pairs = sample_pixels(gaussians, cameras, valid)
    for poses in other_conventions(cameras.viewmats, convention):
        if check_pairs(pairs, replace(cameras, viewmats=poses.viewmats)).ok:
            return describe_other_convention(poses.convention, convention)
    for layout in exact_layouts(len(gaussians), len(cameras), cameras.width, cameras.height):
        pairs = find_correspondences(gaussians.means, valid.reshape(-1), subsample(layout, MAX_CHECKED))
        if layout.kind == "full" and layout.order in _ORDERS and check_pairs(pairs, cameras).ok:
            return f"the Gaussians fit in the order {_ORDERS[layout.order]}"
    return None
