"""Scenes of which the networks get some views, with all their photos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from gsmerge.measure.evaluate import Views
from gsmerge.measure.visibility import context_points, visible_pixels
from gsmerge.moments import Members, scene_members
from gsmerge.render import composite, plan_view, prepare
from gsmerge.render.photos import NEAR, Photos, scene_photos
from gsmerge.runtime.threads import parallel_map
from gsmerge.stages.prepare import canonicalise
from gsmerge.types import Cameras, PixelScene, UnalignedScene
from gsmerge.views import even_views, subset

OPAQUE = 0.5  # alpha from which the Gaussians cover a pixel


@dataclass(frozen=True, eq=False)
class TrainingScene:
    """Some views of a scene, in the canonical frame, and the photos of all."""

    scene: PixelScene  # the chosen views
    members: Members  # its Gaussians
    cameras: Cameras  # of all photos, those of the chosen views first
    images: np.ndarray  # [p,h,w,3] float32, at the size of the scene's own

    def photos(self, level: int = 1) -> Photos:
        """All photos, each side divided by ``level``."""
        names = tuple(map(str, range(len(self.cameras))))
        unaligned = UnalignedScene(self.scene.gaussians[:0], self.cameras, torch.from_numpy(self.images), names)
        return scene_photos(unaligned, level)


def view_subsets(num_views: int, counts: Sequence[int]) -> list[list[int]]:
    """Views of each count, evenly spread; 0, or more than there are, means all. Every selection is returned once."""
    chosen = [even_views(num_views, count if 0 < count < num_views else num_views) for count in counts]
    return [ids for i, ids in enumerate(chosen) if ids not in chosen[:i]]


def make_training_scene(scene: PixelScene, ids: Sequence[int], held_out: Views | None = None) -> TrainingScene:
    """The views ``ids`` of a scene with one Gaussian per pixel, with all its photos.

    Photos of ``held_out`` views are added, resized to the scene's own.
    """
    assert scene.images is not None
    part = subset(scene, ids)
    assert isinstance(part, PixelScene)
    canonical, frame = canonicalise(part)
    rest = [view for view in range(len(scene)) if view not in set(ids)]
    order = [*ids, *rest]
    cameras, images = scene.cameras[order], scene.images.numpy()[order]
    if held_out is not None:
        width, height = cameras.width, cameras.height
        ratio = torch.tensor([width / held_out.cameras.width, height / held_out.cameras.height, 1.0])
        cameras = replace(
            cameras,
            viewmats=torch.cat([cameras.viewmats.double(), held_out.cameras.viewmats.double()]),
            Ks=torch.cat([cameras.Ks.double(), held_out.cameras.Ks.double() * ratio.double()[:, None]]),
        )
        resized = [_resize(image, width, height) for image in held_out.images.numpy()]
        images = np.concatenate([images, np.stack(resized)])
    return TrainingScene(canonical, scene_members(canonical), frame.enter_cameras(cameras), images)


def _resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """The photo at another size, by area averages where it shrinks."""
    if image.shape[:2] == (height, width):
        return image
    smaller = width * height < image.shape[0] * image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def coverage_masks(training: TrainingScene) -> np.ndarray:
    """``[p,h,w]`` bool: pixels of surfaces that the chosen views see, and that their Gaussians cover."""
    own, cameras = len(training.scene), training.cameras
    splats, photos = prepare(training.scene.gaussians, np.zeros(3)), training.photos()

    def opaque(view: int) -> np.ndarray:
        return 1 - composite(plan_view(splats, **photos.camera(view), near=NEAR))[1] >= OPAQUE

    masks = np.stack(parallel_map(opaque, range(len(cameras))))
    if len(cameras) > own:
        points = context_points(training.scene, NEAR)
        masks[own:] &= visible_pixels(points, cameras[own:], NEAR, training.scene.cameras)
    return masks


def reduced_masks(masks: np.ndarray, photos: Photos) -> np.ndarray:
    """Masks ``[p,h,w]`` of full-size photos for smaller ones: pixels of which more than half is in the mask."""
    size = photos.width, photos.height
    small = [cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5 for mask in masks]
    return np.stack(small)
