"""Shapes of a made scene: frames, sizes and surfaces. x to the right, y down, z away; the ground is y = 0."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gsmerge.research.generate.cast import BLOB, BOX, CONE, ELLIPSOID, LEAF, QUAD, SHEET

Array: TypeAlias = NDArray[Any]
Vector: TypeAlias = Sequence[float] | Array  # of length 3
NUM_WAVES = 4
NO_WAVES = np.zeros((NUM_WAVES, 5))


@dataclass(frozen=True)
class Look:
    """How a surface is painted.

    Args:
        texture: Index into the scene's textures.
        repeat: Repeats of the texture per world unit; 0: once over every face.
        gloss: Strength of highlights, 0 to 1.
        shift: Offset into the texture, repeats.
    """

    texture: int
    repeat: float = 1.0
    gloss: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Shape:
    """One shape, as :mod:`gsmerge.research.generate.cast` has them.

    Args:
        kind: Which.
        size: Half sizes along its axes, and the taper of a cone.
        look: Its surface.
        centre: ``[3]`` world.
        turn: ``[3,3]`` rotation, local to world.
        waves: ``[4,5]`` relief.
        shell: Encloses the scene: casts no shade.
        glow: Is as bright as its texture, whatever the light (sky, screens, lamps).
    """

    kind: int
    size: tuple[float, float, float, float]
    look: Look
    centre: Array = field(default_factory=lambda: np.zeros(3))
    turn: Array = field(default_factory=lambda: np.eye(3))
    waves: Array = field(default_factory=lambda: NO_WAVES)
    shell: bool = False
    glow: bool = False


def about(axis: int, angle: float) -> Array:
    """``[3,3]`` rotation about a coordinate axis, radians."""
    out = np.eye(3)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    out[i, i] = out[j, j] = np.cos(angle)
    out[i, j], out[j, i] = -np.sin(angle), np.sin(angle)
    return out


UPRIGHT, LYING = np.eye(3), about(0, np.pi / 2)  # of quads, leaves and sheets: facing -z, facing up


def box(low: Vector, high: Vector, look: Look) -> Shape:
    """A box between two corners."""
    a, b = np.asarray(low, float), np.asarray(high, float)
    half = np.abs(b - a) / 2
    return Shape(BOX, (*half, 1.0), look, (a + b) / 2)


def quad(centre: Vector, half: tuple[float, float], look: Look, turn: Array = UPRIGHT) -> Shape:
    """A rectangle."""
    return Shape(QUAD, (*half, 0.0, 1.0), look, np.asarray(centre, float), turn)


def ball(centre: Vector, radii: Vector, look: Look) -> Shape:
    """An ellipsoid."""
    return Shape(ELLIPSOID, (radii[0], radii[1], radii[2], 1.0), look, np.asarray(centre, float))


def column(foot: Vector, height: float, radius: float, look: Look, *, top: float = 1.0) -> Shape:
    """An upright cylinder that stands on ``foot``; its radius at the top is ``top`` times that at the foot."""
    x, y, z = foot
    size = (radius * top, height / 2, radius * top, 1 / top)  # the kernel's radii are those at -y, which is up
    return Shape(CONE, size, look, np.array([x, y - height / 2, z]))


def rod(start: Vector, end: Vector, radius: float, look: Look) -> Shape:
    """A cylinder between two points."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(b - a))
    y = (b - a) / length
    x = np.cross(y, [0.0, 0.0, 1.0] if abs(y[2]) < 0.9 else [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    return Shape(CONE, (radius, length / 2, radius, 1.0), look, (a + b) / 2, np.stack([x, y, np.cross(x, y)], 1))


def leaf(centre: Vector, half: tuple[float, float], look: Look, turn: Array) -> Shape:
    """A pointed leaf, its tips along local y."""
    return Shape(LEAF, (*half, 0.0, 1.0), look, np.asarray(centre, float), turn)


def blob(centre: Vector, radii: Vector, look: Look, rng: np.random.Generator, rough: float) -> Shape:
    """An uneven ellipsoid; ``rough`` is how far its surface swings, of its size."""
    waves = np.concatenate([rng.normal(0, 2.2, (NUM_WAVES, 3)), rng.uniform(0, 6.28, (NUM_WAVES, 1))], 1)
    waves = np.concatenate([waves, np.full((NUM_WAVES, 1), rough / NUM_WAVES)], 1)
    return Shape(BLOB, (radii[0], radii[1], radii[2], 1.0), look, np.asarray(centre, float), waves=waves)


def sheet(
    centre: Vector,
    half: tuple[float, float],
    look: Look,
    rng: np.random.Generator,
    height: float,
    *,
    length: float,
    turn: Array = LYING,
) -> Shape:
    """An uneven rectangle that swings by ``height`` over waves of about ``length``, shorter ones lower."""
    waves = np.zeros((NUM_WAVES, 5))
    for k in range(NUM_WAVES):
        angle, number = rng.uniform(0, 2 * np.pi), 2 * np.pi / length * 1.7**k
        waves[k] = number * np.cos(angle), number * np.sin(angle), 0, rng.uniform(0, 6.28), 0.5 * height / 1.9**k
    return Shape(SHEET, (*half, 0.0, 1.0), look, np.asarray(centre, float), turn, waves)


def placed(
    shapes: Iterable[Shape], at: Vector = (0, 0, 0), *, yaw: float = 0.0, turn: Array | None = None
) -> list[Shape]:
    """Shapes turned about the origin, about y by ``yaw`` or by ``turn``, then moved."""
    rotation = about(1, yaw) if turn is None else turn
    offset = np.asarray(at, float)
    return [replace(s, centre=rotation @ s.centre + offset, turn=rotation @ s.turn) for s in shapes]


@dataclass(frozen=True)
class Packed:
    """Shapes as the kernel takes them; m of them.

    Args:
        shapes: The shapes.
        kinds: ``[m]`` int32.
        turns: ``[m,3,3]``.
        centres: ``[m,3]``.
        sizes: ``[m,4]``.
        waves: ``[m,4,5]``.
    """

    shapes: tuple[Shape, ...]
    kinds: NDArray[np.int32]
    turns: Array
    centres: Array
    sizes: Array
    waves: Array


def packed(shapes: Sequence[Shape]) -> Packed:
    """The arrays of shapes."""
    return Packed(
        tuple(shapes),
        np.array([s.kind for s in shapes], np.int32),
        np.stack([s.turn for s in shapes]).astype(float),
        np.stack([s.centre for s in shapes]).astype(float),
        np.array([s.size for s in shapes], float),
        np.stack([s.waves for s in shapes]).astype(float),
    )


def bounds(given: Packed) -> Array:
    """``[m,3]`` half sizes of boxes, in the shapes' frames, that hold them."""
    half = given.sizes[:, :3].copy()
    reach = np.abs(given.waves[:, :, 4]).sum(1)
    half[given.kinds == SHEET, 2] = reach[given.kinds == SHEET]
    half[given.kinds == BLOB] *= 1 + reach[given.kinds == BLOB, None]
    wide = np.maximum(given.sizes[:, 3], 1)[given.kinds == CONE]
    half[given.kinds == CONE] *= np.stack([wide, np.ones_like(wide), wide], 1)
    return half
