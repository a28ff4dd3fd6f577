"""Cut Gaussians at the edges of photos, which are the planes through the camera and the borders of the picture."""

from __future__ import annotations

from gsmerge.kernels.signature import STATUS, f4, f8, i8, native, u1

NUM_EDGES = 4  # edges of a photo


@native(
    STATUS, quats=f4("n", 4), scales=f4("n", 3), normals=f8("v", NUM_EDGES, 3), offsets=f8("v", NUM_EDGES),
    first=i8(least=0, most="n"), last=i8(least="first", most="n"), means=f4("n", 3, out=True),
    covars=f8("n", 3, 3, out=True), is_cut=u1("n", out=True),
)  # fmt: skip
def cut_at_edges(quats, scales, normals, offsets, first, last, means, covars, is_cut):
    """Cut Gaussians, of the rows ``first`` to ``last - 1``, that reach past the edges of all v photos.

    A Gaussian is cut at the nearest edge of the photo in which it lies deepest. Distances from edges are measured in
    standard deviations of the Gaussian across the plane of the edge. If the mean is within two standard deviations of
    the edge, the Gaussian gets the moments of its part inside (truncated normal distribution). A Gaussian is cut at
    most twice, because a corner has two edges. Gaussians farther outside do not change. ``gsmerge.fit.edges`` splits
    Gaussians at the same edges, which it finds by the same rule.

    Args:
        normals: Outward unit normals of the planes through the cameras and the edges of their photos.
        offsets: Offsets of the planes. Points x inside have ``normal @ x <= offset``.
        means: Means, written for Gaussians that are cut.
        covars: Covariances, written for Gaussians that are cut.
        is_cut: Written: 1 for Gaussians that are cut.
    """
