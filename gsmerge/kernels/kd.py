"""Over-split of a picture into rectangles, best cut first, with integral images.

Label pictures are padded: ``[h+2,w+2]`` int32 with a frame of -1, so that no kernel asks where the picture ends.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.jit import kernel

# Cuts wait in buckets by the exponent and three mantissa bits of their gain: nearly best first, at O(1) a step.
NUM_BUCKETS = 2048
BUCKET_SHIFT = 20


@kernel
def integral_image(pixels):
    """``[(h+1)·(w+1),3]`` float64: sum of all pixels above and to the left."""
    height, width, _ = pixels.shape
    stride = width + 1
    integral = np.zeros(((height + 1) * stride, 3))
    for y in range(height):
        red, green, blue = 0.0, 0.0, 0.0
        for x in range(width):
            red += pixels[y, x, 0]
            green += pixels[y, x, 1]
            blue += pixels[y, x, 2]
            above = y * stride + x + 1
            integral[above + stride, 0] = integral[above, 0] + red
            integral[above + stride, 1] = integral[above, 1] + green
            integral[above + stride, 2] = integral[above, 2] + blue
    return integral


@kernel
def cut_gain(integral, near, far, step, side, num_pixels, compactness):
    """Where to cut a rectangle across one of its sides, and by how much that lowers its squared error.

    A rectangle of n pixels with colour sum t, whose side of length S is cut at c into parts with sums s and t - s,
    loses ``|S s - c t|² / (n c (S - c))`` of colour error and ``n c (S - c) / 4`` of position error.

    Args:
        integral: From :func:`integral_image`.
        near: Index of the rectangle's first corner in ``integral``.
        far: Index of the corner at the other end of the side that is not cut.
        step: Index distance of one pixel along the side that is cut.
        side: Length of that side, pixels.
        num_pixels: Pixels of the rectangle.
        compactness: Weight of squared pixels against squared colours.

    Returns:
        (gain, cut): the cut lies between 1 and ``side - 1``; gain is -1 if there is nothing to cut.
    """
    near0 = integral[far, 0] - integral[near, 0]
    near1 = integral[far, 1] - integral[near, 1]
    near2 = integral[far, 2] - integral[near, 2]
    last = side * step
    total0 = integral[far + last, 0] - integral[near + last, 0] - near0
    total1 = integral[far + last, 1] - integral[near + last, 1] - near1
    total2 = integral[far + last, 2] - integral[near + last, 2] - near2
    spatial = 0.25 * compactness * num_pixels * num_pixels
    best, best_cut = -1.0, 0
    for cut in range(1, side):
        at = cut * step
        d0 = side * (integral[far + at, 0] - integral[near + at, 0] - near0) - cut * total0
        d1 = side * (integral[far + at, 1] - integral[near + at, 1] - near1) - cut * total1
        d2 = side * (integral[far + at, 2] - integral[near + at, 2] - near2) - cut * total2
        balance = float(cut * (side - cut))
        gain = (d0 * d0 + d1 * d1 + d2 * d2) / balance + spatial * balance
        if gain > best:
            best, best_cut = gain, cut
    return best / num_pixels, best_cut


@kernel
def _enqueue(node, integral, stride, compactness, limit, rectangles, cuts, gains, heads, following):
    """Find the best cut of a rectangle and put it in its bucket, ``limit`` or below; single pixels are left out."""
    y0, x0, y1, x1 = rectangles[node]
    height, width = y1 - y0, x1 - x0
    num_pixels = float(height) * width
    near = y0 * stride + x0
    gain_y, cut_y = cut_gain(integral, near, near + width, stride, height, num_pixels, compactness)
    gain_x, cut_x = cut_gain(integral, near, near + height * stride, 1, width, num_pixels, compactness)
    gains[node] = max(gain_y, gain_x)
    # A cut below another waits for it anyway, so its bucket never needs to be above the one being emptied.
    cuts[node] = -(y0 + cut_y) if gain_y >= gain_x else x0 + cut_x
    if gains[node] >= 0:
        bucket = min(limit, gains.view(np.int32)[node] >> BUCKET_SHIFT)
        following[node] = heads[bucket]
        heads[bucket] = node


@kernel
def split_rectangles(pixels, count, block, compactness):
    """Cut the picture into ``count`` rectangles (at least one per block), the most rewarding cuts first.

    Args:
        pixels: ``[h,w,3]`` float32.
        count: Rectangles wanted, at most h·w.
        block: Side of the blocks that the picture is divided into at the start, pixels.
        compactness: Weight of squared pixels against squared colours.

    Returns:
        (labels, count): padded labels and how many there are.
    """
    height, width, _ = pixels.shape
    integral, stride = integral_image(pixels), width + 1
    num_rows, num_columns = max(1, height // block), max(1, width // block)
    capacity = max(count, num_rows * num_columns)
    rectangles = np.empty((capacity, 4), np.int64)
    cuts, gains, following = np.empty(capacity, np.int64), np.empty(capacity, np.float32), np.empty(capacity, np.int64)
    heads = np.full(NUM_BUCKETS, -1)
    num_leaves = 0
    for i in range(num_rows):
        for j in range(num_columns):
            rectangles[num_leaves, 0], rectangles[num_leaves, 2] = i * height // num_rows, (i + 1) * height // num_rows
            rectangles[num_leaves, 1], rectangles[num_leaves, 3] = j * width // num_columns, (j + 1) * width // num_columns
            _enqueue(num_leaves, integral, stride, compactness, NUM_BUCKETS - 1, rectangles, cuts, gains, heads, following)
            num_leaves += 1
    bucket = NUM_BUCKETS - 1
    while num_leaves < count and bucket >= 0:
        node = heads[bucket]
        if node < 0:
            bucket -= 1
            continue
        heads[bucket] = following[node]
        rectangles[num_leaves] = rectangles[node]
        if cuts[node] < 0:
            rectangles[node, 2] = rectangles[num_leaves, 0] = -cuts[node]
        else:
            rectangles[node, 3] = rectangles[num_leaves, 1] = cuts[node]
        _enqueue(node, integral, stride, compactness, bucket, rectangles, cuts, gains, heads, following)
        _enqueue(num_leaves, integral, stride, compactness, bucket, rectangles, cuts, gains, heads, following)
        num_leaves += 1
    return _paint(rectangles[:num_leaves], height, width), num_leaves


@kernel
def _paint(rectangles, height, width):
    labels = np.full((height + 2, width + 2), -1, np.int32)
    for node in range(len(rectangles)):
        y0, x0, y1, x1 = rectangles[node]
        for y in range(y0 + 1, y1 + 1):
            for x in range(x0 + 1, x1 + 1):
                labels[y, x] = node
    return labels
