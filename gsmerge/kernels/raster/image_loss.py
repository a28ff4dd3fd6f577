"""Compute the gradient of the fit's image loss in one pass over the rows, without images of intermediate values.

Structural similarity needs sums of the image, the photo and their products over windows. Derivatives of the similarity
follow from the sums over windows, and are summed over windows as well. Differences between neighbouring pixels are
computed row by row. Results do not depend on how rows are divided among threads, because each sum is added up in the
same order wherever a range of rows begins.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import STATUS, f4, i8, native

WINDOW_SIDE = 7  # side of the windows, pixels
C1, C2 = np.float32(1e-4), np.float32(9e-4)  # constants of SSIM for values from 0 to 1

DERIVATIVE_ROWS, TERMS = 12, 3  # number of rows of derivatives in memory, and of derivatives for each value
EDGE_ROWS = 7  # number of rows in memory for differences between neighbouring pixels
SUM_CHUNK, PAD = 96, 9  # number of values that are summed at a time, and of zeros beside a row


def room_of(width):
    """Return how many values a buffer for a row of ``width`` pixels needs, with zeros beside the row."""
    return -(-3 * width // SUM_CHUNK) * SUM_CHUNK + PAD


@native(
    STATUS, image=f4("height", "width"), photo=f4("height", "width"), weight=f4("height", "pixels"),
    ssim_lambda=f4(), edge_weight=f4(), first=i8(least=0, most="height"), last=i8(least="first", most="height"),
    gradient=f4("height", "width", out=True), errors=f4("height", out=True),
    terms=f4(DERIVATIVE_ROWS, TERMS, "room", out=True), rows=f4(EDGE_ROWS, "room", out=True),
)  # fmt: skip
def loss_gradient(image, photo, weight, ssim_lambda, edge_weight, first, last, gradient, errors, terms, rows):
    """Write the gradient of (1 - ssim_lambda) |e| + ssim_lambda (1 - SSIM) + edge_weight |difference of e|.

    The error e is ``image - photo``. The differences of e are between each pixel and the next pixel in its row and in
    its column. Pixels have weights, and a difference has the smaller weight of its two pixels. The windows of SSIM have
    7 x 7 pixels of equal weight. Beyond the border all values are zero.

    Args:
        image: ``[h,3w]`` float32, with the three channels of a pixel side by side.
        ssim_lambda: Share of structural similarity, float32.
        edge_weight: Weight of the differences between neighbouring pixels, float32.
        first: First row.
        last: Last row, exclusive.
        gradient: ``[h,3w]`` float32, written in these rows: the gradient, divided by the number of pixels.
        errors: ``[h]`` float32, written: weighted squared error of each row.
        terms, rows: Scratch, whose last axis has the length of :func:`room_of`.
    """
