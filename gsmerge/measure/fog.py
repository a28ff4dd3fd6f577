"""Fog, veils and spikes: what a compact scene shows from outside where its input shows nothing, or surfaces.

Photos judge a scene from where they stand. A viewer's first move is to step back and turn: Gaussians that hang in gaps
between the views then show as haze, those of wrong depth as veils before surfaces, gaps in surfaces as holes, and long
thin ones, which made the texture of one view, as strokes. The measure needs no photos, only the input and the cameras
of its views; docs/guide/evaluate.md defines it for others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsmerge.facts.views import pick_views
from gsmerge.fit.report import HAZE
from gsmerge.geometry import camera_depths, middle_depth, step_outside
from gsmerge.measure.sizes import shrink_cameras
from gsmerge.raster import Splats, make_splats, render, tile_view
from gsmerge.raster.composite import blend_depths
from gsmerge.runtime.record import Progress
from gsmerge.types import Cameras, Gaussians

VIEWS = 3  # of the input, evenly spread, that the cameras start from
# Steps back as shares of the depth of what a view sees, and turns about its middle in degrees, by kind
CAMERAS = {"back": ((0.5, 0), (1.5, 0)), "turned": ((0.5, -30), (0.5, 30))}
ALL = "all"  # kind of all these cameras together
SIDE = 480  # pixels, at most, of the longer side of the pictures
EMPTY, SOLID, OPEN = 0.05, 0.9, 0.5  # opacities: input below, input above, result below
MARGIN = 17  # pixels per side of the square that erodes what is empty
FAR_SHARE = 0.1  # of the width: distance from what the input shows from which fog is far
VEIL = 0.7  # of the input's depth: what a result shows nearer than that is a veil
VEILED = 0.08  # worst veil above which a result gets a note
# Spikes are Gaussians so many times as long as their second axis, and longer (3 sigma) than a share of the width; they
# show where a channel changes by more than CHANGED without them
RATIOS, LONG, CHANGED = (5.0, 3.0), 0.05, 0.05
NEAREST = 0.25  # of the median depth of the view: what is nearer to a camera is drawn in neither picture of depth


@dataclass(frozen=True)
class Fog:
    """Fog, veils and holes that a result shows from outside and its input not; None where there is nothing to measure.

    Args:
        fog_near: Mean opacity, in [0, 1], where the input is empty.
        fog_far: The same farther than a tenth of the width from what the input shows.
        holes: Share of the pixels where the input is solid and the result is not.
        veil: Share of the pixels where the input is solid whose depth in the result is less than 0.7 of the input's,
            mean of the cameras.
        veil_worst: The same of the camera where it is most.
        spikes: Share of the pictures that changes visibly without Gaussians at least five times as long as their second
            axis and longer than 5 % of the width.
        strokes: The same of those at least three times as long.
    """

    fog_near: float | None = None
    fog_far: float | None = None
    holes: float | None = None
    veil: float | None = None
    veil_worst: float | None = None
    spikes: float | None = None
    strokes: float | None = None


@dataclass(frozen=True, eq=False)
class Sight:
    """What a camera sees of a scene."""

    opacities: np.ndarray  # [h,w]
    beyond: np.ndarray  # [h,w] without what is near
    depths: np.ndarray  # [h,w] mean camera z of the same


def measure_fog(
    reference: Gaussians,
    results: Mapping[str, Gaussians],
    cameras: Cameras,
    near: float = 0.01,
    progress: Progress = lambda *_: None,
) -> dict[str, dict[str, Fog]]:
    """Measure fog, veils, holes and spikes of results, by name, from outside the ``cameras`` of a ``reference`` scene.

    Returns one :class:`Fog` by name of the result and kind of camera, of :data:`CAMERAS` and "all"; its figures are
    means over the pixels of all pictures of the kind. ``near`` is the near plane of the pictures, world units.
    """
    first, splats = make_splats(reference), {name: make_splats(result) for name, result in results.items()}
    pictures: dict[str, list[tuple[str, np.ndarray]]] = {name: [] for name in results}
    outside = list(outside_cameras(reference, cameras))
    for number, (kind, camera, depth) in enumerate(outside):
        progress("views from outside", number, len(outside))
        expected = look(first, camera, near, NEAREST * depth)
        for name in results:
            seen = count_pixels(expected, look(splats[name], camera, near, NEAREST * depth))
            pictures[name].append((kind, np.concatenate([seen, count_spikes(results[name], camera, near)])))
    return {
        name: {
            kind: mean_fog(np.stack([counts for other, counts in rows if kind in (other, ALL)]))
            for kind in (*CAMERAS, ALL)
        }
        for name, rows in pictures.items()
    }


def describe_fog(name: str, fog: Fog) -> str | None:
    """Describe haze and veils of a result seen from outside; None if far fog is at most 0.05, the worst veil 0.08."""
    seen = []
    if (fog.fog_far or 0) > HAZE:
        seen.append(f"haze where the input shows nothing (far fog {fog.fog_far:.2f}; compact --fit none makes less)")
    if (fog.veil_worst or 0) > VEILED:
        share = 100 * (fog.veil_worst or 0)
        seen.append(f"a veil before up to {share:.0f} % of what the input shows, as of wrong depth")
    return f"{name}: seen from outside, the result shows {' and '.join(seen)}" if seen else None


def outside_cameras(gaussians: Gaussians, cameras: Cameras) -> Iterator[tuple[str, Cameras, float]]:
    """Yield (kind, camera, median depth of the view that it steps back from) of each picture from outside."""
    cameras = shrink_cameras(cameras, SIDE)
    for view in pick_views(len(cameras), VIEWS):
        camera = cameras[[view]]
        depth = middle_depth(gaussians.means, camera)
        for kind, places in CAMERAS.items():
            for back, turn in places:
                viewmat = step_outside(camera.viewmats[0], depth, back, turn)
                yield kind, replace(camera, viewmats=viewmat[None]), depth


def look(splats: Splats, camera: Cameras, near: float, nearest: float) -> Sight:
    """Draw opacities beyond ``near``, and depths beyond ``nearest``, world units, of a scene in one camera."""
    views = [
        tile_view(splats, camera.viewmats[0], camera.Ks[0], camera.width, camera.height, near=plane)
        for plane in (near, nearest)
    ]
    (_, left), (depths, left_beyond) = map(blend_depths, views)
    return Sight(1 - left, 1 - left_beyond, depths)


def count_pixels(expected: Sight, actual: Sight) -> np.ndarray:
    """Return (sum, number of pixels) ``[4,2]`` of near fog, far fog, holes and veil in a picture of a result."""
    empty, solid = (expected.opacities < EMPTY).astype(np.uint8), expected.opacities > SOLID
    sides = MARGIN, max(MARGIN, 2 * round(FAR_SHARE * empty.shape[1]) + 1)
    masks = [cv2.erode(empty, np.ones((side, side), np.uint8)) > 0 for side in sides]
    fog = [(float(actual.opacities[mask].sum(dtype=np.float64)), float(mask.sum())) for mask in masks]
    covered = expected.beyond > SOLID
    veil = covered & (actual.beyond > EMPTY) & (actual.depths < VEIL * expected.depths)
    holes = float((actual.opacities[solid] < OPEN).sum()), float(solid.sum())
    return np.array([*fog, holes, (float(veil.sum()), float(covered.sum()))])


def count_spikes(gaussians: Gaussians, camera: Cameras, near: float) -> np.ndarray:
    """Return (pixels that change without spikes, pixels) ``[2,2]`` of a picture, for each of ``RATIOS``."""
    _, second, longest = np.sort(gaussians.scales, 1).T
    depths = camera_depths(gaussians.means.astype(np.float64), camera.viewmats[0])
    long = 3 * longest * camera.Ks[0, 0, 0] > LONG * camera.width * np.maximum(depths, near)
    whole, counts = render(gaussians, camera, near=near).images[0], []
    for ratio in RATIOS:
        spikes = long & (longest >= ratio * second)
        less = render(gaussians[~spikes], camera, near=near).images[0] if spikes.any() else whole
        counts.append((float((np.abs(whole - less).max(-1) > CHANGED).sum()), float(camera.width * camera.height)))
    return np.array(counts)


def mean_fog(counts: np.ndarray) -> Fog:
    """Divide the sums of :func:`count_pixels` and :func:`count_spikes`, ``[pictures,6,2]``, by the pixels.

    Veils are divided by picture.
    """
    near, far, holes, _, *spikes = (above / count if count else None for above, count in counts.sum(0).tolist())
    veils = [above / count for above, count in counts[:, 3].tolist() if count]
    mean, worst = (sum(veils) / len(veils), max(veils)) if veils else (None, None)
    return Fog(near, far, holes, mean, worst, *spikes)
