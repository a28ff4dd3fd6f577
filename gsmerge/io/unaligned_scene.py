"""Scenes whose Gaussians belong to no pixels: which rows are Gaussians, and which cameras see them."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsmerge.errors import SceneError
from gsmerge.io.alignment.fit_cameras import CameraFit
from gsmerge.io.alignment.layouts import MAY_BE_UNALIGNED
from gsmerge.io.alignment.mismatch import (
    count_problem,
    count_remedy,
    explain_misalignment,
    looks_like_a_grid,
    misalignment_error,
)
from gsmerge.io.alignment.poses import check_cameras, choose_poses
from gsmerge.io.alignment.recover import recover
from gsmerge.io.alignment.rotations import from_xyzw
from gsmerge.io.alignment.score import AlignmentInput, check_alignment
from gsmerge.io.alignment.similarity import IDENTITY, scale_by
from gsmerge.io.cameras.camera_file import CameraFile, with_convention, with_poses
from gsmerge.io.cameras.nerfstudio import NAME as DATAPARSER
from gsmerge.io.cameras.nerfstudio import find_dataparser, read_dataparser
from gsmerge.io.formats.ply import PlyScene
from gsmerge.io.hints import ReadHints
from gsmerge.io.scene_files import SceneFiles
from gsmerge.io.views import limit_view_size
from gsmerge.types import Cameras, Gaussians, UnalignedScene

MIN_PADDING = 16  # equal rows at the origin: fewer may be Gaussians


def make_unaligned(
    ply: PlyScene, files: SceneFiles, fit: CameraFit, hints: ReadHints
) -> tuple[UnalignedScene, CameraFile, str, list[str]]:
    """The scene, if the cameras see its Gaussians; its cameras as they were read, why it has no pixels, and notes.
    SceneError if they do not, or if other cameras or another reading of them would make it one with pixels.
    """
    inputs, camera_file, cameras = fit.inputs, fit.camera_file, fit.inputs.cameras
    problem, remedy = count_problem(ply.info, cameras), count_remedy(ply.info.count, cameras)
    if inputs.order not in MAY_BE_UNALIGNED:
        if len(ply.gaussians) == len(cameras) * cameras.width * cameras.height:
            alignment = check_alignment(ply.gaussians, cameras, ply.valid)
            reason = explain_misalignment(ply.gaussians, cameras, ply.valid, camera_file.convention)
            if reason or looks_like_a_grid(ply.gaussians, ply.valid, cameras):
                raise misalignment_error(camera_file, alignment, reason)
            problem = f"expected one Gaussian per pixel, found {ply.info.count} rows that are in no known order"
        if _lacks_cameras(inputs):
            raise SceneError(ply.info.path, problem, remedy)
    if inputs.scale is not None:
        cameras = with_poses(cameras, scale_by(inputs.scale).move_viewmats(inputs.viewmats))
    inputs = replace(inputs, cameras=cameras)
    cameras, camera_file, notes = _choose_cameras(files, camera_file, inputs, SceneError(files.ply, problem, remedy))
    cameras, images, smaller = limit_view_size(cameras, inputs.images, hints.max_side)
    gaussians, padding = usable_rows(ply, hints)
    text = "the rows belong to no pixels that could be found: unaligned"
    if hints.exporter != "auto":
        text += f"; only the layouts of {hints.exporter} were tried, as given; --exporter auto tries all"
    scene = UnalignedScene(gaussians, cameras, images, camera_file.names)
    return scene, camera_file, problem, [*notes, *smaller, *padding, text]


def _lacks_cameras(inputs: AlignmentInput) -> bool:
    """Whether the first views are in order, and there are more of them than cameras."""
    count, each = len(inputs.gaussians), inputs.cameras.width * inputs.cameras.height
    pixels = len(inputs.cameras) * each
    if count <= pixels or count % each:
        return False
    first = replace(inputs, gaussians=inputs.gaussians[:pixels], valid=inputs.valid[:pixels], order="view-major")
    return recover(first) is not None


def _choose_cameras(
    files: SceneFiles, camera_file: CameraFile, inputs: AlignmentInput, why: SceneError
) -> tuple[Cameras, CameraFile, list[str]]:
    """Cameras that see the Gaussians: as they are, moved as nerfstudio does, or read in another convention; and notes.
    SceneError if none of these does, with the reason why there are no pixels.
    """
    cameras = inputs.cameras
    moved = _move_by_dataparser(files, inputs)
    if moved is not None:
        notes = [f"the cameras are moved into the Gaussians' frame by {DATAPARSER}"]
        return moved, replace(camera_file, viewmats=moved.viewmats), notes
    poses, check, note = choose_poses(inputs.gaussians, inputs.valid, cameras, inputs.images, camera_file.convention)
    if not check.ok:
        raise SceneError(why.path, f"{why.problem}; {check.description}", why.remedy)
    if poses is None:
        return cameras, camera_file, [note] if note else []
    notes = [f"{poses.describe(camera_file.convention)}: read so"]
    return with_poses(cameras, poses.viewmats), with_convention(camera_file, poses.convention), notes


def _move_by_dataparser(files: SceneFiles, inputs: AlignmentInput) -> Cameras | None:
    """The cameras in nerfstudio's frame, if there is its file and they see the Gaussians better there."""
    path = find_dataparser(files)
    if path is None:
        return None
    frames = [IDENTITY, *read_dataparser(path, files.cameras)]
    moved = [with_poses(inputs.cameras, frame.move_viewmats(inputs.viewmats)) for frame in frames]
    stay, *checks = (check_cameras(inputs.gaussians, inputs.valid, cameras, inputs.images) for cameras in moved)
    best = max(checks, key=lambda check: check.score)
    return moved[1 + checks.index(best)] if best.ok and best.score > stay.score else None


def usable_rows(ply: PlyScene, hints: ReadHints) -> tuple[Gaussians, list[str]]:
    """The finite rows without those that only pad a file; and a note about these."""
    keep = ply.valid & ~is_padding(ply.gaussians)
    count = int(ply.valid.sum()) - int(keep.sum())
    gaussians = ply.gaussians[keep]
    if hints.quats == "xyzw":
        gaussians = replace(gaussians, quats=from_xyzw(gaussians.quats))
    return gaussians, [f"{count:,} rows that only fill the file up are left out"] if count else []


def is_padding(gaussians: Gaussians) -> Tensor:
    """``[n]`` bool: rows at the very origin that are all alike, with which VolSplat fills up its files."""
    rows = torch.nonzero((gaussians.means == 0).all(1))[:, 0]
    padding = torch.zeros(len(gaussians), dtype=torch.bool)
    if len(rows) < MIN_PADDING:
        return padding
    shape = torch.cat([gaussians.scales, gaussians.opacities[:, None], gaussians.sh0[:, 0]], 1)[rows]
    padding[rows[(shape == shape.median(0).values).all(1)]] = True
    return padding
