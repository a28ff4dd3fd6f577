"""Fog: what a compact scene shows where its input shows nothing, seen from outside of the capture.

Photos judge a scene from where they stand. A viewer's first move is to step back and turn: Gaussians that hang in gaps
between the views then show as haze, and gaps in surfaces as holes. The measure needs no photos, only the input and the
cameras of its views; docs/guide/evaluate.md defines it for others.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsmerge.facts.views import pick_views
from gsmerge.fit.report import HAZE
from gsmerge.geometry import middle_depth, step_outside
from gsmerge.measure.sizes import shrink_cameras
from gsmerge.raster import Splats, prepare, tile_view
from gsmerge.raster.composite import blend
from gsmerge.runtime.record import Progress
from gsmerge.types import Cameras, Gaussians

VIEWS = 3  # of the input, evenly spread, that the cameras start from
# Steps back as shares of the depth of what a view sees, and turns about its middle in degrees, by kind
CAMERAS = {"back": ((0.5, 0), (1.5, 0)), "turned": ((0.5, -30), (0.5, 30))}
ALL = "all"  # kind of all these cameras together
SIDE = 480  # pixels, at most, of the longer side of the pictures
EMPTY, SOLID, OPEN = 0.05, 0.9, 0.5  # opacities: input below, input above, result below
MARGIN = 17  # pixels per side of the square that erodes what is empty
FAR = 0.1  # of the width: distance from what the input shows from which fog is far


@dataclass(frozen=True)
class Fog:
    """Fog and holes that a result shows from outside and its input does not; None where there is nothing to measure.

    Args:
        fog_near: Mean opacity, in [0, 1], where the input is empty.
        fog_far: The same farther than a tenth of the width from what the input shows.
        holes: Share of the pixels where the input is solid and the result is not.
    """

    fog_near: float | None = None
    fog_far: float | None = None
    holes: float | None = None


def measure_fog(
    reference: Gaussians,
    results: Mapping[str, Gaussians],
    cameras: Cameras,
    near: float = 0.01,
    progress: Progress = lambda *_: None,
) -> dict[str, dict[str, Fog]]:
    """Measure fog and holes of results, by name, seen from outside the ``cameras`` of the scene ``reference``.

    Returns one :class:`Fog` by name of the result and kind of camera, of :data:`CAMERAS` and "all"; its figures are
    means over the pixels of all pictures of the kind. ``near`` is the near plane of the pictures, world units.
    """
    first, splats = prepare(reference), {name: prepare(result) for name, result in results.items()}
    sums = {name: {kind: np.zeros((3, 2)) for kind in CAMERAS} for name in results}
    outside = list(outside_cameras(reference, cameras))
    for number, (kind, camera) in enumerate(outside):
        progress("views from outside", number, len(outside))
        shown = draw_opacity(first, camera, near)
        for name in results:
            sums[name][kind] += fog_sums(shown, draw_opacity(splats[name], camera, near))
    for kinds in sums.values():
        kinds[ALL] = np.sum(list(kinds.values()), axis=0)
    return {name: {kind: mean_fog(rows) for kind, rows in kinds.items()} for name, kinds in sums.items()}


def describe_fog(name: str, fog: Fog) -> str | None:
    """Describe the haze of a result seen from outside; None if far fog is at most 0.05."""
    if fog.fog_far is None or fog.fog_far <= HAZE:
        return None
    return (
        f"{name}: seen from outside, the result shows haze where the input shows nothing: far fog {fog.fog_far:.2f};"
        " if it comes from a fit to photos, compact --fit none makes none"
    )


def outside_cameras(gaussians: Gaussians, cameras: Cameras) -> Iterator[tuple[str, Cameras]]:
    """Yield (kind, camera) of each picture from outside."""
    cameras = shrink_cameras(cameras, SIDE)
    for view in pick_views(len(cameras), VIEWS):
        camera = cameras[[view]]
        depth = middle_depth(gaussians.means, camera)
        for kind, places in CAMERAS.items():
            for back, turn in places:
                viewmat = step_outside(camera.viewmats[0], depth, back, turn)
                yield kind, replace(camera, viewmats=viewmat[None])


def draw_opacity(splats: Splats, camera: Cameras, near: float) -> np.ndarray:
    """Draw the opacity ``[h,w]`` of a scene in one camera."""
    tiled = tile_view(splats, camera.viewmats[0], camera.Ks[0], camera.width, camera.height, near=near)
    black = np.zeros((len(tiled.ids) + 1, 3), np.float32)
    return 1 - blend(tiled, black[1:], black[0])[1]


def fog_sums(reference: np.ndarray, result: np.ndarray) -> np.ndarray:
    """Return (sum, number of pixels) ``[3,2]`` of near fog, far fog and holes, given opacities ``[h,w]``."""
    empty, solid = (reference < EMPTY).astype(np.uint8), reference > SOLID
    sides = MARGIN, max(MARGIN, 2 * round(FAR * reference.shape[1]) + 1)
    masks = [cv2.erode(empty, np.ones((side, side), np.uint8)) > 0 for side in sides]
    fog = [(float(result[mask].sum(dtype=np.float64)), float(mask.sum())) for mask in masks]
    return np.array([*fog, (float((result[solid] < OPEN).sum()), float(solid.sum()))])


def mean_fog(sums: np.ndarray) -> Fog:
    """Divide the sums by the pixel counts of :func:`fog_sums`, ``[3,2]``, to get mean fog and holes."""
    return Fog(*(above / count if count else None for above, count in sums.tolist()))
