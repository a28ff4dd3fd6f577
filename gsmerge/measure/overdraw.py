"""Overdraw: how many Gaussians a GPU blends into a pixel, which phones and headsets are slow by.

Viewers draw all Gaussians from the back, also those that opaque ones then cover, so nothing is left out here: neither
in the views, nor in pictures from outside, where a viewer's first step leads.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from gsmerge.facts.views import pick_views
from gsmerge.measure.fog import outside_cameras
from gsmerge.measure.sizes import shrink_cameras
from gsmerge.raster import Splats, ViewPlan, contributions, plan_view, prepare
from gsmerge.raster.composite import count_layers, covered_pixels
from gsmerge.raster.view_plan import EPS2D
from gsmerge.settings.budget import Device
from gsmerge.types import Cameras, Gaussians

VIEWS = 6  # evenly spread
SIDE = 480  # pixels, at most, of the longer side of the pictures
CROWDED = 95  # % of the pixels


@dataclass(frozen=True)
class Overdraw:
    """Gaussians that show in a pixel, hidden ones as well."""

    mean: float
    crowded: float  # of the pixel that 95 % of all do not exceed

    def excess(self, device: Device) -> float:
        """Return how many times as much it is as a device draws fluidly."""
        return max(self.mean / device.overdraw, self.crowded / device.crowded)


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures in which overdraw is measured, at a device's size."""

    cameras: dict[str, list[Cameras]]  # by kind: those of views, and of cameras outside
    side: int  # pixels of the longer side on the device
    near: float  # near plane, units of the cameras

    def measure(self, gaussians: Gaussians) -> dict[str, Overdraw]:
        """Measure overdraw by kind of picture."""
        splats, found = prepare(gaussians), {}
        for kind, cameras in self.cameras.items():
            layers = np.concatenate([count_layers(plan).ravel() for plan in self._plans(splats, cameras)])
            found[kind] = Overdraw(float(layers.mean()), float(np.percentile(layers, CROWDED)))
        return found

    def order_by_worth(self, gaussians: Gaussians) -> np.ndarray:
        """Order rows ``[n]`` by what they add to the pictures for each pixel in which they are drawn."""
        splats = prepare(gaussians)
        added, drawn = np.zeros((2, len(gaussians)))
        for cameras in self.cameras.values():
            for plan in self._plans(splats, cameras):
                added += contributions(plan)[0]
                drawn += covered_pixels(plan)
        return np.argsort(added / np.maximum(drawn, 1e-9), kind="stable")

    def _plans(self, splats: Splats, cameras: list[Cameras]) -> Iterator[ViewPlan]:
        """Plan pictures, each Gaussian as large beside them as the device's pixels make it."""
        for camera in cameras:
            eps2d = EPS2D * (max(camera.width, camera.height) / self.side) ** 2
            yield plan_view(
                splats, camera.viewmats[0], camera.Ks[0], camera.width, camera.height, near=self.near, eps2d=eps2d
            )


def overdraw_pictures(gaussians: Gaussians, cameras: Cameras, side: int, near: float) -> Pictures:
    """Choose pictures for the overdraw of ``gaussians`` seen by ``cameras``, and from outside of these."""
    small = shrink_cameras(cameras, SIDE)
    views = [small[[view]] for view in pick_views(len(small), VIEWS)]
    return Pictures(
        {"views": views, "outside": [camera for _, camera in outside_cameras(gaussians, small)]}, side, near
    )
