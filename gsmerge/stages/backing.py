"""A coarse, opaque layer behind the surfaces, seen only through holes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from gsmerge.kernels.gaussians.backing import draw_in, image_extinctions
from gsmerge.moments import Members, pool_members, principal_axes
from gsmerge.runtime.threads import parallel_map
from gsmerge.stages.encode import from_moments, member_rows
from gsmerge.types import FeatureGaussians, Groups, PixelScene, UnalignedScene, to_float32


@dataclass(frozen=True)
class BackingOptions:
    """The layer behind the surfaces.

    Args:
        backing: Share of the superpixels asked for that goes to this layer.
        push: Distance behind the surface, as a share of the depth.
        backing_spread: Factor on the standard deviations.

    Raises:
        ValueError: If a setting is out of range.
    """

    backing: float = 0.07
    push: float = 0.1
    backing_spread: float = 1.2

    def __post_init__(self) -> None:
        if not 0 <= self.backing <= 1:
            raise ValueError(f"backing: expected 0 to 1, got {self.backing}")
        if not self.push >= 0:
            raise ValueError(f"push: expected at least 0, got {self.push}")
        if not self.backing_spread > 0:
            raise ValueError(f"backing_spread: expected more than 0, got {self.backing_spread}")


def encode_backing(
    scene: PixelScene | UnalignedScene,
    members: Members,
    groups: Groups | None,
    options: BackingOptions,
    features: FeatureGaussians,
) -> FeatureGaussians | None:
    """The coarse Feature Gaussians of every view.

    Depths of the members are drawn in to one footprint of the group about its median (no curtain survives), the
    opacity comes from the area in the source image (the view stays covered whatever the depth noise), and the
    whole is pushed back along the view's rays.

    Args:
        scene: The canonical scene.
        members: Its Gaussians as arrays.
        groups: Coarse superpixels of every view; None: there is no such layer.
        options: Push and spread.
        features: Those in front, whose latents it takes the width of.
    """
    if groups is None:
        return None
    starts, ids, views = member_rows(scene, members, groups)
    drawn = _draw_in_members(scene, members, starts, ids, views)
    layer = from_moments(pool_members(drawn, starts, ids), starts, ids, views)
    optical_depths = _image_optical_depths(scene, drawn, layer)
    scales, _ = principal_axes(layer.covars)
    centres, grow = scene.cameras.centres.astype(np.float32)[layer.views], 1 + options.push
    return replace(
        layer,
        means=centres + (layer.means - centres) * grow,
        extinctions=to_float32(optical_depths * scales[:, 1] * scales[:, 2]),
        spreads=layer.spreads * options.backing_spread * grow,
        backing=np.ones(len(layer), bool),
        latents=np.zeros((len(layer), features.latents.shape[1]), np.float32),
    )


def _view_slices(views: np.ndarray, num_views: int) -> list[slice]:
    """The rows of every view's groups (groups are in order of view)."""
    edges = np.searchsorted(views, np.arange(num_views + 1))
    return [slice(a, b) for a, b in pairwise(edges)]


def _camera(scene: PixelScene | UnalignedScene, view: int) -> tuple[np.ndarray, float, float]:
    K = scene.cameras.Ks[view]
    return scene.cameras.viewmats[view].astype(np.float64), float(K[0, 0]), float(K[1, 1])


def _draw_in_members(
    scene: PixelScene | UnalignedScene, members: Members, starts: np.ndarray, ids: np.ndarray, views: np.ndarray
) -> Members:
    """The members moved along their rays to within one footprint of their group's median depth."""
    means, scales = members.means.copy(), members.scales.copy()
    pixels = scene.pixels_per_view

    def one_view(item: tuple[int, slice]) -> None:
        view, groups = item
        viewmat, fx, _ = _camera(scene, view)
        eye = (-viewmat[:3, :3].T @ viewmat[:3, 3]).astype(np.float32)
        own = starts[groups.start : groups.stop + 1]
        seen = ids[own[0] : own[-1]]
        rows: slice | np.ndarray = seen
        places = np.arange(len(seen))
        if members.pixels is None:
            rows, places = slice(view * pixels, (view + 1) * pixels), seen - view * pixels
        depths = means[rows] @ viewmat[2, :3].astype(np.float32) + np.float32(viewmat[2, 3])
        inverse, factors = (1 / np.maximum(depths, 1e-6)).astype(np.float64), np.ones(len(depths))
        draw_in(own - own[0], places, inverse, 1 / abs(fx), factors)
        shrink = factors.astype(np.float32)[:, None]
        means[rows] = eye + (means[rows] - eye) * shrink
        scales[rows] *= shrink

    parallel_map(one_view, enumerate(_view_slices(views, len(scene))))
    return replace(members, means=means, scales=scales)


def _image_optical_depths(scene: PixelScene | UnalignedScene, members: Members, layer: FeatureGaussians) -> np.ndarray:
    """Optical depth ``[g]`` that covers as much of the source image as the members did."""
    starts, ids, views = layer.starts, layer.members, layer.views
    sums = np.zeros(len(layer))

    def one_view(item: tuple[int, slice]) -> None:
        view, groups = item
        viewmat, fx, fy = _camera(scene, view)
        m = members
        own = starts[groups.start : groups.stop + 1]
        image_extinctions(
            own, ids, m.means, m.quats, m.scales, m.opacities, m.footprints, viewmat, fx, fy, sums[groups]
        )
        camera = layer.means[groups].astype(np.float64) @ viewmat[:3, :3].T + viewmat[:3, 3]
        x, y, z = camera.T
        z = np.maximum(z, 1e-9)
        jacobian = np.zeros((len(z), 2, 3))
        jacobian[:, 0, 0], jacobian[:, 0, 2] = fx / z, -fx * x / z**2
        jacobian[:, 1, 1], jacobian[:, 1, 2] = fy / z, -fy * y / z**2
        half = jacobian @ viewmat[:3, :3]
        image = half @ layer.covars[groups].astype(np.float64) @ half.transpose(0, 2, 1)
        sums[groups] /= np.sqrt(np.maximum(np.linalg.det(image), 1e-12))

    parallel_map(one_view, enumerate(_view_slices(views, len(scene))))
    return sums
