"""Scene -> the scene with drawings of its Gaussians outside of all views.

A fit to photos alone loses the Gaussians that no photo shows. To keep these Gaussians, pictures of the input that show
them are added as photos. So Gaussians that only one photo shows stay even if the scene lacks the camera of this photo.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.errors import count_words
from gsmerge.method.fit.outside import outside_cameras
from gsmerge.method.geometry.transforms import motion_matrices
from gsmerge.method.geometry.views import concat_cameras, even_views, resize_cameras
from gsmerge.method.kernels.elementary import arctan2
from gsmerge.method.kernels.matrices import matmul
from gsmerge.method.raster import render
from gsmerge.method.raster.images import thin_out
from gsmerge.method.raster.photos import NEAR_PLANE, blank_photos, counting_pixels, photo_errors
from gsmerge.method.viewpoints.place_cameras import CANDIDATE_GAUSSIANS, PROBE, choose_candidates
from gsmerge.prepare.true_pixels import find_pixels
from gsmerge.runtime.record import record_choices
from gsmerge.types import Cameras, Gaussians, PicturedScene, Pixels, make_scene

# Cameras are placed if views miss at least this share of the Gaussians. A placed camera is used if at least this share
# of its pixels shows mainly Gaussians that the views miss. In fifteen captures in voxels, at most .001 of the Gaussians
# are outside of all views. Two of the four views of a narrow capture miss .02 of its Gaussians, and two of the five
# views of another capture miss .006
LEAST_OUTSIDE = 0.005
# number of views beside which cameras are placed, and of steps back from each
SOURCES = 4
STEPS_BACK = 8
# Bounds of a step: distance backwards as a share of the depth, rotation to the sides and rotation up or down in degrees
BESIDE_LOW = (0.2, -20.0, -15.0)
BESIDE_HIGH = (1.0, 20.0, 15.0)


def draw_outside(scene: PicturedScene) -> tuple[PicturedScene, str]:
    """Add pictures of the input from placed cameras if the views miss a part of the Gaussians; also say so.

    The placed cameras come last. Their pixels count only if they show mainly Gaussians that no view sees. The scene is
    canonical, and its rows belong to no pixels. The scene is returned unchanged if its views miss too few Gaussians.
    """
    outside = scene.get_pixels().homes < 0
    if outside.mean() < LEAST_OUTSIDE or outside.all():  # if all are outside, the cameras are wrong
        return scene, ""
    placed = _place_beside(scene.gaussians, outside, scene.cameras)
    white = np.repeat(outside.astype(np.float32)[:, None], 3, 1)  # all other Gaussians are black

    def is_outside(_: int, image: np.ndarray, transmittance: np.ndarray) -> np.ndarray:
        """Return a mask ``[h,w]`` of the pixels of a render that show mainly Gaussians outside of all views."""
        return np.asarray(image[..., 0] > (1 - transmittance) / 2)

    counting = np.stack(photo_errors(scene.gaussians, blank_photos(placed), is_outside, colors=white))
    useful = np.flatnonzero(counting.mean((1, 2)) > LEAST_OUTSIDE)
    if len(useful) == 0:
        return scene, ""
    placed = placed[useful]
    counting = counting[useful]
    places = count_words(len(placed), "place", "beside the views")
    unseen = f"no view sees {100 * outside.mean():.0f} % of the Gaussians"
    change = f"{unseen}: pictures of the input from {places} stand for photos there"
    record_choices(placed_views=len(placed))
    return _with_drawings(scene, placed, counting), change


def _place_beside(gaussians: Gaussians, outside: np.ndarray, cameras: Cameras) -> Cameras:
    """Place cameras that together show most of the Gaussians in the mask ``outside [n]``, which no view sees.

    Candidates step back from some of the views, or turn about the centre of a view.
    """
    sample = thin_out(gaussians, CANDIDATE_GAUSSIANS)
    step = max(1, -(-len(gaussians) // CANDIDATE_GAUSSIANS))
    sources = cameras[even_views(len(cameras), min(len(cameras), SOURCES))]
    back = outside_cameras(sample.means, sources, STEPS_BACK * len(sources), BESIDE_LOW, BESIDE_HIGH)
    # Copies of the views' cameras turn full circle about their centres in steps of half the field of view. At each step
    # one copy looks straight ahead, one looks up by half the field, and one looks down
    viewmats = []
    views = []
    width = cameras.width
    height = cameras.height
    for view, (viewmat, K) in enumerate(zip(sources.viewmats.astype(np.float64), sources.Ks, strict=True)):
        wide, high = (arctan2(side / 2, focal) for side, focal in ((width, K[0, 0]), (height, K[1, 1])))
        for azimuth in np.arange(0, 2 * np.pi, wide):  # `wide` and `high` are half the field, in radians
            for elevation in (-high, 0.0, high):
                motions = motion_matrices(np.array([[0.0, azimuth, 0, 0, 0, 0], [elevation, 0, 0, 0, 0, 0]]))
                viewmats.append(matmul(matmul(motions[1], motions[0]), viewmat))
                views.append(view)
    candidates = concat_cameras(back, replace(sources, viewmats=np.stack(viewmats), Ks=sources.Ks[views]))
    small = resize_cameras(candidates, PROBE, PROBE)
    least_added = 0.2  # a further camera is placed if it adds more than this share to what earlier cameras show
    return candidates[choose_candidates(sample, small, NEAR_PLANE, least_added, counting=outside[::step])]


def _with_drawings(scene: PicturedScene, cameras: Cameras, counting: np.ndarray) -> PicturedScene:
    """Add drawings of a scene from ``cameras``, which count like photos at pixels in the mask ``counting [c,h,w]``."""
    masks = counting_pixels(scene)
    importance = scene.importance
    empty = scene.empty
    large = scene.large_photos
    if large is not None:
        photos, first = large, max(large.ids) + 1
        Ks = cameras.Ks * np.array([[large.width / cameras.width], [large.height / cameras.height], [1.0]])
        at_size = replace(cameras, Ks=Ks, width=large.width, height=large.height)

        def read(number: int) -> np.ndarray:
            """Return a large photo, or draw a picture if the number is that of a placed camera."""
            if number < first:
                return photos.read(number)
            image = render(scene.gaussians, at_size[[number - first]]).images[0]
            return np.asarray(np.rint(255 * image.clip(0, 1)), np.uint8)

        ids = *large.ids, *range(first, first + len(cameras))
        large = replace(large, Ks=np.concatenate([large.Ks, Ks]), ids=ids, read=read)
    # Gaussians with a pixel in the scene keep it
    pixels = scene.get_pixels()
    placed = find_pixels(make_scene(scene.gaussians, cameras))
    placed_homes = np.where(placed.homes < 0, -1, placed.homes + len(scene) * scene.pixels_per_view)
    homes = np.where(pixels.homes < 0, placed_homes, pixels.homes)
    return replace(
        scene, cameras=concat_cameras(scene.cameras, cameras),
        pixels=Pixels(homes, np.concatenate([pixels.fronts, placed.fronts]), own=False),
        large_photos=large, names=(*scene.names, *(f"placed {view}" for view in range(len(cameras)))),
        images=np.concatenate([scene.images, render(scene.gaussians, cameras).images.clip(0, 1)]),
        masks=np.concatenate([masks, counting]),
        importance=None if importance is None else np.concatenate([importance, np.ones(counting.shape, np.float32)]),
        empty=None if empty is None else np.concatenate([empty, np.zeros(counting.shape, empty.dtype)]),
    )  # fmt: skip
