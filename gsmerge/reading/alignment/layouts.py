"""Lay out rows as pixels of views. Each pixel has a row, or some pixels have none."""

from __future__ import annotations

import numpy as np

from gsmerge.frozen import dataclass

ESTIMATED = "estimated from the grid"  # the `source` of cameras that no file gives
TRIMS = (8, 4, 2)  # pixels that DepthSplat, ZPressor and ReSplat cut off at every border


@dataclass(frozen=True, eq=False)
class Layout:
    """The pixel of each row, in views of one size."""

    views: int
    width: int  # pixels
    height: int
    # "view-major": view by view and line by line. "view-fastest": pixel by pixel, with all views of a pixel in turn
    order: str = "view-major"
    # ``[n]`` the pixel ``(view·H + y)·W + x`` of each row, -1 for a row without one; None if the rows are all pixels in
    # order
    ids: np.ndarray | None = None

    @property
    def description(self) -> str:
        """Description in words, for messages."""
        if self.ids is None:
            return f"every pixel, {self.order}"
        has_layers = len(self.ids) > self.views * self.width * self.height
        return f"{'several Gaussians per pixel' if has_layers else 'some pixels dropped'}, {self.order}"

    def pixel_ids(self) -> np.ndarray:
        """Return the pixel of each row; see ``ids``."""
        if self.ids is not None:
            return self.ids
        count = self.views * self.width * self.height
        # int32 saves memory, as there may be hundreds of millions of rows
        return np.arange(count, dtype=np.int32 if count <= np.iinfo(np.int32).max else np.int64)

    def sample(self, per_view: int) -> tuple[np.ndarray, np.ndarray]:
        """Choose about ``per_view`` rows of each view, spread over columns and lines; return ``[t]`` rows, pixels."""
        area = self.width * self.height
        parts = []
        if self.ids is None:
            pixels = np.arange(0, area, spread_step(-(-area // per_view), self.width))
            rows = (np.arange(self.views)[:, None] * area + pixels).reshape(-1)
            return rows, rows
        for view in range(self.views):
            rows = np.flatnonzero(self.ids // area == view)
            parts.append(rows[:: spread_step(-(-len(rows) // per_view), self.width)])
        rows = np.concatenate(parts)
        return rows, self.ids[rows]


def spread_step(step: int, width: int) -> int:
    """Enlarge a sampling step until it is coprime to the width, so that samples are from all columns."""
    step = max(1, step)
    while step > 1 and np.gcd(step, width) > 1:
        step += 1
    return step
