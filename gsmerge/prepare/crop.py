"""Scene -> the scene inside a crop: the Gaussians in the crop, and masks of the pixels that mostly show them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.errors import UsageError
from gsmerge.geometry.frame import canonicalise
from gsmerge.geometry.transforms import euler_to_rotmat, lies_inside, rgb_to_sh0
from gsmerge.geometry.views import take_rows
from gsmerge.prepare.fill_holes import usual_opacity
from gsmerge.raster import render_in_batches
from gsmerge.runtime.record import note
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.stages import parse_crop
from gsmerge.types import Region, Scene

MOSTLY = 0.5  # a pixel mostly shows the inside if more than this share of its opacity is from Gaussians inside


def find_region(crop: str) -> Region:
    """Return the region that the text of a crop describes, in world units."""
    shape, parsed = parse_crop(crop)
    numbers = np.array(parsed)
    if shape == "sphere":
        return Region(numbers[:3], np.full(3, numbers[3]), np.eye(3), is_sphere=True)
    low, high, degrees = numbers[:3], numbers[3:6], np.pad(numbers[6:], (0, 9 - len(numbers)))
    rotation = euler_to_rotmat(degrees).T if degrees.any() else np.eye(3)
    return Region((low + high) / 2, (high - low) / 2, rotation, is_sphere=False)


def inside_crop(means: np.ndarray, crop: str) -> np.ndarray:
    """Return a mask ``[n]`` of the world-frame centres ``[n,3]`` inside a crop, border included."""
    return lies_inside(find_region(crop), means)


def crop_scene(scene: Scene, crop: str) -> Scene:
    """Return the scene of the Gaussians inside a crop; photos count only at pixels that mostly show these Gaussians.

    Counts, the fit and scores of the returned scene refer to the crop. Raises UsageError if no Gaussian is inside.
    """
    means, region = scene.gaussians.means, find_region(crop)
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
            inside_opacity, opacity = image[..., 0], image[..., 1]
            return np.asarray(inside_opacity > MOSTLY * np.maximum(opacity, usual_opacity(opacity)))

        with use_threads() as threads:
            views = render_in_batches(gaussians, canonical.cameras, at_once=threads, convert=shows_inside)
            shown = np.stack(list(views))
        masks = shown if masks is None else masks & shown
    return replace(take_rows(scene, np.flatnonzero(inside)), masks=masks)
