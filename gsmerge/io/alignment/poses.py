"""Which convention the poses of a camera file are in, decided by what the cameras see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsmerge.errors import SceneError
from gsmerge.io.alignment.recover import MARGIN, Recovery, recover
from gsmerge.io.alignment.score import Clues
from gsmerge.io.alignment.unaligned import Sight, sight
from gsmerge.io.cameras.camera_file import CONVENTIONS, CameraFile, Convention, from_viewmats, to_viewmats
from gsmerge.types import Cameras, Gaussians

_AS_GOOD = 0.98  # of a sight's score: no difference
_SAME = 1e-6  # of the cameras' distances: no difference


@dataclass(frozen=True)
class Poses:
    """One reading of the poses.

    Args:
        words: What it takes the poses for.
        convention: The same, as camera files have it.
        viewmats: ``[c,4,4]`` float64 world to camera under it.
    """

    words: str
    convention: Convention
    viewmats: np.ndarray


def other_readings(viewmats: np.ndarray, convention: Convention) -> list[Poses]:
    """The same poses under the other conventions; none twice, and none that changes nothing.

    Args:
        viewmats: ``[c,4,4]`` under the usual convention.
        convention: The usual one.
    """
    stored, found = from_viewmats(viewmats, convention), [viewmats]
    out = []
    for other in CONVENTIONS:
        read = to_viewmats(stored, other)
        if not any(np.allclose(read, known, atol=_SAME * (1 + np.abs(known).max())) for known in found):
            found.append(read)
            out.append(Poses(f"{other[0]} matrices with {other[1]} axes", other, read))
    return out


def with_poses(cameras: Cameras, viewmats: np.ndarray) -> Cameras:
    """The same cameras in other places."""
    return replace(cameras, viewmats=torch.from_numpy(viewmats))


def reread(camera_file: CameraFile, convention: Convention) -> CameraFile:
    """The same file, its poses taken for those of another convention."""
    stored = from_viewmats(camera_file.viewmats.numpy(), camera_file.convention)
    return replace(camera_file, viewmats=torch.from_numpy(to_viewmats(stored, convention)), convention=convention)


def aligned_poses(clues: Clues, camera_file: CameraFile) -> tuple[Poses, Recovery] | None:
    """The one other reading of the poses under which the rows are pixels; None where there is none.

    Args:
        clues: Under the usual reading, which does not fit.
        camera_file: Where they are from.

    Raises:
        SceneError: If several fit, none of them twice as well as the next.
    """
    if clues.order == "none":
        return None
    found = []
    for poses in other_readings(clues.viewmats, camera_file.convention):
        cameras = with_poses(clues.cameras, poses.viewmats)
        if sight(clues.gaussians, clues.valid, cameras, None).ok:
            recovery = recover(replace(clues, cameras=cameras))
            found += [] if recovery is None else [(poses, recovery)]
    check_one_fits(camera_file, found)
    return min(found, key=lambda one: one[1].best.worst_px, default=None)


def check_one_fits(camera_file: CameraFile, found: Sequence[tuple[Poses, Recovery]]) -> None:
    """Refuse poses of which several readings fit, none of them twice as well as the next.

    Raises:
        SceneError: If that is so.
    """
    ranked = sorted(found, key=lambda one: one[1].best.worst_px)
    if len(ranked) > 1 and ranked[1][1].best.worst_px < MARGIN * max(ranked[0][1].best.worst_px, 1e-3):
        raise SceneError(
            camera_file.path,
            f"expected poses that fit in one reading, found that they fit as {ranked[0][0].words} and as"
            f" {ranked[1][0].words}",
            "convert them to the format's own",
        )


def seen_poses(
    gaussians: Gaussians, valid: Tensor, cameras: Cameras, images: Tensor | None, convention: Convention
) -> tuple[Poses | None, Sight, str | None]:
    """Which reading of the poses sees Gaussians without pixels, judged by how many it sees and by their colours.

    Args:
        gaussians: n rows.
        valid: ``[n]`` bool.
        cameras: Under the usual hints.
        images: ``[c,h,w,3]``, or None.
        convention: The usual one.

    Returns:
        The reading that is clearly better than the usual one and than all others, or None for the usual one; what it
        sees; and a note where another one sees as much as the usual one.
    """
    usual = sight(gaussians, valid, cameras, images)
    others = [
        (poses, sight(gaussians, valid, with_poses(cameras, poses.viewmats), images))
        for poses in other_readings(cameras.viewmats.double().numpy(), convention)
    ]
    best, runner_up = _best_two(others)
    if best is None or not best[1].ok:
        return None, usual, None
    rival = 0.0 if runner_up is None or not runner_up.ok else runner_up.score
    if best[1].score >= MARGIN * max(rival, usual.score if usual.ok else 0.0):
        return best[0], best[1], None
    if usual.ok and best[1].score >= _AS_GOOD * usual.score:
        return None, usual, f"the poses fit as well when read as {best[0].words}; they are read as the format has them"
    return None, usual, None


def _best_two(found: Sequence[tuple[Poses, Sight]]) -> tuple[tuple[Poses, Sight] | None, Sight | None]:
    ranked = sorted(found, key=lambda one: -one[1].score)
    return (ranked[0] if ranked else None), (ranked[1][1] if len(ranked) > 1 else None)


def poses_note(poses: Poses, usual: Convention) -> str:
    """That the poses are read in another way than their format has them."""
    return f"the poses fit when read as {poses.words}, where this format has {usual[0]} with {usual[1]} axes: read so"
