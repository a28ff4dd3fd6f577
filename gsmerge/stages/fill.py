"""Fitted Gaussians -> filled Gaussians: what cameras between and just beside the views see empty.

New views uncover what no photo shows. So the result of a fit is drawn from cameras between the views and just beside
them, and what is empty there continues the farther side of the surfaces around, where no view contradicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsmerge.facts.holes import SIZE, make_gaussians
from gsmerge.facts.place_cameras import between_cameras
from gsmerge.facts.row_colors import fill_gaps
from gsmerge.fit.outside import Outside
from gsmerge.geometry import is_inside, project
from gsmerge.kernels.matrices import invert, matmul
from gsmerge.kernels.pictures import blur
from gsmerge.raster import Splats, TiledView, make_splats, tile_view
from gsmerge.raster.composite import blend, blend_depths, view_colors
from gsmerge.raster.photos import NEAR_PLANE
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Gaussians

# Chosen on seven training captures
SHARE = 0.03  # of the Gaussians, at most, that fill what no view shows
LEVEL = 8  # times a view's pixel is theirs: what no photo shows is blurred anyway
BESIDE = -0.1  # of the way to the nearest view: a camera just outside
MARGIN = 0.05  # of the sides, by which these cameras see more on each side
CLEAR, SOLID = 0.1, 0.05  # transmittance above which a pixel is to be filled, below which it shows a surface
WINDOW, NEARER = 0.08, 0.85  # of the width around a pixel: what is nearer than this share of the farthest depth there
SOFT = 2.0  # standard deviation, pixels, by which colours and inverse depths are blurred into what is empty
MOST_VIEWS = 64  # of a scene that is filled: time grows with their square
DEEPER = (1, 1.06, 1.15, 1.3, 1.6, 2.2)  # times the depth: the first one that no view contradicts is taken
REACH = 2  # pixels: standing so far beside a picture, a Gaussian still reaches into it
FRONT = 0.98  # of the depth of a surface, in front of which a camera would see a Gaussian


@stage("fill")
def fill_between(
    fitted: Gaussians, cameras: Cameras, outside: Outside | None, most: int, *, beyond: bool = False
) -> Gaussians:
    """Make Gaussians for what cameras between and just beside those of the photos see empty.

    There are at most ``most`` and ``SHARE`` times the fitted ones, for what half-way cameras see first. They continue
    the farther side of the surfaces around, and stand where no camera sees into, so no photo says anything against
    them, nor does a view from ``outside``. All are in the view of some photo, unless what lies ``beyond`` the photos
    is wanted, too.
    For scenes of more than ``MOST_VIEWS`` views there are none: photos show nearly all that lies between them.
    """
    added, most = fitted[:0], min(most, int(SHARE * len(fitted)))
    if most == 0 or not 1 < len(cameras) <= MOST_VIEWS:
        return added
    cameras = _small_cameras(cameras)
    between, splats = _wider(between_cameras(cameras, BESIDE)), make_splats(fitted)
    if len(between) == 0:  # all look elsewhere
        return added
    looks = parallel_map(lambda view: _look(splats, between, view), range(len(between)))
    depths = parallel_map(lambda view: blend_depths(_tile(splats, cameras, view)), range(len(cameras)))
    seen = _see(cameras, depths), _see(between, [look[:2] for look in looks]).where_seen()

    def continue_surfaces(view: int) -> Gaussians:
        return _continue_surfaces(looks[view], between[[view]], seen, outside, fitted.shN.shape[1], beyond=beyond)

    for view, more in enumerate(parallel_map(continue_surfaces, range(len(between)))):
        more = more[~_on_same_pixels(more, added, between[[view]])]
        added = Gaussians.concat([added, more[: most - len(added)]])
    return added


def _on_same_pixels(some: Gaussians, others: Gaussians, camera: Cameras) -> np.ndarray:
    """Mark ``some`` Gaussians ``[n]`` whose pixel in a camera is one of the four around one of the ``others``."""
    covered, last = np.zeros((camera.height + 2, camera.width + 2), bool), (camera.width + 1, camera.height + 1)
    (around,), (depths,) = project(others.means, camera)
    corners = around[depths > 0, None] + np.array([(0.5, 0.5), (0.5, 1.5), (1.5, 0.5), (1.5, 1.5)])
    x, y = np.clip(np.floor(corners), 0, last).astype(np.int64).reshape(-1, 2).T
    covered[y, x] = True
    covered[[0, -1]] = covered[:, [0, -1]] = False  # the rim has what stands outside
    x, y = np.clip(np.floor(project(some.means, camera)[0][0] + 1), 0, last).astype(np.int64).T
    return covered[y, x]


@dataclass(frozen=True, eq=False)
class Seen:
    """Surfaces and gaps that c cameras of one size see of a scene."""

    cameras: Cameras
    farthest: np.ndarray  # [c,h,w] mean camera z, the farthest around, as far as new Gaussians reach
    clear: np.ndarray  # [c,h,w] bool, where little is

    def where_seen(self) -> Seen:
        """Return a copy that says nothing where it is clear, as what a camera between photos sees."""
        return Seen(self.cameras, np.where(self.clear, np.float32(0), self.farthest), np.zeros_like(self.clear))

    def show(self, points: np.ndarray) -> np.ndarray:
        """Return a mask ``[n]`` of the points ``[n,3]`` that some picture would hold if nothing stood before them."""
        pixels, z = project(points, self.cameras)
        return ((z > 0) & is_inside(pixels, self.cameras)).any(0)

    def contradict(self, points: np.ndarray) -> np.ndarray:
        """Return a mask ``[n]`` of the points ``[n,3]`` that stand before a surface, or where a camera sees nothing."""
        (pixels, z), size = project(points, self.cameras), np.array([self.cameras.width, self.cameras.height])
        inside = (z > 0) & ((pixels >= -REACH) & (pixels < size + REACH)).all(2)
        camera, point = np.nonzero(inside)
        column, row = np.clip(pixels[inside].astype(np.int64), 0, size - 1).T
        wrong = self.clear[camera, row, column] | (z[inside] < FRONT * self.farthest[camera, row, column])
        return np.bincount(point[wrong], minlength=len(points)) > 0


def lies_between(known: np.ndarray) -> np.ndarray:
    """Mark the pixels with something ``known [h,w]`` both to the left and to the right, or both above and below."""
    sides = []
    for mask in (known, known.T):
        before, after = (np.logical_or.accumulate(some, axis=1) for some in (mask, mask[:, ::-1]))
        sides.append(before & after[:, ::-1])
    return np.asarray(sides[0] | sides[1].T)


def _small_cameras(cameras: Cameras) -> Cameras:
    """Return the cameras with pixels ``LEVEL`` times as large."""
    width, height = (max(LEVEL, round(side / LEVEL)) for side in (cameras.width, cameras.height))
    scales = np.array([[width / cameras.width], [height / cameras.height], [1.0]])
    return replace(cameras, Ks=cameras.Ks.astype(np.float64) * scales, width=width, height=height)


def _wider(cameras: Cameras) -> Cameras:
    """Return the cameras with a margin on each side."""
    right, down = (round(MARGIN * side) for side in (cameras.width, cameras.height))
    Ks = cameras.Ks + np.array([[0, 0, right], [0, 0, down], [0, 0, 0]])
    return replace(cameras, Ks=Ks, width=cameras.width + 2 * right, height=cameras.height + 2 * down)


def _tile(splats: Splats, cameras: Cameras, view: int) -> TiledView:
    """Tile Gaussians in one of the cameras."""
    return tile_view(splats, cameras.viewmats[view], cameras.Ks[view], cameras.width, cameras.height, near=NEAR_PLANE)


def _look(splats: Splats, cameras: Cameras, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw the mean depths ``[h,w]``, transmittance ``[h,w]`` and colours ``[h,w,3]`` that a camera sees."""
    tiled = _tile(splats, cameras, view)
    return *blend_depths(tiled), blend(tiled, view_colors(tiled), np.zeros(3, np.float32))[0]


def _see(cameras: Cameras, looks: Sequence[tuple[np.ndarray, np.ndarray]]) -> Seen:
    """Find surfaces and gaps from the mean depths ``[h,w]`` and transmittance ``[h,w]`` of each camera."""
    around = np.ones((2 * REACH + 1,) * 2, np.uint8)
    farthest = np.stack([cv2.dilate(depths, around) for depths, _ in looks])
    return Seen(cameras, farthest, np.stack([left > CLEAR for _, left in looks]))


def _continue_surfaces(
    look: tuple[np.ndarray, np.ndarray, np.ndarray],
    camera: Cameras,
    seen: tuple[Seen, Seen],
    outside: Outside | None,
    num_higher: int,
    *,
    beyond: bool,
) -> Gaussians:
    """Make Gaussians for the clear pixels of a ``camera`` that continue the farther side of the surfaces beside.

    Each stands at the first of ``DEEPER`` times that depth which nothing ``seen`` contradicts; none where all are.
    """
    depths, left, image = look
    solid, clear = left < SOLID, left > CLEAR
    around = np.ones((2 * round(WINDOW * camera.width) + 1,) * 2, np.uint8)
    known = solid & (depths >= NEARER * cv2.dilate(np.where(solid, depths, np.float32(0)), around))
    clear &= cv2.dilate(known.astype(np.uint8), around) > 0
    clear &= beyond | lies_between(known)
    image = image / np.maximum(1 - left, 1e-6)[..., None]
    values = np.dstack([1 / np.maximum(depths, 1e-6), image, np.ones_like(depths)])
    sums = blur(fill_gaps(values, known) * (clear | known)[..., None], SOFT)[clear]
    y, x = np.nonzero(clear)
    pixels, viewmat, K = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1), camera.viewmats[0], camera.Ks[0]
    eye, rays = camera.centres[0], matmul(matmul(pixels, invert(K).T), viewmat[:3, :3])  # to depth 1
    tried = np.array(DEEPER)[:, None] * (sums[:, 4] / sums[:, 0]).astype(np.float64)
    points = (eye + tried[..., None] * rays).reshape(-1, 3)
    wrong = np.zeros(len(points), bool) if beyond else ~seen[0].show(points)
    for some in seen:
        wrong[~wrong] = some.contradict(points[~wrong])
    if outside is not None:
        wrong[~wrong] = outside.contradict(points[~wrong], FRONT)
    hidden = ~wrong.reshape(tried.shape)
    rows = np.flatnonzero(hidden.any(0))
    chosen = tried[hidden.argmax(0)[rows], rows]
    colors = sums[rows, 1:4] / sums[rows, 4:]
    return make_gaussians(eye, rays[rows], chosen, SIZE / K[0, 0], colors, num_higher)
