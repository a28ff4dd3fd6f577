"""Find photos whose pixels have Gaussians of the same colour on their rays, at any depth.

Models give the Gaussians of a pixel about the colour of that pixel and put them on its ray. A wrong depth only moves
them along the ray. So most pixels of the right photo have a Gaussian of their colour on their ray. Pixels of a wrong
photo have one only by chance.
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

SAMPLE_PIXELS = 4096  # pixels of a view whose rays are examined
SAME = 3 / 255  # largest difference of equal colours after rounding to 8 bits and compression of the photo


def find_on_rays(scene: Scene, views: Sequence[int], photos: Sequence[np.ndarray]) -> np.ndarray:
    """Find which photos have Gaussians of their colours on the rays of their views, as a mask ``[v]``.

    ``scene`` is canonical. ``photos [h,w,3]`` are the photos that names assign to ``views``, at the size of the views.
    Each photo is measured in its own view and in all other views, as the share of pixels with a Gaussian of their
    colour. A photo passes if its share in its own view exceeds the mean of two numbers: the largest share of a wrong
    photo in that view, and the median share of all photos in their own views. No photo passes if this median is not
    clearly above the shares of wrong pairs.
    """
    shares = measure_on_rays(scene, views, photos)
    is_wrong = ~np.eye(len(shares), dtype=bool)
    own_shares, wrong_shares = np.diag(shares).copy(), shares[is_wrong].reshape(len(shares), -1)
    if wrong_shares.size == 0:
        return np.zeros(len(own_shares), bool)
    middle = float(np.median(wrong_shares))
    noise = NORMAL * float(np.median(np.abs(wrong_shares - middle))) + 1 / SAMPLE_PIXELS
    if not np.median(own_shares) - middle > MARGIN * noise:
        return np.zeros(len(own_shares), bool)
    return np.asarray(own_shares > (wrong_shares.max(1) + np.median(own_shares)) / 2)


def measure_on_rays(scene: Scene, views: Sequence[int], photos: Sequence[np.ndarray]) -> np.ndarray:
    """Measure the share ``[v,p]`` of each view's sampled pixels with a Gaussian of the photo's colour on their ray.

    Each of p photos is measured in each of v views. Only pixels with any Gaussian on their ray count.
    """
    g, cameras = scene.gaussians, scene.cameras
    means, scales = (np.ascontiguousarray(column, np.float32) for column in (g.means, g.scales))
    viewmats, Ks = (np.ascontiguousarray(array, np.float64) for array in (cameras.viewmats, cameras.Ks))
    size = cameras.width, cameras.height
    sample_ids = np.full(scene.pixels_per_view, -1, np.int32)  # of sampled pixels; -1 for all other pixels
    sample = np.random.default_rng(0).permutation(len(sample_ids))[:SAMPLE_PIXELS]
    sample_ids[sample] = np.arange(len(sample), dtype=np.int32)

    def count_pixels(ids: np.ndarray) -> int:
        """Count the different sampled pixels among ``ids [n]``."""
        return int(np.count_nonzero(np.bincount(ids, minlength=len(sample))))

    def measure(view: int) -> np.ndarray:
        ids, pixels, _, areas = project_centres(means, scales, viewmats[view], Ks[view], *size, NEAR_PLANE)
        rows = np.flatnonzero((sample_ids[pixels] >= 0) & (areas > 0))  # Gaussians whose centres lie in the picture
        sampled, colors = sample_ids[pixels[rows]], sh0_to_rgb(g.sh0[ids[rows], 0]).clip(0, 1)
        num_covered = max(1, count_pixels(sampled))
        shares = np.zeros(len(photos))
        for photo_id, photo in enumerate(photos):
            differences = np.abs(photo.reshape(-1, 3)[pixels[rows]] - colors).max(1)
            shares[photo_id] = count_pixels(sampled[differences <= SAME]) / num_covered
        return shares

    return np.stack(parallel_map(measure, views))
