"""Gaussians cut at the edges of photos: the moments of what lies inside."""

from __future__ import annotations

from gsmerge.kernels.signature import STATUS, f4, f8, i8, native, u1

NUM_EDGES = 4  # planes of a photo


@native(
    STATUS, quats=f4("n", 4), scales=f4("n", 3), normals=f8("v", NUM_EDGES, 3), offsets=f8("v", NUM_EDGES),
    first=i8(least=0, most="n"), last=i8(least="first", most="n"), means=f4("n", 3, out=True),
    covars=f8("n", 3, 3, out=True), is_cut=u1("n", out=True),
)  # fmt: skip
def cut_at_edges(quats, scales, normals, offsets, first, last, means, covars, is_cut):
    """Cut rows ``first`` to ``last - 1`` of Gaussians that reach past the edges of all v photos.

    The photo in which a Gaussian lies deepest decides, and the edge of it that is nearest, both in standard deviations
    of the Gaussian across the edge's plane. Within two of them the Gaussian becomes the moments of its part inside
    (truncated normal distribution), twice at most. Those farther outside stay as they are.

    Args:
        normals: Outward unit normals of the planes through the cameras and the edges of their photos.
        offsets: Of the planes: points x inside have ``normal @ x <= offset``.
        means: Written where a Gaussian is cut.
        covars: Covariances, written where a Gaussian is cut.
        is_cut: Written, whether it is.
    """
