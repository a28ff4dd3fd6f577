"""Cut a scene into blocks of views that see the same surfaces; each block also gets some views of its neighbours.

Views are nodes of a graph. The weight of an edge says how much two views see of each other's surfaces. Blocks grow one
after another. A block begins at the border of the remaining views, and each step adds the view that shares most
surfaces with the block.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmerge.frozen import dataclass, field
from gsmerge.method.geometry.transforms import camera_centres, project
from gsmerge.method.kernels.reproject import see_points
from gsmerge.runtime.memory import free_pages
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Scene

SHARED = 0.25  # most views of neighbours that a block takes in addition, as a share of its own views
MOST_CUT = 1 / 3  # largest share of the weights that blocks may cut; beyond it, one piece is better


def gaussians_at_once(num_gaussians: int, blocks: int) -> int:
    """Return how many Gaussians are in memory together when a scene is compacted in ``blocks`` blocks."""
    return num_gaussians if blocks == 1 else round(num_gaussians * (1 + SHARED) / blocks)


@dataclass(frozen=True)
class Block:
    """Views that are compacted together: the views that belong to the block, and views of neighbouring blocks."""

    own: tuple[int, ...]  # Its own views, ascending
    shared: tuple[int, ...]  # Views of other blocks that see the same surfaces, ascending

    @property
    def views(self) -> list[int]:
        """All views of the block, ascending."""
        return sorted((*self.own, *self.shared))


@dataclass(frozen=True, eq=False)
class Covisibility:
    """How much each of v views sees of the surfaces of every other view, measured on coarse depth maps."""

    cameras: Cameras
    depths: np.ndarray  # [v,h,w] float64, depths on a coarse grid of each view; infinite where nothing is
    shares: np.ndarray = field(repr=False)  # [v,v] share of the samples of one view (row) that another view sees
    samples: np.ndarray = field(repr=False)  # [n,3] float64, means of some Gaussians of all views
    sample_views: np.ndarray = field(repr=False)  # [n] view of each sample

    @property
    def weights(self) -> np.ndarray:
        """Symmetric edge weights ``[v,v]`` between views."""
        both = self.shares + self.shares.T
        np.fill_diagonal(both, 0)
        return both


def measure_covisibility(scene: Scene) -> Covisibility:
    """Measure, for every two views, which share of the surfaces in one view the other view sees.

    Surfaces that are hidden in a view are not seen by it. The scene must have pixels.
    """
    grid_cells = 24  # cells along the longer side of a view's depth map
    cameras, step = scene.cameras, max(1, -(-max(scene.cameras.height, scene.cameras.width) // grid_cells))
    rows, columns = (np.arange(step // 2, side, step) for side in (cameras.height, cameras.width))
    cell_pixels = (rows[:, None] * cameras.width + columns).reshape(-1)
    fronts = scene.get_pixels().fronts.reshape(len(scene), -1)[:, cell_pixels]
    means = scene.gaussians.means[fronts].astype(np.float64)
    free_pages([scene.gaussians.means])
    valid = fronts >= 0

    def measure_depths(view: int) -> np.ndarray:
        """Return the depths of the cells of a view, infinite where no Gaussian is in front of the camera."""
        z = project(means[view], cameras[[view]])[1][0]
        return np.where(valid[view] & (z > 0), z, np.inf)

    depths = np.stack(parallel_map(measure_depths, range(len(scene)))).reshape(-1, len(rows), len(columns))
    sample_cells = 120  # most cells of a view that are looked up in all other views
    stride = slice(None, None, max(1, len(cell_pixels) // sample_cells))
    samples = [means[view, stride][valid[view, stride]] for view in range(len(scene))]

    def measure_shares(points: np.ndarray) -> np.ndarray:
        """Return the share of the samples of one view that each view sees."""
        _, seen = mark_inside_and_seen(points, cameras, depths)
        return seen.sum(1) / max(1, len(points))

    shares = np.stack(parallel_map(measure_shares, samples))
    sample_views = np.repeat(np.arange(len(scene)), [len(points) for points in samples])
    return Covisibility(cameras, depths, shares, np.concatenate(samples), sample_views)


def mark_inside_and_seen(points: np.ndarray, cameras: Cameras, depths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two masks ``[c,n]`` of points ``[n,3]``: inside the frustum of each camera, and seen by each camera.

    A point is not seen if it lies behind the surfaces of the coarse depth maps ``depths [c,h,w]``.
    """
    viewmats, Ks = (np.ascontiguousarray(array, np.float64) for array in (cameras.viewmats, cameras.Ks))
    same_depth = 0.15  # a point is seen if it lies at most this share of the depth behind the surface of its cell
    return see_points(points, viewmats, Ks, depths, cameras.width, cameras.height, 0.0, 1 + same_depth)


def count_factors(blocks: Sequence[Block], covisibility: Covisibility) -> np.ndarray:
    """Return for each block the factor on its number of Gaussians that makes all blocks equally dense.

    Some Gaussians on surfaces of a block belong to pixels of views outside the block, and the block is built without
    these Gaussians. To make up for them, the number of Gaussians from the block's own views is multiplied by the
    factor.
    """
    views = range(len(covisibility.cameras))
    owners = owning_views(covisibility.samples, covisibility, views)
    factors = np.ones(len(blocks))
    for i, block in enumerate(blocks):
        on_surfaces = np.isin(owners, block.own)
        of_views = np.isin(covisibility.sample_views, block.views)
        num_kept = int((on_surfaces & of_views).sum())
        if num_kept:
            factors[i] = max(1.0, int(on_surfaces.sum()) / num_kept)
    return factors


def partition_views(weights: np.ndarray, count: int) -> list[Block]:
    """Cut v views into ``count`` blocks of similar size, with weak edges between them.

    ``weights [v,v]`` of the edges are symmetric and at least 0. Every view belongs to one block. A block also gets
    views of other blocks, those with the largest weights to its own views, up to ``SHARED`` times the number of its own
    views.
    """
    labels = grow_blocks(weights, count)
    blocks = []
    for label in range(count):
        own = np.flatnonzero(labels == label)
        block_weights = np.where(labels == label, 0, weights[own].sum(0))
        nearest = np.argsort(-block_weights, kind="stable")[: round(SHARED * len(own))]
        blocks.append(Block(tuple(own.tolist()), tuple(sorted(nearest[block_weights[nearest] > 0].tolist()))))
    return blocks


def partition_apart(weights: np.ndarray, count: int) -> list[Block]:
    """Cut views into at most ``count`` blocks that see little of each other, with :func:`partition_views`.

    The number of blocks is halved, down to one, as long as more than a third of the weights lies on edges between
    blocks.
    """
    while True:
        blocks = partition_views(weights, count)
        weight_inside = sum(float(weights[np.ix_(block.own, block.own)].sum()) for block in blocks)
        if count == 1 or weight_inside >= (1 - MOST_CUT) * float(weights.sum()):
            return blocks
        count //= 2


def grow_blocks(weights: np.ndarray, count: int) -> np.ndarray:
    """Return the block of each view ``[v]``, 0 to ``count - 1``; blocks grow one after another.

    A free view has no block yet. A block begins with the free view that has the weakest edges to other free views. The
    block grows by the free view that shares most with it.
    """
    num_views = len(weights)
    labels = np.full(num_views, -1)
    is_free = np.ones(num_views, bool)
    for label in range(count):
        size = round(is_free.sum() / (count - label))
        free_weights = weights[:, is_free].sum(1)  # sum of the edges from each view to free ones
        block_weights = np.where(is_free, 0.0, -np.inf)  # sum of the edges from each free view to the block
        view = int(np.where(is_free, free_weights, np.inf).argmin())
        for _ in range(size):
            labels[view] = label
            is_free[view] = False
            block_weights += weights[view]
            block_weights[view] = -np.inf
            # prefer views with weak edges to other free views, so that no view remains alone
            free_weights -= weights[view]
            score = block_weights - 0.5 * np.where(is_free, free_weights, 0)
            view = int(score.argmax())
    return labels


def owning_views(points: np.ndarray, covisibility: Covisibility, views: Sequence[int]) -> np.ndarray:
    """Return the owner ``[n]`` of each point ``[n,3]``: the nearest of the ``views`` that see the point.

    If no view sees the point, the owner is the nearest view whose picture contains it. If no picture contains the
    point, the owner is the nearest of all views.
    """
    cameras, depths = covisibility.cameras[list(views)], covisibility.depths[list(views)]
    centres = camera_centres(cameras.viewmats.astype(np.float64))

    def find_owners(part: np.ndarray) -> np.ndarray:
        """Return for each point of a part the index of its owner among ``views``."""
        squared_distances = np.square(part - centres[:, None]).sum(-1)
        inside, seen = mark_inside_and_seen(part, cameras, depths)
        may_own = np.where(seen.any(0), seen, inside)
        squared_distances[~may_own & may_own.any(0)] = np.inf
        return squared_distances.argmin(0)

    part_size = 1024  # points whose owners are found together
    parts = np.array_split(points.astype(np.float64), max(1, len(points) // part_size))
    return np.asarray(views)[np.concatenate(parallel_map(find_owners, parts))]
