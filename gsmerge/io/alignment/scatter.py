"""Rows of a file put to their pixels."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsmerge.io.alignment.layouts import Layout
from gsmerge.types import Cameras, Gaussians, PixelScene


def to_grid(
    gaussians: Gaussians, valid: Tensor, layout: Layout, cameras: Cameras, images: Tensor | None, names: tuple[str, ...]
) -> PixelScene:
    """The scene on the full grid of the layout.

    Pixels without a row get a fully transparent one, like rows that are not finite.

    Args:
        gaussians: The file's rows.
        valid: ``[n]`` bool.
        layout: Which row belongs to which pixel.
        cameras: All cameras, in the frame of the Gaussians and at the grid's size.
        images: ``[c,h,w,3]`` of all cameras, or None.
        names: Names of all cameras.
    """
    views = list(layout.views)
    if views != list(range(len(cameras))):
        cameras, images = cameras[views], None if images is None else images[views]
    grid = len(views), layout.height, layout.width
    names = tuple(names[view] for view in views)
    if layout.is_plain:
        return PixelScene(gaussians, cameras, images, valid.reshape(grid), names)
    source = _row_of_pixel(layout)
    missing = source < 0
    none = torch.from_numpy(missing) if missing.any() else None
    if none is not None:
        there = np.where(missing, 0, np.arange(len(source)))
        there[: int(np.argmin(missing))] = int(np.argmin(missing))
        source = source[np.maximum.accumulate(there)]
    index = torch.from_numpy(source)
    out, kept = gaussians[index], valid[index]
    if none is not None:
        kept[none] = False
        for values, value in ((out.opacities, 0.0), (out.sh0, 0.0), (out.shN, 0.0)):
            values[none] = value
        out.quats[none] = torch.tensor((1.0, 0, 0, 0))
    return PixelScene(out, cameras, images, kept.reshape(grid), names, None if none is None else none.reshape(grid))


def _row_of_pixel(layout: Layout) -> np.ndarray:
    """The file row of every pixel of the grid, -1 where there is none."""
    size = layout.width * layout.height
    source = np.full(size * len(layout.views), -1, np.int64)
    for i, (rows, pixels) in enumerate(zip(layout.rows, layout.pixels, strict=True)):
        source[i * size + pixels] = rows.reshape(-1)
    return source
