"""Fitted Gaussians -> filled Gaussians: fill the gaps that cameras between and just beside the views see.

New views uncover places that no photo shows. So the result of a fit is drawn from cameras between the views and just
beside them. Gaps in these pictures are filled with Gaussians that continue the farther one of the surfaces around, at
depths that no view contradicts.
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
SHARE = 0.03  # most new Gaussians, as a share of the fitted ones
LEVEL = 8  # size of a pixel of the drawings, relative to the views': coarse, because the filling is blurred anyway
BESIDE = -0.1  # position of a camera just outside, as a share of the way to the nearest view
MARGIN = 0.05  # margin of the drawings on each side, as a share of their sides
CLEAR, SOLID = 0.1, 0.05  # transmittance above which a pixel is a gap, and below which it shows a surface
# A surface is not continued if it is nearer than NEARER times the farthest depth in a window around the pixel, whose
# half side is WINDOW times the width
WINDOW, NEARER = 0.08, 0.85
SOFT = 2.0  # standard deviation in pixels of the blur by which colours and inverse depths spread into gaps
MOST_VIEWS = 64  # most views of a scene that is filled, because the time grows with their square
DEEPER = (1, 1.06, 1.15, 1.3, 1.6, 2.2)  # depths that are tried, relative to the surface's
REACH = 2  # pixels beside a picture in which a Gaussian still reaches into it
FRONT = 0.98  # share of a surface's depth in front of which a camera would see a Gaussian


@stage("fill")
def fill_between(
    fitted: Gaussians, cameras: Cameras, outside: Outside | None, most: int, *, beyond: bool = False
) -> Gaussians:
    """Make Gaussians that fill the gaps which cameras between and just beside the photos' cameras see.

    There are at most ``most``, and at most ``SHARE`` times the fitted ones; gaps that half-way cameras see come first.
    The new Gaussians continue the farther one of the surfaces around. They stand where no camera sees them, so no photo
    contradicts them, nor does a view from ``outside``. All are in the view of some photo, unless ``beyond``. Scenes of
    more than ``MOST_VIEWS`` views get none, because photos show nearly everything between them.
    """
    added, most = fitted[:0], min(most, int(SHARE * len(fitted)))
    if most == 0 or not 1 < len(cameras) <= MOST_VIEWS:
        return added
    cameras = _small_cameras(cameras)
    between, splats = _widen(between_cameras(cameras, BESIDE)), make_splats(fitted)
    if len(between) == 0:  # all views look in different directions
        return added
    drawings = parallel_map(lambda view: _draw(splats, between, view), range(len(between)))
    depths = parallel_map(lambda view: blend_depths(_tile(splats, cameras, view)), range(len(cameras)))
    seen = _find_seen(cameras, depths), _find_seen(between, [drawing[:2] for drawing in drawings]).without_gaps()

    def continue_surfaces(view: int) -> Gaussians:
        return _continue_surfaces(drawings[view], between[[view]], seen, outside, fitted.shN.shape[1], beyond=beyond)

    for view, more in enumerate(parallel_map(continue_surfaces, range(len(between)))):
        more = more[~_on_same_pixels(more, added, between[[view]])]
        added = Gaussians.concat([added, more[: most - len(added)]])
    return added


def _on_same_pixels(gaussians: Gaussians, others: Gaussians, camera: Cameras) -> np.ndarray:
    """Mark ``gaussians`` ``[n]`` whose pixel in a camera is one of the four nearest to one of the ``others``."""
    covered, last = np.zeros((camera.height + 2, camera.width + 2), bool), (camera.width + 1, camera.height + 1)
    (positions,), (depths,) = project(others.means, camera)
    corners = positions[depths > 0, None] + np.array([(0.5, 0.5), (0.5, 1.5), (1.5, 0.5), (1.5, 1.5)])
    x, y = np.clip(np.floor(corners), 0, last).astype(np.int64).reshape(-1, 2).T
    covered[y, x] = True
    covered[[0, -1]] = covered[:, [0, -1]] = False  # the rim stands for everything outside the picture
    x, y = np.clip(np.floor(project(gaussians.means, camera)[0][0] + 1), 0, last).astype(np.int64).T
    return covered[y, x]


@dataclass(frozen=True, eq=False)
class Seen:
    """Surfaces and gaps that c cameras of one size see in a scene."""

    cameras: Cameras
    farthest: np.ndarray  # [c,h,w] mean depth, the farthest within the reach of a new Gaussian
    clear: np.ndarray  # [c,h,w] bool, gaps

    def without_gaps(self) -> Seen:
        """Return a copy that contradicts nothing in gaps, for cameras between the photos, whose gaps are filled."""
        return Seen(self.cameras, np.where(self.clear, np.float32(0), self.farthest), np.zeros_like(self.clear))

    def show(self, points: np.ndarray) -> np.ndarray:
        """Return a mask ``[n]`` of the points ``[n,3]`` that lie in the field of view of some camera."""
        pixels, z = project(points, self.cameras)
        return ((z > 0) & is_inside(pixels, self.cameras)).any(0)

    def contradict(self, points: np.ndarray) -> np.ndarray:
        """Return a mask ``[n]`` of the points ``[n,3]`` that stand in front of a surface, or in a gap of a camera."""
        (pixels, z), size = project(points, self.cameras), np.array([self.cameras.width, self.cameras.height])
        inside = (z > 0) & ((pixels >= -REACH) & (pixels < size + REACH)).all(2)
        camera, point = np.nonzero(inside)
        column, row = np.clip(pixels[inside].astype(np.int64), 0, size - 1).T
        wrong = self.clear[camera, row, column] | (z[inside] < FRONT * self.farthest[camera, row, column])
        return np.bincount(point[wrong], minlength=len(points)) > 0


def lies_between(known: np.ndarray) -> np.ndarray:
    """Mark the pixels with ``known [h,w]`` pixels both to the left and to the right, or both above and below."""
    sides = []
    for mask in (known, known.T):
        before, after = (np.logical_or.accumulate(ordered, axis=1) for ordered in (mask, mask[:, ::-1]))
        sides.append(before & after[:, ::-1])
    return np.asarray(sides[0] | sides[1].T)


def _small_cameras(cameras: Cameras) -> Cameras:
    """Return the cameras with pixels ``LEVEL`` times as large."""
    width, height = (max(LEVEL, round(side / LEVEL)) for side in (cameras.width, cameras.height))
    scales = np.array([[width / cameras.width], [height / cameras.height], [1.0]])
    return replace(cameras, Ks=cameras.Ks.astype(np.float64) * scales, width=width, height=height)


def _widen(cameras: Cameras) -> Cameras:
    """Return the cameras with a margin on each side."""
    right, down = (round(MARGIN * side) for side in (cameras.width, cameras.height))
    Ks = cameras.Ks + np.array([[0, 0, right], [0, 0, down], [0, 0, 0]])
    return replace(cameras, Ks=Ks, width=cameras.width + 2 * right, height=cameras.height + 2 * down)


def _tile(splats: Splats, cameras: Cameras, view: int) -> TiledView:
    """Tile Gaussians in one of the cameras."""
    return tile_view(splats, cameras.viewmats[view], cameras.Ks[view], cameras.width, cameras.height, near=NEAR_PLANE)


def _draw(splats: Splats, cameras: Cameras, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw the mean depths ``[h,w]``, transmittance ``[h,w]`` and colours ``[h,w,3]`` of one camera."""
    tiled = _tile(splats, cameras, view)
    return *blend_depths(tiled), blend(tiled, view_colors(tiled), np.zeros(3, np.float32))[0]


def _find_seen(cameras: Cameras, drawings: Sequence[tuple[np.ndarray, np.ndarray]]) -> Seen:
    """Find surfaces and gaps from the mean depths ``[h,w]`` and transmittance ``[h,w]`` of each camera."""
    around = np.ones((2 * REACH + 1,) * 2, np.uint8)
    farthest = np.stack([cv2.dilate(depths, around) for depths, _ in drawings])
    return Seen(cameras, farthest, np.stack([transmittance > CLEAR for _, transmittance in drawings]))


def _continue_surfaces(
    drawing: tuple[np.ndarray, np.ndarray, np.ndarray],
    camera: Cameras,
    seen: tuple[Seen, Seen],
    outside: Outside | None,
    num_higher: int,
    *,
    beyond: bool,
) -> Gaussians:
    """Make Gaussians in the gaps of a ``camera`` that continue the farther one of the surfaces beside each gap.

    A Gaussian stands at the first of the depths ``DEEPER``, relative to that surface, that nothing ``seen``
    contradicts. There is none if all depths are contradicted.
    """
    depths, transmittance, image = drawing
    solid, clear = transmittance < SOLID, transmittance > CLEAR
    around = np.ones((2 * round(WINDOW * camera.width) + 1,) * 2, np.uint8)
    known = solid & (depths >= NEARER * cv2.dilate(np.where(solid, depths, np.float32(0)), around))
    clear &= cv2.dilate(known.astype(np.uint8), around) > 0
    clear &= beyond | lies_between(known)
    image = image / np.maximum(1 - transmittance, 1e-6)[..., None]
    values = np.dstack([1 / np.maximum(depths, 1e-6), image, np.ones_like(depths)])
    sums = blur(fill_gaps(values, known) * (clear | known)[..., None], SOFT)[clear]
    y, x = np.nonzero(clear)
    pixels, viewmat, K = np.stack([x + 0.5, y + 0.5, np.ones(len(x))], 1), camera.viewmats[0], camera.Ks[0]
    eye, rays = camera.centres[0], matmul(matmul(pixels, invert(K).T), viewmat[:3, :3])  # to depth 1
    tried = np.array(DEEPER)[:, None] * (sums[:, 4] / sums[:, 0]).astype(np.float64)
    points = (eye + tried[..., None] * rays).reshape(-1, 3)
    wrong = np.zeros(len(points), bool) if beyond else ~seen[0].show(points)
    for views in seen:
        wrong[~wrong] = views.contradict(points[~wrong])
    if outside is not None:
        wrong[~wrong] = outside.contradict(points[~wrong], FRONT)
    hidden = ~wrong.reshape(tried.shape)
    rows = np.flatnonzero(hidden.any(0))
    chosen = tried[hidden.argmax(0)[rows], rows]
    colors = sums[rows, 1:4] / sums[rows, 4:]
    return make_gaussians(eye, rays[rows], chosen, SIZE / K[0, 0], colors, num_higher)
