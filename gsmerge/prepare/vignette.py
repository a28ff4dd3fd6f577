"""Scene with photos -> the scene without a vignette: light that falls off so far that photos end in a dark ring.

Two photos show one surface at two pixels. The quotient of its brightnesses is that of the light at the two pixels,
whatever the surface is. The light at all pixels follows from the quotients of many surfaces by least squares. It counts
only if it also predicts the quotients in photos from which it was not estimated.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gsmerge.arrays import mean_columns
from gsmerge.frozen import dataclass, replace
from gsmerge.method.compare.similarity import stands_out
from gsmerge.method.compare.view_pictures import fit_size
from gsmerge.method.geometry.transforms import median, medians, rgb_to_sh0, sh0_to_rgb
from gsmerge.method.geometry.views import even_views, take_rows
from gsmerge.method.kernels.elementary import exp, log
from gsmerge.method.kernels.matrices import solve
from gsmerge.method.kernels.pictures import sample_bilinear
from gsmerge.method.raster.photos import counting_pixels
from gsmerge.prepare.exposure import CLIPPED_LEVEL, NOISE_LEVEL
from gsmerge.prepare.photo_change import KEEP, PhotoChange, change_large
from gsmerge.prepare.surfaces import collect_surfaces
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import PicturedScene

LEAST_VIEWS = 4  # half of them predict the others
MOST_VIEWS = 12  # photos that are compared
PIXELS = 8000  # pixels of a photo whose surfaces are looked up
RINGS = 24  # cells of a ring, in each of which light is one unknown
CELLS = 16  # cells along half of the longer side of a grid
BRIGHTEST = 0.9  # usual light is that of the brightest tenth
LEAST_SURFACES = 3  # surfaces from whose quotients the light of two cells is compared
ROUGH = 0.05  # error of the logarithm of a quotient up to which quotients count alike; larger ones count less
ROUNDS = 5  # of weighted least squares
# Lenses halve the light in the corners at most, which is 0.73 in sRGB, and photos from new places have the same
# falloff: that one stays. Where less than DARK is left of the usual light, in at least LEAST_SHARE of all pixels, it is
# no picture of a scene. What has less than BLACK is mostly noise, and does not count
DARK = 0.5
LEAST_SHARE = 0.01
BLACK = 0.2


@dataclass(frozen=True, eq=False)
class _Quotients:
    """Quotients of the brightnesses at which pairs of photos show the same surfaces."""

    here: np.ndarray  # [n] pixel of one photo
    there: np.ndarray  # [n] pixel of the other
    values: np.ndarray  # [n] logarithm of the first brightness over the second, less the median of the two photos
    views: np.ndarray  # [n] number of the first photo

    def __getitem__(self, chosen: np.ndarray) -> _Quotients:
        """Return the quotients of a mask ``[n]``."""
        return _Quotients(self.here[chosen], self.there[chosen], self.values[chosen], self.views[chosen])


@dataclass(frozen=True, eq=False)
class _Shape:
    """Shape of a vignette: pixels of one cell have the same light, and that of neighbours is nearly the same."""

    places: np.ndarray  # [k,h,w] place of each pixel, in cells; of a ring k is 1, of a grid 2: down and across
    size: tuple[int, ...]  # number of cells along each of the k axes

    def find_cells(self) -> np.ndarray:
        """Return the cell ``[h * w]`` of each pixel."""
        return np.ravel_multi_index(tuple(self.places.astype(np.int64)), self.size).reshape(-1)

    def spread(self, light: np.ndarray) -> np.ndarray:
        """Return the light ``[h,w]`` of pixels from that of cells, by linear interpolation."""
        cells = light.reshape(-1, self.size[-1]).astype(np.float32)
        along = (self.places - 0.5).astype(np.float32)
        down = along[0] if len(along) == 2 else np.zeros_like(along[0])
        ends = np.array(cells.shape, np.float32) - 1
        x = along[-1].clip(0, ends[1])
        return np.asarray(sample_bilinear(cells, x, down.clip(0, ends[0])))


def divide_by_vignette(scene: PicturedScene) -> tuple[PicturedScene, np.ndarray | None, str]:
    """Divide photos, and the Gaussians of their pixels, by the light at each pixel, if it falls off to a dark ring.

    Pixels that are nearly black are left out with their Gaussians. Also returns these pixels ``[v,h,w]`` bool, None
    without a vignette, and a sentence.
    """
    views = scene.photo_views
    if len(views) < LEAST_VIEWS or not scene.has_own_pixels:
        return scene, None, ""
    views = [views[i] for i in even_views(len(views), min(len(views), MOST_VIEWS))]
    size = fit_size((scene.cameras.width, scene.cameras.height), CELLS)
    greys = (mean_columns(scene.images[view]) for view in views)
    small = np.stack([cv2.resize(grey, size, interpolation=cv2.INTER_AREA) for grey in greys])
    usual = medians(small.reshape(len(small), -1).T)[:, None, None]
    is_dark = small < DARK * usual
    if is_dark.all(0).mean() < LEAST_SHARE:  # no place is dark in all photos, as in nearly all scenes
        return scene, None, ""
    light = _find_light(scene, views)
    if light is None or (light < DARK * median(light)).mean() < LEAST_SHARE:
        return scene, None, ""
    brightest = np.max([mean_columns(scene.images[view]) for view in views], axis=0)
    black = np.broadcast_to((light < BLACK) | (brightest < NOISE_LEVEL), scene.images.shape[:3])
    change = PhotoChange(light=light.clip(BLACK))
    images = np.stack(parallel_map(change, list(scene.images)))
    large = None if scene.large_photos is None else change_large(scene.large_photos, [change] * len(scene))
    homes = scene.get_pixels().homes
    g = scene.gaussians
    factors = (1 / light.clip(BLACK)).reshape(-1)[homes % light.size][:, None, None].astype(np.float32)
    sh0 = rgb_to_sh0(sh0_to_rgb(g.sh0) * factors).astype(np.float32)
    scene = replace(scene, images=images, large_photos=large, masks=counting_pixels(scene) & ~black)
    scene = replace(scene, gaussians=replace(g, sh0=sh0, shN=g.shN * factors))
    said = (
        f"all photos end in a dark ring (a vignette, down to {100 * light.min():.0f} % of the light): photos, and the"
        f" Gaussians of their pixels, are divided by the light{KEEP}"
    )
    if not black.any():
        return scene, black, said
    said += f"; {100 * black[0].mean():.1f} % of their pixels are too dark, and left out"
    return take_rows(scene, np.flatnonzero(~black.reshape(-1)[homes])), black, said


def _list_shapes(width: int, height: int) -> list[_Shape]:
    """List the shapes that a vignette may have, the simplest first: a round or oval ring, or the same on all sides."""
    y, x = np.mgrid[:height, :width] + 0.5
    across = np.abs(2 * x / width - 1)
    down = np.abs(2 * y / height - 1)
    end = 1 - 1e-6  # the farthest pixels belong to the last cell
    circle = np.sqrt((across * width) ** 2 + (down * height) ** 2) / np.sqrt(width**2 + height**2)
    oval = np.sqrt((across**2 + down**2) / 2)
    lines, columns = (max(3, round(side / max(width, height) * CELLS)) for side in (height, width))
    rings = [_Shape((end * radius * RINGS)[None], (RINGS,)) for radius in (circle, oval)]
    return [*rings, _Shape(end * np.stack([down * lines, across * columns]), (lines, columns))]


def _find_light(scene: PicturedScene, views: Sequence[int]) -> np.ndarray | None:
    """Estimate the light ``[h,w]`` at each pixel, at most 1; None if it does not predict photos that are left out.

    A shape counts in place of a simpler one if it predicts these photos better.
    """
    height, width = scene.images.shape[1:3]
    quotients = _compare_surfaces(scene, views)
    is_left_out = quotients.views % 2 == 0
    left_out = quotients[is_left_out]
    shapes = _list_shapes(width, height)
    regions = shapes[-1].find_cells()[left_out.here]  # of which errors are means
    counts = np.maximum(np.bincount(regions), 1)
    errors = list[np.ndarray]()  # of the left-out quotients, by each shape
    for shape in shapes:
        cells = shape.find_cells()
        light = _solve_light(quotients[~is_left_out], shape, cells)
        errors.append(np.abs(left_out.values - (light[cells[left_out.here]] - light[cells[left_out.there]])))

    def predicts_better(errors: np.ndarray, others: np.ndarray) -> bool:
        """Return whether errors are clearly smaller than others."""
        return stands_out(np.bincount(regions, others - errors) / counts)

    circle, oval, grid = shapes
    circle_errors, oval_errors, grid_errors = errors
    shape, least = (circle, circle_errors) if circle_errors.sum() < oval_errors.sum() else (oval, oval_errors)
    if not predicts_better(least, np.abs(left_out.values)):
        return None
    if predicts_better(grid_errors, least):
        shape = grid
    light = exp(shape.spread(_solve_light(quotients, shape, shape.find_cells())).astype(np.float64))
    usual = np.sort(light.reshape(-1))[int(BRIGHTEST * light.size)]
    return np.asarray((light / usual).clip(0, 1), np.float32)


def _compare_surfaces(scene: PicturedScene, views: Sequence[int]) -> _Quotients:
    """Compare the brightnesses of surfaces that each of ``views`` shows with those in other photos."""
    brightness = mean_columns(scene.images).reshape(len(scene), -1)

    def compare(view: int, other: int, rows: np.ndarray, other_rows: np.ndarray) -> _Quotients | None:
        """Compare two photos."""
        pair = np.stack([brightness[view][rows], brightness[other][other_rows]])
        usable = ((pair > NOISE_LEVEL) & (pair < CLIPPED_LEVEL)).all(0)
        if not usable.any():
            return None
        values = log(pair[0, usable].astype(np.float64) / pair[1, usable])
        numbers = np.full(len(values), views.index(view))
        return _Quotients(rows[usable], other_rows[usable], values - median(values), numbers)

    found = collect_surfaces(scene).compare(views, PIXELS, compare)
    if not found:
        nothing = np.zeros(0, np.int64)
        return _Quotients(nothing, nothing, np.zeros(0), nothing)
    fields = zip(*((one.here, one.there, one.values, one.views) for one in found), strict=True)
    return _Quotients(*(np.concatenate(field) for field in fields))


def _solve_light(quotients: _Quotients, shape: _Shape, cells: np.ndarray) -> np.ndarray:
    """Solve for the logarithm ``[c]`` of the light in each of the ``cells [h * w]``, from medians of pairs of cells.

    Second differences of neighbours are small, so that cells in which no surface is seen continue the others.
    """
    number = int(np.prod(shape.size))
    light = np.zeros(number)
    keys = cells[quotients.here] * number + cells[quotients.there]
    order = np.lexsort((quotients.values, keys))
    pairs, firsts, counts = np.unique(keys[order], return_index=True, return_counts=True)
    here, there = np.divmod(pairs, number)
    is_usable = (here != there) & (counts >= LEAST_SURFACES)
    if not is_usable.any():
        return light
    here = here[is_usable]
    there = there[is_usable]
    counts = counts[is_usable]
    middles = quotients.values[order][firsts[is_usable] + counts // 2]
    smooth = 1e-3 * np.eye(number)
    ids = np.arange(number).reshape(shape.size)
    for axis in range(ids.ndim):
        line = np.moveaxis(ids, axis, 0)
        triples = ((line[:-2], 1), (line[1:-1], -2), (line[2:], 1))
        for one, first in triples:
            for other, second in triples:
                np.add.at(smooth, (one, other), first * second)
    for _ in range(ROUNDS):
        errors = np.abs(light[here] - light[there] - middles)
        weights = counts / np.maximum(errors / ROUGH, 1)
        matrix = smooth * np.median(counts)
        np.add.at(matrix, (here, here), weights)
        np.add.at(matrix, (there, there), weights)
        np.add.at(matrix, (here, there), -weights)
        np.add.at(matrix, (there, here), -weights)
        right = np.bincount(here, weights * middles, number) - np.bincount(there, weights * middles, number)
        light = solve(matrix, right[:, None])[:, 0]
    return light
