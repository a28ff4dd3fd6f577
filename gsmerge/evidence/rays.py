"""Find photos whose pixels have Gaussians of their colours on their rays, at whatever depth.

Models give the Gaussians of a pixel about its colour, and put them on its ray: a wrong depth moves them along it. So
most pixels of a right photo have one of their colour there, and those of another photo as few as chance gives.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmerge.evidence.scores import MARGIN, NORMAL
from gsmerge.geometry import sh0_to_rgb
from gsmerge.kernels.gaussians.fronts import project_centres
from gsmerge.raster.photos import NEAR_PLANE
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

SAMPLE_PIXELS = 4096  # of a view, whose rays are looked along
SAME = 3 / 255  # difference of colours that a rounding of 8 bits and a photo's compression leave


def find_on_rays(scene: Scene, views: Sequence[int], photos: Sequence[np.ndarray]) -> np.ndarray:
    """Find which of some views' photos have Gaussians of their colours on their rays, as a mask ``[v]``.

    ``scene`` is canonical, and ``photos [h,w,3]`` are those that names give to the views, of their size. A photo has
    them if it has more than half-way from what the views' other photos have there to what all have in the middle on
    their own; none has where these do not stand out.
    """
    shares = measure_on_rays(scene, views, photos)
    own, others = np.diag(shares).copy(), shares[~np.eye(len(shares), dtype=bool)].reshape(len(shares), -1)
    if others.size == 0:
        return np.zeros(len(own), bool)
    middle = float(np.median(others))
    noise = NORMAL * float(np.median(np.abs(others - middle))) + 1 / SAMPLE_PIXELS
    if not np.median(own) - middle > MARGIN * noise:
        return np.zeros(len(own), bool)
    return np.asarray(own > (others.max(1) + np.median(own)) / 2)


def measure_on_rays(scene: Scene, views: Sequence[int], photos: Sequence[np.ndarray]) -> np.ndarray:
    """Measure the share ``[v,p]`` of sampled pixels of views with a Gaussian of a photo's colour on their ray."""
    g, cameras = scene.gaussians, scene.cameras
    means, scales = (np.ascontiguousarray(column, np.float32) for column in (g.means, g.scales))
    viewmats, Ks = (np.ascontiguousarray(array, np.float64) for array in (cameras.viewmats, cameras.Ks))
    size = cameras.width, cameras.height
    numbers = np.full(scene.pixels_per_view, -1, np.int32)  # of the pixels that are sampled
    sample = np.random.default_rng(0).permutation(len(numbers))[:SAMPLE_PIXELS]
    numbers[sample] = np.arange(len(sample), dtype=np.int32)

    def measure(view: int) -> np.ndarray:
        ids, pixels, _, areas = project_centres(means, scales, viewmats[view], Ks[view], *size, NEAR_PLANE)
        rows = np.flatnonzero((numbers[pixels] >= 0) & (areas > 0))  # whose centres lie in the picture
        places, colors = numbers[pixels[rows]], sh0_to_rgb(g.sh0[ids[rows], 0]).clip(0, 1)
        seen = max(1, int(np.count_nonzero(np.bincount(places, minlength=len(sample)))))
        shares = np.zeros(len(photos))
        for number, photo in enumerate(photos):
            apart = np.abs(photo.reshape(-1, 3)[pixels[rows]] - colors).max(1)
            shares[number] = np.count_nonzero(np.bincount(places[apart <= SAME], minlength=len(sample))) / seen
        return shares

    return np.stack(parallel_map(measure, views))
