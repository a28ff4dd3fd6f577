"""What cameras see of Gaussians, and in which convention their poses are, decided by that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.geometry import project_points, sh0_to_rgb
from gsmerge.io.alignment.recover import MARGIN, Recovery, recover
from gsmerge.io.alignment.score import AlignmentInput
from gsmerge.io.cameras.camera_file import CONVENTIONS, CameraFile, Convention, from_viewmats, to_viewmats
from gsmerge.types import Cameras, Gaussians

Fit = TypeVar("Fit")

_AS_GOOD = 0.98  # of the score of what the cameras see: no difference
_SAME = 1e-6  # of the cameras' distances: no difference
_SAMPLES = 20_000  # Gaussians that are projected
_MIN_SEEN = 0.5  # share of them that some camera sees
_MAX_COLOR_RATIO = 0.85  # of their colours' distance from the photos, over that from random pixels
_SAME_COLORS = 0.01  # mean distance of the colours from random pixels below which photos say nothing


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


@dataclass(frozen=True)
class CameraCheck:
    """What the cameras see of some Gaussians."""

    share_seen: float  # share of the Gaussians inside at least one picture
    # distance of their colours from the photos where they are seen, over the distance from the same pixels shuffled;
    # NaN without photos, or where the colours hardly vary
    color_ratio: float
    ok: bool  # whether these are likely the cameras of these Gaussians

    @property
    def score(self) -> float:
        """0 to 1, to rank cameras by: the share that is seen, reduced where colours fit little better than random."""
        return self.share_seen * (1.0 if np.isnan(self.color_ratio) else max(0.0, 1 - self.color_ratio))

    @property
    def description(self) -> str:
        """The figures in one sentence."""
        seen = f"the cameras see {100 * self.share_seen:.0f} % of the Gaussians"
        if np.isnan(self.color_ratio):
            return seen
        return f"{seen}, whose colours are {self.color_ratio:.2f} times as far from the photos as any others"


def check_cameras(gaussians: Gaussians, valid: np.ndarray, cameras: Cameras, images: np.ndarray | None) -> CameraCheck:
    """Project some valid Gaussians into all views, and compare them with ``images [c,h,w,3]`` where there are any."""
    rows = np.flatnonzero(valid)
    rows = rows[:: max(1, len(rows) // _SAMPLES)]
    points = gaussians.means[rows].astype(np.float64)
    colors = sh0_to_rgb(gaussians.sh0[rows, 0]).clip(0, 1)
    visible, errors, others = np.zeros(len(rows), bool), [], []
    rng = np.random.default_rng(0)
    for view in range(len(cameras)):
        with np.errstate(all="ignore"):
            xy, depth = project_points(points, cameras.viewmats[view], cameras.Ks[view])
            xy = np.floor(xy)
        inside = (depth > 0) & (xy >= 0).all(1) & (xy < (cameras.width, cameras.height)).all(1)
        visible |= inside
        if images is not None and inside.any():
            x, y = xy[inside].astype(np.int64).T
            photo = images[view, y, x]
            errors.append(np.abs(colors[inside] - photo).mean(1))
            others.append(np.abs(colors[inside] - rng.permutation(photo)).mean(1))
    share, ratio = float(visible.mean()), np.nan
    if errors and (other := float(np.concatenate(others).mean())) > _SAME_COLORS:
        ratio = float(np.concatenate(errors).mean()) / other
    return CameraCheck(share, ratio, share >= _MIN_SEEN and not ratio > _MAX_COLOR_RATIO)


def find_aligned_poses(inputs: AlignmentInput, camera_file: CameraFile) -> tuple[Poses, Recovery] | None:
    """The one other reading of the poses under which the rows are pixels; None where there is none. SceneError if
    several fit, none of them twice as well as the next.
    """
    if inputs.order == "none":
        return None
    fits = []
    for poses in other_conventions(inputs.cameras.viewmats, camera_file.convention):
        cameras = replace(inputs.cameras, viewmats=poses.viewmats)
        if check_cameras(inputs.gaussians, inputs.valid, cameras, None).ok:
            recovery = recover(replace(inputs, cameras=cameras))
            fits += [] if recovery is None else [(poses, recovery.best.worst_px, recovery)]
    return choose_fit(camera_file, fits)


def choose_fit(camera_file: CameraFile, fits: Sequence[tuple[Poses, float, Fit]]) -> tuple[Poses, Fit] | None:
    """The fit with the smallest distance in pixels (the second entry); None without any. SceneError if several readings
    of the poses fit, none of them twice as well as the next.
    """
    ranked = sorted(fits, key=lambda one: one[1])
    if len(ranked) > 1 and ranked[1][1] < MARGIN * max(ranked[0][1], 1e-3):
        both = f"{ranked[0][0].description} and as {ranked[1][0].description}"
        problem = f"expected poses that fit in one reading, found that they fit as {both}"
        raise SceneError(camera_file.path, problem, "convert them to the format's own")
    return (ranked[0][0], ranked[0][2]) if ranked else None


def choose_poses(
    gaussians: Gaussians, valid: np.ndarray, cameras: Cameras, images: np.ndarray | None, convention: Convention
) -> tuple[Poses | None, CameraCheck, str | None]:
    """Which reading of the poses sees unaligned Gaussians, judged by how many it sees and by their colours.

    Arguments are as for :func:`check_cameras`, with the cameras under the usual convention.

    Returns:
        The reading that is clearly better than the usual one and than all others, or None for the usual one; what it
        sees; and a note where another one sees as much as the usual one.
    """
    usual = check_cameras(gaussians, valid, cameras, images)
    others = [
        (poses, check_cameras(gaussians, valid, replace(cameras, viewmats=poses.viewmats), images))
        for poses in other_conventions(cameras.viewmats, convention)
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
