"""Which convention the poses of a camera file are in, decided by what the cameras see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from gsmerge.errors import SceneError
from gsmerge.io.alignment.recover import MARGIN, Recovery, recover
from gsmerge.io.alignment.score import AlignmentInput
from gsmerge.io.alignment.unaligned import CameraCheck, check_cameras
from gsmerge.io.cameras.camera_file import (
    CONVENTIONS,
    CameraFile,
    Convention,
    from_viewmats,
    to_viewmats,
    with_poses,
)
from gsmerge.types import Cameras, Gaussians

_AS_GOOD = 0.98  # of the score of what the cameras see: no difference
_SAME = 1e-6  # of the cameras' distances: no difference


@dataclass(frozen=True)
class Poses:
    """One reading of the poses: a convention, and ``viewmats [c,4,4]`` float64 world to camera under it."""

    convention: Convention
    viewmats: np.ndarray

    @property
    def description(self) -> str:
        """What it takes the poses for."""
        return f"{self.convention[0]} matrices with {self.convention[1]} axes"

    def describe(self, usual: Convention) -> str:
        """That these fit, not the poses as their format has them."""
        return f"the poses fit when read as {self.description}, where this format has {usual[0]} with {usual[1]} axes"


def other_conventions(viewmats: np.ndarray, convention: Convention) -> list[Poses]:
    """The poses ``viewmats [c,4,4]`` of one convention under the others; none twice, and none that changes nothing."""
    stored, readings = from_viewmats(viewmats, convention), [Poses(convention, viewmats)]
    for other in CONVENTIONS:
        read = to_viewmats(stored, other)
        known = [poses.viewmats for poses in readings]
        if not any(np.allclose(read, one, atol=_SAME * (1 + np.abs(one).max())) for one in known):
            readings.append(Poses(other, read))
    return readings[1:]


def find_aligned_poses(inputs: AlignmentInput, camera_file: CameraFile) -> tuple[Poses, Recovery] | None:
    """The one other reading of the poses under which the rows are pixels; None where there is none. SceneError if
    several fit, none of them twice as well as the next.
    """
    if inputs.order == "none":
        return None
    fits = []
    for poses in other_conventions(inputs.viewmats, camera_file.convention):
        cameras = with_poses(inputs.cameras, poses.viewmats)
        if check_cameras(inputs.gaussians, inputs.valid, cameras, None).ok:
            recovery = recover(replace(inputs, cameras=cameras))
            fits += [] if recovery is None else [(poses, recovery)]
    return choose_fit(camera_file, fits)


def choose_fit(camera_file: CameraFile, fits: Sequence[tuple[Poses, Recovery]]) -> tuple[Poses, Recovery] | None:
    """The reading of the poses that fits best; None without any. SceneError if several fit, none of them twice as well
    as the next.
    """
    ranked = sorted(fits, key=lambda one: one[1].best.worst_px)
    if len(ranked) > 1 and ranked[1][1].best.worst_px < MARGIN * max(ranked[0][1].best.worst_px, 1e-3):
        both = f"{ranked[0][0].description} and as {ranked[1][0].description}"
        problem = f"expected poses that fit in one reading, found that they fit as {both}"
        raise SceneError(camera_file.path, problem, "convert them to the format's own")
    return ranked[0] if ranked else None


def choose_poses(
    gaussians: Gaussians, valid: Tensor, cameras: Cameras, images: Tensor | None, convention: Convention
) -> tuple[Poses | None, CameraCheck, str | None]:
    """Which reading of the poses sees unaligned Gaussians, judged by how many it sees and by their colours.

    Arguments are as for :func:`check_cameras`, with the cameras under the usual convention.

    Returns:
        The reading that is clearly better than the usual one and than all others, or None for the usual one; what it
        sees; and a note where another one sees as much as the usual one.
    """
    usual = check_cameras(gaussians, valid, cameras, images)
    others = [
        (poses, check_cameras(gaussians, valid, with_poses(cameras, poses.viewmats), images))
        for poses in other_conventions(cameras.viewmats.double().numpy(), convention)
    ]
    ranked = sorted(others, key=lambda one: -one[1].score)
    if not ranked or not ranked[0][1].ok:
        return None, usual, None
    poses, best = ranked[0]
    scores = [check.score for check in (usual, *(check for _, check in ranked[1:2])) if check.ok]
    if best.score >= MARGIN * max(scores, default=0.0):
        return poses, best, None
    as_good = usual.ok and best.score >= _AS_GOOD * usual.score
    note = f"the poses fit as well when read as {poses.description}; they are read as the format has them"
    return None, usual, note if as_good else None
