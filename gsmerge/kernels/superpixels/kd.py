"""Cut a picture into rectangles, from which merging starts. The best cut, by integral images, is made first.

Padded labels are ``[h+2,w+2]`` int32 with a frame of -1, so that no kernel has to check for the border.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import COUNT, STATUS, declare, f4, f8, i4, i8

NUM_BUCKETS = 2048  # number of lists, each for cuts with about the same gain
NODE = 8  # columns of the row of a rectangle


_integral_image = declare("integral_image", STATUS, pixels=f4("height", "width", 3), integral=f8("places", 3, out=True))


def integral_image(pixels):
    """Return, for each corner of a pixel, the sum of all pixels above and to the left, ``[(h+1)·(w+1),3]`` float64."""
    height, width, _ = pixels.shape
    integral = np.empty(((height + 1) * (width + 1), 3))
    _integral_image(pixels, integral)
    return integral


# Finds the best cut of a rectangle across one of its sides. Writes the gain of the cut, which is the reduction of the
# squared error, and its position, 1 to side - 1. The gain is below 0 if the rectangle cannot be cut. Let the rectangle
# have n pixels whose colours sum to t. A cut at c of the side of length S makes parts with sums s and t - s. The cut
# lowers the colour error by |S s - c t|² / (n c (S - c)), and the position error by n c (S - c) / 4 times the
# compactness. near and far are indices in the integral image: near belongs to the rectangle's first corner, and far to
# the other end of the uncut side from this corner. step is the difference of indices of neighbours along the side that
# is cut.
cut_gain = declare(
    "cut_gain", STATUS, integral=f8("places", 3), near=i8(least=0), far=i8(least=0), step=i8(least=1), side=i8(least=0),
    num_pixels=f8(), compactness=f8(), found=f8(2, out=True),
)  # fmt: skip


# Returns the number of labels
_split_rectangles = declare(
    "split_rectangles", COUNT, integral=f8("places", 3), count=i8(least=0), block=i8(least=1), compactness=f8(),
    nodes=i4("capacity", NODE, out=True), heads=i8(NUM_BUCKETS, out=True),
    labels=i4("padded_height", "padded_width", out=True),
)  # fmt: skip


def split_rectangles(pixels, count, block, compactness):
    """Cut a picture into ``count`` rectangles, or into more if there are more blocks.

    The picture is first divided into square blocks. Then rectangles are cut where a cut has the largest gain, which is
    the reduction of the squared error.

    Args:
        count: Wanted number of rectangles, at most h·w.
        block: Side of the blocks, pixels.
        compactness: Weight of squared distances in pixels, relative to squared differences of colours.

    Returns:
        Padded labels, and the number of rectangles.
    """
    height, width, _ = pixels.shape
    capacity = max(count, max(1, height // block) * max(1, width // block))
    nodes, heads = np.empty((capacity, NODE), np.int32), np.empty(NUM_BUCKETS, np.int64)
    labels = np.empty((height + 2, width + 2), np.int32)
    return labels, _split_rectangles(integral_image(pixels), count, block, compactness, nodes, heads, labels)
