"""Names beside their lines instead of a legend, placed where they cover least."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

Curve = NDArray[np.float64]  # [n,2]
SIZE = 7  # points
NEAR, FAR = 5.0, 11.0  # distances between a label and its point, points
DIRECTIONS = ((1, 0), (1, 1), (1, -1), (0, 1), (0, -1), (-1, 1), (-1, -1), (-1, 0))
SAME_END = 0.05  # of the width of the axes
STEP = 3.0  # pixels between the samples of a line


@dataclass(frozen=True)
class Label:
    """A name and where its line runs.

    Args:
        text: The name.
        color: Of the text.
        curve: ``[n,2]`` points of the line, data coordinates.
        anchors: ``[m,2]`` points that the name may stand beside; None: those of the line.
    """

    text: str
    color: str
    curve: Curve
    anchors: Curve | None = None


def end_labels(axes: Axes, labels: Sequence[Label]) -> list[Text]:
    """Write the names right of the axes, each at the height of its line's end, moved apart where they would touch.

    Must come before the figure is laid out, which then makes room for them; :func:`settle` moves them apart.

    Returns:
        The names; none where the lines do not all end at about the same place.
    """
    ends = [_axes_place(axes, label.curve[-1])[0] for label in labels]
    if not labels or max(ends) - min(ends) > SAME_END:
        return []
    return [
        axes.text(
            1.03, _axes_place(axes, label.curve[-1])[1], label.text, transform=axes.transAxes, fontsize=SIZE,
            color=label.color, fontweight="bold", va="center",
        )
        for label in labels
    ]  # fmt: skip


def settle(axes: Axes, labels: Sequence[Label], texts: Sequence[Text]) -> None:
    """Move the names of :func:`end_labels` apart, with a thin line to the end of the curve from those that moved."""
    height = 1.25 * max(text.get_window_extent().height for text in texts) / axes.bbox.height
    wanted = [_axes_place(axes, label.curve[-1])[1] for label in labels]
    for text, label, at, y in zip(texts, labels, wanted, spread(wanted, height), strict=True):
        text.set_position((1.06, y))
        end = _axes_place(axes, label.curve[-1])
        if abs(y - at) > 0.004 or end[0] < 0.98:
            axes.plot(
                [end[0] + 0.012, 1.05], [at, y], transform=axes.transAxes, color=label.color, linewidth=0.5, alpha=0.6,
                clip_on=False, zorder=1,
            )  # fmt: skip


def spread(wanted: Sequence[float], gap: float) -> list[float]:
    """Places at least ``gap`` apart, in the order of the wanted ones and as near to them as can be (least squares)."""
    order = sorted(range(len(wanted)), key=lambda i: wanted[i])
    groups: list[tuple[float, int]] = []  # (mean of the places less their steps, members)
    for rank, i in enumerate(order):
        mean, count = wanted[i] - rank * gap, 1
        while groups and groups[-1][0] >= mean:
            before, members = groups.pop()
            mean, count = (before * members + mean * count) / (members + count), members + count
        groups.append((mean, count))
    level = [mean for mean, count in groups for _ in range(count)]
    placed = [0.0] * len(wanted)
    for rank, i in enumerate(order):
        placed[i] = level[rank] + rank * gap
    return placed


def _axes_place(axes: Axes, point: Curve) -> Curve:
    """A point in fractions of the axes."""
    return np.asarray(axes.transAxes.inverted().transform(axes.transData.transform(point)), np.float64)


def place_labels(axes: Axes, labels: Sequence[Label]) -> None:
    """Write every label beside a point of its line, none over another and over as little else as can be.

    The figure must have been laid out.
    """
    pixels = [_sampled(np.asarray(axes.transData.transform(label.curve), np.float64)) for label in labels]
    scale = axes.figure.dpi / 72
    taken: list[Bbox] = []
    for i, label in enumerate(labels):
        text = axes.text(0, 0, label.text, fontsize=SIZE, color=label.color, fontweight="bold", zorder=9)
        text.set_in_layout(False)
        size = text.get_window_extent()
        spots = label.curve if label.anchors is None else label.anchors
        anchors = np.asarray(axes.transData.transform(spots), np.float64)
        others = np.concatenate([p for j, p in enumerate(pixels) if j != i] or [np.zeros((0, 2))])
        best = min(
            _candidates(anchors, size.width, size.height, scale),
            key=lambda found: found[0] + _cost(found[1], axes.bbox, taken, others, pixels[i]),
        )[1]
        taken.append(best.padded(1.5 * scale))
        text.set_transform(axes.transAxes)
        text.set_position(tuple(axes.transAxes.inverted().transform((best.x0, best.y0))))
        text.set_verticalalignment("bottom")


def _sampled(curve: Curve) -> Curve:
    """Points along a polyline, a few pixels apart."""
    parts = [curve]
    for a, b in pairwise(curve):
        count = max(2, int(np.hypot(*(b - a)) / STEP))
        parts.append(a + np.linspace(0, 1, count)[:, None] * (b - a))
    return np.concatenate(parts)


def _candidates(anchors: Curve, width: float, height: float, scale: float) -> list[tuple[float, Bbox]]:
    """Places for a label and how much less each is liked than the first: ends before the middle, near before far."""
    ends = [len(anchors) - 1, 0, *range(1, len(anchors) - 1)]
    found = []
    for rank, end in enumerate(ends):
        for turn, (dx, dy) in enumerate(DIRECTIONS):
            for distance in (NEAR, FAR):
                gap = distance * scale
                x, y = anchors[end] + np.array([dx, dy]) * gap
                x0 = x if dx > 0 else x - width if dx < 0 else x - width / 2
                y0 = y if dy > 0 else y - height if dy < 0 else y - height / 2
                found.append((2.0 * min(rank, 3) + turn + 0.3 * distance, Bbox.from_bounds(x0, y0, width, height)))
    return found


def _cost(box: Bbox, inside: Bbox, taken: Sequence[Bbox], others: Curve, own: Curve) -> float:
    outside = max(0.0, inside.x0 - box.x0) + max(0.0, box.x1 - inside.x1)
    outside += max(0.0, inside.y0 - box.y0) + max(0.0, box.y1 - inside.y1)
    covered = 4.0 * _inside(box, others) + 2.0 * _inside(box, own)
    centre = np.array([[(box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2]])
    nearest = [float(np.hypot(*(points - centre).T).min()) if len(points) else np.inf for points in (own, others)]
    misleading = 30.0 if nearest[1] < nearest[0] else 0.0
    return 20.0 * outside + covered + misleading + sum(1000.0 for other in taken if box.overlaps(other))


def _inside(box: Bbox, points: Curve) -> int:
    x, y = points.T
    return int(((x > box.x0) & (x < box.x1) & (y > box.y0) & (y < box.y1)).sum())
