"""Find the nearest points of other views, and measure how points agree with the Gaussians of other views.

Nearest points are found by a balanced k-d tree. Node i of the tree is a run of consecutive entries of the array
``order``. The children 2 i + 1 and 2 i + 2 of node i are the halves of its run. A plane across one axis separates the
points of the two children. The agreement of a point with a view is measured at the pixel of the view to which the point
projects.
"""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.signature import STATUS, declare, f4, f8, i1, i4, i8, native

SUM_COLUMNS = 6  # number of sums of sum_cross_view


@native(
    STATUS, points=f8("n", 3), order=i8("m", out=True, least=0, below="n"), axes=i1("nodes", out=True),
    splits=f8("nodes", out=True),
)  # fmt: skip
def build_tree(points, order, axes, splits):
    """Build the k-d tree of finite ``points [n,3]``.

    Args:
        order: ``[n]`` int64 rows of the points in any order, sorted into the runs of the tree.
        axes: ``[nodes]`` int8, written: axis along which each node is divided.
        splits: ``[nodes]`` float64, written: coordinate at which each node is divided.
    """


def make_tree(points):
    """Return order, axes and splits of the k-d tree of finite ``points [n,3]`` in C order, see :func:`build_tree`."""
    leaf = 16  # runs of at most this many points are not divided
    nodes = 4 << (len(points) // leaf).bit_length()
    order = np.arange(len(points))
    axes = np.zeros(nodes, np.int8)
    splits = np.zeros(nodes)
    build_tree(points, order, axes, splits)
    return order, axes, splits


_search_tree = declare(
    "search_tree", STATUS, points=f8("n", 3), views=i8("n"), order=i8("m"), axes=i1("nodes"), splits=f8("nodes"),
    first=i8(least=0), last=i8(), most=i8(), distances=f8("k", out=True), out=i8("n", "k", out=True),
)  # fmt: skip


def nearest_of_others(points, views, order, axes, splits, first, last, most, out):
    """Write the nearest points of other views, for the points from ``first`` to before ``last``.

    Args:
        points: Points of the tree.
        views: ``[n]`` int64. A point with a number below 0 belongs to no view, so all other points count as points of
            other views.
        order, axes, splits: Results of :func:`build_tree`.
        first: First row.
        last: Last row, exclusive.
        most: Largest number of points with which a point is compared.
        out: ``[n,k]`` int64, written: rows of the k nearest points, nearest first, and -1 if there are fewer.
    """
    _search_tree(points, views, order, axes, splits, first, last, most, np.empty(out.shape[1]), out)


@native(STATUS, values=f8("n"), order=i8("m", out=True, least=0, below="n"), low=i8(least=0), high=i8(), place=i8())
def partition(values, order, low, high, place):
    """Reorder a part of ``order`` so that one position gets the value that it would have after sorting.

    Afterwards no value before the position is larger than the value at it, and no value after the position is smaller.

    Args:
        values: ``[n]`` float64 numbers, which do not change.
        order: ``[m]`` int64 indices of ``values``, reordered from ``low`` to before ``high``.
        place: The position in ``order``, from ``low`` to before ``high``.
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
        own: ``[g]`` int64 view to which each point belongs, with which the point is not compared. Points with a number
            below 0 are compared with all views.
        asked: ``[v,most]`` int32 views with which the points of each view are compared.
        width: Width of the views, pixels.
        height: Height of the views, pixels.
        fronts: ``[v,h,w]`` int32 row of the front Gaussian of each pixel, -1 for none.
        color_scale: Factor from ``sh0`` to colours.
        near: Largest difference of the logarithms of two depths of the same surface.
        far: Largest difference of the logarithms of two depths. Larger differences are clipped to ``far`` before they
            are added.
        min_opacity: Least opacity of a Gaussian that shows a surface.
        first: First point.
        last: Last point, exclusive.
        out: ``[g,6]`` float64, to which sums over the views that see the point are added. Column 0 is the number of
            views that see the point. Columns 1 to 3 are the numbers of views whose surface is at the point, behind it,
            and in front of it. Column 4 is the absolute difference of colours where the surface is at the point. Column
            5 is the difference of the logarithms of depths.
    """
