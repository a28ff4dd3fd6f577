"""How far a scene extends, its outliers, and what its views show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gsmerge.types import Cameras, Gaussians, PixelScene, UnalignedScene

MAX_SAMPLES = 200_000  # Gaussians that are measured
OUTLIER_BOX = 10.0  # times the box of 1 % to 99 %: what lies beyond is an outlier
HUGE_SCALE_SHARE = 0.1  # of the box's diagonal: larger scales show no detail
_VISIBLE = 1 / 255  # opacity; less does not show in an 8-bit image


@dataclass(frozen=True)
class Extents:
    """Where the Gaussians lie and how large they are, world units."""

    box_low: tuple[float, ...]  # 1 % quantile of the positions per axis
    box_high: tuple[float, ...]  # 99 % quantile of the same
    diagonal: float  # of that box
    share_outliers: float  # share of the Gaussians outside of the box made ten times as large about its middle
    scale_median: float  # of each Gaussian's largest scale
    scale_max: float  # the largest scale of all
    share_huge: float  # share of the Gaussians whose largest scale is above a tenth of the diagonal


@dataclass(frozen=True)
class Coverage:
    """What one view shows."""

    name: str  # of its image
    share_of_pixels: float | None  # share of the pixels that have a visible Gaussian of their own; None without pixels
    share_of_gaussians: float  # share of all Gaussians whose centre is inside the picture


def extents(gaussians: Gaussians) -> Extents:
    """Measure finite Gaussians; zeros where there are none. Large scenes are sampled, except for the largest scale."""
    if len(gaussians) == 0:
        return Extents((0.0,) * 3, (0.0,) * 3, 0.0, 0.0, 0.0, 0.0, 0.0)
    step = -(-len(gaussians) // MAX_SAMPLES)
    points = gaussians.means[::step].numpy().astype(np.float64)
    largest = gaussians.scales.amax(1).numpy()
    low, high = np.percentile(points, (1, 99), axis=0)
    diagonal = float(np.linalg.norm(high - low))
    half = np.maximum((high - low) / 2, 1e-3 * max(diagonal, 1e-30))
    outside = (np.abs(points - (low + high) / 2) > OUTLIER_BOX * half).any(1)
    return Extents(
        box_low=tuple(map(float, low)),
        box_high=tuple(map(float, high)),
        diagonal=diagonal,
        share_outliers=float(outside.mean()),
        scale_median=float(np.median(largest[::step])),
        scale_max=float(largest.max()),
        share_huge=float((largest[::step] > HUGE_SCALE_SHARE * diagonal).mean()),
    )


def coverage(scene: PixelScene | UnalignedScene) -> tuple[Coverage, ...]:
    """What every view shows of a scene; of several Gaussians per pixel each layer is a view."""
    if len(scene) == 0:
        return ()
    rows = torch.arange(0, len(scene.gaussians), -(-len(scene.gaussians) // MAX_SAMPLES))
    if isinstance(scene, PixelScene):
        rows = rows[scene.stored.reshape(-1)[rows]]
    shares = _shares_inside(scene.gaussians.means[rows].numpy().astype(np.float64), scene.cameras)
    pixels: list[float | None] = [None] * len(scene)
    if isinstance(scene, PixelScene):
        visible = (scene.gaussians.opacities >= _VISIBLE).reshape(scene.valid.shape) & scene.stored
        pixels = [float(view.double().mean()) for view in visible]
    return tuple(map(Coverage, scene.names, pixels, shares))


def _shares_inside(points: np.ndarray, cameras: Cameras) -> list[float]:
    size = np.array([cameras.width, cameras.height])
    shares = []
    for viewmat, K in zip(cameras.viewmats.double().numpy(), cameras.Ks.double().numpy(), strict=True):
        image = (points @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
        with np.errstate(all="ignore"):
            xy = image[:, :2] / image[:, 2:]
        inside = (image[:, 2] > 0) & (xy >= 0).all(1) & (xy < size).all(1)
        shares.append(float(inside.mean()) if len(points) else 0.0)
    return shares
