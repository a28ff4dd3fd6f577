"""Scene -> the scene inside a crop: the Gaussians in the crop, and masks of the pixels that mostly show them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.errors import UsageError
from gsmerge.method.geometry.frame import canonicalise
from gsmerge.method.geometry.regions import find_region
from gsmerge.method.geometry.transforms import lies_inside, rgb_to_sh0
from gsmerge.method.geometry.views import take_rows
from gsmerge.method.raster import render_in_batches
from gsmerge.prepare.fill_holes import usual_opacity
from gsmerge.runtime.record import note
from gsmerge.runtime.threads import use_threads
from gsmerge.types import Scene

MOSTLY = 0.5  # a pixel mostly shows the inside if more than this share of its opacity is from Gaussians inside


def crop_scene(scene: Scene, crop: str) -> Scene:
    """Return the scene of the Gaussians inside a crop; photos count only at pixels that mostly show these Gaussians.

    Counts, the fit and scores of the returned scene refer to the crop. Raises UsageError if no Gaussian is inside.
    """
    means = scene.gaussians.means
    region = find_region(crop)
    inside = lies_inside(region, means)
    count = int(inside.sum())
    if count == 0:
        remedy = "gsmerge inspect shows the extent of the scene"
        raise UsageError(f"crop: expected Gaussians of the scene in {crop}, found none; {remedy}")
    # centres on the border are inside, although coordinates as large as these are rounded
    largest = float(np.abs(region.middle).max() + region.half.max())
    scene = replace(scene, region=replace(region, rounding=float(np.finfo(means.dtype).eps) * largest))
    if count == scene.num_gaussians:
        return scene
    note(f"crop: {count:,} of {scene.num_gaussians:,} Gaussians are inside; counts, fit and scores refer to these")
    masks = scene.masks
    if scene.images is not None:
        canonical, _ = canonicalise(scene)
        colors = np.ones((len(inside), 1, 3), np.float32)  # in red only the Gaussians inside are 1, in green all are
        colors[~inside, :, 0] = 0
        gaussians = replace(canonical.gaussians, sh0=rgb_to_sh0(colors), shN=np.zeros((len(inside), 0, 3), np.float32))

        def shows_inside(image: np.ndarray) -> np.ndarray:
            """Return a mask ``[h,w]`` of the pixels of a render that mostly show Gaussians inside."""
            inside_opacity = image[..., 0]
            opacity = image[..., 1]
            return np.asarray(inside_opacity > MOSTLY * np.maximum(opacity, usual_opacity(opacity)))

        with use_threads() as threads:
            views = render_in_batches(gaussians, canonical.cameras, at_once=threads, convert=shows_inside)
            shown = np.stack(list(views))
        masks = shown if masks is None else masks & shown
    return replace(take_rows(scene, np.flatnonzero(inside)), masks=masks)
