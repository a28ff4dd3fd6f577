"""Project Gaussians into a view, to find which ones it may show, with conics, boxes and colours. Run the backward pass.

Cameras, Gaussians and images follow the conventions of gsplat. The dilation is 0.3 square pixels. Conics follow from
the first-order (EWA) projection, whose directions are clamped 15 % outside the image. Contributions below 1/255 are
left out. A conic is stored with its square completed, so that the exponent of a pixel is never positive, however thin
the Gaussian::

    ln w(x, y) = lnop - (rate_x (x - mean_x - slope (y - mean_y)))^2 - rate_y (y - mean_y)^2

The backward pass computes gradients of means, rotations, scales and opacities from sums over an image. The backward
pass follows "Mathematical supplement for the gsplat library" (Ye 2023) and EWA splatting (Zwicker 2001). Gradients pass
through the conic to half axes, rotation and scale. Gradients reach the mean through its image position and through the
derivative of the projection.

The colours that Gaussians show to a camera are spherical harmonics of the direction of view.
"""

from __future__ import annotations

from gsmerge.method.kernels.signature import STATUS, f4, f8, i2, i4, i8, native, u1

TILE = 16  # pixels per side; one row of a tile is one AVX-512 vector
MAX_SIZE = 32767 * TILE  # most pixels per side of a view, since tile columns and rows have 16 bits
CONIC = 8  # numbers of a conic: mean_x, mean_y, rate_x, slope, rate_y, lnop, first row, last row
# Sums of a Gaussian over pixels: weight times the gradient of the colour (3), v = d loss / d exponent, and v times x,
# y, xx, xy and yy, where x and y are relative to the mean
SUMS = 9

# Positions of numbers in the array of a camera
ROTATION = 0
SHIFT = 9
FX = 12
FY = 13
CX = 14
CY = 15
WIDTH = 16
HEIGHT = 17
NEAR = 18
FAR = 19
EPS2D = 20
# further positions, where a limit has two numbers
LIMIT_X = 21
LIMIT_Y = 23
ANTIALIASED = 25
CAMERA = 26  # length of the array of a camera
BLOCK = 128  # gradients of the pose are summed over blocks of this many Gaussians
POSE = 12  # numbers of a world-to-camera matrix: rotation (9, row by row), shift (3)


@native(
    i8(), means=f4("n", 3), scales=f4("n", 3), opacities=f4("n"), keep=u1("n", optional=True),
    wanted=i4("lines", "columns", optional=True), camera=f4(CAMERA), start=i4(), ids=i4("n", out=True),
)  # fmt: skip
def cull(means, scales, opacities, keep, wanted, camera, start, ids):
    """List the Gaussians that may touch a wanted tile, and return their number.

    Args:
        keep: ``[n]`` uint8, 0 for Gaussians to leave out, or None to leave out none.
        wanted: ``[tile_height + 1, tile_width + 1]`` int32 number of wanted tiles above and to the left of each corner,
            or None if all tiles are wanted.
        start: Number of the first Gaussian, which is added to all ids.
        ids: ``[n]`` int32, of which the first entries are written: ascending ids of the listed Gaussians.
    """


@native(
    STATUS, means=f4("n", 3), quats=f4("n", 4), scales=f4("n", 3), opacities=f4("n"), ids=i4("m"), camera=f4(CAMERA),
    conics=f4("m", CONIC, out=True), depths=f4("m", out=True), boxes=i2("m", 4, out=True),
)  # fmt: skip
def project(means, quats, scales, opacities, ids, camera, conics, depths, boxes):
    """Project the listed Gaussians, and write their conics, depths and boxes.

    Args:
        quats: ``[n,4]`` wxyz of any length.
        opacities: ``[n]``, of which values above 1 count as 1.
        depths: ``[m]`` float32, written: camera z.
        boxes: ``[m,4]`` int16, written: first and last column of tiles, first and last row, or zeros for Gaussians that
            are not drawn. Last ones are exclusive.
    """


@native(
    STATUS, means=f4("n", 3), quats=f4("n", 4), scales=f4("n", 3), opacities=f4("n"), ids=i4("m"), sums=f4("m", SUMS),
    camera=f4(CAMERA), first=i8(least=0, most="m"), last=i8(least="first", most="m"),
    grad_means=f4("m", 3, out=True), grad_quats=f4("m", 4, out=True), grad_scales=f4("m", 3, out=True),
    grad_opacities=f4("m", out=True), grad_poses=f4("blocks", POSE, out=True, optional=True),
)  # fmt: skip
def project_backward(
    means, quats, scales, opacities, ids, sums, camera, first, last,
    grad_means, grad_quats, grad_scales, grad_opacities, grad_poses,
):  # fmt: skip
    """Write the gradients of the loss with respect to the parameters of a range of the listed Gaussians.

    Args:
        sums: ``[m,SUMS]`` float32 rows of :func:`gsmerge.method.kernels.raster.blend.blend_backward`, summed over all
        tiles. first: Start of the range, a multiple of BLOCK. last: End of the range, exclusive. grad_poses:
        ``[blocks,POSE]`` float32, written: gradient with respect to the world-to-camera matrix, summed over
            blocks of ``BLOCK`` Gaussians. It may be None.
    """


@native(
    STATUS, means=f4("n", 3), sh0=f4("n", 1, 3), shN=f4("n", "num", 3), ids=i4("m"), eye=f4(3),
    first=i8(least=0, most="m"), last=i8(least="first", most="m"), colors=f4("m", 3, out=True),
)  # fmt: skip
def view_colors(means, sh0, shN, ids, eye, first, last, colors):
    """Write the colours of a range of the listed Gaussians as seen from ``eye [3]``, at least 0."""


@native(
    STATUS, means=f4("n", 3), shN=f4("n", "num", 3), ids=i4("m"), eye=f4(3), first=i8(least=0, most="m"),
    last=i8(least="first", most="m"), colors=f4("m", 3), grad_colors=f4("m", 3), grad_sh0=f4("m", 1, 3, out=True),
    grad_shN=f4("m", "num", 3, out=True), grad_means=f4("m", 3, out=True),
)  # fmt: skip
def view_colors_backward(means, shN, ids, eye, first, last, colors, grad_colors, grad_sh0, grad_shN, grad_means):
    """Run the backward pass of :func:`view_colors` for a range of the listed Gaussians.

    Args:
        colors: ``[m,3]`` float32 colours of :func:`view_colors`. No gradient passes where they are 0.
        grad_means: ``[m,3]`` float32, written: gradient through the direction in which the eye sees the Gaussian.
    """


@native(STATUS, ids=i4("m"), rows=f4("m", "c"), totals=f4("n", "c", out=True))
def add_rows(ids, rows, totals):
    """Add the ``rows [m,c]`` to the rows ``ids [m]`` int32 of ``totals [n,c]``."""


@native(means=f4("n", 3), origin=f8(3), out=f4("n", 3, out=True))
def shift_means(means, origin, out):
    """Write the means minus ``origin``, computed in float64."""
