"""Find surfaces that several photos show, compare photos there, and solve for what differs between all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from gsmerge.frozen import dataclass
from gsmerge.method.geometry.transforms import camera_distances, order_others
from gsmerge.method.kernels.matrices import solve
from gsmerge.method.kernels.reproject import find_surfaces
from gsmerge.method.raster.photos import NEAR_PLANE
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Scene

# Numbers of nearest views and of farther views with which a view is compared; see choose_partners
NEAREST_VIEWS = 6
FARTHER_VIEWS = 2
LEAST_SHARED = 60  # shared pixels from which a ratio is measured
SAME_LOG_DEPTH = 0.05  # difference of the logarithms of two depths of one surface
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Ratio:
    """Measured ratio of k values between two views, such as three colours, from surfaces that both show."""

    view: int
    other: int
    ratios: np.ndarray  # [k] median, over the pixels, of the logarithm of the other view's values over this view's
    count: int  # number of pixels


@dataclass(frozen=True, eq=False)
class Surfaces:
    """For each pixel, the centre of the Gaussian in front, and whether the pixel counts."""

    cameras: Cameras
    means: np.ndarray  # [v,h*w,3] canonical units
    valid: np.ndarray  # [v,h*w] bool, True for pixels that count

    def look_up(self, view: int, rows: np.ndarray, other: int) -> tuple[np.ndarray, np.ndarray]:
        """Find which of the pixels ``rows`` of a view show a surface that another view shows, too.

        Returns indices into ``rows``, and the pixels at which the other view shows the surface.
        """
        viewmat = self.cameras.viewmats[other].astype(np.float64)
        K = self.cameras.Ks[other].astype(np.float64)
        return find_surfaces(
            self.means[view],
            rows,
            self.means[other],
            self.valid[other],
            viewmat,
            K,
            self.cameras.width,
            NEAR_PLANE,
            SAME_LOG_DEPTH,
        )

    def find_shown(self, view: int, asked: np.ndarray, others: Sequence[int], usable: np.ndarray) -> np.ndarray:
        """Return a mask ``[h*w]`` of the pixels ``asked [h*w]`` of a view whose surface one of ``others`` shows.

        Only pixels of other views that are ``usable [v,h*w]`` show a surface.
        """
        rows = np.flatnonzero(asked & self.valid[view])
        is_shown = np.zeros_like(asked)
        for other in others:
            shared, other_rows = self.look_up(view, rows, other)
            is_shown[rows[shared[usable[other, other_rows]]]] = True
            rows = rows[~is_shown[rows]]
        return is_shown

    def compare(
        self, views: Sequence[int], num_pixels: int, compare: Callable[[int, int, np.ndarray, np.ndarray], T | None]
    ) -> list[T]:
        """Compare each of ``views`` with some others of them, at surfaces of ``num_pixels`` pixels that both show.

        ``compare(view, other, rows, other_rows)`` gets these pixels of both views, ``[m]`` each; what it returns is
        listed, unless it is None.
        """
        sample = np.random.default_rng(0).permutation(self.valid.shape[1])[:num_pixels]
        partners = choose_partners(camera_distances(self.cameras[list(views)]))

        def compare_view(number: int) -> list[T]:
            """Compare one of ``views`` with its partners."""
            view = views[number]
            found = list[T]()
            rows = sample[self.valid[view, sample]]
            for other in (views[partner] for partner in partners[number]):
                shared, other_rows = self.look_up(view, rows, other)
                result = compare(view, other, rows[shared], other_rows)
                if result is not None:
                    found.append(result)
            return found

        return [result for found in parallel_map(compare_view, range(len(views))) for result in found]


def collect_surfaces(scene: Scene) -> Surfaces:
    """Collect the pixels of a scene; pixels without a Gaussian and pixels outside masks do not count."""
    shape = len(scene), scene.pixels_per_view
    fronts = scene.get_pixels().fronts.reshape(shape)
    valid = fronts >= 0
    if scene.masks is not None:
        valid = valid & scene.masks.reshape(shape)
    return Surfaces(scene.cameras, scene.gaussians.means.take(fronts, axis=0), valid)


def choose_partners(distances: np.ndarray) -> np.ndarray:
    """Choose the views ``[v,p]``, ascending, with which each view is compared: all others, or p of them.

    ``distances [v,v]`` are between cameras. The nearest views share the most surfaces. Farther views, at equal steps in
    the order of distance, connect groups of cameras that stand apart.
    """
    order = order_others(distances)
    if order.shape[1] > NEAREST_VIEWS + FARTHER_VIEWS:
        steps = np.linspace(NEAREST_VIEWS, order.shape[1] - 1, FARTHER_VIEWS).round().astype(int)
        order = order[:, [*range(NEAREST_VIEWS), *steps]]
    return np.sort(order, axis=1)


def solve_gains(pairs: Sequence[Ratio], num_views: int) -> np.ndarray:
    """Solve for the logarithmic gains ``[v,k]`` of all views, with mean zero; without pairs all gains are zero."""
    matrix = np.full((num_views, num_views), 1.0 / num_views)
    right = np.zeros((num_views, len(pairs[0].ratios) if pairs else 3))
    max_weighted_pixels = 1000  # above this number of shared pixels, the weight of a pair of views does not grow
    for pair in pairs:
        ends = [pair.view, pair.other]
        weight = np.sqrt(min(pair.count, max_weighted_pixels))
        matrix[np.ix_(ends, ends)] += weight * np.array([[1, -1], [-1, 1]])
        right[ends] += weight * np.array([-pair.ratios, pair.ratios])
    matrix[np.diag_indices(num_views)] += 1e-6  # views without pairs get a gain of one
    gains: np.ndarray = solve(matrix, right)
    return gains
