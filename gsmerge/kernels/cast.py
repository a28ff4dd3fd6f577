"""Casting of rays of a pinhole camera against a list of shapes: the nearest hit of every pixel.

Every shape has a frame of its own (centre, rotation local to world) and half sizes x, y, z along its axes:

- QUAD: the rectangle z = 0
- BOX: a box
- ELLIPSOID: an ellipsoid
- CONE: a cylinder about y, whose radius is ``extra`` times as large at +y as at -y, with both ends closed
- LEAF: the part of z = 0 where ``|x| <= hx (1 - (y / hy)^2)``
- BLOB: an ellipsoid whose radius is 1 + waves, in units of the half sizes

``waves[m,4,5]`` are sines: three wave numbers, phase and amplitude each.
"""

from __future__ import annotations

from gsmerge.kernels.signature import STATUS, f4, f8, i4, native

QUAD, BOX, ELLIPSOID, CONE, LEAF, BLOB = range(6)


@native(
    STATUS, eye=f8(3), axes=f8(3, 3), lens=f8(4), step=f8(), kinds=i4("m", least=0, below=6), rotations=f8("m", 3, 3),
    centres=f8("m", 3), sizes=f8("m", 4), waves=f8("m", 4, 5), rects=i4("m", 4), depth=f8("h", "w", out=True),
    ids=i4("h", "w", out=True), points=f4("h", "w", 3, out=True), normals=f4("h", "w", 3, out=True),
)  # fmt: skip
def cast(eye, axes, lens, step, kinds, rotations, centres, sizes, waves, rects, depth, ids, points, normals):
    """Fill depth along z (untouched where nothing is hit nearer), shape, point in its frame, and world normal.

    Args:
        eye: ``[3]`` float64 position of the camera.
        axes: ``[3,3]`` float64 camera to world.
        lens: ``[4]`` float64 fx, fy, cx, cy in pixels.
        step: Pixels from one sample to the next.
        kinds: ``[m]`` int32 kinds of the shapes, 0 to 5.
        sizes: ``[m,4]`` float64 half sizes and ``extra``.
        rects: ``[m,4]`` int32 samples x0, y0, x1, y1 that can see the shape.
        depth: ``[h,w]`` float64, the farthest before.
        ids: ``[h,w]`` int32, -1 before.
        normals: ``[h,w,3]`` float32, towards the camera.
    """


@native(
    points=f4("n", 3), normals=f4("n", 3), axes=f8("k", 3, 3), centre=f8(3), radius=f8(), maps=f4("k", "s", "s"),
    bias=f8(), weights=f8("k"), out=f4("n", out=True),
)  # fmt: skip
def add_light(points, normals, axes, centre, radius, maps, bias, weights, out):
    """Add up the share of each light that reaches points, times the cosine and its weight.

    Args:
        normals: ``[n,3]`` float32 of length 1.
        axes: ``[k,3,3]`` float64 rows right, down and forward of the lights' parallel rays.
        centre: ``[3]`` float64 middle of the shadow maps.
        radius: Half their side.
        maps: ``[k,s,s]`` float32: how far forward of the middle the first surface lies.
        bias: How far behind it a point is still lit.
        out: ``[n]`` float32, added to.
    """
