"""Cameras that are some pixels off, moved to where every view's Gaussians lie on the rays of their pixels.

Models that predict poses write Gaussians and cameras that differ a little. A pose for each view follows from its
pixels and their Gaussians alone. Which of the two was wrong is for the photos to say, much later: see
``gsmerge/stages/align_views.py``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import project_points
from gsmerge.io.alignment.layouts import subsample
from gsmerge.io.alignment.poses import other_conventions
from gsmerge.io.alignment.recover import Recovery, exact_layouts_of, recover
from gsmerge.io.alignment.score import AlignmentInput, check_pairs, find_correspondences, pixel_limit, score_layout
from gsmerge.io.alignment.similarity import IDENTITY, Correspondences, pixel_errors, solve_pose
from gsmerge.io.cameras.camera_file import CameraFile
from gsmerge.io.cameras.moves import describe_moves, list_moves
from gsmerge.types import Cameras

MAX_PX, MAX_SHARE = 12.0, 0.05  # pixels, and share of a small image's side, that cameras may be off
NEAR_PX = 0.5  # cameras that are nearer stay where they are
AS_GOOD, AS_GOOD_PX = 1.3, 0.25  # times and pixels more than moved cameras leave, up to which other intrinsics fit
ROUNDS = 4  # of reweighted least squares
SAMPLES = 2000  # Gaussians of a view that its pose is solved from


@dataclass(frozen=True)
class MovedCameras:
    """Cameras in their new places."""

    cameras: Cameras
    worst_px: float  # the largest median distance of a view's Gaussians from their pixels before
    moves: list[dict[str, Any]]  # of every view, see list_moves

    @property
    def note(self) -> str:
        """What was done, in one sentence."""
        return (
            f"the cameras are off by a median of up to {self.worst_px:.1f} px: each was moved to where its Gaussians"
            f" lie in their pixels, {describe_moves(self.moves)}"
        )


def max_pixels(width: int, height: int) -> float:
    """Median distance in pixels up to which cameras are moved to their Gaussians; beyond it a scene is refused."""
    return max(pixel_limit(width, height), min(MAX_PX, MAX_SHARE * math.sqrt(width * height)))


def move_cameras(
    pairs: Correspondences, cameras: Cameras, names: tuple[str, ...], source: str = "Ks"
) -> MovedCameras | None:
    """The cameras under which the Gaussians of a sample project into their pixels; None where some are too far off.

    SceneError, which names ``source``, where not the poses are wrong but the intrinsics.
    """
    before = check_pairs(pairs, cameras)
    if not before.worst_px <= max_pixels(cameras.width, cameras.height):
        return None
    viewmats, errors = cameras.viewmats.astype(np.float64), pixel_errors(pairs, cameras.viewmats, cameras.Ks)
    for view in np.unique(pairs.views):
        if np.median(errors[pairs.views == view]) > NEAR_PX:
            pose = solve_pose(pairs, int(view), cameras.Ks[view])
            if pose is None:
                return None
            viewmats[view] = pose
    moved = replace(cameras, viewmats=viewmats)
    after = check_pairs(pairs, moved)
    if not after.ok:
        return None
    _check_intrinsics(pairs, cameras, before.worst_px, after.worst_px, source)
    axes = viewmats[pairs.views, 2]
    depth = float(np.median((axes[:, :3] * pairs.points).sum(1) + axes[:, 3]))
    return MovedCameras(moved, before.worst_px, list_moves(names, cameras.viewmats, viewmats, depth))


def _check_intrinsics(pairs: Correspondences, cameras: Cameras, before_px: float, moved_px: float, source: str) -> None:
    """Refuse cameras whose Gaussians lie as near to their pixels under one change of all Ks as under moved poses."""
    if len(np.unique(pairs.views)) < 2:  # in one view a turn and a shift of the picture are one
        return
    factors, shifts = np.ones(2), np.zeros(2)
    with np.errstate(all="ignore"):
        places, depth = project_points(pairs.points[:, None], cameras.viewmats[pairs.views], cameras.Ks[pairs.views])
    good = (depth[:, 0] > 0) & np.isfinite(places[:, 0]).all(1)
    for axis in range(2):
        before, wanted = places[good, 0, axis], pairs.pixels[good, axis]
        weights = np.ones(len(before))
        for _ in range(ROUNDS):
            factors[axis], shifts[axis] = np.polyfit(before, wanted, 1, w=weights)
            error = np.abs(factors[axis] * before + shifts[axis] - wanted)
            weights = 1 / np.hypot(1, error / (3 * np.median(error) + 1e-9))
    Ks = cameras.Ks * np.array([*factors, 1])[:, None]
    Ks[:, :2, 2] += shifts
    other = check_pairs(pairs, replace(cameras, Ks=Ks))
    if not (other.ok and other.worst_px <= max(AS_GOOD * moved_px, moved_px + AS_GOOD_PX)):
        return
    x, y = (Ks[:, :2, 2] - cameras.Ks[:, :2, 2]).mean(0)
    raise SceneError(
        source,
        f"expected intrinsics that fit the Gaussians, found others, under which they lie {before_px:.1f} px off their"
        " pixels in every view alike",
        f"multiply fx by {factors[0]:.4g} and fy by {factors[1]:.4g}, and add {x:.2f} to cx and {y:.2f} to cy"
        f" (pixels of {cameras.width} x {cameras.height})",
    )


def recover_moved(inputs: AlignmentInput, camera_file: CameraFile) -> tuple[MovedCameras, Recovery] | None:
    """The reading of a file without missing pixels under cameras that are moved a little; None where there is none.

    None, too, where the poses fit in another convention, or the photos' colours speak against it: views in the wrong
    order look like cameras that are off. SceneError as of :func:`move_cameras`.
    """
    if inputs.scale is not None:
        return None
    scores = [
        score_layout(inputs, replace(layout, views=tuple(labelling[view] for view in layout.views)), IDENTITY)
        for layout in exact_layouts_of(inputs)
        for labelling in dict.fromkeys(map(tuple, inputs.labellings))
    ]
    best = min(scores, key=lambda score: score.worst_px, default=None)
    if best is None or not best.worst_px <= max_pixels(inputs.cameras.width, inputs.cameras.height):
        return None
    for poses in other_conventions(inputs.cameras.viewmats, camera_file.convention):
        other = replace(inputs, cameras=replace(inputs.cameras, viewmats=poses.viewmats))
        if score_layout(other, best.layout, IDENTITY).ok:
            return None
    pairs = find_correspondences(inputs.gaussians.means, inputs.valid, subsample(best.layout, SAMPLES))
    moved = move_cameras(pairs, inputs.cameras, camera_file.names, str(camera_file.path))
    recovery = None if moved is None else recover(replace(inputs, cameras=moved.cameras), exact_frames=True)
    return None if moved is None or recovery is None or recovery.confirmed is False else (moved, recovery)
