"""Unaligned Gaussians -> members: the pixel that each belongs to, and the Gaussian that each pixel shows.

The paper draws every view and gives a Gaussian to the superpixel with most of its blending weights (supplement
"Compaction of Non-Pixel-Aligned FF Backbones"). Weights at the pixels of the centres alone lead to results that are as
good, in less time. Gaussians that no view sees are marked.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.errors import UsageError
from gsmerge.geometry import morton_codes
from gsmerge.kernels.gaussians.fronts import weigh_centres
from gsmerge.moments import Members, pool_members, scene_members, unaligned_members
from gsmerge.raster.images import ONE_AT_A_TIME
from gsmerge.raster.photos import NEAR
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import in_turn
from gsmerge.settings.stages import DecodeOptions
from gsmerge.stages.decode import decode
from gsmerge.stages.encode import from_moments
from gsmerge.types import Gaussians, Scene


@stage("members")
def assign(scene: Scene) -> Members:
    """Return all Gaussians of a canonical scene as members with a pixel each; UsageError if no view sees any."""
    if scene.aligned:
        return scene_members(scene)
    pixels, fronts = find_pixels(scene)
    if not (pixels >= 0).any():
        raise UsageError(
            f"expected views that see the scene, found that none of {len(scene)} sees any of {len(pixels)} Gaussians: "
            "give the cameras that belong to it"
        )
    return unaligned_members(scene, pixels, fronts)


def find_pixels(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Find the pixel of each Gaussian, ``[n]`` int64 over all views, and the front of each pixel, ``[v,h,w]`` int32.

    A Gaussian's pixel is where its opacity x transmittance x area, pixels, is largest, -1 if no view sees it; the first
    view wins ties. A pixel's front is the Gaussian with the largest opacity x transmittance of those whose centres it
    sees, -1 without any.
    """
    g, cameras, count = scene.gaussians, scene.cameras, len(scene)
    means, scales, opacities = (np.ascontiguousarray(column, np.float32) for column in (g.means, g.scales, g.opacities))
    viewmats, Ks = (np.ascontiguousarray(array, np.float64) for array in (cameras.viewmats, cameras.Ks))
    fronts = np.empty((count, cameras.height, cameras.width), np.int32)
    most, pixels = np.zeros(len(g), np.float32), np.full(len(g), -1, np.int64)

    def weigh(view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return weigh_centres(means, scales, opacities, viewmats[view], Ks[view], NEAR, fronts[view])

    of_views = in_turn(weigh, range(count)) if len(g) <= ONE_AT_A_TIME else map(weigh, range(count))
    for view, (ids, places, weights) in enumerate(of_views):
        better = weights > most[ids]
        ids = ids[better]
        most[ids], pixels[ids] = weights[better], view * scene.pixels_per_view + places[better]
    return pixels, fronts


def merge_unseen(gaussians: Gaussians, scene: Scene, count: int) -> Gaussians:
    """Merge n Gaussians that no view sees into ``count``, by runs along Morton's curve."""
    order = np.argsort(morton_codes(gaussians.means.astype(np.float64)), kind="stable")
    members = unaligned_members(replace(scene, gaussians=gaussians), np.full(len(gaussians), -1, np.int64))
    starts = np.linspace(0, len(order), count + 1).astype(np.int64)
    features = from_moments(pool_members(members, starts, order), starts, order, np.full(count, -1))
    return decode(features, members, DecodeOptions(min_opacity=0.0))
