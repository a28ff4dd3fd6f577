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

import math

from gsmerge.kernels.jit import kernel

QUAD, BOX, ELLIPSOID, CONE, LEAF, BLOB = range(6)
NEAR = 1e-4  # of the depth unit: hits nearer than this do not count
MARCH, BISECT = 24, 10  # most steps over a blob's bounds, and halvings of the step with the change of sign
MISS = 1e30


@kernel
def _wave(waves, x, y, z):
    total = 0.0
    for k in range(waves.shape[0]):
        total += waves[k, 4] * math.sin(waves[k, 0] * x + waves[k, 1] * y + waves[k, 2] * z + waves[k, 3])
    return total


@kernel
def _limits(waves):
    """Compute the most that the waves add up to, and the steepest that they get."""
    reach, slope = 0.0, 0.0
    for k in range(waves.shape[0]):
        reach += abs(waves[k, 4])
        slope += abs(waves[k, 4]) * math.sqrt(waves[k, 0] ** 2 + waves[k, 1] ** 2 + waves[k, 2] ** 2)
    return reach, slope


@kernel
def _slab(o, d, h):
    """Compute entry and exit of a ray between -h and h along one axis."""
    if d == 0.0:
        if abs(o) <= h:
            return -MISS, MISS
        return MISS, -MISS
    a, b = (-h - o) / d, (h - o) / d
    if a > b:
        a, b = b, a
    return a, b


@kernel
def _flat(leaf, s, ox, oy, oz, dx, dy, dz):
    if dz == 0.0:
        return MISS
    t = -oz / dz
    x, y = ox + t * dx, oy + t * dy
    if abs(y) > s[1] or t < NEAR:
        return MISS
    width = s[0]
    if leaf:
        width *= 1.0 - (y / s[1]) ** 2
    if abs(x) > width:
        return MISS
    return t


@kernel
def _box(s, ox, oy, oz, dx, dy, dz):
    x0, x1 = _slab(ox, dx, s[0])
    y0, y1 = _slab(oy, dy, s[1])
    z0, z1 = _slab(oz, dz, s[2])
    near, far = max(x0, y0, z0), min(x1, y1, z1)
    if near > far or far < NEAR:
        return MISS
    return near if near >= NEAR else far


@kernel
def _sphere(radius, ox, oy, oz, dx, dy, dz):
    """Compute entry and exit of the sphere about the origin."""
    a = dx * dx + dy * dy + dz * dz
    b = ox * dx + oy * dy + oz * dz
    c = ox * ox + oy * oy + oz * oz - radius * radius
    root = b * b - a * c
    if root <= 0.0:
        return MISS, -MISS
    root = math.sqrt(root)
    return (-b - root) / a, (-b + root) / a


@kernel
def _cone(s, ox, oy, oz, dx, dy, dz):
    """Hit side or ends of a tapered cylinder; x and z come in units of the radii at -y, y in half heights."""
    best = MISS
    mean, slope = 0.5 * (1.0 + s[3]), 0.5 * (s[3] - 1.0)
    r, dr = mean + slope * oy, slope * dy
    a = dx * dx + dz * dz - dr * dr
    b = ox * dx + oz * dz - r * dr
    c = ox * ox + oz * oz - r * r
    root = b * b - a * c
    if root > 0.0 and a != 0.0:
        root = math.sqrt(root)
        for sign in (-1.0, 1.0):
            t = (-b + sign * root) / a
            y = oy + t * dy
            if NEAR <= t < best and abs(y) <= 1.0 and mean + slope * y >= 0.0:
                best = t
    if dy != 0.0:
        for end in (-1.0, 1.0):
            t = (end - oy) / dy
            x, z, radius = ox + t * dx, oz + t * dz, mean + slope * end
            if NEAR <= t < best and x * x + z * z <= radius * radius:
                best = t
    return best


@kernel
def _level(waves, x, y, z):
    """Compute the distance from a blob in its own frame, about; 0 on its surface."""
    return math.sqrt(x * x + y * y + z * z) - 1.0 - _wave(waves, x, y, z)


@kernel
def _march(waves, pace, first, last, ox, oy, oz, dx, dy, dz):
    """Find the first change of sign between two depths, by steps that hardly cross the surface.

    ``pace`` is the most that the level may change per unit of depth.
    """
    first = max(first, NEAR)
    if last <= first:
        return MISS
    least, t = (last - first) / MARCH, first
    level = _level(waves, ox + t * dx, oy + t * dy, oz + t * dz)
    outside = level > 0.0
    while t < last:
        before = t
        t = min(t + max(abs(level) / pace, least), last)
        level = _level(waves, ox + t * dx, oy + t * dy, oz + t * dz)
        if (level > 0.0) != outside:
            low, high = before, t
            for _ in range(BISECT):
                t = 0.5 * (low + high)
                if (_level(waves, ox + t * dx, oy + t * dy, oz + t * dz) > 0.0) == outside:
                    low = t
                else:
                    high = t
            return 0.5 * (low + high)
    return MISS


@kernel
def _hit(kind, s, waves, reach, slope, limit, ox, oy, oz, dx, dy, dz):
    """Compute the depth of the nearest hit, in the shape's own frame, if it is nearer than ``limit``."""
    if kind in (QUAD, LEAF):
        return _flat(kind == LEAF, s, ox, oy, oz, dx, dy, dz)
    if kind == BOX:
        return _box(s, ox, oy, oz, dx, dy, dz)
    ox, oy, oz, dx, dy, dz = ox / s[0], oy / s[1], oz / s[2], dx / s[0], dy / s[1], dz / s[2]
    if kind == CONE:
        return _cone(s, ox, oy, oz, dx, dy, dz)
    if kind == BLOB:
        near, far = _sphere(1.0 + reach, ox, oy, oz, dx, dy, dz)
        pace = (1.0 + slope) * math.sqrt(dx * dx + dy * dy + dz * dz)
        return _march(waves, pace, near, min(far, limit), ox, oy, oz, dx, dy, dz)
    near, far = _sphere(1.0, ox, oy, oz, dx, dy, dz)
    if near >= NEAR:
        return near
    return far if far >= NEAR else MISS


@kernel
def _normal(kind, s, waves, x, y, z):
    """Compute the outward normal in the shape's own frame, any length."""
    if kind in (QUAD, LEAF):
        return 0.0, 0.0, 1.0
    a, b, c = x / s[0], y / s[1], z / max(s[2], 1e-12)
    if kind == BOX:
        if abs(a) >= abs(b) and abs(a) >= abs(c):
            return a, 0.0, 0.0
        if abs(b) >= abs(c):
            return 0.0, b, 0.0
        return 0.0, 0.0, c
    if kind == CONE:
        if abs(b) > 1.0 - 1e-6:
            return 0.0, b, 0.0
        radius = 0.5 * (1.0 + s[3]) + 0.5 * (s[3] - 1.0) * b
        return a / s[0], -radius * 0.5 * (s[3] - 1.0) / s[1], c / s[2]
    length = math.sqrt(a * a + b * b + c * c)
    nx, ny, nz = a / length, b / length, c / length
    if kind == BLOB:
        for k in range(waves.shape[0]):
            swing = waves[k, 4] * math.cos(waves[k, 0] * a + waves[k, 1] * b + waves[k, 2] * c + waves[k, 3])
            nx -= swing * waves[k, 0]
            ny -= swing * waves[k, 1]
            nz -= swing * waves[k, 2]
    return nx / s[0], ny / s[1], nz / s[2]


@kernel
def _local(rotation, centre, eye, dx, dy, dz):
    """Move origin and direction of a ray into the shape's frame."""
    ex, ey, ez = eye[0] - centre[0], eye[1] - centre[1], eye[2] - centre[2]
    return (
        rotation[0, 0] * ex + rotation[1, 0] * ey + rotation[2, 0] * ez,
        rotation[0, 1] * ex + rotation[1, 1] * ey + rotation[2, 1] * ez,
        rotation[0, 2] * ex + rotation[1, 2] * ey + rotation[2, 2] * ez,
        rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0] * dz,
        rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1] * dz,
        rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2] * dz,
    )


@kernel
def _ray(axes, lens, step, i, j):
    """Compute the direction of pixel row i and column j, of length 1 along the camera's z."""
    u, v = ((j + 0.5) * step - lens[2]) / lens[0], ((i + 0.5) * step - lens[3]) / lens[1]
    return (
        axes[0, 0] * u + axes[0, 1] * v + axes[0, 2],
        axes[1, 0] * u + axes[1, 1] * v + axes[1, 2],
        axes[2, 0] * u + axes[2, 1] * v + axes[2, 2],
    )


@kernel
def cast(eye, axes, lens, step, kinds, rotations, centres, sizes, waves, rects, depth, ids, points, normals):
    """Fill depth along z (untouched where nothing is hit nearer), shape, point in its frame, and world normal.

    ``axes [3,3]`` camera to world, ``lens`` fx, fy, cx, cy in pixels of which one is 1 / ``step`` samples wide,
    ``rects [m,4]`` the samples x0, y0, x1, y1 that can see the shape; ``ids`` must be -1 and ``depth`` the farthest.
    """
    for m in range(len(kinds)):
        reach, slope = _limits(waves[m])
        for i in range(rects[m, 1], rects[m, 3]):
            for j in range(rects[m, 0], rects[m, 2]):
                dx, dy, dz = _ray(axes, lens, step, i, j)
                ox, oy, oz, dx, dy, dz = _local(rotations[m], centres[m], eye, dx, dy, dz)
                t = _hit(kinds[m], sizes[m], waves[m], reach, slope, depth[i, j], ox, oy, oz, dx, dy, dz)
                if t < depth[i, j]:
                    depth[i, j] = t
                    ids[i, j] = m
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            m = ids[i, j]
            if m < 0:
                continue
            wx, wy, wz = _ray(axes, lens, step, i, j)
            ox, oy, oz, dx, dy, dz = _local(rotations[m], centres[m], eye, wx, wy, wz)
            t = depth[i, j]
            x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
            points[i, j, 0], points[i, j, 1], points[i, j, 2] = x, y, z
            nx, ny, nz = _normal(kinds[m], sizes[m], waves[m], x, y, z)
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            if nx * dx + ny * dy + nz * dz > 0.0:  # seen from inside or behind
                length = -length
            rotation = rotations[m]
            for k in range(3):
                normals[i, j, k] = (rotation[k, 0] * nx + rotation[k, 1] * ny + rotation[k, 2] * nz) / length


@kernel
def add_light(points, normals, axes, centre, radius, maps, bias, weights, out):
    """Add up the share of each light that reaches points, times the cosine and its weight.

    ``axes [k,3,3]`` rows right, down and forward of the lights' parallel rays, ``maps [k,s,s]`` how far forward of
    ``centre`` the first surface lies over the square of half side ``radius``, ``out [n]`` is added to.
    """
    size = maps.shape[1]
    for k in range(len(maps)):
        a = axes[k]
        for i in range(len(points)):
            cosine = -(normals[i, 0] * a[2, 0] + normals[i, 1] * a[2, 1] + normals[i, 2] * a[2, 2])
            if cosine <= 0.0:
                continue
            x, y, z = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
            u = ((a[0, 0] * x + a[0, 1] * y + a[0, 2] * z) / radius + 1.0) * 0.5 * size
            v = ((a[1, 0] * x + a[1, 1] * y + a[1, 2] * z) / radius + 1.0) * 0.5 * size
            if 0.0 <= u < size and 0.0 <= v < size:
                forward = a[2, 0] * x + a[2, 1] * y + a[2, 2] * z
                if maps[k, int(v), int(u)] < forward - bias:
                    continue
            out[i] += weights[k] * cosine
