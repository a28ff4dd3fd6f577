"""Changes of a scene that should matter little, or be survived. Each gives a new scene, and moves the judges along."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from gsmerge.measure.evaluate import Views
from gsmerge.stages.prepare import scene_frame
from gsmerge.types import SH_C0, Cameras, Gaussians, PixelScene, UnalignedScene
from gsmerge.views import even_views, subset

SEED = 7
FLYAWAYS = 2.5e-5  # share of the Gaussians that is thrown far away
OVERSIZED, OVERSIZE = 0.01, 8.0  # share of the Gaussians, and how many times as large they become
BROKEN = 0.01  # share of the rows that are made NaN


@dataclass(frozen=True)
class Judged:
    """A scene and the views that its results are judged by.

    Args:
        scene: The scene.
        judges: Held-out views, in its world; None: its own views.
    """

    scene: PixelScene | UnalignedScene
    judges: Views | None


def fewer_views(given: Judged, count: int) -> Judged:
    """Only so many views, at equal intervals."""
    return replace(given, scene=subset(given.scene, even_views(len(given.scene), min(count, len(given.scene)))))


def half_the_views(given: Judged) -> Judged:
    """Every second view, about."""
    return fewer_views(given, max(1, len(given.scene) // 2))


def reordered(given: Judged) -> Judged:
    """The views in another order."""
    order = np.random.default_rng(SEED).permutation(len(given.scene)).tolist()
    return replace(given, scene=subset(given.scene, order))


def repeated(given: Judged) -> Judged:
    """Every view twice."""
    return replace(given, scene=subset(given.scene, [*range(len(given.scene))] * 2))


def moved(given: Judged, factor: float, shift: Sequence[float]) -> Judged:
    """The world scaled, and moved by so many units of its own size."""
    offset = torch.tensor(shift, dtype=torch.float64) * scene_frame(given.scene).unit * factor
    scene, judges = given.scene, given.judges
    means = factor * scene.gaussians.means.double() + offset
    gaussians = replace(scene.gaussians, means=means, scales=scene.gaussians.scales * factor)
    scene = replace(scene, gaussians=gaussians, cameras=_moved_cameras(scene.cameras, factor, offset))
    if judges is not None:
        judges = replace(judges, cameras=_moved_cameras(judges.cameras, factor, offset))
    return Judged(scene, judges)


def _moved_cameras(cameras: Cameras, factor: float, offset: Tensor) -> Cameras:
    viewmats = cameras.viewmats.double().clone()
    viewmats[:, :3, 3] = factor * viewmats[:, :3, 3] - viewmats[:, :3, :3] @ offset
    return replace(cameras, viewmats=viewmats)


def wrong_poses(given: Judged, degrees: float) -> Judged:
    """Every view, with its Gaussians, turned about its own eye by a random axis."""
    scene = given.scene
    assert isinstance(scene, PixelScene)
    rng = np.random.default_rng(SEED)
    means = scene.gaussians.means.double().clone().reshape(len(scene), -1, 3)
    viewmats = scene.cameras.viewmats.double().clone()
    for view in range(len(scene)):
        turn = torch.from_numpy(_rotation(rng.normal(size=3), np.deg2rad(degrees)))
        old = viewmats[view].clone()
        viewmats[view, :3] = turn @ old[:3]
        camera = means[view] @ old[:3, :3].T + old[:3, 3]
        means[view] = (camera - viewmats[view, :3, 3]) @ viewmats[view, :3, :3]
    gaussians = replace(scene.gaussians, means=means.reshape(-1, 3))
    return replace(given, scene=replace(scene, gaussians=gaussians, cameras=replace(scene.cameras, viewmats=viewmats)))


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def other_exposure(given: Judged, share: float) -> Judged:
    """Photos, and Gaussians of their views, brighter and darker by turns."""
    scene = given.scene
    assert isinstance(scene, PixelScene)
    assert scene.images is not None
    gains = torch.tensor([1 + share if view % 2 else 1 - share for view in range(len(scene))], dtype=torch.float32)
    rows = gains.repeat_interleave(scene.pixels_per_view)[:, None, None]
    g = scene.gaussians
    sh0 = ((0.5 + SH_C0 * g.sh0) * rows - 0.5) / SH_C0
    gaussians = replace(g, sh0=sh0, shN=g.shN * rows)
    images = (scene.images * gains[:, None, None, None]).clamp(0, 1)
    return replace(given, scene=replace(scene, gaussians=gaussians, images=images))


def broken_rows(given: Judged) -> Judged:
    """Rows without finite numbers: the reader sets them aside."""
    scene = given.scene
    chosen = _chosen(len(scene.gaussians), BROKEN)
    if isinstance(scene, UnalignedScene):
        return replace(given, scene=replace(scene, gaussians=scene.gaussians[~chosen]))
    opacities = torch.where(chosen, torch.zeros(()), scene.gaussians.opacities)
    return replace(
        given,
        scene=replace(
            scene,
            gaussians=replace(scene.gaussians, opacities=opacities),
            valid=scene.valid & ~chosen.reshape(scene.valid.shape),
        ),
    )


def flyaways(given: Judged) -> Judged:
    """A few Gaussians a thousand times as far away."""
    scene = given.scene
    chosen = _chosen(len(scene.gaussians), FLYAWAYS)[:, None]
    means = torch.where(chosen, 1000 * scene.gaussians.means, scene.gaussians.means)
    return replace(given, scene=replace(scene, gaussians=replace(scene.gaussians, means=means)))


def oversized(given: Judged) -> Judged:
    """Some Gaussians many times as large."""
    return replace(given, scene=replace(given.scene, gaussians=_enlarged(given.scene.gaussians)))


def _enlarged(gaussians: Gaussians) -> Gaussians:
    chosen = _chosen(len(gaussians), OVERSIZED)[:, None]
    return replace(gaussians, scales=torch.where(chosen, OVERSIZE * gaussians.scales, gaussians.scales))


def _chosen(count: int, share: float) -> Tensor:
    """``[count]`` bool: a share of them, at least one."""
    chosen = torch.zeros(count, dtype=torch.bool)
    chosen[np.random.default_rng(SEED).choice(count, max(1, round(share * count)), replace=False)] = True
    return chosen
