"""Convert the Gaussians of a file: scales from their logarithms, and quaternions to unit length."""

from __future__ import annotations

from gsmerge.method.kernels.signature import f4, i4, i8, native


@native(
    i8(), rows=f4("n", "columns"), places=i4("used", least=0, below="columns"), most_position=f4(),
    most_harmonic=f4(), most_log_scale=f4(), means=f4("n", 3, out=True), quats=f4("n", 4, out=True),
    scales=f4("n", 3, out=True), opacities=f4("n", out=True), sh0=f4("n", 3, out=True), shN=f4("n", "rest", out=True),
)  # fmt: skip
def convert_rows(rows, places, most_position, most_harmonic, most_log_scale, means, quats, scales, opacities, sh0, shN):
    """Convert rows with usual values, in blocks of 64 rows, and return the number of converted rows.

    The first block with an unusual row ends the conversion, so that the caller can handle it. The rows of the outputs
    after the converted rows are undefined. A row is usual if its values are finite, its positions, harmonics and log
    scales are within the limits, and its quaternion has a length between 1e-15 and 1e15. ``places`` are the columns of
    x, y, z, of the harmonics in the order of ``sh0`` and ``shN``, of the log scales, of the quaternions wxyz, and of
    the opacity. Opacities are copied.
    """
