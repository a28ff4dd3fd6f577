"""Whether the cameras see Gaussians that belong to no pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from gsmerge.geometry import project_points, sh0_to_rgb
from gsmerge.io.alignment.layouts import plain_layout, subsample
from gsmerge.io.alignment.score import find_correspondences, pixel_limit
from gsmerge.io.alignment.similarity import pixel_errors, solve_pose
from gsmerge.types import Cameras, Gaussians

_SAMPLES = 20_000  # Gaussians that are projected
_MIN_SEEN = 0.5  # share of them that some camera sees
_MAX_COLOR_RATIO = 0.85  # of their colours' distance from the photos, over that from random pixels
_SAME_COLORS = 0.01  # mean distance of the colours from random pixels below which photos say nothing


@dataclass(frozen=True)
class CameraCheck:
    """What the cameras see of some Gaussians.

    Args:
        share_seen: Share of the Gaussians inside at least one picture.
        color_ratio: Distance of their colours from the photos where they are seen, over the distance from the same
            pixels shuffled; NaN without photos, or where the colours hardly vary.
        ok: Whether these are likely the cameras of these Gaussians.
    """

    share_seen: float
    color_ratio: float
    ok: bool

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


def check_cameras(gaussians: Gaussians, valid: Tensor, cameras: Cameras, images: Tensor | None) -> CameraCheck:
    """Project some valid Gaussians into all views, and compare them with ``images [c,h,w,3]`` where there are any."""
    rows = np.flatnonzero(valid.numpy())
    rows = rows[:: max(1, len(rows) // _SAMPLES)]
    points = gaussians.means.numpy()[rows].astype(np.float64)
    colors = sh0_to_rgb(gaussians.sh0.numpy()[rows, 0]).clip(0, 1)
    visible, errors, others = np.zeros(len(rows), bool), [], []
    rng = np.random.default_rng(0)
    viewmats, Ks = cameras.viewmats.double().numpy(), cameras.Ks.double().numpy()
    for view in range(len(cameras)):
        with np.errstate(all="ignore"):
            xy, depth = project_points(points, viewmats[view], Ks[view])
            xy = np.floor(xy)
        inside = (depth > 0) & (xy >= 0).all(1) & (xy < (cameras.width, cameras.height)).all(1)
        visible |= inside
        if images is not None and inside.any():
            x, y = xy[inside].astype(np.int64).T
            photo = images[view].numpy()[y, x]
            errors.append(np.abs(colors[inside] - photo).mean(1))
            others.append(np.abs(colors[inside] - rng.permutation(photo)).mean(1))
    share, ratio = float(visible.mean()), np.nan
    if errors and (other := float(np.concatenate(others).mean())) > _SAME_COLORS:
        ratio = float(np.concatenate(errors).mean()) / other
    return CameraCheck(share, ratio, share >= _MIN_SEEN and not ratio > _MAX_COLOR_RATIO)


def looks_like_a_grid(gaussians: Gaussians, valid: Tensor, cameras: Cameras) -> bool:
    """Whether the first view's rows are pixels of some camera, if not of the given one: wrong cameras, then."""
    layout = subsample(plain_layout(1, cameras.width, cameras.height), 2000)
    pairs, K = find_correspondences(gaussians.means, valid, layout), cameras.Ks.double().numpy()[:1]
    pose = solve_pose(pairs, 0, K[0])
    if pose is None:
        return False
    # the intrinsics may be what is wrong: a pose that takes most of it up is enough
    limit = 4 * pixel_limit(cameras.width, cameras.height)
    return bool(np.median(pixel_errors(pairs, pose[None], K)) < limit)
