"""What the segmentation kernels share: padded label pictures and the rows of their regions.

Label pictures are padded: ``[h+2,w+2]`` int32 with a frame of -1, so that no kernel asks where the picture ends.
A region's row holds what a cost needs in half a cache line of float32: its mean feature (r, g, b, y·spread,
x·spread; spread² is the weight of squared pixels against squared colours), its number of pixels, and two columns
that belong to the algorithm at work. Means, not sums, keep float32 exact enough for pictures of any size.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.jit import kernel

NUM_PIXELS, ROW = 5, 8  # column after the five of the mean, and the length of a row


def pad_labels(labels):
    """A label picture ``[h,w]`` with the frame that the kernels expect."""
    return np.pad(labels.astype(np.int32, copy=False), 1, constant_values=-1)


@kernel
def region_rows(labels, pixels, count, capacity, spread):
    """``[capacity,8]`` float32, of which the first ``count`` rows are filled; sums are float64."""
    height, width, _ = pixels.shape
    sums = np.zeros((count, 6))
    for y in range(height):
        for x in range(width):
            label = labels[y + 1, x + 1]
            sums[label, 0] += pixels[y, x, 0]
            sums[label, 1] += pixels[y, x, 1]
            sums[label, 2] += pixels[y, x, 2]
            sums[label, 3] += y
            sums[label, 4] += x
            sums[label, 5] += 1.0
    rows = np.zeros((capacity, ROW), np.float32)
    for label in range(count):
        num_pixels = sums[label, 5]
        for i in range(3):
            rows[label, i] = sums[label, i] / num_pixels
        rows[label, 3] = spread * sums[label, 3] / num_pixels
        rows[label, 4] = spread * sums[label, 4] / num_pixels
        rows[label, NUM_PIXELS] = num_pixels
    return rows
