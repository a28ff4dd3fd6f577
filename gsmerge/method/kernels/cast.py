"""Draw simple shapes by casting the rays of a pinhole camera, and light them with shadow maps.

Every shape has its own frame (a centre, and a rotation from the frame to the world) and half sizes along x, y and z.
There are these kinds.

- QUAD is the rectangle z = 0.
- BOX is a box.
- ELLIPSOID is an ellipsoid.
- CONE is a cylinder about y with closed ends. The radius of a CONE at +y is ``extra`` times its radius at -y.
- LEAF is the part of z = 0 where ``|x| <= hx (1 - (y / hy)^2)``, with the half sizes hx and hy.
- BLOB is an ellipsoid whose radius, in units of the half sizes, is 1 plus the sum of its four waves.

A wave in ``waves [m,4,5]`` is a sine with three wave numbers, a phase and an amplitude.
"""

from __future__ import annotations

from gsmerge.method.kernels.signature import STATUS, f4, f8, i4, native

QUAD, BOX, ELLIPSOID, CONE, LEAF, BLOB = range(6)


@native(
    STATUS, eye=f8(3), axes=f8(3, 3), lens=f8(4), step=f8(), kinds=i4("m", least=0, below=6), rotations=f8("m", 3, 3),
    centres=f8("m", 3), sizes=f8("m", 4), waves=f8("m", 4, 5), rects=i4("m", 4), depth=f8("h", "w", out=True),
    ids=i4("h", "w", out=True), points=f4("h", "w", 3, out=True), normals=f4("h", "w", 3, out=True),
)  # fmt: skip
def cast(eye, axes, lens, step, kinds, rotations, centres, sizes, waves, rects, depth, ids, points, normals):
    """Write what the ray of each pixel hits first: its depth along z, the shape, the point and the normal.

    Points are in the frame of the shape, normals in the world. A pixel changes only if its ray hits a shape in front of
    the present depth.

    Args:
        eye: ``[3]`` float64 position of the camera.
        axes: ``[3,3]`` float64 rotation from the camera to the world.
        lens: ``[4]`` float64 fx, fy, cx, cy in pixels.
        step: Distance from one sample to the next, pixels.
        kinds: ``[m]`` int32 kinds of the shapes, 0 to 5.
        sizes: ``[m,4]`` float64 half sizes and ``extra``.
        rects: ``[m,4]`` int32 rectangles of samples, x0, y0, x1 and y1, in which the shape may appear.
        depth: ``[h,w]`` float64, which the caller fills with the largest depth.
        ids: ``[h,w]`` int32 shapes, which the caller fills with -1.
        normals: ``[h,w,3]`` float32, pointing towards the camera.
    """


@native(
    points=f4("n", 3), normals=f4("n", 3), axes=f8("k", 3, 3), centre=f8(3), radius=f8(), maps=f4("k", "s", "s"),
    bias=f8(), weights=f8("k"), out=f4("n", out=True),
)  # fmt: skip
def add_light(points, normals, axes, centre, radius, maps, bias, weights, out):
    """Add to ``out`` the light that points get from all lamps.

    A lamp whose rays reach a point gives it the lamp's weight times the cosine between ray and normal.

    Args:
        normals: ``[n,3]`` float32 of length 1.
        axes: ``[k,3,3]`` float64 axes of the lamps: right, down, and forward along their parallel rays.
        centre: ``[3]`` float64 middle of the shadow maps.
        radius: Half the side of the shadow maps.
        maps: ``[k,s,s]`` float32 distances of the first surfaces from the middle, along the rays.
        bias: Largest distance behind the first surface at which a point is still lit.
        out: ``[n]`` float32, to which the light is added.
    """
