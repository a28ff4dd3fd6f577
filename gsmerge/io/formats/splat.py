"""Read and write ``.splat``, the format of antimatter15/splat, which most viewers read.

A ``.splat`` has 32 bytes per Gaussian and no header. A component q of a quaternion wxyz is the byte 128 + 128 q.
Harmonics above degree 0 cannot be stored.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.bounds import check_file, read_errors
from gsmerge.io.formats.rows import EXPORT_AGAIN, Columns, Packed, StoredRows, column_blocks, to_bytes, to_stored
from gsmerge.io.formats.table import PLAIN, Contents
from gsmerge.method.geometry.transforms import rgb_to_sh0
from gsmerge.method.kernels.elementary import exp, log
from gsmerge.types import Gaussians

MAX_DEGREE = 0  # of harmonics, since the format has only colours
ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colors", "u1", 4), ("quats", "u1", 4)])


def splat_bytes(gaussians: Gaussians, _: Contents = PLAIN) -> bytes:
    """Encode a ``.splat`` file, which has only Gaussians; raise ValueError if there is NaN or inf."""
    all_rows = np.empty(len(gaussians), ROW)
    for start, columns in column_blocks(gaussians, MAX_DEGREE):
        rows = all_rows[start : start + len(columns)]
        rows["means"], rows["scales"] = columns.means, exp(columns.log_scales)
        rows["colors"] = to_bytes(255 * np.concatenate([columns.colors, columns.opacities[:, None]], 1))
        rows["quats"] = to_bytes(128 * columns.quats + 128)
    return all_rows.tobytes()


def read_rows(path: Path) -> StoredRows:
    """Read the Gaussians of a ``.splat``; raise SceneError unless the file consists of rows of 32 bytes."""
    size = check_file(path)
    if size % ROW.itemsize:
        problem = f"expected a .splat of {ROW.itemsize} bytes per Gaussian, found {size} bytes"
        raise SceneError(path, problem, EXPORT_AGAIN)
    with read_errors(path):
        rows = np.fromfile(path, ROW)
    sizes = {"means": 12, "scales": 12, "sh0": 3, "opacities": 1, "quats": 4}
    packed = Packed(len(rows), 0, lambda block: _unpack(rows[block]), lambda block: _unpack(rows[block], are_logs=True))
    return to_stored([packed], ".splat", {name: row_bytes * len(rows) for name, row_bytes in sizes.items()})


def _unpack(rows: np.ndarray, *, are_logs: bool = False) -> Columns:
    """Convert stored rows to Gaussians; ``are_logs``: against the rules, scales are logarithms."""
    colors = rows["colors"] / 255
    return Columns(
        means=rows["means"],
        quats=(rows["quats"] - 128.0) / 128,
        log_scales=rows["scales"] if are_logs else log(rows["scales"]),
        opacities=colors[:, 3],
        sh0=rgb_to_sh0(colors[:, :3]),
        harmonics=np.zeros((len(rows), 0, 3)),
    )
