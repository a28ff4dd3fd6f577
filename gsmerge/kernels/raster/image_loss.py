"""The gradient of the fit's image loss in one pass over the rows: no image is written but the result.

Structural similarity needs sums over windows of image, photo and their products, and then sums over windows of what
those give. Differences between neighbouring pixels follow row by row. Every sum is added up in the same order
wherever a range of rows begins, so results do not depend on how rows are shared out.
"""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import STATUS, f4, i8, native

WINDOW_SIDE = 7  # of the windows, pixels
C1, C2 = np.float32(1e-4), np.float32(9e-4)  # SSIM's constants for a data range of 1

DERIVATIVE_ROWS, TERMS = 12, 3  # rows of derivatives that are kept at a time, and numbers of each of their values
EDGE_ROWS = 7  # of differences, weights and what they give
SUM_CHUNK, PAD = 96, 9  # values that are summed at a time, and beside a row


def room_of(width):
    """Return the length of a buffer for a row of ``width`` pixels."""
    return -(-3 * width // SUM_CHUNK) * SUM_CHUNK + PAD


@native(
    STATUS, image=f4("height", "width"), photo=f4("height", "width"), weight=f4("height", "pixels"),
    ssim_lambda=f4(), edge_weight=f4(), first=i8(least=0, most="height"), last=i8(least="first", most="height"),
    gradient=f4("height", "width", out=True), errors=f4("height", out=True),
    terms=f4(DERIVATIVE_ROWS, TERMS, "room", out=True), rows=f4(EDGE_ROWS, "room", out=True),
)  # fmt: skip
def loss_gradient(image, photo, weight, ssim_lambda, edge_weight, first, last, gradient, errors, terms, rows):
    """Write the gradient of (1 - ssim_lambda) |e| + ssim_lambda (1 - SSIM) + edge_weight |difference of e|.

    e is ``image - photo``; differences of e are taken to the next pixel of a row and of a column. Pixels have weights,
    and a pair of pixels has the smaller weight of the two. Windows of SSIM are uniform, of 7 x 7 pixels, zero beyond
    the border.

    Args:
        image: ``[h,3w]`` float32, interleaved channels.
        ssim_lambda: Share of structural similarity, float32.
        edge_weight: Weight of the differences between neighbouring pixels, float32.
        first: First row.
        last: Last row, exclusive.
        gradient: ``[h,3w]`` float32, the rows are written, divided by the number of pixels.
        errors: ``[h]`` float32, weighted squared error of each row, written.
        terms, rows: Buffers as long as :func:`room_of` says, overwritten.
    """
