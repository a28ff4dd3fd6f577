"""Which groups of the state a batch sees, and which of its own groups show something new."""

from __future__ import annotations

import cv2
import numpy as np

from gsmerge.moments import Members, feature_to_gaussians
from gsmerge.online.options import OnlineOptions
from gsmerge.render.photos import Photos, photo_errors
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, FeatureGaussians, Gaussians

REACH = 3.34  # standard deviations to where an opaque Gaussian adds 1/255
MARGIN = 2.0  # pixels that the rasterizer's low-pass adds to that


def groups_in_view(features: FeatureGaussians, cameras: Cameras) -> np.ndarray:
    """``[v,g]`` bool: groups that may show in each view, by their position and size.

    The only step that goes through all groups: the time of those after it depends on what the views see.
    """
    means = features.means.astype(np.float64)
    radii = REACH * np.sqrt(np.trace(features.covars, axis1=1, axis2=2, dtype=np.float64))
    viewmats, Ks = cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64)

    def one_view(view: int) -> np.ndarray:
        viewmat, K = viewmats[view], Ks[view]
        points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
        inside: np.ndarray = points[:, 2] > -radii
        for axis, size in ((0, cameras.width), (1, cameras.height)):
            for edge, sign in ((-MARGIN, 1), (size + MARGIN, -1)):
                normal = np.zeros(3)  # of the plane through the camera and an edge of the image, inward
                normal[axis], normal[2] = sign * K[axis, axis], sign * (K[axis, 2] - edge)
                inside &= points @ (normal / np.linalg.norm(normal)) > -radii
        return inside

    return np.stack(parallel_map(one_view, range(len(cameras))))


def rows_in_view(features: FeatureGaussians, cameras: Cameras) -> np.ndarray:
    """Rows, rising, of the groups that may show in some view."""
    return np.flatnonzero(groups_in_view(features, cameras).any(0))


def pixel_errors(gaussians: Gaussians, photos: Photos, height: int, width: int) -> np.ndarray:
    """``[v,h,w]`` float32 mean squared colour error of every pixel, plus the squared transmittance.

    The transmittance counts holes, which a black photo would hide.
    """

    def score(view: int, image: np.ndarray, transmittance: np.ndarray) -> np.ndarray:
        errors = ((np.clip(image, 0, 1) - photos.images[view]) ** 2).mean(-1) + transmittance**2
        return cv2.resize(errors.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST)

    return np.stack(photo_errors(gaussians, photos, score))


def group_errors(features: FeatureGaussians, members: Members, errors: np.ndarray) -> np.ndarray:
    """``[g]`` mean of the pixels' errors ``[v,h,w]`` over each group's members; one without a pixel counts as 1."""
    starts, rows = features.starts, features.members
    pixels = rows if members.pixels is None else members.pixels[rows]
    each = np.where(pixels >= 0, errors.reshape(-1)[pixels], 1.0)
    return np.add.reduceat(each, starts[:-1]) / np.diff(starts)


def novel_rows(
    there: Gaussians,
    features: FeatureGaussians,
    members: Members,
    photos: Photos,
    cameras: Cameras,
    options: OnlineOptions,
) -> np.ndarray:
    """Rows of a batch's groups that show something which the state does not show as well.

    ``there``: the state's Gaussians in view; ``photos``: the batch's, at half the state's size.
    """
    if options.tolerance == 0:
        return np.arange(len(features))
    size = cameras.height, cameras.width
    errors = group_errors(features, members, pixel_errors(there, photos, *size))
    own_errors = group_errors(features, members, pixel_errors(feature_to_gaussians(features), photos, *size))
    limit = np.maximum(options.tolerance**2, options.margin**2 * own_errors)
    return np.flatnonzero(errors > limit)
