"""Over-split of a picture into rectangles, best cut first, with integral images.

Label pictures are padded: ``[h+2,w+2]`` int32 with a frame of -1, so that no kernel asks where the picture ends.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.jit import kernel

# Cuts wait in buckets by the exponent and three mantissa bits of their gain: nearly best first, at O(1) a step.
NUM_BUCKETS = 2048
BUCKET_SHIFT = 20
CUT, NEXT = 4, 5  # columns of a rectangle's row after y0, x0, y1, x1: its best cut (row, or minus column), its list


@kernel(part=True)
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


@kernel(inline=True)
def cut_gain(integral, near, far, step, side, num_pixels, compactness):
    """Find the best cut of a rectangle across one of its sides, and how much it lowers the squared error.

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


@kernel(part=True)
def enqueue(node, y0, x0, y1, x1, limit, integral, stride, compactness, nodes, heads, gain, bits):
    """Store a rectangle with its best cut, in the bucket of the cut's gain or ``limit``; single pixels wait nowhere.

    A cut below another waits for it anyway, so its bucket never needs to be above the one being emptied.
    """
    height, width = y1 - y0, x1 - x0
    num_pixels = float(height) * width
    near = y0 * stride + x0
    gain_y, cut_y = cut_gain(integral, near, near + width, stride, height, num_pixels, compactness)
    gain_x, cut_x = cut_gain(integral, near, near + height * stride, 1, width, num_pixels, compactness)
    nodes[node, 0], nodes[node, 1], nodes[node, 2], nodes[node, 3] = y0, x0, y1, x1
    nodes[node, CUT] = y0 + cut_y if gain_y >= gain_x else -(x0 + cut_x)
    gain[0] = max(gain_y, gain_x)
    if gain[0] >= 0:
        bucket = min(limit, bits[0] >> BUCKET_SHIFT)
        nodes[node, NEXT] = heads[bucket]
        heads[bucket] = node


@kernel(part=True)
def paint(nodes, count, height, width):
    labels = np.empty((height + 2, width + 2), np.int32)
    for y in range(height + 2):
        for x in range(width + 2):
            labels[y, x] = -1
    for node in range(count):
        for y in range(nodes[node, 0] + 1, nodes[node, 2] + 1):
            for x in range(nodes[node, 1] + 1, nodes[node, 3] + 1):
                labels[y, x] = node
    return labels


@kernel
def split_rectangles(pixels, count, block, compactness):
    """Cut the picture into ``count`` rectangles (at least one per block), the most rewarding cuts first.

    Args:
        count: Rectangles wanted, at most h·w.
        block: Side of the blocks that the picture is divided into at the start, pixels.
        compactness: Weight of squared pixels against squared colours.

    Returns:
        (labels, count): padded labels and how many there are.
    """
    height, width, _ = pixels.shape
    integral, stride = integral_image(pixels), width + 1
    num_rows, num_columns = max(1, height // block), max(1, width // block)
    nodes = np.empty((max(count, num_rows * num_columns), 8), np.int32)
    heads = np.empty(NUM_BUCKETS, np.int64)
    for i in range(NUM_BUCKETS):
        heads[i] = -1
    gain = np.empty(1, np.float32)
    bits = gain.view(np.int32)
    num_leaves, bucket = 0, NUM_BUCKETS - 1
    for i in range(num_rows):
        y0, y1 = i * height // num_rows, (i + 1) * height // num_rows
        for j in range(num_columns):
            x0, x1 = j * width // num_columns, (j + 1) * width // num_columns
            enqueue(num_leaves, y0, x0, y1, x1, bucket, integral, stride, compactness, nodes, heads, gain, bits)
            num_leaves += 1
    while num_leaves < count and bucket >= 0:
        node = heads[bucket]
        if node < 0:
            bucket -= 1
            continue
        heads[bucket] = nodes[node, NEXT]
        y0, x0, y1, x1 = nodes[node, 0], nodes[node, 1], nodes[node, 2], nodes[node, 3]
        row, column = max(nodes[node, CUT], y0), max(-nodes[node, CUT], x0)  # where the second part starts
        across = row > y0
        for part in range(2):
            top, left = (row, column) if part == 1 else (y0, x0)
            bottom, right = (y1, x1) if part == 1 else (row if across else y1, x1 if across else column)
            target = num_leaves if part == 1 else node
            enqueue(target, top, left, bottom, right, bucket, integral, stride, compactness, nodes, heads, gain, bits)
        num_leaves += 1
    return paint(nodes, num_leaves, height, width), num_leaves
