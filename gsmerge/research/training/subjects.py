"""Scenes with some of their views, and every photo that is known of them."""

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
class Subject:
    """A canonical scene of some views, and the photos of all.

    Args:
        scene: The chosen views, canonical.
        members: Its Gaussians.
        cameras: Those of all photos, canonical; the scene's own come first.
        images: ``[p,h,w,3]`` float32, at the size of the scene's own.
    """

    scene: PixelScene
    members: Members
    cameras: Cameras
    images: np.ndarray

    def photos(self, level: int = 1) -> Photos:
        """All photos, each side divided by ``level``."""
        names = tuple(map(str, range(len(self.cameras))))
        every = UnalignedScene(self.scene.gaussians[:0], self.cameras, torch.from_numpy(self.images), names)
        return scene_photos(every, level)


def view_subsets(num_views: int, counts: Sequence[int]) -> list[list[int]]:
    """Views of each count, evenly spread: 0, and a count that there are not as many for, means all; none twice."""
    chosen = [even_views(num_views, count if 0 < count < num_views else num_views) for count in counts]
    return [ids for i, ids in enumerate(chosen) if ids not in chosen[:i]]


def make_subject(scene: PixelScene, ids: Sequence[int], held_out: Views | None = None) -> Subject:
    """A scene as if only some of its views had been given; the other photos are known nevertheless.

    Args:
        scene: One Gaussian per pixel, with photos.
        ids: The views that are given.
        held_out: More photos in the scene's frame; brought to the size of the scene's own.
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
        fitting = [_at_size(image, width, height) for image in held_out.images.numpy()]
        images = np.concatenate([images, np.stack(fitting)])
    return Subject(canonical, scene_members(canonical), frame.enter_cameras(cameras), images)


def _at_size(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """The photo at another size; area averages where it shrinks."""
    if image.shape[:2] == (height, width):
        return image
    smaller = width * height < image.shape[0] * image.shape[1]
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)


def covered(subject: Subject) -> np.ndarray:
    """``[p,h,w]`` bool: pixels that show what the given views have seen, and that their Gaussians cover."""
    own, cameras = len(subject.scene), subject.cameras
    splats, photos = prepare(subject.scene.gaussians, np.zeros(3)), subject.photos()

    def opaque(view: int) -> np.ndarray:
        return 1 - composite(plan_view(splats, **photos.camera(view), near=NEAR))[1] >= OPAQUE

    masks = np.stack(parallel_map(opaque, range(len(cameras))))
    if len(cameras) > own:
        points = context_points(subject.scene, NEAR)
        masks[own:] &= visible_pixels(points, cameras[own:], NEAR, subject.scene.cameras)
    return masks


def reduced_masks(masks: np.ndarray, photos: Photos) -> np.ndarray:
    """Masks ``[p,h,w]`` of full-size photos for the same photos at a smaller size: most of a pixel must count."""
    size = photos.width, photos.height
    small = [cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5 for mask in masks]
    return np.stack(small)
