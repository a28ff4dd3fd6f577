"""Store the blending weights of a view as a sparse matrix, for stages that render one geometry many times.

The matrix is called W, and an image is W times the colours of the Gaussians. W has one row per pixel and one column per
Gaussian. A row has some twenty entries, so a product takes much less time than blending along the tile lists.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsmerge.kernels.raster import list_weights as kernels
from gsmerge.raster import TiledView

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class ViewWeights:
    """Sparse matrix W of one view's blending weights, stored tile by tile and Gaussian by Gaussian."""

    ids: Array  # [m] int32 Gaussians that may touch the image
    flatten_ids: Array  # [intersections] int32 rows of `ids`
    isect_offsets: Array  # [tiles + 1] int64 starts of the tiles' lists in `flatten_ids`
    tile_width: int  # tiles per row
    starts: Array  # [intersections + 1] int64 starts of the entries in `lanes` and `weights`
    lanes: Array  # uint8 pixel of each entry within its tile, row by row
    weights: Array  # float32 blending weight of each entry
    height: int  # pixels
    width: int  # pixels

    @property
    def entries(self) -> tuple[Array, Array, Array, Array, Array, int]:
        """First arguments of the kernels that process the entries of W."""
        return self.starts, self.lanes, self.weights, self.flatten_ids, self.isect_offsets, self.tile_width


def view_weights(tiled: TiledView) -> ViewWeights:
    """Compute the blending weights of a tiled view."""
    starts, lanes, weights = kernels.list_weights(*tiled.lists, tiled.height, tiled.width)
    return ViewWeights(tiled.ids, *tiled.lists[1:], starts, lanes, weights, tiled.height, tiled.width)


def apply_transposed(view: ViewWeights, image: Array) -> Array:
    """Multiply the transpose of W with an ``image [h,w,c]`` of up to four channels.

    Returns ``[m,c]`` float64, with a row for each of ``view.ids``.
    """
    channels = image.shape[2]
    padded = np.zeros((view.height, view.width, kernels.LANES), np.float32)
    padded[..., :channels] = image
    sums = np.zeros((len(view.ids), kernels.LANES))
    kernels.collect(*view.entries, padded, sums)
    return sums[:, :channels]
