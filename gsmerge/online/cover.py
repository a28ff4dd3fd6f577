"""What the views see of the state, and which new groups show what it shows as well."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from gsmerge.moments import Members
from gsmerge.render import composite, plan_view, prepare
from gsmerge.render.photos import Photos
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, FeatureGaussians, Gaussians

REACH = 3.34  # standard deviations to where a solid Gaussian adds 1/255
MARGIN = 2.0  # pixels that the rasterizer's low-pass adds to that


def in_view(features: FeatureGaussians, cameras: Cameras) -> np.ndarray:
    """``[v,g]`` bool: groups that may show in each view, by their place and size.

    One look at every group and view, so that all that follows depends on what the views see and not on the state.
    """
    means = features.means.double().numpy()
    radii = REACH * np.sqrt(features.covars.double().diagonal(dim1=1, dim2=2).sum(1).numpy())
    viewmats, Ks = cameras.viewmats.double().numpy(), cameras.Ks.double().numpy()

    def one_view(view: int) -> np.ndarray:
        viewmat, K = viewmats[view], Ks[view]
        places = means @ viewmat[:3, :3].T + viewmat[:3, 3]
        inside: np.ndarray = places[:, 2] > -radii
        for axis, size in ((0, cameras.width), (1, cameras.height)):
            for edge, sign in ((-MARGIN, 1), (size + MARGIN, -1)):
                normal = np.zeros(3)  # of the plane through the eye and an edge of the picture, pointing inside
                normal[axis], normal[2] = sign * K[axis, axis], sign * (K[axis, 2] - edge)
                inside &= places @ (normal / np.linalg.norm(normal)) > -radii
        return inside

    return np.stack(parallel_map(one_view, range(len(cameras))))


def rows_in_view(features: FeatureGaussians, cameras: Cameras) -> Tensor:
    """Rows, rising, of the groups that may show in some view."""
    return torch.from_numpy(np.flatnonzero(in_view(features, cameras).any(0)))


def pixel_errors(gaussians: Gaussians, pictures: Photos, height: int, width: int) -> np.ndarray:
    """``[v,h,w]`` float32 mean squared colour error of every pixel as some Gaussians show it, holes counted.

    Where the Gaussians let light through, the square of its share is added: a dark pixel is no excuse for a hole.

    Args:
        gaussians: Canonical Gaussians.
        pictures: The views, usually at half size.
        height: Of the result.
        width: Of the result.
    """
    splats = prepare(gaussians)

    def one_view(view: int) -> np.ndarray:
        image, transmittance = composite(plan_view(splats, **pictures.camera(view)))
        errors = ((np.clip(image, 0, 1) - pictures.images[view]) ** 2).mean(-1) + transmittance**2
        return cv2.resize(errors.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST)

    return np.stack(parallel_map(one_view, range(len(pictures))))


def group_errors(features: FeatureGaussians, members: Members, errors: np.ndarray) -> np.ndarray:
    """``[g]`` mean of the pixels' errors over the members of every group; members of no pixel count as fully wrong.

    Args:
        features: g Feature Gaussians, each with at least one member.
        members: The scene's Gaussians that they point to.
        errors: ``[v,h,w]``.
    """
    rows = features.members.numpy()
    pixels = rows if members.pixels is None else members.pixels[rows]
    each = np.where(pixels >= 0, errors.reshape(-1)[pixels], 1.0)
    starts = features.starts.numpy()
    return np.add.reduceat(each, starts[:-1]) / np.diff(starts)
