"""Scene -> the pixel of each Gaussian and the Gaussian in front of each pixel; also raise sizes far below a pixel.

Pixels are found by projection of centres. Each view is divided into cells that are wider than the distances between
neighbouring Gaussians. The Gaussian that a cell's pixels show most is the cell's front, and hides the Gaussians behind
it. A pixel that contains no centre shows the front of its cell.

A renderer widens every Gaussian by the low-pass filter of the pixels. Because of this filter, Gaussians that are far
smaller than a pixel, such as points that all got one tiny size, look right when rendered. But functions that use these
tiny sizes without rendering would find an empty scene.
"""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from gsmerge.method.geometry.pooling import measure_pixel_sizes
from gsmerge.method.geometry.transforms import find_nearest
from gsmerge.method.kernels.gaussians.fronts import project_centres, weigh_centres
from gsmerge.method.kernels.raster.binning import depth_order
from gsmerge.method.raster.images import ONE_AT_A_TIME
from gsmerge.method.raster.photos import NEAR_PLANE
from gsmerge.method.raster.tiled_view import EPS2D
from gsmerge.runtime.threads import in_turn
from gsmerge.types import Pixels, Scene, SceneT

# Cells are wide enough if at least this share of them has a centre. Only cells whose neighbours all have a centre are
# examined. Of eight captures in voxels, six have shares of at least .97, and lose nothing compared with finding fronts
# by rendering. The two with shares of .93 and .95 lose 1.5 and 5 dB
COVERED_CELLS = 0.96
SHOWN_WIDTH = 4.0  # width of a Gaussian that shows nearly all of it, in standard deviations
ESTIMATE_GAUSSIANS = 10_000  # medians and shares are estimated from at least this many Gaussians, if there are as many
SAME_DEPTH = 1.05  # a centre is on the surface of its cell up to this multiple of the depth of the cell's front
LOW_PASS = math.sqrt(EPS2D)  # standard deviation of the low-pass, pixels
# The low-pass hides a Gaussian whose scales are all below the share HIDDEN_SIZE of the low-pass. If at most the share
# FEWEST_HIDDEN of the Gaussians is hidden, nothing changes, because a fit repairs such a small share. In sound scenes
# seen from placed cameras, the low-pass hides up to .05 of the Gaussians
HIDDEN_SIZE = 0.5
FEWEST_HIDDEN = 0.1


def with_pixels(scene: SceneT) -> SceneT:
    """Return a canonical scene with pixels; if the scene has no pixels, they are found by projection."""
    return scene if scene.pixels is not None else replace(scene, pixels=find_pixels(scene))


def raise_sizes(scene: SceneT, *, placed: bool = False) -> tuple[SceneT, str]:
    """Return a canonical scene in which Gaussians that the low-pass hides have its size, and a sentence about them.

    Gaussians that share a pixel may be smaller than it, because each shows a part of the pixel. They do not count as
    hidden, because otherwise sound scenes with few pixels would change. If the cameras were ``placed``, sizes are
    compared with the distance to the nearest Gaussian instead of a pixel. Without photos, nothing changes in a scene
    that is drawn antialiased, because there the low-pass makes small Gaussians fainter instead of hiding their size.
    """
    g = scene.gaussians
    cameras = scene.cameras
    by_distance = placed and len(scene.gaussians) > 1
    if cameras.antialiased and scene.images is None:
        return scene, ""
    homes = np.full(len(g), -1) if scene.pixels is None else scene.pixels.homes
    step = max(1, len(g) // ESTIMATE_GAUSSIANS)
    units = measure_pixel_sizes(g.means[::step], homes[::step], cameras)
    if by_distance:  # the Gaussians of a sample are farther apart than all Gaussians
        units = np.minimum(units, find_nearest(g.means[::step], 1)[1][:, 0] / math.sqrt(step))
    if (g.scales[::step].max(1) < HIDDEN_SIZE * LOW_PASS * units).mean() < FEWEST_HIDDEN:
        return scene, ""
    units = find_nearest(g.means, 1)[1][:, 0] if by_distance else measure_pixel_sizes(g.means, homes, cameras)
    sizes = g.scales.max(1)
    seen = (homes >= 0) | by_distance
    num_sharing = 1 if by_distance else np.where(seen, np.bincount(homes + 1)[homes + 1], 1)
    is_near = units < 1  # sizes are not compared with pixels as large as the scene's median depth, or larger
    hidden = (sizes * np.sqrt(num_sharing) < HIDDEN_SIZE * LOW_PASS * units) & is_near
    if np.count_nonzero(hidden & seen) <= FEWEST_HIDDEN * np.count_nonzero(seen):
        return scene, ""
    share = 100 * hidden.mean()
    usual = np.median(sizes[hidden] / units[hidden])
    change = (
        f"{share:.0f} % of the Gaussians are far smaller than"
        f" {'the distance to the next one' if by_distance else 'a pixel of the views'}, about {usual:.1g} of it;"
        " they count as half of it, about as large as they look"
    )
    scales = np.where(hidden[:, None], LOW_PASS * units[:, None], g.scales).astype(np.float32)
    return replace(scene, gaussians=replace(g, scales=scales)), change


def find_pixels(scene: Scene) -> Pixels:
    """Find the pixel of each Gaussian of a canonical scene, and the front of each pixel.

    In each view, the weight of a Gaussian is opacity x transmittance x area in pixels. The pixel of a Gaussian is the
    pixel at its centre, in the first view in which it has its largest weight; -1 if no view sees the Gaussian. The
    front of a pixel is the Gaussian with the largest opacity x transmittance among those with a centre in the pixel. A
    pixel that contains no centre has the front of the cell around it, or -1 if the cell is empty.
    """
    g = scene.gaussians
    cameras = scene.cameras
    count = len(scene)
    means, scales, opacities = (np.ascontiguousarray(column, np.float32) for column in (g.means, g.scales, g.opacities))
    viewmats, Ks = (np.ascontiguousarray(array, np.float64) for array in (cameras.viewmats, cameras.Ks))
    height = cameras.height
    width = cameras.width
    fronts = np.empty((count, height, width), np.int32)
    best_weights = np.zeros(len(g), np.float32)
    homes = np.full(len(g), -1, np.int64)

    def weigh(view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fill the fronts of a view; return the rows ``[m]`` of its Gaussians, their pixels and their weights."""
        shape = height, width
        ids, pixels, depths, areas = project_centres(means, scales, viewmats[view], Ks[view], width, height, NEAR_PLANE)
        if len(ids) == 0:
            fronts[view] = -1
            return ids, pixels, areas
        inside = areas > 0
        shown = np.zeros(shape, bool)
        shown.reshape(-1)[pixels[inside]] = True
        some_areas = areas[:: max(1, len(areas) // ESTIMATE_GAUSSIANS)]
        level = choose_level(shown, SHOWN_WIDTH * float(np.sqrt(np.median(np.abs(some_areas)))))
        # first the fronts of all cells, then the fronts of pixels from the Gaussians on the surface of their cell
        order = depth_order(depths)
        cells, cells_shape = _cells_of(pixels, shape, level)
        grid_fronts = np.empty(cells_shape, np.int32)
        weights = weigh_centres(order, ids, cells, areas, opacities, grid_fronts)  # fills `grid_fronts`
        cell_fronts = grid_fronts.reshape(-1)
        front_depths = depths[np.searchsorted(ids, cell_fronts).clip(max=len(ids) - 1)]
        max_depths = SAME_DEPTH * np.where(cell_fronts >= 0, front_depths, np.inf)
        on_surface = (depths <= max_depths[cells])[order]
        weigh_centres(order[on_surface], ids, pixels, areas, opacities, fronts[view])  # fills `fronts`
        pixel_cells, _ = _cells_of(np.arange(height * width, dtype=np.int32), shape, level)
        np.copyto(fronts[view], cell_fronts[pixel_cells].reshape(shape), where=fronts[view] < 0)
        return ids, pixels, weights

    weighed = in_turn(weigh, range(count)) if len(g) <= ONE_AT_A_TIME else map(weigh, range(count))
    for view, (ids, pixels, weights) in enumerate(weighed):
        is_better = weights > best_weights[ids]
        ids = ids[is_better]
        best_weights[ids], homes[ids] = weights[is_better], view * scene.pixels_per_view + pixels[is_better]
    return Pixels(homes, fronts, own=False)


def choose_level(shown: np.ndarray, widest: float) -> int:
    """Choose the level of cells, which are 2**level pixels wide, from the mask ``shown [h,w]`` of pixels with a centre.

    Cells are wide enough if nearly all of them have a centre. Only cells whose neighbours all have a centre are
    examined. The result is one level above the smallest cells that are wide enough, so that hidden surfaces do not show
    through where a centre is missing. The result is 1 if no cells of up to ``widest`` pixels are wide enough.
    """
    fine = shown
    level = 0
    while 2**level <= max(widest, 1.0):
        around = cv2.erode(_coarser(fine).astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) > 0
        height, width = fine.shape
        between = around.repeat(2, 0)[:height].repeat(2, 1)[:, :width]
        if between.any() and np.count_nonzero(fine & between) >= COVERED_CELLS * np.count_nonzero(between):
            return level + 1
        fine = _coarser(fine)
        level = level + 1
    return 1


def _coarser(mask: np.ndarray) -> np.ndarray:
    """Halve a mask ``[h,w]``: the result is True for each square of 2 x 2 pixels with at least one True pixel."""
    height, width = mask.shape
    even = np.pad(mask, ((0, height % 2), (0, width % 2)))
    lines = even[::2] | even[1::2]
    return np.asarray(lines[:, ::2] | lines[:, 1::2])


def _cells_of(pixels: np.ndarray, shape: tuple[int, ...], level: int) -> tuple[np.ndarray, tuple[int, int]]:
    """Return the cell of each of ``pixels [m]`` int32 of a picture ``[h,w]``, and the numbers of cells down and across.

    A cell of a ``level`` is 2**level pixels wide.
    """
    height, width = shape
    rows, columns = np.divmod(pixels, np.int32(width))
    wide = -(-width // (1 << level))
    return (rows >> level) * np.int32(wide) + (columns >> level), (-(-height // (1 << level)), wide)
