"""Find the nearest points of other views, and measure the agreement of points with the Gaussians of other views.

Nearest points are found by a balanced k-d tree in arrays, searched without recursion. Node i of the tree is a run of
``order``. Its children 2 i + 1 and 2 i + 2 are the halves of the run, which is partitioned at its middle along one
axis. Agreement is measured in each view at the single pixel that a point projects to.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import STATUS, declare, f4, f8, i1, i4, i8, native

SUM_COLUMNS = 6  # of the sums of :func:`sum_cross_view`


@native(
    STATUS, points=f8("n", 3), order=i8("m", out=True, least=0, below="n"), axes=i1("nodes", out=True),
    splits=f8("nodes", out=True),
)  # fmt: skip
def build_tree(points, order, axes, splits):
    """Build the tree of finite points ``[n,3]``.

    Args:
        order: ``[n]`` int64 rows of the points, in any order; reordered.
        axes: ``[nodes]`` int8, written: axis along which each node is divided.
        splits: ``[nodes]`` float64, written: coordinate at which each node is divided.
    """


def make_tree(points):
    """Return order, axes and splits of the tree of finite points ``[n,3]`` in C order."""
    leaf = 16  # runs of at most so many points are not divided
    nodes = 4 << (len(points) // leaf).bit_length()
    order, axes, splits = np.arange(len(points)), np.zeros(nodes, np.int8), np.zeros(nodes)
    build_tree(points, order, axes, splits)
    return order, axes, splits


_search_tree = declare(
    "search_tree", STATUS, points=f8("n", 3), views=i8("n"), order=i8("m"), axes=i1("nodes"), splits=f8("nodes"),
    first=i8(least=0), last=i8(), most=i8(), distances=f8("k", out=True), out=i8("n", "k", out=True),
)  # fmt: skip


def nearest_of_others(points, views, order, axes, splits, first, last, most, out):
    """Write the nearest points of other views to rows ``first`` to ``last`` of ``out [n,k]``.

    Args:
        points: As given to :func:`build_tree`.
        views: ``[n]`` int64; a point with a view below 0 belongs to no view, and any other point counts for it.
        order: As written by :func:`build_tree`, like ``axes`` and ``splits``.
        first: First row.
        last: Last row, exclusive.
        most: Number of points that are compared with each, in whole leaves of the tree.
        out: ``[n,k]`` int64: nearest first, -1 if there are fewer.
    """
    _search_tree(points, views, order, axes, splits, first, last, most, np.empty(out.shape[1]), out)


@native(STATUS, values=f8("n"), order=i8("m", out=True, least=0, below="n"), low=i8(least=0), high=i8(), place=i8())
def partition(values, order, low, high, place):
    """Reorder a run of an order so that one place holds the value that sorting would put there.

    No value before the place is larger, and no value after it is smaller.

    Args:
        values: ``[n]`` float64 numbers, unchanged.
        order: ``[m]`` int64 places in ``values``; those from ``low`` to before ``high`` are reordered.
        place: Place in ``order``, from ``low`` to before ``high``.
    """


@native(
    STATUS, points=f8("g", 3), colors=f4("g", 3), own=i8("g"), asked=i4("views", "most", least=0, below="views"),
    viewmats=f8("views", 4, 4), Ks=f8("views", 3, 3),
    width=i8(least=0, below=1 << 31), height=i8(least=0, below=1 << 31),
    fronts=i4("views", "height", "width"), means=f4("n", 3), opacities=f4("n"), sh0=f4("n", 1, 3),
    color_scale=f8(), near=f8(), far=f8(), min_opacity=f8(), first=i8(least=0), last=i8(),
    out=f8("g", SUM_COLUMNS, out=True),
)  # fmt: skip
def sum_cross_view(
    points, colors, own, asked, viewmats, Ks, width, height, fronts, means, opacities, sh0, color_scale, near,
    far, min_opacity, first, last, out,
):  # fmt: skip
    """Compare the points from ``first`` to before ``last`` with other views, and sum the results over the views.

    Args:
        colors: ``[g,3]`` float32 base colours minus 0.5.
        own: ``[g]`` int64 view of each point, which is left out; below 0: none, so all views are compared.
        asked: ``[v,most]`` int32 views that are compared with the points of each view.
        width: Width of the views, pixels.
        height: Height of the views, pixels.
        fronts: ``[v,h,w]`` int32 Gaussian of each pixel, -1 for none.
        color_scale: Factor from ``sh0`` to colours.
        near: Largest difference of the logarithms of two depths of one surface.
        far: Larger differences are clipped to this.
        min_opacity: More transparent Gaussians show no surface.
        first: First point.
        last: Last point, exclusive.
        out: ``[g,6]`` float64; the sums are added: number of views that see the point; number of those whose surface is
            at the point, behind it, and in front of it; absolute difference of colours if the surface is at the point;
            difference of the logarithms of depths.
    """
