"""Scene -> blocks of views that see the same surfaces, each with some views of its neighbours.

Views are nodes of a graph. The weight of an edge says how much of one view the other view sees. Blocks grow one by one
from the rim of the graph; each step adds the view that shares most with the block. Then blocks exchange views as long
as that lowers the weights between blocks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from gsmerge.geometry import camera_centres, project
from gsmerge.kernels.matrices import matmul
from gsmerge.kernels.reproject import see_points
from gsmerge.runtime.memory import free_pages
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Scene

GRID = 24  # cells along the longer side of a view's depth map
SAMPLE_CELLS = 120  # most cells of a view that are looked up in all other views
SAME_DEPTH = 0.15  # share by which a point may lie behind the depth of a cell that shows it
SHARED = 0.25  # most views of neighbours that a block takes in addition, as a share of its own views
SLACK = 0.2  # share by which blocks may differ from equal sizes
SWEEPS = 8  # most passes in which blocks exchange views
POINTS_TOGETHER = 32  # points of a view that are looked up together; only a few cameras can see any of them
OWNED_TOGETHER = 1024  # points whose owners are searched together
MOST_CUT = 1 / 3  # largest share of the weights that blocks may cut; beyond it, one piece is better


def gaussians_at_once(num_gaussians: int, blocks: int) -> int:
    """Return how many Gaussians are in memory at once when a scene is compacted in ``blocks`` blocks."""
    return num_gaussians if blocks == 1 else round(num_gaussians * (1 + SHARED) / blocks)


@dataclass(frozen=True)
class Block:
    """Views that are compacted together: the block's own, and further ones shared with neighbouring blocks."""

    own: tuple[int, ...]  # Its own views, ascending
    shared: tuple[int, ...]  # Views of other blocks that see the same surfaces, ascending

    @property
    def views(self) -> list[int]:
        """All views of the block, ascending."""
        return sorted((*self.own, *self.shared))


@dataclass(frozen=True, eq=False)
class Covisibility:
    """The share of the surfaces of each of v views that every other view sees, from coarse depth maps."""

    cameras: Cameras
    depths: np.ndarray  # [v,h,w] float64, depths of a coarse grid of each view; infinite where nothing is
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
    """Measure which share of every view each other view sees, with occlusion; the scene has to have pixels."""
    cameras, step = scene.cameras, max(1, -(-max(scene.cameras.height, scene.cameras.width) // GRID))
    rows, columns = (np.arange(step // 2, side, step) for side in (cameras.height, cameras.width))
    picked = (rows[:, None] * cameras.width + columns).reshape(-1)
    fronts = scene.get_pixels().fronts.reshape(len(scene), -1)[:, picked]
    means = scene.gaussians.means[fronts].astype(np.float64)
    free_pages([scene.gaussians.means])
    valid = fronts >= 0

    def measure_depths(view: int) -> np.ndarray:
        z = project(means[view], cameras[[view]])[1][0]
        return np.where(valid[view] & (z > 0), z, np.inf)

    depths = np.stack(parallel_map(measure_depths, range(len(scene)))).reshape(-1, len(rows), len(columns))
    stride = slice(None, None, max(1, len(picked) // SAMPLE_CELLS))
    samples = [means[view, stride][valid[view, stride]] for view in range(len(scene))]

    frustums = make_frustums(cameras, depths)

    def measure_shares(points: np.ndarray) -> np.ndarray:
        counts = np.zeros(len(scene))
        for rows in split_points(points, POINTS_TOGETHER):
            candidates = frustums.reached_by(points[rows])
            counts[candidates] += see(points[rows], cameras[candidates], depths[candidates])[1].sum(1)
        return counts / max(1, len(points))

    shares = np.stack(parallel_map(measure_shares, samples))
    sample_views = np.repeat(np.arange(len(scene)), [len(points) for points in samples])
    return Covisibility(cameras, depths, shares, np.concatenate(samples), sample_views)


@dataclass(frozen=True, eq=False)
class Frustums:
    """Half-spaces that bound what each of v cameras sees, to exclude cameras that see none of a few points."""

    planes: np.ndarray  # [v,5,4] unit normals, which point inside, and distances; the last is the image plane
    farthest: np.ndarray  # [v] largest depth that the camera sees

    def reached_by(self, points: np.ndarray, *, hidden: bool = False) -> np.ndarray:
        """Return the cameras, ascending, that may see any of ``points [n,3]``; ``hidden``: also through surfaces."""
        low, high = points.min(0), points.max(0)
        middle, radius = (low + high) / 2, float(np.sqrt(np.square(high - low).sum())) * 0.500001  # rounded up
        distances = matmul(self.planes[..., :3], middle[:, None])[..., 0] + self.planes[..., 3]
        radius += 1e-9 * float(np.abs(distances).max(initial=0))
        reached = (distances >= -radius).all(1)
        if not hidden:
            reached &= distances[:, -1] - radius <= self.farthest
        return np.flatnonzero(reached)


def make_frustums(cameras: Cameras, depths: np.ndarray) -> Frustums:
    """Compute the frustums of cameras whose surfaces lie at ``depths [v,h,w]``."""
    across, down, ahead = (cameras.Ks[:, row].astype(np.float64) for row in range(3))
    normals = np.stack([across, down, cameras.width * ahead - across, cameras.height * ahead - down, ahead], 1)
    normals /= np.sqrt(np.square(normals).sum(-1, keepdims=True))
    viewmats = cameras.viewmats.astype(np.float64)[:, :3]
    return Frustums(matmul(normals, viewmats), (1 + SAME_DEPTH) * depths.max((1, 2)))


def split_points(points: np.ndarray, max_size: int) -> Iterator[np.ndarray]:
    """Yield the rows of ``points [n,3]`` in groups of at most ``max_size`` points that lie close to each other."""
    groups = [np.arange(len(points))] if len(points) else []
    while groups:
        rows = groups.pop()
        if len(rows) <= max_size:
            yield rows
            continue
        values = points[rows]
        order = np.argsort(values[:, np.ptp(values, 0).argmax()], kind="stable")
        groups += [rows[order[len(rows) // 2 :]], rows[order[: len(rows) // 2]]]


def see(points: np.ndarray, cameras: Cameras, depths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two masks ``[c,n]`` of points ``[n,3]``: inside the frustum of each camera, and seen by each camera.

    Points behind the surfaces of the coarse depth maps ``depths [c,h,w]`` are not seen.
    """
    viewmats, Ks = (np.ascontiguousarray(array, np.float64) for array in (cameras.viewmats, cameras.Ks))
    return see_points(points, viewmats, Ks, depths, cameras.width, cameras.height, 0.0, 1 + SAME_DEPTH)


def count_factors(blocks: Sequence[Block], covisibility: Covisibility) -> np.ndarray:
    """Return a factor for each block's number of Gaussians that makes all blocks equally dense.

    Views of other blocks also have Gaussians on the surfaces of a block, but these are dropped. The factor makes up for
    them.
    """
    views = range(len(covisibility.cameras))
    owners = owning_views(covisibility.samples, covisibility, views)
    factors = np.ones(len(blocks))
    for i, block in enumerate(blocks):
        inside = np.isin(owners, block.own)
        used = np.isin(covisibility.sample_views, block.views)
        num_kept = int((inside & used).sum())
        if num_kept:
            factors[i] = max(1.0, int(inside.sum()) / num_kept)
    return factors


def partition_views(weights: np.ndarray, count: int) -> list[Block]:
    """Cluster v views into ``count`` blocks of similar size with weak edges between them; add views of neighbours.

    ``weights [v,v]`` are symmetric and at least 0. Every view belongs to one block. A block also shares those views of
    other blocks that have the largest weights with it, up to ``SHARED`` times the number of its own views.
    """
    labels = exchange(weights, grow_blocks(weights, count))
    blocks = []
    for label in range(count):
        members = np.flatnonzero(labels == label)
        seen = np.where(labels == label, 0, weights[members].sum(0))
        nearest = np.argsort(-seen, kind="stable")[: round(SHARED * len(members))]
        blocks.append(Block(tuple(members.tolist()), tuple(sorted(nearest[seen[nearest] > 0].tolist()))))
    return blocks


def partition_apart(weights: np.ndarray, count: int) -> list[Block]:
    """Cut views into at most ``count`` blocks that see little of each other.

    The blocks are those of :func:`partition_views`. Their number is halved, down to one, while they cut more than a
    third of the weights.
    """
    while True:
        blocks = partition_views(weights, count)
        inside = sum(float(weights[np.ix_(block.own, block.own)].sum()) for block in blocks)
        if count == 1 or inside >= (1 - MOST_CUT) * float(weights.sum()):
            return blocks
        count //= 2


def grow_blocks(weights: np.ndarray, count: int) -> np.ndarray:
    """Label views ``[v]`` with 0 to ``count - 1``, growing blocks one by one from the rim of the unlabelled views.

    A block starts with the view that has the weakest edges to the unlabelled views, and grows by the view that shares
    most with the block.
    """
    num_views = len(weights)
    labels, is_free = np.full(num_views, -1), np.ones(num_views, bool)
    for label in range(count):
        size = round(is_free.sum() / (count - label))
        free_weights = weights[:, is_free].sum(1)  # of the edges from each view to unlabelled ones
        block_weights = np.where(is_free, 0.0, -np.inf)  # of the edges from each unlabelled view to the block
        view = int(np.where(is_free, free_weights, np.inf).argmin())
        for _ in range(size):
            labels[view], is_free[view] = label, False
            block_weights += weights[view]
            block_weights[view] = -np.inf
            # prefer views with weak edges to the other unlabelled ones, so that no view remains alone
            free_weights -= weights[view]
            score = block_weights - 0.5 * np.where(is_free, free_weights, 0)
            view = int(score.argmax())
    return labels


def exchange(weights: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Move views between the blocks ``labels [v]`` while that weakens the edges between blocks.

    The sizes of the blocks stay nearly equal.
    """
    labels, count = labels.copy(), int(labels.max()) + 1
    mean = len(labels) / count
    min_size, max_size = int(np.floor((1 - SLACK) * mean)), int(np.ceil((1 + SLACK) * mean))
    for _ in range(SWEEPS):
        moved = False
        for view in range(len(labels)):
            ties = np.bincount(labels, weights[view], count)
            sizes, label = np.bincount(labels, minlength=count), labels[view]
            is_better = (sizes < max_size) & (ties > ties[label])
            if sizes[label] > max(1, min_size) and is_better.any():
                labels[view] = int(np.where(is_better, ties, -np.inf).argmax())
                moved = True
        if not moved:
            break
    return labels


def owning_views(points: np.ndarray, covisibility: Covisibility, views: Sequence[int]) -> np.ndarray:
    """Return the owner ``[n]`` of each point ``[n,3]``: the nearest of the ``views`` that see the point.

    If no view sees the point, its owner is the nearest view with the point inside its picture. If no picture contains
    the point, its owner is the nearest view.
    """
    cameras, depths = covisibility.cameras[list(views)], covisibility.depths[list(views)]
    centres, frustums = camera_centres(cameras.viewmats.astype(np.float64)), make_frustums(cameras, depths)
    points = points.astype(np.float64)

    def find_owners(rows: np.ndarray) -> np.ndarray:
        owners, ownerless = np.zeros(len(rows), np.int64), np.arange(len(rows))
        for condition in ("seen", "inside", "any"):
            remaining = points[rows[ownerless]]
            candidates = np.arange(len(views))
            if condition != "any":
                candidates = frustums.reached_by(remaining, hidden=condition == "inside")
            squares = np.square(remaining - centres[candidates][:, None]).sum(-1)
            if condition != "any":
                inside, seen = see(remaining, cameras[candidates], depths[candidates])
                squares[~(seen if condition == "seen" else inside)] = np.inf
            is_owned = np.isfinite(squares).any(0)
            if is_owned.any():
                owners[ownerless[is_owned]] = candidates[squares[:, is_owned].argmin(0)]
            ownerless = ownerless[~is_owned]
            if len(ownerless) == 0:
                break
        return owners

    owners, groups = np.zeros(len(points), np.int64), list(split_points(points, OWNED_TOGETHER))
    for rows, group_owners in zip(groups, parallel_map(find_owners, groups), strict=True):
        owners[rows] = group_owners
    return np.asarray(views)[owners]
