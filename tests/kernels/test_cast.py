"""Rays meet shapes where a look at every point of a ray finds the shape's definition."""

from __future__ import annotations

import numpy as np
import pytest
from messages import refuses
from sweeps import sweep

from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.cast import BLOB, BOX, CONE, ELLIPSOID, LEAF, QUAD, add_light, cast
from gsmerge.research.generate.shapes import NO_WAVES, Material, Shape, ShapeArrays, pack_shapes

FAR, STEPS, EXACT = 12.0, 6_000, 1e-7
KINDS = {"quad": QUAD, "box": BOX, "ellipsoid": ELLIPSOID, "cone": CONE, "leaf": LEAF, "blob": BLOB}


def rotation(rng: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def random_shape(kind: int, rng: np.random.Generator) -> Shape:
    """Draw a shape around (0, 0, 4), about 1 large, in any attitude."""
    waves = NO_WAVES
    if kind == BLOB:
        numbers = rng.normal(0, 2, (4, 3))
        waves = np.concatenate([numbers, rng.uniform(0, 6, (4, 1)), rng.uniform(0.02, 0.06, (4, 1))], 1)
    size = (*rng.uniform(0.5, 1.2, 3), rng.uniform(0.3, 1.6))
    return Shape(kind, size, Material(0), np.array([0, 0, 4.0]) + rng.normal(0, 0.2, 3), rotation(rng), waves)


def sides(shape: Shape, points: np.ndarray) -> np.ndarray:
    """Return on which side of the surface points in its frame are; the surface is where that changes."""
    (x, y, z), (a, b, c, taper) = points.T, shape.size
    number, phase, height = shape.waves[:, :3], shape.waves[:, 3], shape.waves[:, 4]
    if shape.kind == BOX:
        return (np.abs(x) <= a) & (np.abs(y) <= b) & (np.abs(z) <= c)
    if shape.kind == CONE:
        radius = 1 + (taper - 1) * (y / b + 1) / 2
        return (np.abs(y) <= b) & (np.square(x / a) + np.square(z / c) <= radius**2)
    if shape.kind in (ELLIPSOID, BLOB):
        scaled = points / [a, b, c]
        swing = (elementary.sin(scaled @ number.T + phase) * height).sum(1) if shape.kind == BLOB else 0.0
        return np.linalg.norm(scaled, axis=1) <= 1 + swing
    return z > 0


def within(shape: Shape, point: np.ndarray) -> bool:
    """Return whether a point of the surface's level belongs to it: open surfaces end."""
    (x, y, _), (a, b, *_) = np.abs(point), shape.size
    if shape.kind == QUAD:
        return bool(x <= a and y <= b)
    if shape.kind == LEAF:
        return bool(y <= b and x <= a * (1 - (y / b) ** 2))
    return True


def slow_depth(shape: Shape, ray: np.ndarray) -> float:
    def places(t: np.ndarray) -> np.ndarray:
        return (t[:, None] * ray - shape.centre) @ shape.rotation

    t = np.linspace(1e-4, FAR, STEPS)
    before = sides(shape, places(t))
    for i in np.flatnonzero(np.diff(before)):
        low, high = t[i], t[i + 1]
        while high - low > EXACT:
            middle = (low + high) / 2
            low, high = (middle, high) if sides(shape, places(np.array([middle])))[0] == before[i] else (low, middle)
        if within(shape, places(np.array([low]))[0]):
            return float(low)
    return np.inf


def run(shapes: ShapeArrays, width: int, height: int, focal: float) -> tuple[np.ndarray, ...]:
    depth, ids = np.full((height, width), 1e6), np.full((height, width), -1, np.int32)
    points, normals = np.zeros((2, height, width, 3), np.float32)
    lens = np.array([focal, focal, width / 2, height / 2])
    rects = np.tile(np.array([0, 0, width, height], np.int32), (len(shapes.kinds), 1))
    table = shapes.kinds, shapes.rotations, shapes.centres, shapes.sizes, shapes.waves
    cast(np.zeros(3), np.eye(3), lens, 1.0, *table, rects, depth, ids, points, normals)
    return depth, ids, points, normals


def ray(i: int, j: int, width: int, height: int, focal: float) -> np.ndarray:
    return np.array([(j + 0.5 - width / 2) / focal, (i + 0.5 - height / 2) / focal, 1.0])


@pytest.mark.parametrize("name", KINDS)
@sweep("seed", range(3))
def test_depth_is_where_the_side_changes(name: str, seed: int) -> None:
    shape, (w, h, f) = random_shape(KINDS[name], np.random.default_rng([seed, KINDS[name]])), (11, 9, 18.0)
    depth, ids, points, _ = run(pack_shapes([shape]), w, h, f)
    slow = np.array([[slow_depth(shape, ray(i, j, w, h, f)) for j in range(w)] for i in range(h)])
    hit = np.isfinite(slow)
    assert hit.sum() >= 8
    disagree = hit != (ids == 0)
    assert disagree.sum() <= 1  # a ray that grazes an edge
    both = hit & ~disagree
    np.testing.assert_allclose(depth[both], slow[both], atol=EXACT + 1e-4)
    for i, j in zip(*np.nonzero(both), strict=True):
        there = (depth[i, j] * ray(i, j, w, h, f) - shape.centre) @ shape.rotation
        np.testing.assert_allclose(points[i, j], there, atol=1e-5)


@pytest.mark.parametrize("name", KINDS)
def test_normals_match_the_slopes_of_the_depth(name: str) -> None:
    """A step along the surface is at right angles to the normal, which looks at the camera."""
    shape, (w, h, f) = random_shape(KINDS[name], np.random.default_rng(KINDS[name])), (120, 90, 120.0)
    depth, ids, _, normals = run(pack_shapes([shape]), w, h, f)
    rays = np.stack([[ray(i, j, w, h, f) for j in range(w)] for i in range(h)])
    world = rays * np.where(ids == 0, depth, np.nan)[..., None]
    seen = ids == 0
    assert seen.sum() > 300
    assert ((normals * rays).sum(-1)[seen] < 1e-6).all()
    np.testing.assert_allclose(np.linalg.norm(normals[seen], axis=1), 1, atol=1e-5)
    for axis in (0, 1):
        step = np.diff(world, axis=axis)
        length = np.linalg.norm(step, axis=-1)
        first = normals[:-1] if axis == 0 else normals[:, :-1]
        off = np.abs((step * first).sum(-1)) / length
        assert np.nanmedian(off) < 0.05


def test_the_nearest_of_several_shapes_is_seen() -> None:
    rng = np.random.default_rng(3)
    shapes = [random_shape(kind, rng) for kind in (BOX, ELLIPSOID, CONE, BLOB, QUAD)]
    alone = np.stack([run(pack_shapes([shape]), 24, 18, 20.0)[0] for shape in shapes])
    depth, ids, _, _ = run(pack_shapes(shapes), 24, 18, 20.0)
    np.testing.assert_allclose(
        depth, alone.min(0), rtol=1e-4
    )  # where a blob's search ends depends on what is before it
    assert len(set(ids[ids >= 0])) >= 3
    np.testing.assert_array_equal(ids, np.where(alone.min(0) < 1e6, alone.argmin(0), -1))


def test_light_reaches_points_with_nothing_before_them() -> None:
    rng = np.random.default_rng(0)
    axes = np.stack([rotation(rng) for _ in range(3)])
    maps = rng.uniform(-0.5, 0.5, (3, 8, 8)).astype(np.float32)
    points, normals = rng.uniform(-1.2, 1.2, (2, 200, 3)).astype(np.float32)
    centre, radius, bias, weights = np.array([0.1, 0.0, -0.1]), 1.1, 0.02, np.array([0.5, 1.0, 0.25])
    out = np.zeros(200, np.float32)
    add_light(points, normals, axes, centre, radius, maps, bias, weights, out)
    slow = np.zeros(200)
    for k in range(3):
        u, v, forward = ((points - centre) @ axes[k].T).T
        column, row = np.floor((u / radius + 1) * 4).astype(int), np.floor((v / radius + 1) * 4).astype(int)
        inside = (column >= 0) & (column < 8) & (row >= 0) & (row < 8)
        actual = maps[k][row.clip(0, 7), column.clip(0, 7)]
        reached = ~inside | (actual >= forward - bias)
        slow += weights[k] * np.maximum(0, -(normals @ axes[k][2])) * reached
    assert (slow == 0).any()
    np.testing.assert_allclose(out, slow, atol=1e-5)


def test_the_bits_are_the_same_on_every_processor(each_target) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(3)
    shapes = pack_shapes([random_shape(kind, rng) for kind in (BOX, ELLIPSOID, CONE, BLOB, BLOB, LEAF, QUAD)])
    shapes.centres[1, 0], shapes.sizes[2, 1], shapes.waves[4, 0, 0] = np.nan, np.inf, np.nan
    axes, maps = np.stack([rotation(rng) for _ in range(3)]), rng.normal(size=(3, 8, 8)).astype(np.float32)

    def light() -> tuple[np.ndarray, ...]:
        depth, ids, points, normals = run(shapes, 24, 18, 20.0)
        out = np.zeros(depth.size, np.float32)
        lit = points.reshape(-1, 3), normals.reshape(-1, 3), axes, np.zeros(3), 1.1, maps, 0.02, np.ones(3), out
        add_light(*lit)
        return depth, ids, points, normals, out

    _, ids, _, _, lit = each_target(light)
    assert len(np.unique(ids)) > 3
    assert (lit > 0).any()


def test_kernels_take_no_pixels_and_no_points() -> None:
    shapes = pack_shapes([random_shape(BOX, np.random.default_rng(0))])
    assert run(shapes, 0, 0, 1.0)[0].shape == (0, 0)
    empty = np.empty((0, 3), np.float32), np.empty((0, 3), np.float32), np.empty((0, 3, 3)), np.zeros(3), 1.0
    add_light(*empty, np.empty((0, 0, 0), np.float32), 0.1, np.empty(0), np.empty(0, np.float32))


@pytest.mark.parametrize("rect", [(-1, 0, 2, 2), (0, -1, 2, 2), (0, 0, 4, 2), (0, 0, 2, 3)])
def test_samples_outside_the_picture_are_refused(rect: tuple[int, ...]) -> None:
    shapes = pack_shapes([random_shape(BOX, np.random.default_rng(0))])
    table = shapes.kinds, shapes.rotations, shapes.centres, shapes.sizes, shapes.waves
    pictures = np.full((2, 3), 1e6), np.full((2, 3), -1, np.int32), *np.zeros((2, 2, 3, 3), np.float32)
    with refuses(ValueError, "cast", "indices"):
        cast(np.zeros(3), np.eye(3), np.ones(4), 1.0, *table, np.array([rect], np.int32), *pictures)
    with refuses(ValueError, "cast: kinds", "below 6", 7):
        cast(
            np.zeros(3), np.eye(3), np.ones(4), 1.0, shapes.kinds + 6, *table[1:], np.zeros((1, 4), np.int32), *pictures
        )
