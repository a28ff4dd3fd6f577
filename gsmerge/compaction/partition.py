"""Scene -> blocks of views that see the same surfaces, each with some views of its neighbours.

Views are nodes of a graph whose edges say how much of one view another one sees. Blocks grow from its rim, each time
by the view that shares most with those in it, and then exchange views while that cuts less.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from gsmerge.geometry import camera_centres, project
from gsmerge.kernels.matrices import matmul
from gsmerge.runtime.memory import free_pages
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Cameras, Scene

GRID = 24  # cells along the longer side of a view's depth map
SAMPLE_CELLS = 120  # cells of a view that are looked up in all others, at most
SAME_DEPTH = 0.15  # share by which a point may lie behind the depth of a cell that shows it
SHARED = 0.25  # views of neighbours that a block takes in addition, a share of its own
SLACK = 0.2  # share by which blocks may differ from equal sizes
SWEEPS = 8  # exchanges of views between blocks, at most
TOGETHER = 32  # points of a view that are looked up together: few cameras may see any of them
POINTS = 1024  # the same where owners are searched
MOST_CUT = 1 / 3  # of what views share: where blocks cut more, one piece is better


def gaussians_at_once(num_gaussians: int, blocks: int) -> int:
    """Return how many Gaussians are in memory at once when a scene is compacted in ``blocks`` blocks."""
    return num_gaussians if blocks == 1 else round(num_gaussians * (1 + SHARED) / blocks)


@dataclass(frozen=True)
class Block:
    """Views that are compacted together: the block's own, and further ones shared with neighbouring blocks."""

    own: tuple[int, ...]  # its views, ascending
    shared: tuple[int, ...]  # views of other blocks that see the same surfaces, ascending

    @property
    def views(self) -> list[int]:
        """All views of the block, ascending."""
        return sorted((*self.own, *self.shared))


@dataclass(frozen=True, eq=False)
class Covisibility:
    """Shares of its surface that each of v views has in common with the others, from coarse depth maps."""

    cameras: Cameras
    depths: np.ndarray  # [v,h,w] float64 depths of a coarse grid of each view, infinite where nothing is
    shares: np.ndarray = field(repr=False)  # [v,v] share of the samples of one view (row) that another one sees
    samples: np.ndarray = field(repr=False)  # [n,3] float64 some means of all views
    sample_views: np.ndarray = field(repr=False)  # [n] the view of each

    @property
    def weights(self) -> np.ndarray:
        """Symmetric edge weights ``[v,v]`` between views."""
        both = self.shares + self.shares.T
        np.fill_diagonal(both, 0)
        return both


def measure_covisibility(scene: Scene) -> Covisibility:
    """Measure the share of every view of a scene with pixels that each other view sees, with occlusion."""
    cameras, step = scene.cameras, max(1, -(-max(scene.cameras.height, scene.cameras.width) // GRID))
    rows, columns = (np.arange(step // 2, side, step) for side in (cameras.height, cameras.width))
    picked = (rows[:, None] * cameras.width + columns).reshape(-1)
    fronts = scene.get_pixels().fronts.reshape(len(scene), -1)[:, picked]
    means = scene.gaussians.means[fronts].astype(np.float64)
    free_pages([scene.gaussians.means])
    valid = fronts >= 0

    def one_depth(view: int) -> np.ndarray:
        z = project(means[view], cameras[[view]])[1][0]
        return np.where(valid[view] & (z > 0), z, np.inf)

    depths = np.stack(parallel_map(one_depth, range(len(scene)))).reshape(-1, len(rows), len(columns))
    stride = slice(None, None, max(1, len(picked) // SAMPLE_CELLS))
    samples = [means[view, stride][valid[view, stride]] for view in range(len(scene))]

    frustums = make_frustums(cameras, depths)

    def one_view(points: np.ndarray) -> np.ndarray:
        counts = np.zeros(len(scene))
        for rows in split_points(points, TOGETHER):
            near = frustums.reached_by(points[rows])
            counts[near] += see(points[rows], cameras[near], depths[near])[0].sum(1)
        return counts / max(1, len(points))

    shares = np.stack(parallel_map(one_view, samples))
    numbers = np.repeat(np.arange(len(scene)), [len(points) for points in samples])
    return Covisibility(cameras, depths, shares, np.concatenate(samples), numbers)


@dataclass(frozen=True, eq=False)
class Frustums:
    """Half-spaces that bound what each of v cameras sees: most cameras are far from a few points."""

    planes: np.ndarray  # [v,5,4] unit normals, which point inside, and distances; the last is the image plane
    farthest: np.ndarray  # [v] largest depth that is seen

    def reached_by(self, points: np.ndarray, *, hidden: bool = False) -> np.ndarray:
        """Return the cameras, ascending, that may see any of ``points [n,3]``; with ``hidden`` through surfaces."""
        low, high = points.min(0), points.max(0)
        middle, radius = (low + high) / 2, float(np.sqrt(np.square(high - low).sum())) * 0.500001
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


def split_points(points: np.ndarray, most: int) -> Iterator[np.ndarray]:
    """Yield the rows of ``points [n,3]`` in groups of at most ``most`` that lie close to each other."""
    groups = [np.arange(len(points))] if len(points) else []
    while groups:
        rows = groups.pop()
        if len(rows) <= most:
            yield rows
            continue
        values = points[rows]
        order = np.argsort(values[:, np.ptp(values, 0).argmax()], kind="stable")
        groups += [rows[order[len(rows) // 2 :]], rows[order[: len(rows) // 2]]]


def see(points: np.ndarray, cameras: Cameras, depths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return masks ``[c,n]`` of points ``[n,3]``: seen by each camera, and inside each camera's frustum.

    Points behind the surfaces of the coarse depth maps ``depths [c,h,w]`` are not seen.
    """
    pixels, z = project(points, cameras)
    inside = (z > 0) & (pixels > 0).all(-1) & (pixels < (cameras.width, cameras.height)).all(-1)
    height, width = depths.shape[1:]
    scale = np.array([width / cameras.width, height / cameras.height])
    cells = np.where(inside[..., None], pixels * scale, 0).astype(np.int64)
    nearest = depths[np.arange(len(depths))[:, None], cells[..., 1], cells[..., 0]]
    return inside & (z <= (1 + SAME_DEPTH) * nearest), inside


def count_factors(blocks: Sequence[Block], covisibility: Covisibility) -> np.ndarray:
    """Return a factor for each block's number of Gaussians that makes all blocks equally dense.

    Views of other blocks also see the surfaces of a block, but their Gaussians there are dropped.
    """
    views = range(len(covisibility.cameras))
    owners = owning_views(covisibility.samples, covisibility, views)
    factors = np.ones(len(blocks))
    for i, block in enumerate(blocks):
        inside = np.isin(owners, block.own)
        used = np.isin(covisibility.sample_views, block.views)
        kept = int((inside & used).sum())
        if kept:
            factors[i] = max(1.0, int(inside.sum()) / kept)
    return factors


def partition_views(weights: np.ndarray, count: int) -> list[Block]:
    """Cluster v views into ``count`` blocks of similar size with weak edges between them; add views of neighbours.

    ``weights [v,v]`` are symmetric and at least 0. Every view belongs to one block. A block also shares the views of
    other blocks with the largest weights, up to ``SHARED`` times the number of its own.
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
    """Cut views into at most ``count`` blocks that see little of each other, as :func:`partition_views` does.

    The number is halved while more than a third of the shared weights is cut, down to one block.
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
    labels, left = np.full(num_views, -1), np.ones(num_views, bool)
    for label in range(count):
        size = round(left.sum() / (count - label))
        behind = weights[:, left].sum(1)  # edges of each view to those left
        gain = np.where(left, 0.0, -np.inf)
        view = int(np.where(left, behind, np.inf).argmin())
        for _ in range(size):
            labels[view], left[view] = label, False
            gain += weights[view]
            gain[view] = -np.inf
            # of equals the one that leaves the fewest edges behind, so that no view is left alone
            behind -= weights[view]
            score = gain - 0.5 * np.where(left, behind, 0)
            view = int(score.argmax())
    return labels


def exchange(weights: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Move views between blocks ``labels [v]`` while that weakens the edges between them; sizes stay nearly equal."""
    labels, count = labels.copy(), int(labels.max()) + 1
    mean = len(labels) / count
    least, most = int(np.floor((1 - SLACK) * mean)), int(np.ceil((1 + SLACK) * mean))
    for _ in range(SWEEPS):
        moved = False
        for view in range(len(labels)):
            ties = np.bincount(labels, weights[view], count)
            sizes, label = np.bincount(labels, minlength=count), labels[view]
            free = (sizes < most) & (ties > ties[label])
            if sizes[label] > max(1, least) and free.any():
                labels[view] = int(np.where(free, ties, -np.inf).argmax())
                moved = True
        if not moved:
            break
    return labels


def owning_views(points: np.ndarray, covisibility: Covisibility, views: Sequence[int]) -> np.ndarray:
    """Return the owner ``[n]`` of each point ``[n,3]``: the nearest of the ``views`` that see the point.

    If no view sees the point, it is the nearest view with the point inside its picture, or else the nearest view.
    """
    cameras, depths = covisibility.cameras[list(views)], covisibility.depths[list(views)]
    centres, frustums = camera_centres(cameras.viewmats.astype(np.float64)), make_frustums(cameras, depths)
    points = points.astype(np.float64)

    def of_group(rows: np.ndarray) -> np.ndarray:
        best, left = np.zeros(len(rows), np.int64), np.arange(len(rows))  # those without an owner so far
        for sight in ("seen", "inside", "any"):
            part = points[rows[left]]
            near = np.arange(len(views)) if sight == "any" else frustums.reached_by(part, hidden=sight == "inside")
            squares = np.square(part - centres[near][:, None]).sum(-1)
            if sight != "any":
                seen, inside = see(part, cameras[near], depths[near])
                squares[~(seen if sight == "seen" else inside)] = np.inf
            owned = np.isfinite(squares).any(0)
            if owned.any():
                best[left[owned]] = near[squares[:, owned].argmin(0)]
            left = left[~owned]
            if len(left) == 0:
                break
        return best

    owners, groups = np.zeros(len(points), np.int64), list(split_points(points, POINTS))
    for rows, best in zip(groups, parallel_map(of_group, groups), strict=True):
        owners[rows] = best
    return np.asarray(views)[owners]
