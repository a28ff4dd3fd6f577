"""The columns of a Gaussian splat in a PLY file, and the ranges of what they may hold.

Log scales, logits and channel-major harmonics exist only in what reads and writes files.
"""

from __future__ import annotations

import numpy as np

MAX_LOG_SCALE = 30.0  # exp(30) squared and exp(-30) squared are still normal float32 numbers
MAX_HARMONIC = 1e6  # pictures of it can still be squared and summed in float32
MAX_LOGIT = 16.0  # from 16.6 on the sigmoid is 1 in float32, and its logit infinite
LOGIT_COMMENT = "opacity: logit"  # so that our own files are never guessed at

MEANS, NORMALS = ("x", "y", "z"), ("nx", "ny", "nz")
SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
RGB = ("red", "green", "blue")  # instead of the former, in nerfstudio's files of plain colours
SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
REQUIRED = (*MEANS, *SH0, "opacity", *SCALES, *QUATS)
BLOCK_BYTES = 1 << 19  # of file rows converted at a time: they stay in the cache from the first column to the last


def sh_degree(num_rest: int) -> int:
    """SH degree of that many ``f_rest`` columns."""
    return round((num_rest / 3 + 1) ** 0.5) - 1


def color_columns(names: tuple[str, ...] | None) -> tuple[str, ...]:
    """The columns that hold the base colour."""
    return SH0 if names is None or SH0[0] in names else RGB


def spread_low_degree(shN: np.ndarray) -> None:
    """Put harmonics of a low degree in their places, where the columns are those of degree 3; in place.

    Long-LRM writes 45 columns whatever the degree: those of degree 1 (or 2) are channel-major in the first 9 (or 24).

    Args:
        shN: ``[n,15,3]`` as read from columns of degree 3; others are left alone.
    """
    if shN.shape[1] != 15:
        return
    columns = shN.transpose(0, 2, 1).reshape(len(shN), 45)
    last = int(np.flatnonzero(columns.any(0)).max(initial=-1))
    for higher in (3, 8):
        if 0 <= last < 3 * higher:
            shN[:] = 0
            shN[:, :higher] = columns[:, : 3 * higher].reshape(-1, 3, higher).transpose(0, 2, 1)
            return


def layout_name(names: tuple[str, ...], num_rest: int) -> str:
    """What to call a file with these columns."""
    normals = set(NORMALS) <= set(names)
    if SH0[0] not in names:
        return "columns of red, green and blue"
    if num_rest == 0:
        return "17-column export" if normals else "14-column export (no normals)"
    return f"INRIA, SH degree {sh_degree(num_rest)}" + ("" if normals else " (no normals)")


def bytes_by_attribute(rows: np.ndarray, extra: tuple[str, ...]) -> dict[str, int]:
    """Bytes of all rows by attribute; ``extra`` are the columns that mean nothing here."""
    groups = {"means": MEANS, "normals": NORMALS, "sh0": color_columns(rows.dtype.names), "opacities": ("opacity",)}
    groups |= {"scales": SCALES, "quats": QUATS, "extra": extra}
    of = {name: kind for kind, names in groups.items() for name in names}
    sizes: dict[str, int] = {}
    assert rows.dtype.names is not None
    for name in rows.dtype.names:
        kind = of.get(name, "shN")
        sizes[kind] = sizes.get(kind, 0) + rows.dtype[name].itemsize * len(rows)
    return sizes
