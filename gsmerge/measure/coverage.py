"""Measure where a scene's Gaussians lie, how large they are, and how much of the views they cover."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsmerge.measure.visibility import MAX_SAMPLE_GAUSSIANS, inside_views
from gsmerge.raster.photos import LEAST_OPACITY
from gsmerge.stages.clean import BOX_QUANTILES, beyond_scene, floater_share
from gsmerge.types import Gaussians, Scene

HUGE_SCALE_SHARE = 0.1  # of the box's diagonal; larger scales show no detail


def extents(gaussians: Gaussians) -> dict[str, Any]:
    """Measure positions and sizes of finite Gaussians, in world units; on a sample if there are many.

    Returns:
        ``box_low`` and ``box_high``: percentiles 1 and 99 of the positions per axis; ``diagonal`` of that box;
        ``share_outliers``: beyond ten times the box about its centre; ``share_floaters``: isolated, or beyond that;
        ``scale_median`` of each Gaussian's largest scale; ``scale_max``: the largest scale of all; ``share_huge``:
        scales above a tenth of the diagonal. All are 0 if there are no Gaussians.
    """
    names = ("diagonal", "share_outliers", "share_floaters", "scale_median", "scale_max", "share_huge")
    if len(gaussians) == 0:
        return {"box_low": [0.0] * 3, "box_high": [0.0] * 3, **dict.fromkeys(names, 0.0)}
    step = -(-len(gaussians) // MAX_SAMPLE_GAUSSIANS)
    points, largest = gaussians.means[::step].astype(np.float64), gaussians.scales.max(1)
    low, high = np.percentile(points, BOX_QUANTILES, axis=0)
    diagonal = np.linalg.norm(high - low)
    values = (
        diagonal, beyond_scene(points).mean(), floater_share(gaussians), np.median(largest[::step]), largest.max(),
        (largest[::step] > HUGE_SCALE_SHARE * diagonal).mean(),
    )  # fmt: skip
    shares = {name: float(value) for name, value in zip(names, values, strict=True)}
    return {"box_low": low.tolist(), "box_high": high.tolist(), **shares}


def coverage(scene: Scene) -> list[dict[str, Any]]:
    """Measure how much of each view the Gaussians cover. Layers count as views.

    Returns for each view its ``name``, ``share_of_pixels``: the share of pixels with a visible Gaussian of their own
    (None if views have no own Gaussians), and ``share_of_gaussians``: the share whose centre is inside the picture.
    """
    if len(scene) == 0:
        return []
    shares = shares_inside(scene, MAX_SAMPLE_GAUSSIANS)
    pixels: list[float | None] = [None] * len(scene)
    if scene.has_own_pixels:
        own, covered = scene.get_pixels(), scene.covered
        visible = own.shown if covered is None else covered
        visible = visible & (scene.gaussians.opacities >= LEAST_OPACITY)[own.fronts]
        pixels = [float(view.mean()) for view in visible]
    keys = ("name", "share_of_pixels", "share_of_gaussians")
    return [dict(zip(keys, view, strict=True)) for view in zip(scene.names, pixels, shares, strict=True)]


def shares_inside(scene: Scene, most: int) -> list[float]:
    """Measure the share of Gaussians whose centres lie in each view, on a sample of at most ``most``."""
    rows = np.arange(0, scene.num_gaussians, max(1, -(-scene.num_gaussians // most)))
    points = scene.file_gaussians.means[rows].astype(np.float64)
    return [float(inside.mean()) if len(points) else 0.0 for inside in inside_views(points, scene.cameras)]
