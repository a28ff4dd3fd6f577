"""Fitted Gaussians -> filled Gaussians: fill the gaps that cameras between or just beside the views would show.

New views uncover places that no photo shows. To find such places, the result of a fit is drawn from cameras between the
views and just beside them. Gaps in the drawn pictures are filled with new Gaussians, which continue the farthest
surface beside the gap, at depths that no view contradicts.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.fit.outside import Outside
from gsmerge.method.geometry.gaps import fill_gaps
from gsmerge.method.geometry.pixel_gaussians import NEW_SIZE_PIXELS, make_round_gaussians, pixel_rays
from gsmerge.method.geometry.transforms import is_inside, project
from gsmerge.method.geometry.views import resize_cameras
from gsmerge.method.kernels.pictures import blur
from gsmerge.method.raster import Splats, make_splats
from gsmerge.method.raster.composite import blend, blend_depths, view_colors
from gsmerge.method.raster.images import tile_camera
from gsmerge.method.viewpoints.place_cameras import between_cameras
from gsmerge.runtime.record import stage
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Gaussians

# Chosen on seven training captures
FILLED_SHARE = 0.03  # largest number of new Gaussians, as a share of the fitted ones
FILL_LEVEL = 8  # width of a drawing's pixel, in pixels of the views; large, because new Gaussians are blurred
FILL_MARGIN = 0.05  # margin that is added to each side of a drawing, as a share of its width or height
# Gaps have a transmittance above the first number, and surfaces have a transmittance below the second one
GAP_TRANSMITTANCE = 0.1
SURFACE_TRANSMITTANCE = 0.05
# A surface is not continued if its depth is less than NEARER_SHARE times the largest depth in a window around the
# pixel. The window reaches from the pixel to each side by the share WINDOW_SHARE of the picture's width
WINDOW_SHARE = 0.08
NEARER_SHARE = 0.85
MOST_FILLED_VIEWS = 64  # most views of a scene that is filled, because the time grows with their square
DEPTH_FACTORS = (1, 1.06, 1.15, 1.3, 1.6, 2.2)  # depths that are tried for a new Gaussian, in depths of the surface
BESIDE_PIXELS = 2  # a new Gaussian reaches at most BESIDE_PIXELS beyond the pixel that it fills
FRONT_SHARE = 0.98  # a Gaussian hides a surface if its depth is less than this share of the surface's depth


@stage("fill")
def fill_between(
    fitted: Gaussians, cameras: Cameras, outside: Outside | None, most: int, *, beyond: bool = False
) -> Gaussians:
    """Make Gaussians that fill gaps seen from cameras between or just beside the cameras of the photos.

    There are at most ``most`` new Gaussians, and at most ``FILLED_SHARE`` times the number of ``fitted`` ones. Gaps
    that cameras half-way between two views show are filled first. The new Gaussians are at positions where neither a
    photo nor a view from ``outside`` would show them. Each new Gaussian is in the field of view of some photo, unless
    ``beyond`` is true. Scenes of more than ``MOST_FILLED_VIEWS`` views get no new Gaussians, because their photos show
    nearly everything between the cameras.
    """
    added = fitted[:0]
    max_count = min(most, int(FILLED_SHARE * len(fitted)))
    if max_count == 0 or not 1 < len(cameras) <= MOST_FILLED_VIEWS:
        return added
    width, height = (max(FILL_LEVEL, round(side / FILL_LEVEL)) for side in (cameras.width, cameras.height))
    cameras = resize_cameras(replace(cameras, Ks=cameras.Ks.astype(np.float64)), width, height)
    # Distance of a camera just beside a view, as a share of the distance to the nearest view. The distance is negative,
    # because the camera is on the side of the view that is away from the nearest view. Chosen on seven training
    # captures
    beside = -0.1
    between, splats = between_cameras(cameras, beside), make_splats(fitted)
    if len(between) == 0:  # all views look in different directions
        return added
    # the pictures of the cameras between the views have a margin on each side
    right, down = (round(FILL_MARGIN * side) for side in (width, height))
    Ks = between.Ks + np.array([[0, 0, right], [0, 0, down], [0, 0, 0]])
    between = replace(between, Ks=Ks, width=width + 2 * right, height=height + 2 * down)
    drawings = parallel_map(lambda view: _draw(splats, between, view), range(len(between)))
    depths = parallel_map(lambda view: blend_depths(tile_camera(splats, cameras, view)), range(len(cameras)))
    seen_between = _find_seen(between, [drawing[:2] for drawing in drawings])
    # the cameras between the views contradict no Gaussian in a gap, because their gaps shall be filled
    farthest = np.where(seen_between.clear, np.float32(0), seen_between.farthest)
    seen = _find_seen(cameras, depths), Seen(between, farthest, np.zeros_like(seen_between.clear))

    def continue_surfaces(view: int) -> Gaussians:
        """Make the Gaussians that fill the gaps of one drawing."""
        return _continue_surfaces(drawings[view], between[[view]], seen, outside, fitted.shN.shape[1], beyond=beyond)

    for view, new in enumerate(parallel_map(continue_surfaces, range(len(between)))):
        new = new[~_on_covered_pixels(new, added, between[[view]])]
        added = Gaussians.concat([added, new[: max_count - len(added)]])
    return added


def _on_covered_pixels(gaussians: Gaussians, covering: Gaussians, camera: Cameras) -> np.ndarray:
    """Return a mask ``[n]`` of the Gaussians with centres on covered pixels of ``camera``.

    Each of the Gaussians ``covering`` covers the four pixels nearest to its centre.
    """
    covered = np.zeros((camera.height + 2, camera.width + 2), bool)
    last = (camera.width + 1, camera.height + 1)
    (positions,), (depths,) = project(covering.means, camera)
    corners = positions[depths > 0, None] + np.array([(0.5, 0.5), (0.5, 1.5), (1.5, 0.5), (1.5, 1.5)])
    x, y = np.clip(np.floor(corners), 0, last).astype(np.int64).reshape(-1, 2).T
    covered[y, x] = True
    covered[[0, -1]] = covered[:, [0, -1]] = False  # the outermost pixels stand for everything outside the picture
    x, y = np.clip(np.floor(project(gaussians.means, camera)[0][0] + 1), 0, last).astype(np.int64).T
    return covered[y, x]


@dataclass(frozen=True, eq=False)
class Seen:
    """Surfaces and gaps of a scene, as c cameras with pictures of one size see them."""

    cameras: Cameras
    farthest: np.ndarray  # [c,h,w] largest mean depth of the pixels that a new Gaussian at this pixel would reach
    clear: np.ndarray  # [c,h,w] bool, true for gaps

    def show(self, points: np.ndarray) -> np.ndarray:
        """Return a mask ``[n]`` of the ``points [n,3]`` that lie in the field of view of some camera."""
        pixels, z = project(points, self.cameras)
        return ((z > 0) & is_inside(pixels, self.cameras)).any(0)

    def contradict(self, points: np.ndarray) -> np.ndarray:
        """Return a mask ``[n]`` of the ``points [n,3]`` that would hide a surface or appear in a gap in some camera."""
        pixels, z = project(points, self.cameras)
        size = np.array([self.cameras.width, self.cameras.height])
        inside = (z > 0) & ((pixels >= -BESIDE_PIXELS) & (pixels < size + BESIDE_PIXELS)).all(2)
        camera, point = np.nonzero(inside)
        column, row = np.clip(pixels[inside].astype(np.int64), 0, size - 1).T
        wrong = self.clear[camera, row, column] | (z[inside] < FRONT_SHARE * self.farthest[camera, row, column])
        return np.bincount(point[wrong], minlength=len(points)) > 0


def lies_between(known: np.ndarray) -> np.ndarray:
    """Return a mask ``[h,w]`` of pixels that lie between two pixels of the mask ``known`` in their row or column."""
    masks = []
    for mask in (known, known.T):  # rows, then columns
        before, after = (np.logical_or.accumulate(ordered, axis=1) for ordered in (mask, mask[:, ::-1]))
        masks.append(before & after[:, ::-1])
    return np.asarray(masks[0] | masks[1].T)


def _draw(splats: Splats, cameras: Cameras, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what one camera sees: mean depths ``[h,w]``, transmittances ``[h,w]`` and colours ``[h,w,3]``."""
    tiled = tile_camera(splats, cameras, view)
    return *blend_depths(tiled), blend(tiled, view_colors(tiled), np.zeros(3, np.float32))[0]


def _find_seen(cameras: Cameras, drawings: Sequence[tuple[np.ndarray, np.ndarray]]) -> Seen:
    """Find surfaces and gaps in the ``drawings``, which have depths ``[h,w]`` and transmittances ``[h,w]``."""
    around = np.ones((2 * BESIDE_PIXELS + 1,) * 2, np.uint8)
    farthest = np.stack([cv2.dilate(depths, around) for depths, _ in drawings])
    return Seen(cameras, farthest, np.stack([transmittance > GAP_TRANSMITTANCE for _, transmittance in drawings]))


def _continue_surfaces(
    drawing: tuple[np.ndarray, np.ndarray, np.ndarray],
    camera: Cameras,
    seen: tuple[Seen, Seen],
    outside: Outside | None,
    num_higher: int,
    *,
    beyond: bool,
) -> Gaussians:
    """Fill the gaps in a camera's ``drawing`` with Gaussians that continue the farthest surface beside each gap.

    A gap is filled at most as far from the surface as the window of ``WINDOW_SHARE`` reaches, and only between
    surfaces, unless ``beyond`` is true. Depths of ``DEPTH_FACTORS`` times the surface's depth are tried for each
    Gaussian. A Gaussian gets the first of these depths that no view contradicts, and is left out if views contradict
    all. ``seen`` has what the photos' cameras see, and what the cameras between them see. If ``beyond`` is true,
    Gaussians may be outside of the field of view of all photos.
    """
    drawn_depths, transmittance, image = drawing
    solid = transmittance < SURFACE_TRANSMITTANCE
    gaps = transmittance > GAP_TRANSMITTANCE
    window = np.ones((2 * round(WINDOW_SHARE * camera.width) + 1,) * 2, np.uint8)
    nearer = NEARER_SHARE * cv2.dilate(np.where(solid, drawn_depths, np.float32(0)), window)
    far = solid & (drawn_depths >= nearer)
    gaps &= cv2.dilate(far.astype(np.uint8), window) > 0
    gaps &= beyond | lies_between(far)
    image = image / np.maximum(1 - transmittance, 1e-6)[..., None]
    values = np.dstack([1 / np.maximum(drawn_depths, 1e-6), image, np.ones_like(drawn_depths)])
    # Standard deviation in pixels of the blur by which colours and inverse depths spread into gaps. Chosen on seven
    # training captures
    blur_pixels = 2.0
    sums = blur(fill_gaps(values, far) * (gaps | far)[..., None], blur_pixels)[gaps]
    inverse_depths = sums[:, 0]
    colors = sums[:, 1:4]
    weights = sums[:, 4]
    surface_depths = weights / inverse_depths
    colors = colors / weights[:, None]
    eye = camera.centres[0]
    rays = pixel_rays(gaps, camera.Ks[0], camera.viewmats[0])
    depths = np.array(DEPTH_FACTORS)[:, None] * surface_depths.astype(np.float64)
    points = (eye + depths[..., None] * rays).reshape(-1, 3)
    wrong = np.zeros(len(points), bool) if beyond else ~seen[0].show(points)
    for views in seen:
        wrong[~wrong] = views.contradict(points[~wrong])
    if outside is not None:
        wrong[~wrong] = outside.contradict(points[~wrong], FRONT_SHARE)
    possible = ~wrong.reshape(depths.shape)
    rows = np.flatnonzero(possible.any(0))
    first_possible = depths[possible.argmax(0)[rows], rows]
    return make_round_gaussians(
        eye, rays[rows], depths=first_possible, size=NEW_SIZE_PIXELS / camera.Ks[0][0, 0], colors=colors[rows],
        num_higher=num_higher,
    )  # fmt: skip
