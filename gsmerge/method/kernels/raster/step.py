"""Take a step of a fit, from projection to the optimiser, in phases that work on one table of buffers.

The phases run the kernels of the other modules, with the same bits. The buffers are checked once, when the table is
filled. In a step, every thread makes one call for each phase, whose only arguments are the table and the number of the
phase, see ``gsmerge/method/kernels/raster/step.c``.

The gradient of the fit's image loss is computed in one pass over the rows, without images of intermediate values.
Structural similarity needs sums of the image, the photo and their products over windows. Derivatives of the similarity
follow from the sums over windows, and are summed over windows as well. Differences between neighbouring pixels are
computed row by row. Results do not depend on how rows are divided among threads, because each sum is added up in the
same order wherever a range of rows begins.
"""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.gaussians.optimise import COLUMNS
from gsmerge.method.kernels.raster.project import CAMERA, CONIC, POSE, SUMS
from gsmerge.method.kernels.signature import STATUS, Table, f4, i2, i4, i8, native, u1, u8

WINDOW_SIDE = 7  # side of the windows, pixels
# constants of SSIM for values from 0 to 1
C1 = np.float32(1e-4)
C2 = np.float32(9e-4)

# number of rows of derivatives in memory, and of derivatives for each value
DERIVATIVE_ROWS = 12
TERMS = 3
EDGE_ROWS = 7  # number of rows in memory for differences between neighbouring pixels
# number of values that are summed at a time, and of zeros beside a row
SUM_CHUNK = 96
PAD = 9

# Phases of a step. If most Gaussians of a view are hidden, "count_open" follows "count", and "deal_open" replaces
# "deal". A list that "deal_open" makes ends at the last visible Gaussian of the tile
PHASES = ("cull", "project", "count", "count_open", "deal", "deal_open", "blend", "loss", "backward", "update")
THREAD_GAUSSIANS = 1 << 13  # number of Gaussians that a thread culls or projects at a time

# The arrays of the table are in this order. The first arrays of the table are the state of the fit. The next arrays are
# buffers with a row for each of n Gaussians, each tile, each intersection and each pixel. The last arrays are set in
# each step
STEP = Table(
    "Step",
    ("step", "num_visible", "num_intersections", "next", "arrived", "failed"),
    means=f4("n", 3, out=True), quats=f4("n", 4, out=True), scales=f4("n", 3, out=True), opacities=f4("n", out=True),
    colors=f4("n", 3, out=True), x=f4("n", COLUMNS, out=True), x0=f4("n", COLUMNS), m=f4("n", COLUMNS, out=True),
    v=f4("n", COLUMNS, out=True), units=f4("n"), box_shares=f4("n"), min_sizes=f4("n"), fixed=u1("n"),
    sh0=f4("n", 1, 3), shN=f4("n", "num", 3), drawn=f4("n"), ids=i4("n", out=True),
    num_kept=i8("pieces", out=True), conics=f4("n", CONIC, out=True), depths=f4("n", out=True),
    tints=f4("n", 3, out=True), boxes=i2("n", 4, out=True), order=i4("n", out=True), keys=u8("n", out=True),
    spare=u8("n", out=True), ordered_boxes=i2("n", 4, out=True), sums=f4("n", SUMS, out=True),
    g_means=f4("n", 3, out=True), g_quats=f4("n", 4, out=True), g_scales=f4("n", 3, out=True),
    g_opacities=f4("n", out=True), g_colors=f4("n", 3, out=True), g_poses=f4("blocks", POSE, out=True),
    corners=i8("spans", "num_corners", out=True), counts=i8("spans", "tiles", out=True),
    offsets=i8("ends", out=True), light=f4("tiles", out=True), flatten_ids=i4("room", out=True),
    slots=f4("room", SUMS, out=True), image=f4("height", "width", 3, out=True),
    transmittance=f4("height", "width", out=True), gradient=f4("height", "width", 3, out=True),
    errors=f4("height", out=True), terms=f4("threads", DERIVATIVE_ROWS, TERMS, "line", out=True),
    rows=f4("threads", EDGE_ROWS, "line", out=True), photo=f4("height", "width", 3), weight=f4("height", "width"),
    camera=f4(CAMERA), eye=f4(3), background=f4(3), loss_weights=f4(2), rates=f4(COLUMNS), limits=f4(5), betas=f4(2),
    regs=f4(2),
)  # fmt: skip


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


@native(STATUS, table=i8("fields", out=True), phase=i8(least=0, below=len(PHASES)))
def fit_phase(table, phase):
    """Do a thread's share of a phase of a step. ``phase`` is the index of its name in ``PHASES``.

    Each of the ``threads`` calls this function once for each phase. A phase may begin when all calls of the phase
    before have ended. After "count" and "count_open" the table has the number of intersections, for which the buffers
    need room before the next phase.
    """
