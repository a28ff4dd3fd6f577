"""Measure fog, veils, holes and spikes: errors of a compact scene that only show from outside the views.

Photos score a scene only from the viewpoints of the photos, but a person who views the scene first steps back and
turns. From outside, Gaussians in gaps between the views show as haze, and Gaussians of wrong depth show as veils before
surfaces. Gaps in surfaces show as holes. Long thin Gaussians, which look like texture in one view, show as strokes.
Photos are not needed, only the input and the cameras of its views. docs/guide/measure.md explains the figures to
users.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import cv2
import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.fit.report import HAZE
from gsmerge.method.geometry.transforms import camera_depths, middle_depth, step_outside
from gsmerge.method.geometry.views import pick_views
from gsmerge.method.raster import Splats, make_splats, render
from gsmerge.method.raster.composite import blend_depths
from gsmerge.method.raster.images import tile_camera
from gsmerge.runtime.record import Progress
from gsmerge.scoring.sizes import shrink_cameras
from gsmerge.types import Cameras, Gaussians

VIEWS = 3  # evenly spread input views from which the cameras start
# Outside cameras by kind, as pairs of a share and an angle. A camera steps back from an input view, by this share of
# the view's median depth. Then the camera turns about the point in the view's middle, by this angle in degrees
FOG_CAMERAS = {"back": ((0.5, 0), (1.5, 0)), "turned": ((0.5, -30), (0.5, 30))}
ALL = "all"  # kind that stands for the outside cameras of all kinds
FOG_PIXELS = 480  # longer side of the pictures is at most this, pixels
# A pixel of the input is empty if its opacity is below FOG_EMPTY, and solid if its opacity is above FOG_SOLID. A solid
# pixel of the input is a hole of a result if the result has an opacity below FOG_OPEN in this pixel
FOG_EMPTY = 0.05
FOG_SOLID = 0.9
FOG_OPEN = 0.5
EROSION_PIXELS = 17  # side, in pixels, of the square that erodes empty regions
VEIL_SHARE = 0.7  # a result has a veil where its depth is below this share of the input's depth
VEILED = 0.08  # share of the pixels; a result whose worst veil is larger gets a note
# A spike is a Gaussian whose longest scale is at least RATIOS times the second one, and whose length at 3 sigma is more
# than LONG of the picture's width. A spike is visible where a channel changes by more than CHANGED if the spike is
# removed
RATIOS = (5.0, 3.0)
LONG = 0.05
CHANGED = 0.05
FOG_NEAR_PLANE = 0.25  # near plane of the depths of both scenes, as a share of the view's median depth


@dataclass(frozen=True)
class Fog:
    """Fog, veils, holes and spikes of a result, seen from outside and compared with its input.

    A figure is None if it can be measured on no pixel.

    Args:
        fog_near: Mean opacity, in [0, 1], where the input is empty.
        fog_far: Mean opacity of the pixels that are more than a tenth of the width away from every pixel in which the
            input shows anything.
        holes: Share of the pixels with a solid input in which the result has an opacity below a half.
        veil: Share of the pixels with a solid input in which the depth of the result is less than 0.7 of the input's
            depth. This share is a mean over the cameras.
        veil_worst: The largest veil of a single camera.
        spikes: Share of the pixels that change visibly if all spikes are removed. A spike is longer than 5 % of the
            width, and at least five times as long as its second axis.
        strokes: Like ``spikes``, but a spike is at least three times as long as its second axis.
    """

    fog_near: float | None = None
    fog_far: float | None = None
    holes: float | None = None
    veil: float | None = None
    veil_worst: float | None = None
    spikes: float | None = None
    strokes: float | None = None


@dataclass(frozen=True, eq=False)
class OutsidePicture:
    """Opacities and depths of a scene in one outside camera."""

    opacities: np.ndarray  # [h,w]
    beyond: np.ndarray  # [h,w] opacities without Gaussians nearer than FOG_NEAR_PLANE
    depths: np.ndarray  # [h,w] mean camera z, without Gaussians nearer than FOG_NEAR_PLANE


def measure_fog(
    reference: Gaussians,
    results: Mapping[str, Gaussians],
    cameras: Cameras,
    near: float = 0.01,
    progress: Progress = lambda *_: None,
    marks: Mapping[str, bool] | None = None,
) -> dict[str, dict[str, Fog]]:
    """Measure fog, veils, holes and spikes of results, by name, from outside the ``cameras`` of a ``reference`` scene.

    Returns, by the name of a result and the kind of camera, a :class:`Fog` of all pictures of this kind. Kinds are the
    keys of :data:`FOG_CAMERAS`, and "all". ``near`` is the near plane of the pictures, in world units. ``marks`` says,
    by name, whether a result is drawn antialiased, if it differs from the ``cameras``.
    """
    reference_splats = make_splats(reference)
    marks = marks or {}
    splats = {name: make_splats(result) for name, result in results.items()}
    measured: dict[str, list[tuple[str, np.ndarray]]] = {name: [] for name in results}  # camera's kind, sums of pixels
    outside = list(fog_cameras(reference, cameras))
    for number, (kind, camera, depth) in enumerate(outside):
        progress("views from outside", number, len(outside))
        expected = draw_depths(reference_splats, camera, near, FOG_NEAR_PLANE * depth)
        for name in results:
            own_camera = replace(camera, antialiased=marks.get(name, camera.antialiased))
            sums = sum_pixels(expected, draw_depths(splats[name], own_camera, near, FOG_NEAR_PLANE * depth))
            measured[name].append((kind, np.concatenate([sums, count_spikes(results[name], own_camera, near)])))
    return {
        name: {
            kind: mean_fog(np.stack([sums for picture_kind, sums in pictures if kind in (picture_kind, ALL)]))
            for kind in (*FOG_CAMERAS, ALL)
        }
        for name, pictures in measured.items()
    }


def describe_fog(name: str, fog: Fog) -> str | None:
    """Describe haze and veils that a result shows from outside, or return None if both are small."""
    faults = []
    if (fog.fog_far or 0) > HAZE:
        faults.append(f"haze where the input shows nothing (far fog {fog.fog_far:.2f}; compact --fit none makes less)")
    if (fog.veil_worst or 0) > VEILED:
        share = 100 * (fog.veil_worst or 0)
        faults.append(f"a veil of wrong depth before up to {share:.0f} % of what the input shows")
    return f"{name}: seen from outside, the result shows {' and '.join(faults)}" if faults else None


def fog_cameras(gaussians: Gaussians, cameras: Cameras) -> Iterator[tuple[str, Cameras, float]]:
    """Yield the kind and the camera of each outside picture, and the median depth of the input view that was moved."""
    cameras = shrink_cameras(cameras, FOG_PIXELS)
    for view in pick_views(len(cameras), VIEWS):
        camera = cameras[[view]]
        depth = middle_depth(gaussians.means, camera)
        for kind, moves in FOG_CAMERAS.items():
            for back, turn in moves:
                viewmat = step_outside(camera.viewmats[0], depth, back, turn)
                yield kind, replace(camera, viewmats=viewmat[None]), depth


def draw_depths(splats: Splats, camera: Cameras, near: float, depth_near: float) -> OutsidePicture:
    """Draw the opacities in one outside camera twice, with ``near`` and with ``depth_near`` as the near plane.

    Depths are drawn with ``depth_near`` only. Both planes are in world units.
    """
    views = [tile_camera(splats, camera, 0, plane) for plane in (near, depth_near)]
    (_, transmittance), (depths, transmittance_beyond) = map(blend_depths, views)
    return OutsidePicture(1 - transmittance, 1 - transmittance_beyond, depths)


def sum_pixels(expected: OutsidePicture, actual: OutsidePicture) -> np.ndarray:
    """Compare a picture of the result, ``actual``, with the picture ``expected`` of the input.

    Returns ``[4,2]`` with a row each for near fog, far fog, holes and veil. A row has a sum over pixels, and the number
    of pixels over which the sum was taken.
    """
    empty = (expected.opacities < FOG_EMPTY).astype(np.uint8)
    solid = expected.opacities > FOG_SOLID
    far_share = 0.1  # fog is far if it is farther than this share of the width from every pixel that the input shows
    sides = EROSION_PIXELS, max(EROSION_PIXELS, 2 * round(far_share * empty.shape[1]) + 1)
    masks = [cv2.erode(empty, np.ones((side, side), np.uint8)) > 0 for side in sides]
    fog = [(float(actual.opacities[mask].sum(dtype=np.float64)), float(mask.sum())) for mask in masks]
    covered = expected.beyond > FOG_SOLID
    veil = covered & (actual.beyond > FOG_EMPTY) & (actual.depths < VEIL_SHARE * expected.depths)
    holes = float((actual.opacities[solid] < FOG_OPEN).sum()), float(solid.sum())
    return np.array([*fog, holes, (float(veil.sum()), float(covered.sum()))])


def count_spikes(gaussians: Gaussians, camera: Cameras, near: float) -> np.ndarray:
    """Count the pixels that change if the spikes of a scene are removed.

    Returns ``[2,2]`` with a row for each of ``RATIOS``: the number of these pixels, and the number of all pixels.
    """
    _, second, longest = np.sort(gaussians.scales, 1).T
    depths = camera_depths(gaussians.means.astype(np.float64), camera.viewmats[0])
    is_long = 3 * longest * camera.Ks[0, 0, 0] > LONG * camera.width * np.maximum(depths, near)
    image = render(gaussians, camera, near=near).images[0]
    counts = []
    for ratio in RATIOS:
        is_spike = is_long & (longest >= ratio * second)
        without_spikes = render(gaussians[~is_spike], camera, near=near).images[0] if is_spike.any() else image
        num_changed = (np.abs(image - without_spikes).max(-1) > CHANGED).sum()
        counts.append((float(num_changed), float(camera.width * camera.height)))
    return np.array(counts)


def mean_fog(sums: np.ndarray) -> Fog:
    """Make the figures of a :class:`Fog` from ``sums [pictures,6,2]`` of several pictures.

    A picture has the four rows of :func:`sum_pixels`, and the two rows of :func:`count_spikes`. A figure is the sum
    over all pictures, divided by the number of pixels over which it was taken. Veils are divided picture by picture,
    and the shares are then averaged.
    """
    near, far, holes, _, *spikes = (total / count if count else None for total, count in sums.sum(0).tolist())
    veils = [total / count for total, count in sums[:, 3].tolist() if count]
    mean, worst = (sum(veils) / len(veils), max(veils)) if veils else (None, None)
    return Fog(near, far, holes, mean, worst, *spikes)
