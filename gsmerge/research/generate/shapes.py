"""Make the shapes of a synthetic scene; x points to the right, y down and z away, and the ground is y = 0."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gsmerge.frozen import dataclass, field, replace
from gsmerge.method.kernels.cast import BLOB, BOX, CONE, ELLIPSOID, LEAF, QUAD
from gsmerge.method.kernels.elementary import cos, sin
from gsmerge.method.kernels.matrices import matmul

Array: TypeAlias = NDArray[Any]
Vector: TypeAlias = Sequence[float] | Array  # of length 3
Pair: TypeAlias = tuple[float, float]
NUM_WAVES = 4  # number of waves that bend the surface of a shape
NO_WAVES = np.zeros((NUM_WAVES, 5))  # waves with the amplitude 0, for a smooth surface
# columns: the taper in a shape's size, and the amplitude in its waves
TAPER = 3
AMPLITUDE = 4


@dataclass(frozen=True)
class Material:
    """Texture and gloss of a surface."""

    texture: int  # index into the scene's textures
    repeat: float = 1.0  # repeats of the texture per world unit; 0: once over every face
    gloss: float = 0.0  # strength of highlights, 0 to 1
    shift: Pair = (0.0, 0.0)  # offset into the texture, repeats


@dataclass(frozen=True, eq=False)
class Shape:
    """One shape; see :mod:`gsmerge.method.kernels.cast` for the kinds."""

    kind: int
    size: tuple[float, float, float, float]  # half sizes along its axes, and the taper of a cone
    material: Material
    centre: Array = field(default_factory=lambda: np.zeros(3))  # [3] world
    rotation: Array = field(default_factory=lambda: np.eye(3))  # [3,3] local to world
    waves: Array = field(default_factory=lambda: NO_WAVES)  # [4,5] waves of the surface's relief
    shell: bool = False  # True for walls, which enclose the scene and cast no shadow
    glow: bool = False  # True if the shape is as bright as its texture in any light (sky, screens, lamps)


def norm(vector: Array) -> float:
    """Compute the length of a vector, with the same bits on every processor."""
    return float(np.sqrt((vector * vector).sum()))


def rotate(points: Array, rotation: Array) -> Array:
    """Rotate points ``[n,3]``, with the same bits on every processor."""
    return matmul(points, rotation.T)


def invert_motion(motion: Array) -> Array:
    """Invert a rigid motion ``[4,4]``."""
    out = np.eye(4)
    out[:3, :3] = motion[:3, :3].T
    out[:3, 3] = -(motion[:3, :3] * motion[:3, 3:]).sum(0)
    return out


def axis_rotation(axis: int, angle: float) -> Array:
    """Compute the rotation ``[3,3]`` about coordinate axis 0, 1 or 2 by an angle in radians."""
    out = np.eye(3)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    out[i, i] = out[j, j] = cos(angle)
    out[i, j], out[j, i] = -sin(angle), sin(angle)
    return out


FACING_FRONT, LYING = np.eye(3), axis_rotation(0, np.pi / 2)  # with these rotations quads and leaves face -z, or up


def box(low: Vector, high: Vector, material: Material) -> Shape:
    """Make a box between two corners."""
    a = np.asarray(low, float)
    b = np.asarray(high, float)
    half = np.abs(b - a) / 2
    return Shape(BOX, (*half, 1.0), material, (a + b) / 2)


def quad(centre: Vector, half: Pair, material: Material, rotation: Array = FACING_FRONT) -> Shape:
    """Make a rectangle with the half sides ``half``. Without a rotation the rectangle faces -z."""
    return Shape(QUAD, (*half, 0.0, 1.0), material, np.asarray(centre, float), rotation)


def ball(centre: Vector, radii: Vector, material: Material) -> Shape:
    """Make an ellipsoid."""
    return Shape(ELLIPSOID, (radii[0], radii[1], radii[2], 1.0), material, np.asarray(centre, float))


def column(foot: Vector, height: float, radius: float, material: Material, *, top: float = 1.0) -> Shape:
    """Make an upright cylinder or cone on the point ``foot``. The radius at the top is ``top`` times ``radius``."""
    x, y, z = foot
    size = (radius * top, height / 2, radius * top, 1 / top)  # the kernel takes the radii of the top, which is at -y
    return Shape(CONE, size, material, np.array([x, y - height / 2, z]))


def rod(start: Vector, end: Vector, radius: float, material: Material) -> Shape:
    """Make a cylinder between two points."""
    a = np.asarray(start, float)
    b = np.asarray(end, float)
    length = norm(b - a)
    y = (b - a) / length
    x = np.cross(y, [0.0, 0.0, 1.0] if abs(y[2]) < 0.9 else [1.0, 0.0, 0.0])
    x /= norm(x)
    return Shape(CONE, (radius, length / 2, radius, 1.0), material, (a + b) / 2, np.stack([x, y, np.cross(x, y)], 1))


def leaf(centre: Vector, half: Pair, material: Material, rotation: Array) -> Shape:
    """Make a pointed leaf with the half sides ``half``. Before the rotation the tips of the leaf are on the y axis."""
    return Shape(LEAF, (*half, 0.0, 1.0), material, np.asarray(centre, float), rotation)


def blob(centre: Vector, radii: Vector, material: Material, rng: np.random.Generator, rough: float) -> Shape:
    """Make an uneven ellipsoid; ``rough`` is the amplitude of its relief, as a share of its size."""
    waves = np.concatenate([rng.normal(0, 2.2, (NUM_WAVES, 3)), rng.uniform(0, 6.28, (NUM_WAVES, 1))], 1)
    waves = np.concatenate([waves, np.full((NUM_WAVES, 1), rough / NUM_WAVES)], 1)
    return Shape(BLOB, (radii[0], radii[1], radii[2], 1.0), material, np.asarray(centre, float), waves=waves)


def place_shapes(
    shapes: Iterable[Shape], at: Vector = (0, 0, 0), *, yaw: float = 0.0, rotation: Array | None = None
) -> list[Shape]:
    """Rotate shapes about the origin, by ``yaw`` about y or by ``rotation``, then move them to ``at``."""
    rotation = axis_rotation(1, yaw) if rotation is None else rotation
    offset = np.asarray(at, float)
    return [
        replace(s, centre=(rotation * s.centre).sum(1) + offset, rotation=matmul(rotation, s.rotation)) for s in shapes
    ]


@dataclass(frozen=True, eq=False)
class ShapeArrays:
    """Arrays of m shapes, as the kernel takes them."""

    shapes: tuple[Shape, ...]
    kinds: NDArray[np.int32]  # [m]
    rotations: Array  # [m,3,3]
    centres: Array  # [m,3]
    sizes: Array  # [m,4]
    waves: Array  # [m,4,5]


def pack_shapes(shapes: Sequence[Shape]) -> ShapeArrays:
    """Convert at least one shape to arrays."""
    return ShapeArrays(
        tuple(shapes), kinds=np.array([s.kind for s in shapes], np.int32),
        rotations=np.stack([s.rotation for s in shapes]).astype(float),
        centres=np.stack([s.centre for s in shapes]).astype(float), sizes=np.array([s.size for s in shapes], float),
        waves=np.stack([s.waves for s in shapes]).astype(float),
    )  # fmt: skip


def half_sizes(shapes: ShapeArrays) -> Array:
    """Compute the half sizes ``[m,3]`` of the shapes' bounding boxes, along the axes of each shape."""
    half = shapes.sizes[:, :3].copy()
    relief = np.abs(shapes.waves[:, :, AMPLITUDE]).sum(1)
    half[shapes.kinds == BLOB] *= 1 + relief[shapes.kinds == BLOB, None]
    widening = np.maximum(shapes.sizes[:, TAPER], 1)[shapes.kinds == CONE]
    half[shapes.kinds == CONE] *= np.stack([widening, np.ones_like(widening), widening], 1)
    return half
