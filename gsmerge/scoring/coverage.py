"""Measure where a scene's Gaussians lie, how large they are, and how much of the views they cover."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsmerge.method.raster.photos import LEAST_OPACITY
from gsmerge.method.stages.clean import BOX_QUANTILES, beyond_scene, floater_share
from gsmerge.scoring.visibility import VISIBILITY_GAUSSIANS, inside_views
from gsmerge.types import Gaussians, Scene


def extents(gaussians: Gaussians) -> dict[str, Any]:
    """Measure positions and sizes of Gaussians with finite values, in world units.

    If there are many Gaussians, a sample is measured.
    Returns:
        ``box_low`` and ``box_high``: percentiles 1 and 99 of the positions, for each axis. ``diagonal``: length of this
        box's diagonal. ``share_outliers``: share of positions outside the box enlarged ten times. ``share_floaters``:
        share of isolated Gaussians and outliers. ``scale_median``: median of the Gaussians' largest scales.
        ``scale_max``: largest scale of all. ``share_huge``: share of Gaussians whose largest scale is above a tenth of
        the diagonal. All figures are 0 if there are no Gaussians.
    """
    names = ("diagonal", "share_outliers", "share_floaters", "scale_median", "scale_max", "share_huge")
    if len(gaussians) == 0:
        return {"box_low": [0.0] * 3, "box_high": [0.0] * 3, **dict.fromkeys(names, 0.0)}
    step = -(-len(gaussians) // VISIBILITY_GAUSSIANS)
    points = gaussians.means[::step].astype(np.float64)
    largest = gaussians.scales.max(1)
    low, high = np.percentile(points, BOX_QUANTILES, axis=0)
    diagonal = np.linalg.norm(high - low)
    huge_scale_share = 0.1  # scales above this share of the box's diagonal are huge, since they show no detail
    values = (
        diagonal, beyond_scene(points).mean(), floater_share(gaussians), np.median(largest[::step]), largest.max(),
        (largest[::step] > huge_scale_share * diagonal).mean(),
    )  # fmt: skip
    shares = {name: float(value) for name, value in zip(names, values, strict=True)}
    return {"box_low": low.tolist(), "box_high": high.tolist(), **shares}


def coverage(scene: Scene) -> list[dict[str, Any]]:
    """Measure how much of each view the Gaussians cover. If a photo has two layers, each layer is a view.

    Returns three entries for each view. ``name`` is the view's name. ``share_of_pixels`` is the share of the pixels
    from which a visible Gaussian comes, or None if the scene does not have one Gaussian per pixel.
    ``share_of_gaussians`` is the share of all Gaussians whose mean is inside the picture.
    """
    if len(scene) == 0:
        return []
    shares = shares_inside(scene, VISIBILITY_GAUSSIANS)
    pixels: list[float | None] = [None] * len(scene)
    if scene.has_own_pixels:
        pixel_rows = scene.get_pixels()
        covered = scene.covered
        has_row = pixel_rows.shown if covered is None else covered
        visible = has_row & (scene.gaussians.opacities >= LEAST_OPACITY)[pixel_rows.fronts]
        pixels = [float(view.mean()) for view in visible]
    return [
        {"name": name, "share_of_pixels": pixel_share, "share_of_gaussians": share}
        for name, pixel_share, share in zip(scene.names, pixels, shares, strict=True)
    ]


def shares_inside(scene: Scene, most: int) -> list[float]:
    """Return, for each view, the share of the Gaussians whose means are inside the view.

    At most ``most`` Gaussians are tested.
    """
    rows = np.arange(0, scene.num_gaussians, max(1, -(-scene.num_gaussians // most)))
    points = scene.file_gaussians.means[rows].astype(np.float64)
    return [float(inside.mean()) if len(points) else 0.0 for inside in inside_views(points, scene.cameras)]
