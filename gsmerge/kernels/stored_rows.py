"""Convert Gaussians as files store them: log scales become scales, and quaternions unit ones."""

from __future__ import annotations

from gsmerge.kernels.signature import f4, i4, i8, native


@native(
    i8(), rows=f4("n", "columns"), places=i4("used", least=0, below="columns"), most_harmonic=f4(),
    most_log_scale=f4(), means=f4("n", 3, out=True), quats=f4("n", 4, out=True), scales=f4("n", 3, out=True),
    opacities=f4("n", out=True), sh0=f4("n", 3, out=True), shN=f4("n", "rest", out=True),
)  # fmt: skip
def convert_rows(rows, places, most_harmonic, most_log_scale, means, quats, scales, opacities, sh0, shN):
    """Convert rows up to the first ones that are not plain, and return how many that are: those behind are undefined.

    ``places``: columns of x, y, z, then of the harmonics in the order of ``sh0`` and ``shN``, of the log scales, of the
    quaternions wxyz and of the opacity, which is copied. Rows are plain whose values are finite, whose harmonics and
    log scales are no larger than the limits, and whose quaternions have a length between 1e-15 and 1e15. Rows are
    looked at 64 at a time.
    """
