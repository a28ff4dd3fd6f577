"""What a scene's views see of its Gaussians: weights, depths, and a plan of each view."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

import numpy as np

from gsmerge.raster.composite import contributions
from gsmerge.raster.images import render
from gsmerge.raster.photos import NEAR
from gsmerge.raster.view_plan import ViewPlan, plan_view, prepare
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

ONE_AT_A_TIME = 4_000_000  # Gaussians; the plan of a view is as large as they are
MIN_ALPHA = 0.5  # opacity of a pixel from which it counts when superpixels are merged


def seen_weights(scene: Scene) -> np.ndarray:
    """Measure the largest blending weight ``[n]`` float32 of each Gaussian in one view, pixels."""
    most, lock = np.zeros(len(scene.gaussians), np.float32), Lock()

    def one_view(_: int, plan: ViewPlan) -> None:
        sums, _peaks = contributions(plan)
        with lock:
            np.maximum(most, sums, out=most)

    plan_views(scene, one_view)
    return most


def plan_views(scene: Scene, use: Callable[[int, ViewPlan], None]) -> None:
    """Plan every view and use it, in parallel unless the plans would fill the memory."""
    splats, cameras = prepare(scene.gaussians), scene.cameras
    viewmats, Ks = cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64)

    def one_view(view: int) -> None:
        use(view, plan_view(splats, viewmats[view], Ks[view], cameras.width, cameras.height, near=NEAR))

    if len(splats) <= ONE_AT_A_TIME:
        parallel_map(one_view, range(len(scene)))
        return
    for view in range(len(scene)):
        one_view(view)


def seen_depths(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Render the mean depth ``[v,h,w]`` of every pixel, and a mask ``[v,h,w]`` of mostly opaque pixels."""
    drawn = render(scene.gaussians, scene.cameras, near=NEAR, with_depths=True)
    assert drawn.depths is not None
    return drawn.depths[..., 0], drawn.alphas[..., 0] > MIN_ALPHA
