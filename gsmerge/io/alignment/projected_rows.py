"""The rows of a file as its cameras see them: what the searches for pixels in incomplete files start from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmerge.geometry import project_points
from gsmerge.io.alignment.layouts import Layout

MIN_BLOCK = 500  # rows of a view; fewer cannot be distinguished from noise


@dataclass(frozen=True)
class ProjectedRows:
    """n finite rows of a file and the c views to which they may belong.

    A search (pruned, interleaved, unordered) takes these and returns a layout whose pixels still have to be measured,
    or None if the rows do not look like what it searches for.
    """

    points: np.ndarray  # ``[n,3]`` float64 means
    ids: np.ndarray  # ``[n]`` rows of the file
    viewmats: np.ndarray  # ``[c,4,4]`` float64 world to camera, in the frame of the Gaussians
    Ks: np.ndarray  # ``[c,3,3]`` float64 intrinsics, pixels
    width: int  # of the grid, pixels
    height: int

    def __len__(self) -> int:
        return len(self.points)

    @property
    def num_views(self) -> int:
        """Views that rows may belong to."""
        return len(self.viewmats)

    def project(self, rows: np.ndarray | slice, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Columns and rows ``[r]`` of the image that some rows project to, pixels; NaN behind the camera."""
        with np.errstate(all="ignore"):
            xy, depth = project_points(self.points[rows], self.viewmats[view], self.Ks[view])
        xy[depth <= 0] = np.nan
        return xy[:, 0], xy[:, 1]

    def pixels(self, rows: np.ndarray | slice, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``[r]`` int32 pixels ``y·W + x`` that some rows lie in, -1 outside the image; and what they project to."""
        u, v = self.project(rows, view)
        inside = (u >= 0) & (v >= 0) & (u < self.width) & (v < self.height)
        pixels = np.full(len(u), -1, np.int32)
        pixels[inside] = v[inside].astype(np.int32) * self.width + u[inside].astype(np.int32)
        return pixels, u, v

    def layout(
        self, order: str, parts: Sequence[tuple[int, np.ndarray, np.ndarray]], *, missing: int, note: str = ""
    ) -> Layout:
        """A search's result: ``parts`` are views, some of these rows, and their pixels; ``missing`` have none."""
        words = "in no order" if order == "unordered" else order
        return Layout(
            description=f"{missing:,} pixels of {len(parts)} views dropped, {words}{note}",
            kind="pruned",
            order=order,
            width=self.width,
            height=self.height,
            views=tuple(view for view, _, _ in parts),
            rows=tuple(self.ids[rows] for _, rows, _ in parts),
            pixels=tuple(pixels for _, _, pixels in parts),
        )
