"""``.splat``: 32 bytes per Gaussian and no header, the format of antimatter15/splat that most viewers read.

Position and scale as float32, red, green, blue and opacity as bytes, and the quaternion wxyz as bytes 128 + 128 q.
There is no room for harmonics above degree 0.
"""

from __future__ import annotations

import numpy as np

from gsmerge.io.formats.arrays import columns_of, to_bytes
from gsmerge.types import Gaussians

MAX_DEGREE = 0
ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colors", "u1", 4), ("quats", "u1", 4)])


def splat_bytes(gaussians: Gaussians) -> bytes:
    """Content of a ``.splat`` file.

    Raises:
        ValueError: If there is NaN or inf.
    """
    columns = columns_of(gaussians, MAX_DEGREE)
    rows = np.empty(len(columns), ROW)
    rows["means"], rows["scales"] = columns.means, np.exp(columns.log_scales)
    rows["colors"] = to_bytes(255 * np.concatenate([columns.colors, columns.opacities[:, None]], 1))
    rows["quats"] = to_bytes(128 * columns.quats + 128)
    return rows.tobytes()
