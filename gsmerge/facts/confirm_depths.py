"""Scene with pixels -> how much of its depth other views confirm: what says before a fit whether it can succeed.

Each pixel's Gaussian is looked up in the other views, and the Gaussian there is projected back: the depth is confirmed
where the two agree, and contradicted where more views see through it than confirm it. Where no other view looks, it is
alone. Pixels that others see only where they have no Gaussian, as beyond a crop, say nothing and do not count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from gsmerge.frame import scene_depth
from gsmerge.geometry import camera_depths, nearest_views, project
from gsmerge.kernels.elementary import log
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.budget import parse_share
from gsmerge.settings.stages import SHARE
from gsmerge.types import Scene

SAMPLE_PIXELS = 1200  # pixels of a view
NEIGHBORS = 16  # nearest other views in which they are looked up
REACH, PIXELS = 1 / 120, 1.5  # of the longer side, and pixels at least: distance to which a pixel is found again
SAME = 0.05  # logarithm of two depths of one surface
TINY = 1e-9  # canonical units, least depth
# Of 15 captures everything below POOR is poor, and nothing sound is; LONELY tells apart why
POOR, LONELY = 0.5, 0.2
CERTAIN, ENOUGH = 2.0, 30  # standard errors that chance may make; of so many samples a mean's error is about normal
# Parts of pictures, as a range of columns and of rows in thirds; a part is poor where most of its pixels are
THIRDS = {
    "left third": ((0, 1), (0, 3)), "right third": ((2, 3), (0, 3)), "upper third": ((0, 3), (0, 1)),
    "lower third": ((0, 3), (2, 3)), "middle": ((1, 2), (1, 2)),
}  # fmt: skip
MOSTLY = 0.5
# Gaussians per pixel that a scene bears: most, down to a share of confirmed pixels, then falling to the usual share at
# another one. More are learned by heart (docs/guide/how-many.md): the most is the largest share at which no capture
# with so much confirmed depth lost .1 dB in photos that were not used.
MOST, FEWEST, SOUND, WRONG = 0.07, parse_share(SHARE), 0.75, 0.6


@dataclass(frozen=True)
class Agreement:
    """Shares of the pixels of a scene that say something, by what other views say of their depth."""

    confirmed: float  # by at least one view, and by no fewer than see through it
    contradicted: float  # more views see through it than confirm it
    alone: float  # no other view looks there
    num_pixels: int = field(default=SAMPLE_PIXELS, compare=False)  # that were sampled and say something
    # Where most is contradicted, and where alone, as "left third of 4 of 7 views"; empty: nowhere more than elsewhere
    contradicted_part: str = field(default="", compare=False)
    alone_part: str = field(default="", compare=False)
    from_one_point: bool = field(default=False, compare=False)  # no two views show things displaced by ``PIXELS``

    def to_dict(self) -> dict[str, float]:
        """Return the shares of the scene, for reports."""
        return {name: round(getattr(self, name), 4) for name in ("confirmed", "contradicted", "alone")}

    @property
    def share(self) -> float:
        """Gaussians per pixel that the scene bears."""
        part = (self.confirmed - WRONG) / (SOUND - WRONG)
        return FEWEST + (MOST - FEWEST) * min(1.0, max(0.0, part))

    @property
    def doubt(self) -> str | None:
        """Why a result will be poor and what would help, in one sentence; None where depth is sound."""
        if self.from_one_point:
            return (
                "the photos stand at one point, as pieces of a panorama: none can confirm another's depth, and new"
                " views from elsewhere show what the model made of it; photos from other places would help most"
            )
        error = math.sqrt(self.confirmed * (1 - self.confirmed) / self.num_pixels)
        if self.confirmed + CERTAIN * error >= POOR or self.num_pixels < ENOUGH:
            return None
        problem = f"only {100 * self.confirmed:.0f} % of the pixels have a depth that another view confirms"
        if self.alone > LONELY:
            cause = f"{100 * self.alone:.0f} % are seen by no other view: the photos are too few or too far apart"
            where = f" ({self.alone_part})" if self.alone_part else ""
            return f"{problem}, and {cause}{where}; more photos between these would help most"
        where = f" ({self.contradicted_part})" if self.contradicted_part else ""
        cause = f"though others look at them: the depth is wrong{where}"
        return f"{problem}, {cause}; an export with better depth would help most"


def confirm_depths(scene: Scene) -> Agreement | None:
    """Measure how far the views of a scene confirm each other's depth.

    None with fewer than two, where they have no Gaussians of their own (what several share confirms itself), or where
    no pixel says anything.
    """
    views, pixels_of = len(scene), scene.pixels
    if views < 2 or pixels_of is None or not pixels_of.own or not pixels_of.shown.any():
        return None
    means, centres = scene.gaussians.means, scene.cameras.centres
    cameras, fronts = scene.cameras, pixels_of.fronts.reshape(views, -1)
    width, height = cameras.width, cameras.height
    reach = max(PIXELS, REACH * max(width, height))

    def count(view: int) -> np.ndarray:
        rows = np.flatnonzero(fronts[view] >= 0)
        rows = rows[np.random.default_rng(view).integers(max(len(rows), 1), size=min(len(rows), SAMPLE_PIXELS))]
        points, pixels = (
            means[fronts[view, rows]].astype(np.float64),
            np.stack([rows % width, rows // width], 1) + 0.5,
        )
        others = nearest_views(centres, view)[:NEIGHBORS]
        places, depths = project(points, cameras[others])
        x, y = places[..., 0], places[..., 1]
        inside = (depths > TINY) & (x > 0) & (y > 0) & (x < width) & (y < height)
        number, ids = np.nonzero(inside)  # of the other view, and the pixel that it sees
        column, row = x[number, ids].astype(np.int64), y[number, ids].astype(np.int64)
        there, other = row * width + column, others[number]
        front = fronts[other, there]
        known = front >= 0
        number, ids, other = number[known], ids[known], other[known]
        tells = np.asarray(~inside.any(0))
        tells[ids] = True
        surface = means.take(front[known], 0).astype(np.float64)
        (back,), (ahead,) = project(surface, cameras[[view]])
        right, down = (back - pixels[ids]).T
        away = np.where(ahead > TINY, np.sqrt(right * right + down * down), np.inf) / reach
        behind = log(depths[number, ids] / np.maximum(camera_depths(surface, cameras.viewmats[other]), TINY))
        agrees = (away < 1) & (np.abs(behind) < SAME)
        sees_through = ~agrees & ((behind < -2 * SAME) | ((behind < 0) & (away > 2)))
        same, through = (np.bincount(ids[each], minlength=len(rows)) for each in (agrees, sees_through))
        kinds = (same > 0) & (same >= through), through > same, ~inside.any(0)
        thirds = np.stack([3 * (rows % width) // width, 3 * (rows // width) // height])
        within = [
            np.logical_and(*((third >= low) & (third < high) for third, (low, high) in zip(thirds, part, strict=True)))
            for part in THIRDS.values()
        ]
        parts = [part & tells for part in (np.ones(len(rows), bool), *within)]
        return np.array([[part.sum(), *((part & kind).sum() for kind in kinds)] for part in parts])

    counts = np.stack(parallel_map(count, range(views)))  # [v,part,4], first the whole
    num_pixels = int(counts[:, 0, 0].sum())
    if num_pixels == 0:
        return None
    confirmed, contradicted, alone = counts[:, 0, 1:].sum(0) / num_pixels
    of_wrong, of_alone = (_worst_part(counts[:, 1:, kind], counts[:, 1:, 0]) for kind in (2, 3))
    at_one = _stand_at_one_point(scene)
    return Agreement(float(confirmed), float(contradicted), float(alone), num_pixels, of_wrong, of_alone, at_one)


def _stand_at_one_point(scene: Scene) -> bool:
    """Return whether the cameras' largest distance moves things in the middle of the depth by less than ``PIXELS``."""
    cameras = scene.cameras
    apart = np.linalg.norm(np.ptp(cameras.centres, axis=0))
    return bool(apart * cameras.Ks[:, 0, 0].max() < PIXELS * scene_depth(scene))


def _worst_part(poor: np.ndarray, pixels: np.ndarray) -> str:
    """Name the part of pictures in which ``poor [v,part]`` of the ``pixels`` are most in most views.

    Empty where no part is poor in more views than any other one.
    """
    views = (poor > MOSTLY * np.maximum(pixels, 1)).sum(0)
    worst = int(views.argmax())
    if views[worst] == 0 or views.min() == views[worst]:
        return ""
    return f"{list(THIRDS)[worst]} of {views[worst]} of {len(poor)} views"
