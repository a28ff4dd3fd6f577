"""Merging of neighbouring regions with Ward's rule, and moves of border pixels, all views at a time.

Both follow the kernels ``merge_tree`` and ``sweep``. Merging has rounds there too; here a round is over all edges at
once. A sweep goes from pixel to pixel there; here a quarter of the pixels decides at once, none of which is next to
another, so that each decision about connectivity stands, whatever the others do. Means follow after every quarter.
Sums are of whole numbers, so results repeat bit for bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsmerge.gpu.rectangles import ONE, whole_colors
from gsmerge.gpu.runs import ranks_by_part, smallest_by_part
from gsmerge.kernels.superpixels.sweeps import CONNECTIVITY
from gsmerge.kernels.superpixels.ward import CEILING_GROWTH, TIE_BREAK

NEIGHBOURS = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))  # in the order of the table's bits
FIRST_CEILING = 1.1  # times the cost of the dearest edge that is cheap enough if costs stayed as they begin


def pixel_features(images: Tensor) -> Tensor:
    """``[v·h·w,6]`` int64: colour in whole numbers, y, x, 1; for sums over regions."""
    views, height, width, _ = images.shape
    y, x = torch.meshgrid(
        torch.arange(height, device=images.device), torch.arange(width, device=images.device), indexing="ij"
    )
    places = torch.stack([y, x, torch.ones_like(x)], -1).expand(views, height, width, 3)
    return torch.cat([whole_colors(images), places], -1).reshape(-1, 6)


def sum_regions(labels: Tensor, features: Tensor, count: int) -> Tensor:
    """``[count,6]`` int64 sums of :func:`pixel_features` over the regions."""
    sums = torch.zeros((count, 6), dtype=torch.int64, device=labels.device)
    return sums.index_add_(0, labels.reshape(-1), features)


def scale_features(features: Tensor, spread: float) -> Tensor:
    """``[...,5]`` float64 colour, and y and x times ``spread``, of :func:`pixel_features` or their sums ``[...,6]``."""
    scale = torch.tensor([1 / ONE] * 3 + [spread] * 2, dtype=torch.float64, device=features.device)
    return features[..., :5].double() * scale


def mean_features(sums: Tensor, spread: float) -> Tensor:
    """``[r,5]`` float64 mean colour, and mean y and x times ``spread``, of sums ``[r,6]``."""
    return scale_features(sums, spread) / sums[:, 5:].double()


def adjacent_pairs(labels: Tensor) -> Tensor:
    """``[e,2]`` labels of neighbouring regions, about one row per straight piece of common border."""
    pairs = []
    for axis in (1, 2):
        first, second = labels.narrow(axis, 0, labels.shape[axis] - 1), labels.narrow(axis, 1, labels.shape[axis] - 1)
        begins = first != second
        along = 3 - axis
        length = labels.shape[along] - 1
        same = (first.narrow(along, 1, length) == first.narrow(along, 0, length)) & (
            second.narrow(along, 1, length) == second.narrow(along, 0, length)
        )
        begins.narrow(along, 1, length).logical_and_(~same)
        pairs.append(torch.stack([first[begins], second[begins]], 1))
    return torch.cat(pairs)


def mix(u: Tensor, v: Tensor) -> Tensor:
    """Whole numbers of 32 bits that depend on two others, in no visible way."""
    mixed = (u * 2654435761 & 0xFFFFFFFF) ^ (v * 40503 & 0xFFFFFFFF)
    return mixed ^ mixed >> 15


@dataclass(eq=False)
class _Tree:
    """Regions and what they merge into: rows of the leaves first, then of the merged in the order of their making."""

    means: Tensor  # [2r,5]
    sizes: Tensor  # [2r] pixels
    heights: Tensor  # [2r] cost at which each came to be, not below those of its parts
    parents: Tensor  # [2r] -1 at a root
    views: Tensor  # [2r]
    keys: Tensor  # [2r] a number of each, the same whatever other views there are
    count: int


def merge_regions(labels: Tensor, features: Tensor, each: int, count: int, spread: float) -> Tensor:
    """Merge the regions of every view down to ``count``, cheapest first.

    Args:
        labels: ``[v,h,w]`` from 0, ``each`` of every view next to each other, each region 4-connected.
        features: Of the pixels, see :func:`pixel_features`.
        each: Regions of every view.
        count: Regions wanted in every view, 1 to ``each``.
        spread: Square root of the weight of squared pixels against squared colours.

    Returns:
        ``[v,h,w]`` labels from 0, ``count`` of every view next to each other.
    """
    views, merges = len(labels), each - count
    if merges == 0:
        return labels
    tree = _plant(sum_regions(labels, features, views * each), each, spread)
    pairs = adjacent_pairs(labels)
    ceilings = _first_ceilings(pairs, tree, views, merges / each)
    done = torch.zeros(views, dtype=torch.int64, device=labels.device)
    rounds = 0
    while True:
        pairs, joined = _merge_round(pairs, tree, ceilings)
        done += joined
        rounds += 1
        if int(joined.sum()) == 0:
            if bool((done >= merges).all()):
                break
            ceilings = torch.where(done < merges, ceilings * CEILING_GROWTH, ceilings)
    return _cut(tree, views, each, merges, rounds)[labels]


def _plant(sums: Tensor, each: int, spread: float) -> _Tree:
    """A tree of leaves alone, with room for what they merge into."""
    num = len(sums)

    def room(tensor: Tensor) -> Tensor:
        return torch.cat([tensor, torch.zeros_like(tensor)])

    numbers = torch.arange(num, device=sums.device)
    parents = torch.full((2 * num,), -1, dtype=torch.int64, device=sums.device)
    sizes = sums[:, 5].double()
    means = mean_features(sums, spread)
    heights, views, keys = torch.zeros_like(sizes), numbers // each, numbers % each
    return _Tree(room(means), room(sizes), room(heights), parents, room(views), room(keys), num)


def _costs(pairs: Tensor, tree: _Tree) -> Tensor:
    """``[e]`` growth of the squared error if two regions become one: n_u n_v / (n_u + n_v) |mean_u - mean_v|².

    A small number that depends on the pair only is added, so that flat pictures do not merge one pair a round.
    """
    u, v = pairs.unbind(1)
    squares = (tree.means[u] - tree.means[v]).square().sum(1)
    ties = TIE_BREAK / 1024 * ((mix(tree.keys[u], tree.keys[v]) & 1023) + 1)
    return squares * tree.sizes[u] * tree.sizes[v] / (tree.sizes[u] + tree.sizes[v]) + ties


def _first_ceilings(pairs: Tensor, tree: _Tree, views: int, share: float) -> Tensor:
    """``[v]`` a little above the dearest merge that will be needed when ``share`` of the regions are to vanish."""
    of_pair = tree.views[pairs[:, 0]]
    counts = torch.bincount(of_pair, minlength=views)
    ranks = torch.minimum((share * counts).long(), counts - 1).clamp_min(0)
    dearest = smallest_by_part(_costs(pairs, tree), of_pair, ranks)
    return torch.where(counts > 0, FIRST_CEILING * dearest, 0.0).clamp_min(2 * TIE_BREAK)


def _merge_round(pairs: Tensor, tree: _Tree, ceilings: Tensor) -> tuple[Tensor, Tensor]:
    """Merge the two regions of every edge that is the cheapest of both -> edges left, merges ``[v]`` of each view."""
    costs = _costs(pairs, tree)
    cheap = costs <= ceilings[tree.views[pairs[:, 0]]]
    bids = torch.where(cheap, costs, torch.inf)
    best = torch.full((len(tree.parents),), torch.inf, dtype=bids.dtype, device=bids.device)
    best.scatter_reduce_(0, pairs.reshape(-1), bids.repeat_interleave(2), "amin")
    number = torch.arange(len(pairs), device=pairs.device)[:, None].expand(-1, 2)
    number = torch.where(cheap[:, None] & (bids[:, None] == best[pairs]), number, len(pairs))
    first = torch.full_like(tree.parents, len(pairs))
    first.scatter_reduce_(0, pairs.reshape(-1), number.reshape(-1), "amin")
    mutual = torch.nonzero(cheap & (first[pairs] == number[:, :1]).all(1) & (number[:, 0] < len(pairs)))[:, 0]
    u, v = pairs[mutual].unbind(1)
    new = slice(tree.count, tree.count + len(mutual))
    total = tree.sizes[u] + tree.sizes[v]
    tree.means[new] = tree.means[v] + (tree.sizes[u] / total)[:, None] * (tree.means[u] - tree.means[v])
    tree.sizes[new], tree.views[new], tree.keys[new] = total, tree.views[u], mix(tree.keys[u], tree.keys[v])
    tree.heights[new] = torch.maximum(costs[mutual], torch.maximum(tree.heights[u], tree.heights[v]))
    tree.parents[u] = tree.parents[v] = torch.arange(new.start, new.stop, device=pairs.device)
    tree.count = new.stop
    pairs = torch.where(tree.parents[pairs] >= 0, tree.parents[pairs], pairs)
    return pairs[pairs[:, 0] != pairs[:, 1]], torch.bincount(tree.views[u], minlength=len(ceilings))


def _cut(tree: _Tree, views: int, each: int, merges: int, rounds: int) -> Tensor:
    """``[v·each]`` label of every leaf when only the cheapest ``merges`` of every view are made."""
    num_leaves = views * each
    made = slice(num_leaves, tree.count)
    keep = torch.zeros(tree.count, dtype=torch.bool, device=tree.parents.device)
    # children come before their parents, so the first of equal ones never lack a child
    keep[made] = ranks_by_part(tree.heights[made], tree.views[made], views) < merges
    parents = tree.parents[: tree.count]
    itself = torch.arange(tree.count, device=parents.device)
    up = torch.where((parents >= 0) & keep[parents.clamp_min(0)], parents, itself)
    for _ in range(math.ceil(math.log2(rounds + 1)) + 1):  # a leaf is at most one merge a round below its root
        up = up[up]
    keys = tree.views[:num_leaves] * tree.count + up[:num_leaves]
    return torch.unique(keys, return_inverse=True)[1]


def move_borders(labels: Tensor, features: Tensor, count: int, passes: int, spread: float) -> Tensor:
    """Moves of border pixels that lower the squared error and take no region apart; ``passes`` over all pixels.

    A pixel goes from region A to a 4-neighbour's region B if ``n_A/(n_A-1)·d_A² > n_B/(n_B+1)·d_B²`` and A stays
    connected without it. It needs a neighbour of its own label, so that no region can run empty.

    Args:
        labels: ``[v,h,w]`` from 0, each region 4-connected; not changed.
        features: Of the pixels, see :func:`pixel_features`.
        count: Regions of all views.
        passes: Each decides about every pixel once.
        spread: Square root of the weight of squared pixels against squared colours.
    """
    views, height, width = labels.shape
    padded = torch.full((views, height + 2, width + 2), -1, dtype=torch.int64, device=labels.device)
    padded[:, 1:-1, 1:-1] = labels
    sums = sum_regions(labels, features, count)
    table = torch.from_numpy(CONNECTIVITY).to(labels.device).bool()
    grid = features.reshape(views, height, width, 6)
    for _ in range(passes):
        for y, x in ((0, 0), (1, 1), (0, 1), (1, 0)):
            if y < height and x < width:
                _move_quarter(padded, grid[:, y::2, x::2], sums, table, spread, (y, x))
    return padded[:, 1:-1, 1:-1].contiguous()


def _move_quarter(
    padded: Tensor, features: Tensor, sums: Tensor, table: Tensor, spread: float, corner: tuple[int, int]
) -> None:
    """Move every second pixel of every second row, in place; ``sums`` follow."""
    height, width = padded.shape[1] - 2, padded.shape[2] - 2

    def beside(dy: int, dx: int) -> Tensor:
        y, x = corner[0] + 1 + dy, corner[1] + 1 + dx
        return padded[:, y : height + 1 + dy : 2, x : width + 1 + dx : 2]

    own = beside(0, 0).clone()
    around = [beside(*step) for step in NEIGHBOURS]
    bits = sum(((label == own) << bit for bit, label in enumerate(around)), torch.zeros_like(own))
    means, sizes = mean_features(sums, spread).float(), sums[:, 5].float()
    leaving, joining = sizes / (sizes - 1).clamp_min(1), sizes / (sizes + 1)
    points = scale_features(features, spread).float()

    def cost(label: Tensor, factor: Tensor) -> Tensor:
        known = label.clamp_min(0)
        return (points - means[known]).square().sum(-1) * factor[known]

    best, target = cost(own, leaving), own
    movable = table[bits]
    for label in around[::2]:
        offer = cost(label, joining)
        better = (label >= 0) & (label != own) & (offer < best) & movable
        best, target = torch.where(better, offer, best), torch.where(better, label, target)
    moved = (target != own)[..., None] * features
    sums.index_add_(0, target.reshape(-1), moved.reshape(-1, 6))
    sums.index_add_(0, own.reshape(-1), -moved.reshape(-1, 6))
    beside(0, 0).copy_(target)
