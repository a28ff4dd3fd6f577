"""Over-split of pictures into rectangles, the most rewarding cuts first, all views and a level of cuts at a time.

The kernel ``split_rectangles`` takes one cut after another from a queue. The same rectangles come from whole levels: a
cut is never made before the one that it lies in, so the gain that counts is the smallest on the way to it, and the
cuts that are made are the largest of those numbers. Cuts below as many known ones as are wanted are not looked into.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from gsmerge.gpu.runs import ranks_by_part, smallest_by_part

ONE = 1 << 20  # of a colour channel in whole numbers: their sums have no order, and no error
NODES = 1 << 15  # rectangles whose cuts are weighed at once: some hundred MB


@dataclass(frozen=True, eq=False)
class Rectangles:
    """n rectangles of some views and their best cuts.

    Args:
        view: ``[n]`` int64.
        corners: ``[n,4]`` int64 y0, x0, y1, x1, pixels.
        across: ``[n]`` bool: cut into an upper and a lower part, not a left and a right one.
        cut: ``[n]`` int64 first row or column of the second part.
        gain: ``[n]`` float64, by how much the squared error falls, at most that of the rectangle that it was cut from;
            -1 where there is nothing to cut.
        parent: ``[n]`` int64 place of that rectangle among all; -1 without one.
    """

    view: Tensor
    corners: Tensor
    across: Tensor
    cut: Tensor
    gain: Tensor
    parent: Tensor

    def __len__(self) -> int:
        return len(self.view)


def whole_colors(images: Tensor) -> Tensor:
    """Colours ``[...,3]`` in [0, 1] as whole numbers, int64."""
    return (images.double() * ONE).round().long()


def split_rectangles(images: Tensor, count: int, block: int, compactness: float) -> tuple[Tensor, int]:
    """Cut every view into ``count`` rectangles, or one for each block where those are more.

    Args:
        images: ``[v,h,w,3]`` colours in [0, 1].
        count: Rectangles of each view, at most h·w.
        block: Side of the blocks that views are divided into at the start, pixels.
        compactness: Weight of squared pixels against squared colours.

    Returns:
        ``[v,h,w]`` int64 labels from 0, those of a view next to each other, and how many each view has.
    """
    views, height, width, _ = images.shape
    integral = _integral_images(images)
    corners = _divide_evenly(height, width, block, images.device)
    num_blocks = len(corners)
    wanted = max(0, count - num_blocks)
    view = torch.arange(views, device=images.device).repeat_interleave(num_blocks)
    none = torch.full((len(view),), -1, dtype=torch.int64, device=images.device)
    never = torch.full((len(view),), torch.inf, dtype=torch.float64, device=images.device)
    level = _weigh(view, corners.repeat(views, 1), none, never, integral, compactness)
    known, first = level, 0
    while wanted:
        worst = -smallest_by_part(-known.gain, known.view, torch.full((views,), wanted - 1, device=view.device))
        chosen = torch.nonzero((level.gain >= 0) & (level.gain >= worst[level.view]))[:, 0]
        if len(chosen) == 0:
            break
        level = _cut_in_two(level, chosen, first, integral, compactness)
        first = len(known)
        known = Rectangles(*(torch.cat([getattr(k, f.name) for k in (known, level)]) for f in fields(Rectangles)))
    divided = (known.gain >= 0) & (ranks_by_part(-known.gain, known.view, views) < wanted)
    leaves = torch.nonzero(~divided & ((known.parent < 0) | divided[known.parent.clamp_min(0)]))[:, 0]
    leaves = leaves[torch.sort(known.view[leaves], stable=True).indices]
    return _paint(known.view[leaves], known.corners[leaves], images.shape[:3]), len(leaves) // max(views, 1)


def _integral_images(images: Tensor) -> Tensor:
    """``[v,h+1,w+1,3]`` int64: sum of all pixels above and to the left."""
    views, height, width, _ = images.shape
    sums = torch.zeros((views, height + 1, width + 1, 3), dtype=torch.int64, device=images.device)
    sums[:, 1:, 1:] = whole_colors(images).cumsum(1).cumsum(2)
    return sums


def _divide_evenly(height: int, width: int, block: int, device: torch.device) -> Tensor:
    """``[b,4]`` corners of about square blocks."""
    lines, columns = max(1, height // block), max(1, width // block)
    y = torch.arange(lines + 1, device=device) * height // lines
    x = torch.arange(columns + 1, device=device) * width // columns
    grids = (y[:-1, None], x[None, :-1], y[1:, None], x[None, 1:])
    return torch.stack([grid.expand(lines, columns).reshape(-1) for grid in grids], 1)


def _weigh(
    view: Tensor, corners: Tensor, parent: Tensor, limit: Tensor, integral: Tensor, compactness: float
) -> Rectangles:
    """Rectangles with their best cuts, whose gains are at most ``limit [n]``."""
    gains, cuts, across = [], [], []
    for first in range(0, len(view), NODES):
        rows = slice(first, first + NODES)
        upright = _best_cuts(view[rows], corners[rows], integral, compactness, 0)
        sideways = _best_cuts(view[rows], corners[rows], integral, compactness, 1)
        down = upright[0] >= sideways[0]
        gains.append(torch.maximum(upright[0], sideways[0]))
        cuts.append(torch.where(down, upright[1], sideways[1]))
        across.append(down)
    gain = torch.minimum(torch.cat(gains), limit)
    return Rectangles(view, corners, torch.cat(across), torch.cat(cuts), gain, parent)


def _best_cuts(view: Tensor, corners: Tensor, integral: Tensor, compactness: float, axis: int) -> tuple[Tensor, Tensor]:
    """Gain ``[n]`` and first row (``axis`` 0) or column (1) of the second part of the best cuts; -1 without any.

    A rectangle of n pixels with colour sum t, whose side of length S is cut at c into parts with sums s and t - s,
    loses ``|S s - c t|² / (n c (S - c))`` of colour error and ``n c (S - c) / 4`` of position error.
    """
    near, far = corners[:, axis], corners[:, axis + 2]
    low, high = corners[:, 1 - axis], corners[:, 3 - axis]
    side = far - near
    pixels = (side * (high - low)).double()
    cut = torch.arange(1, max(2, int(side.max())), device=view.device)
    places = torch.minimum(near[:, None] + cut, far[:, None])  # beyond the side: the whole, which is left out below

    def sums(at: Tensor) -> Tensor:
        """``[n,c,3]`` colour of what lies before ``at [n,c]``, from the edge of the picture on."""
        which = view[:, None]
        if axis == 0:
            return integral[which, at, high[:, None]] - integral[which, at, low[:, None]]
        return integral[which, high[:, None], at] - integral[which, low[:, None], at]

    start = sums(near[:, None])
    total, part = (sums(far[:, None]) - start).double() / ONE, (sums(places) - start).double() / ONE
    off = side[:, None, None] * part - cut[:, None] * total
    balance = (cut * (side[:, None] - cut)).double()
    gain = (off * off).sum(-1) / balance + 0.25 * compactness * (pixels * pixels)[:, None] * balance
    gain = torch.where(balance > 0, gain, -torch.inf)
    best = gain.argmax(1, keepdim=True)
    return torch.where(side > 1, gain.gather(1, best)[:, 0] / pixels, -1.0), near + 1 + best[:, 0]


def _cut_in_two(level: Rectangles, chosen: Tensor, first: int, integral: Tensor, compactness: float) -> Rectangles:
    """The two parts of every chosen rectangle of a level, which begins at ``first`` among all."""
    corners, cut, across = level.corners[chosen], level.cut[chosen], level.across[chosen]
    upper, lower = corners.clone(), corners.clone()
    upper[:, 2], upper[:, 3] = torch.where(across, cut, corners[:, 2]), torch.where(across, corners[:, 3], cut)
    lower[:, 0], lower[:, 1] = torch.where(across, cut, corners[:, 0]), torch.where(across, corners[:, 1], cut)
    both, limit = level.view[chosen].repeat(2), level.gain[chosen].repeat(2)
    return _weigh(both, torch.cat([upper, lower]), (first + chosen).repeat(2), limit, integral, compactness)


def _paint(view: Tensor, corners: Tensor, shape: torch.Size) -> Tensor:
    """``[v,h,w]`` the number of the rectangle ``[n]`` that every pixel lies in; they cover all pixels once."""
    y0, x0, y1, x1 = corners.unbind(1)
    num_pixels, width = shape.numel(), x1 - x0
    areas = (y1 - y0) * width
    owner = torch.repeat_interleave(torch.arange(len(view), device=view.device), areas, output_size=num_pixels)
    inside = torch.arange(num_pixels, device=view.device) - (areas.cumsum(0) - areas)[owner]
    y = y0[owner] + inside // width[owner]
    labels = torch.empty(num_pixels, dtype=torch.int64, device=view.device)
    labels[(view[owner] * shape[1] + y) * shape[2] + x0[owner] + inside % width[owner]] = owner
    return labels.reshape(shape)
