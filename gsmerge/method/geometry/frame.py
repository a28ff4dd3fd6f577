"""Move scenes into and out of their canonical frame, in which all computations run.

The frame's origin is the scene's middle, and its unit is the median depth. In this frame float32 keeps its precision
far from the world's origin, and thresholds (near plane, floors) mean the same at every scale. The unit is a power of
two, so scaling to the frame and back changes no bit.
"""

from __future__ import annotations

import math

import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.geometry.transforms import camera_depths, lower_median, move_region, project
from gsmerge.method.kernels.matrices import matmul
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Gaussians, Scene, SceneT

FRAME_GAUSSIANS = 65536  # Gaussians by which the frame is chosen
FRAME_ROWS = 65536  # Gaussians per task
MAX_UNIT_VIEWS = 32  # most views by which the unit is chosen, if views share Gaussians


@dataclass(frozen=True, eq=False)
class Frame:
    """Canonical frame: x_canonical = (x_world - origin) / unit."""

    origin: np.ndarray  # [3] float64, world units
    unit: float  # length of the canonical unit in world units, a power of two

    def enter(self, gaussians: Gaussians) -> Gaussians:
        """Move Gaussians from the world into the frame; means in float32."""
        means, scales = np.empty(gaussians.means.shape, np.float32), np.empty_like(gaussians.scales)

        def fill(first: int) -> None:
            rows = slice(first, first + FRAME_ROWS)
            for axis, start in enumerate(self.origin):  # NumPy is twice as fast if it takes one axis at a time
                means[rows, axis] = (gaussians.means[rows, axis] - start) / self.unit
            np.divide(gaussians.scales[rows], self.unit, out=scales[rows])

        parallel_map(fill, range(0, len(gaussians), FRAME_ROWS))
        return replace(gaussians, means=means, scales=scales)

    def leave(self, gaussians: Gaussians) -> Gaussians:
        """Move Gaussians from the frame into the world; means in float64."""
        means = gaussians.means.astype(np.float64) * self.unit + self.origin
        return replace(gaussians, means=means, scales=gaussians.scales * self.unit)

    def leave_cameras(self, cameras: Cameras) -> Cameras:
        """Move cameras from the frame into the world."""
        viewmats = cameras.viewmats.astype(np.float64)
        viewmats[:, :3, 3] = self.unit * viewmats[:, :3, 3] - matmul(viewmats[:, :3, :3], self.origin)
        return replace(cameras, viewmats=viewmats)

    def enter_cameras(self, cameras: Cameras) -> Cameras:
        """Move cameras from the world into the frame."""
        viewmats = cameras.viewmats.astype(np.float64)
        shift = viewmats[:, :3, 3] + matmul(viewmats[:, :3, :3], self.origin)
        viewmats[:, :3, 3] = shift / self.unit
        return replace(cameras, viewmats=viewmats)


def scene_frame(scene: Scene) -> Frame:
    """Choose the canonical frame by the median of the means and the median depth.

    The unit is the power of two that is nearest to the median depth. Raises ValueError without Gaussians or views.
    """
    if len(scene.gaussians) == 0 or len(scene) == 0:
        raise ValueError(f"expected Gaussians and views, got {len(scene.gaussians)} and {len(scene)}")
    means = scene.gaussians.means[sample_rows(scene)].astype(np.float64)
    return Frame(lower_median(means), unit_of(scene_depth(scene)))


def unit_of(depth: float) -> float:
    """Return the power of two that is nearest to a depth; 1 for a depth of 0, or one that is not finite."""
    mantissa, exponent = math.frexp(depth if depth > 0 and math.isfinite(depth) else 1.0)  # mantissa: 0.5 to 1
    return math.ldexp(1.0, exponent if mantissa >= math.sqrt(0.5) else exponent - 1)


def scene_depth(scene: Scene) -> float:
    """Measure the median depth of sampled Gaussians in their own views, or else in all views that see them.

    Returns 0 if no view sees a Gaussian.
    """
    rows = sample_rows(scene)
    means = scene.gaussians.means[rows].astype(np.float64)
    if scene.has_own_pixels:
        homes = scene.get_pixels().homes[rows]
        if homes.min() < 0:
            means = means[homes >= 0]
            homes = homes[homes >= 0]
        return float(lower_median(np.abs(camera_depths(means, scene.cameras.viewmats, homes // scene.pixels_per_view))))
    return seen_depth(means, scene.cameras)


def seen_depth(means: np.ndarray, cameras: Cameras) -> float:
    """Measure the median depth of means ``[n,3]`` in all views that see them; 0 if no view sees one."""
    views = cameras[:: max(1, len(cameras) // MAX_UNIT_VIEWS)]
    pixels, depths = project(means, views)
    x = pixels[..., 0]
    y = pixels[..., 1]
    seen = (depths > 0) & (x > 0) & (x < views.width) & (y > 0) & (y < views.height)
    return float(lower_median(depths[seen])) if seen.any() else 0.0


def sample_rows(scene: Scene) -> slice:
    """Choose evenly spread rows of a scene. Raises ValueError if the scene has no Gaussians."""
    count = len(scene.gaussians)
    if count == 0:
        raise ValueError("expected at least one Gaussian, got none")
    return slice(0, count, max(1, count // FRAME_GAUSSIANS))


def canonicalise(scene: SceneT, frame: Frame | None = None) -> tuple[SceneT, Frame]:
    """Move a scene into the canonical ``frame``, by default its own; return the scene and the frame."""
    frame = frame or scene_frame(scene)
    region = None if scene.region is None else move_region(scene.region, frame.origin, frame.unit)
    gaussians = frame.enter(scene.gaussians)
    cameras = frame.enter_cameras(scene.cameras)
    return replace(scene, gaussians=gaussians, cameras=cameras, region=region), frame
