"""Scenes whose Gaussians belong to no pixels: which rows are Gaussians, which cameras see them, and what is wrong."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import lower_median
from gsmerge.io.alignment.fit_cameras import CameraFit
from gsmerge.io.alignment.layouts import MAY_BE_UNALIGNED
from gsmerge.io.alignment.poses import check_cameras, choose_poses, other_conventions
from gsmerge.io.alignment.recover import recover
from gsmerge.io.alignment.rotations import from_xyzw
from gsmerge.io.alignment.score import Alignment, AlignmentInput, check_alignment, check_pairs, sample_pixels
from gsmerge.io.alignment.similarity import IDENTITY, candidate_similarities, pixel_errors, scale_by, solve_pose
from gsmerge.io.cameras.camera_file import CameraFile, Convention, with_convention
from gsmerge.io.cameras.json_files import DATAPARSER, find_dataparser, read_dataparser
from gsmerge.io.formats.ply import PlyInfo, PlyScene
from gsmerge.io.hints import ReadHints
from gsmerge.io.photos import ASPECT_TOLERANCE
from gsmerge.io.scene_files import SceneFiles
from gsmerge.io.views import limit_view_size
from gsmerge.types import Cameras, Gaussians, Scene

MIN_PADDING = 16  # equal rows at the origin: fewer may be Gaussians


def make_unaligned(
    ply: PlyScene, files: SceneFiles, fit: CameraFit, hints: ReadHints
) -> tuple[Scene, CameraFile, str, list[str]]:
    """The scene, if the cameras see its Gaussians; its cameras as they were read, why it has no pixels, and notes.
    SceneError if they do not, or if other cameras or another reading of them would make it one with pixels.
    """
    inputs, camera_file, cameras = fit.inputs, fit.camera_file, fit.inputs.cameras
    problem, remedy = count_problem(ply.info, cameras), count_remedy(ply.info.count, cameras)
    if inputs.order not in MAY_BE_UNALIGNED:
        if len(ply.gaussians) == len(cameras) * cameras.width * cameras.height:
            alignment = check_alignment(ply.gaussians, cameras, ply.valid)
            reason = explain_misalignment(ply.gaussians, cameras, ply.valid, camera_file.convention)
            if reason or looks_like_a_grid(ply.gaussians, ply.valid, cameras, 4 * alignment.limit_px):
                raise misalignment_error(camera_file.path, alignment, reason)
            problem = f"expected one Gaussian per pixel, found {ply.info.count} rows that are in no known order"
        if _lacks_cameras(inputs):
            raise SceneError(ply.info.path, problem, remedy)
    if inputs.scale is not None:
        cameras = replace(cameras, viewmats=scale_by(inputs.scale).move_viewmats(cameras.viewmats))
    inputs = replace(inputs, cameras=cameras)
    cameras, camera_file, notes = _choose_cameras(files, camera_file, inputs, SceneError(files.ply, problem, remedy))
    cameras, images, smaller = limit_view_size(cameras, inputs.images, hints.max_side)
    gaussians, padding = usable_rows(ply, hints)
    text = "the rows belong to no pixels that could be found: unaligned"
    if hints.exporter != "auto":
        text += f"; only the layouts of {hints.exporter} were tried, as given; --hint exporter=auto tries all"
    scene = Scene(gaussians, cameras, images, None, camera_file.names)
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
    return replace(cameras, viewmats=poses.viewmats), with_convention(camera_file, poses.convention), notes


def _move_by_dataparser(files: SceneFiles, inputs: AlignmentInput) -> Cameras | None:
    """The cameras in nerfstudio's frame, if there is its file and they see the Gaussians better there."""
    path = find_dataparser(files)
    if path is None:
        return None
    frames = [IDENTITY, *read_dataparser(path, files.cameras)]
    moved = [replace(inputs.cameras, viewmats=frame.move_viewmats(inputs.cameras.viewmats)) for frame in frames]
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


def is_padding(gaussians: Gaussians) -> np.ndarray:
    """``[n]`` bool: rows at the very origin that are all alike, with which VolSplat fills up its files."""
    rows = np.flatnonzero((gaussians.means == 0).all(1))
    padding = np.zeros(len(gaussians), bool)
    if len(rows) < MIN_PADDING:
        return padding
    shape = np.concatenate([gaussians.scales, gaussians.opacities[:, None], gaussians.sh0[:, 0]], 1)[rows]
    padding[rows[(shape == lower_median(shape)).all(1)]] = True
    return padding


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


def misalignment_error(path: str, alignment: Alignment, reason: str | None) -> SceneError:
    """That the rows would be enough, but do not lie on the rays of their pixels, or as well on those of others."""
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
    """The other reading of the cameras or of the row order under which the scene would fit, in words; None without any.

    Gaussians, cameras (read under ``convention``) and ``valid`` are as for :func:`check_alignment`.
    """
    pairs = sample_pixels(gaussians, cameras, valid)
    given = cameras.viewmats
    frames = candidate_similarities(pairs, given, cameras.Ks, effort=1)
    scaled = [f for f in frames if f.kind == "scaled"]
    others = [(f"the cameras fit with their {f.description}", f.move_viewmats(given)) for f in scaled]
    for reason, viewmats in [*_other_viewmats(cameras, convention), *others]:
        if check_pairs(pairs, replace(cameras, viewmats=viewmats)).ok:
            return reason
    for reason, order in _other_orders(len(cameras), cameras.height, cameras.width):
        if check_alignment(gaussians[order], cameras, valid.reshape(-1)[order]).ok:
            return reason
    swapped = replace(cameras, width=cameras.height, height=cameras.width)
    if check_alignment(gaussians, swapped, valid).ok:
        return "the cameras fit with width and height swapped"
    return None


def looks_like_a_grid(gaussians: Gaussians, valid: np.ndarray, cameras: Cameras, limit: float) -> bool:
    """Whether the first view's rows are pixels of some camera, if not of the given one: wrong cameras, then.

    The intrinsics may be what is wrong: a pose that takes most of it up, to a median of ``limit`` pixels, is enough.
    """
    pairs, K = sample_pixels(gaussians, cameras, valid), cameras.Ks[:1]
    pairs = pairs.select(pairs.views == 0)
    pose = solve_pose(pairs, 0, K[0])
    return pose is not None and bool(np.median(pixel_errors(pairs, pose[None], K)) < limit)


def _other_viewmats(cameras: Cameras, convention: Convention) -> Iterator[tuple[str, np.ndarray]]:
    given = cameras.viewmats
    for poses in other_conventions(given, convention):
        yield poses.describe(convention), poses.viewmats
    transposed = given.copy()
    transposed[:, :3, :3] = given[:, :3, :3].transpose(0, 2, 1)
    transposed[:, :3, 3] = -np.einsum("vij,vj->vi", transposed[:, :3, :3], cameras.centres)
    yield "the cameras fit with their rotations transposed", transposed
    for axis, words in ((1, "y axis flipped (rows counted from the bottom)"), (0, "x axis flipped (mirrored images)")):
        mirrored = given.copy()
        mirrored[:, axis] *= -1
        yield f"the cameras fit with the {words}", mirrored


def _other_orders(views: int, height: int, width: int) -> Iterator[tuple[str, np.ndarray]]:
    """Permutations that bring rows of another order into view-major, row-major order."""
    rows = np.arange(views * height * width)
    by_pixel, by_column = rows.reshape(height, width, views), rows.reshape(views, width, height)
    yield "the rows fit in the order row, column, view (view fastest)", by_pixel.transpose(2, 0, 1).reshape(-1)
    yield "the rows fit in the order view, column, row (column-major)", by_column.transpose(0, 2, 1).reshape(-1)
    yield "the rows fit with the views in reverse order", rows.reshape(views, -1)[::-1].reshape(-1)
