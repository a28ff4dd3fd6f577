"""Prepare scenes for training: all photos of a scene, and some of its views for the networks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmerge.frozen import dataclass
from gsmerge.method.geometry.frame import canonicalise
from gsmerge.method.geometry.pooling import Members, scene_members
from gsmerge.method.geometry.views import concat_cameras, even_views, resize_cameras, subset
from gsmerge.method.raster import composite, make_splats, tile_view
from gsmerge.method.raster.photos import NEAR_PLANE, Photos, photos_of
from gsmerge.runtime.threads import parallel_map
from gsmerge.scoring.sizes import resize_photo
from gsmerge.scoring.visibility import context_points, visible_pixels
from gsmerge.types import Cameras, Scene, Views


@dataclass(frozen=True, eq=False)
class TrainingScene:
    """The chosen views of a scene, in the canonical frame, with all photos of the scene."""

    scene: Scene  # the chosen views
    members: Members  # the Gaussians of these views
    cameras: Cameras  # cameras of all photos; the cameras of the chosen views are first
    images: np.ndarray  # [p,h,w,3] float32 photos, at the size of the scene's photos

    def photos(self, level: float = 1) -> Photos:
        """Return all photos with sides divided by ``level``."""
        return photos_of(self.images, self.cameras, level)


def view_subsets(num_views: int, counts: Sequence[int]) -> list[list[int]]:
    """Choose evenly spread views for each of ``counts``; equal choices are returned once.

    All views are chosen if a count is 0, or larger than ``num_views``.
    """
    chosen = [even_views(num_views, count if 0 < count < num_views else num_views) for count in counts]
    return [ids for i, ids in enumerate(chosen) if ids not in chosen[:i]]


def make_training_scene(scene: Scene, ids: Sequence[int], held_out: Views | None = None) -> TrainingScene:
    """Prepare the views ``ids`` of an aligned scene for training, with all photos of the scene.

    Photos of ``held_out`` views are added, resized to the size of the scene's photos.
    """
    assert scene.images is not None
    part = subset(scene, ids)
    canonical, frame = canonicalise(part)
    other_views = [view for view in range(len(scene)) if view not in set(ids)]
    order = [*ids, *other_views]
    cameras = scene.cameras[order]
    images = scene.images[order]
    if held_out is not None:
        width = cameras.width
        height = cameras.height
        cameras = concat_cameras(cameras, resize_cameras(held_out.cameras, width, height))
        resized = [resize_photo(image, width, height) for image in held_out.images]
        images = np.concatenate([images, np.stack(resized)])
    return TrainingScene(canonical, scene_members(canonical), frame.enter_cameras(cameras), images)


def measure_covered(training: TrainingScene, level: float = 1) -> np.ndarray:
    """Measure how far each chosen view covers every pixel of each photo, ``[v,p,h,w]`` uint8.

    The value of a pixel is the opacity of the view's Gaussians, times 255. The value is 0 if the view does not see what
    the pixel shows. :func:`covered_pixels` finds from these values what a subset of the views covers. ``level`` divides
    the photos' sides.
    """
    scene, photos = training.scene, training.photos(level)
    cameras = Cameras(photos.viewmats, photos.Ks, photos.width, photos.height)

    def measure_view(view: int) -> np.ndarray:
        """Measure the coverage ``[p,h,w]`` of all photos by the Gaussians of one view."""
        part = subset(scene, [view])
        splats = make_splats(part.gaussians, np.zeros(3))
        views = (tile_view(splats, **photos.camera(photo), near=NEAR_PLANE) for photo in range(len(photos)))
        opacities = np.stack([1 - composite(tiled)[1] for tiled in views])
        seen = visible_pixels(context_points(part, NEAR_PLANE), cameras, NEAR_PLANE, scene.cameras)
        seen[view] = True  # the view sees all of its own photo
        return np.where(seen, np.round(255 * opacities), 0).astype(np.uint8)

    return np.stack(parallel_map(measure_view, range(len(scene))))


def covered_pixels(covers: np.ndarray) -> np.ndarray:
    """Return the mask of pixels that the views together cover, from ``covers [v,...]`` of :func:`measure_covered`."""
    transmittance = np.ones(covers.shape[1:], np.float32)
    for cover in covers:
        transmittance *= 1 - cover.astype(np.float32) / 255
    min_alpha = 0.5  # least alpha of a pixel that counts as covered
    return transmittance <= 1 - min_alpha
