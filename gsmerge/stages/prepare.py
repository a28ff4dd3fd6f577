"""Bring a scene to the frame that all arithmetic runs in, and back.

Origin at the scene's middle and unit = its median depth, so that float32 keeps its precision far from the world's
origin and thresholds (near plane, floors) mean the same at every scale. The unit is a power of two: scaling there
and back changes no bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from gsmerge.geometry import project
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Gaussians, PixelScene, UnalignedScene

Scene = TypeVar("Scene", PixelScene, UnalignedScene)
SAMPLES = 65536  # Gaussians that are looked at
NEAR = 0.01  # near plane of every render that is scored, in canonical units
ROWS = 65536  # Gaussians per task
MAX_VIEWS = 32  # of a scene in no order


@dataclass(frozen=True)
class Frame:
    """x_canonical = (x_world - origin) / unit.

    Args:
        origin: ``[3]`` float64, world units.
        unit: Length of the canonical unit in world units, a power of two.
    """

    origin: Tensor
    unit: float

    def enter(self, gaussians: Gaussians) -> Gaussians:
        """World to canonical; means in float32."""
        means, scales = torch.empty(gaussians.means.shape), torch.empty_like(gaussians.scales)

        def fill(first: int) -> None:
            rows = slice(first, first + ROWS)
            means[rows] = (gaussians.means[rows].double() - self.origin) / self.unit
            torch.div(gaussians.scales[rows], self.unit, out=scales[rows])

        parallel_map(fill, range(0, len(gaussians), ROWS))
        return replace(gaussians, means=means, scales=scales)

    def leave(self, gaussians: Gaussians) -> Gaussians:
        """Canonical to world; means in float64."""
        means = gaussians.means.double() * self.unit + self.origin
        return replace(gaussians, means=means, scales=gaussians.scales * self.unit)

    def enter_cameras(self, cameras: Cameras) -> Cameras:
        """World to canonical."""
        viewmats = cameras.viewmats.double().clone()
        shift = viewmats[:, :3, 3] + viewmats[:, :3, :3] @ self.origin
        viewmats[:, :3, 3] = shift / self.unit
        return replace(cameras, viewmats=viewmats)


def find_frame(scene: PixelScene) -> Frame:
    """The canonical frame of a scene: median mean (float64) and median depth of its valid Gaussians.

    Raises:
        ValueError: If no Gaussian is valid.
    """
    h, w = scene.cameras.height, scene.cameras.width
    rows = torch.nonzero(scene.valid.reshape(-1))[:, 0]
    if len(rows) == 0:
        raise ValueError("expected at least one valid Gaussian, got none")
    rows = rows[:: max(1, len(rows) // SAMPLES)]
    means = scene.gaussians.means[rows].double()
    origin = means.median(0).values
    viewmats = scene.cameras.viewmats.double()[rows // (h * w)]
    depths = (viewmats[:, 2, :3] * means).sum(1) + viewmats[:, 2, 3]
    depth = float(depths.abs().median())
    unit = 2.0 ** round(math.log2(depth)) if depth > 0 and math.isfinite(depth) else 1.0
    return Frame(origin, unit)


def find_unaligned_frame(scene: UnalignedScene) -> Frame:
    """The canonical frame of a scene in no order: median mean, and median depth of what the views have before them.

    Raises:
        ValueError: If there is no Gaussian or no view.
    """
    if len(scene.gaussians) == 0 or len(scene) == 0:
        raise ValueError(f"expected Gaussians and views, got {len(scene.gaussians)} and {len(scene)}")
    means = scene.gaussians.means[:: max(1, len(scene.gaussians) // SAMPLES)].double()
    views = scene.cameras[:: max(1, len(scene) // MAX_VIEWS)]
    pixels, depths = project(means, views)
    size = torch.tensor([views.width, views.height])
    seen = (depths > 0) & ((pixels > 0) & (pixels < size)).all(-1)
    depth = float(depths[seen].median()) if bool(seen.any()) else 0.0
    return Frame(means.median(0).values, 2.0 ** round(math.log2(depth)) if depth > 0 else 1.0)


def scene_frame(scene: PixelScene | UnalignedScene) -> Frame:
    """The canonical frame of a scene of either kind.

    Raises:
        ValueError: As :func:`find_frame` and :func:`find_unaligned_frame`.
    """
    return find_frame(scene) if isinstance(scene, PixelScene) else find_unaligned_frame(scene)


def canonicalise(scene: Scene, frame: Frame | None = None) -> tuple[Scene, Frame]:
    """The scene in its canonical frame, or in a given one, and the frame."""
    frame = frame or scene_frame(scene)
    return replace(scene, gaussians=frame.enter(scene.gaussians), cameras=frame.enter_cameras(scene.cameras)), frame
