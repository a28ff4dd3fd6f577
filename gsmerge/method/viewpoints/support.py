"""Gaussians and cameras -> support: the number of views that show each Gaussian.

Behind other surfaces and beyond the borders of the photos, where no photo shows the scene, the Gaussians of a fit are
guesses. The photos' cameras do not see these guesses, but from farther away they look like surfaces. The number of
views tells guesses from other Gaussians, so that results can mark the guesses, leave them out, or show them faintly.
"""

from __future__ import annotations

import numpy as np

from gsmerge.method.geometry.frame import scene_frame
from gsmerge.method.raster import make_splats, tile_view
from gsmerge.method.raster.composite import list_contributions
from gsmerge.method.raster.photos import blank_photos
from gsmerge.runtime.threads import in_turn
from gsmerge.settings.fit import FitOptions
from gsmerge.types import Cameras, Gaussians, make_scene

# A view shows a Gaussian if the Gaussian's blending weight in some pixel is at least SHOWN_WEIGHT, the least in a fit
SHOWN_WEIGHT = FitOptions().min_contribution


def count_views(gaussians: Gaussians, cameras: Cameras) -> np.ndarray:
    """Count the views that show each of n canonical Gaussians, ``[n]`` int32.

    A view shows a Gaussian whose blending weight is at least 1/255 in some pixel. A fit keeps only such Gaussians.
    """
    splats = make_splats(gaussians)
    min_level = 2  # pictures are smaller by at least this factor, as in a fit's survey
    max_side = 480  # longer side of the pictures, pixels
    pictures = blank_photos(cameras, max(min_level, max(cameras.width, cameras.height) / max_side))

    def list_shown(view: int) -> np.ndarray:
        """Return the rows of the Gaussians that a view shows."""
        tiled = tile_view(splats, **pictures.camera(view))
        return tiled.ids[list_contributions(tiled)[1] >= SHOWN_WEIGHT]

    counts = np.zeros(len(gaussians), np.int32)
    for shown in in_turn(list_shown, range(len(pictures))):
        counts[shown] += 1
    return counts


def count_views_in_world(gaussians: Gaussians, cameras: Cameras) -> np.ndarray:
    """Count the views that show each of n Gaussians in the world frame, ``[n]`` int32; there must be a view."""
    frame = scene_frame(make_scene(gaussians, cameras))
    return count_views(frame.enter(gaussians), frame.enter_cameras(cameras))
