"""Furniture of a synthetic building, and how it stands in a room: with its back to a wall, clear of the walk."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from gsmerge.research.generate.floor_plan import CEILING, RoomPlan, room_loop
from gsmerge.research.generate.objects import Shapes, chair, clutter, lamp, plant, shelf, sofa, table
from gsmerge.research.generate.shapes import LYING, Array, Shape, ball, bounds, box, pack, place, quad
from gsmerge.research.generate.textures import Palette

TURNS = (  # rotations of a wall's frame, whose room is at z < 0: far, right, near, left
    np.eye(3),
    np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]),
    np.diag([-1.0, 1.0, -1.0]),
    np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]]),
)
CLEARANCE = 0.35  # between furniture and the walk
TRIES = 8  # places at which a piece of furniture is tried
Maker = Callable[[Palette], Shapes]


def _cabinet(pal: Palette, width: float, depth: float, height: float) -> Shapes:
    """Build a chest of drawers, or a kitchen's cupboards, with things on top; its back towards +z."""
    rng, body, front = pal.rng, pal.material("wood", "plain"), pal.material("wood", "plain", "plain")
    knob, top = pal.material("plain", gloss=0.8), pal.material("wood", "marble", "granite", "plain")
    out = [box((-width / 2, -height + 0.03, -depth / 2), (width / 2, 0, depth / 2), body)]
    out.append(box((-width / 2 - 0.02, -height, -depth / 2 - 0.03), (width / 2 + 0.02, 0.03 - height, depth / 2), top))
    columns, rows = max(1, round(width / 0.6)), int(rng.integers(1, 4))
    wide, high = width / columns, (height - 0.12) / rows
    for i, j in itertools.product(range(columns), range(rows)):
        x, y = -width / 2 + i * wide, -0.06 - j * high
        drawer = box((x + 0.015, y - high + 0.03, -depth / 2 - 0.015), (x + wide - 0.015, y, 0), front)
        out += [drawer, ball((x + wide / 2, y - high / 2, -depth / 2 - 0.03), np.full(3, 0.018), knob)]
    return out + clutter(pal, int(rng.integers(1, 5)), (0.42 * width, 0.3 * depth), height)


def _bed(pal: Palette) -> Shapes:
    """Build a bed along a wall at +z."""
    wood, cover, sheet = pal.material("wood", "plain"), pal.material("cloth", repeat=0.8), pal.material("plain")
    out = [box((-1.0, -0.28, -0.45), (1.0, -0.08, 0.45), wood), box((-0.98, -0.48, -0.43), (0.98, -0.28, 0.43), sheet)]
    out += [box((-0.4, -0.52, -0.46), (0.99, -0.3, 0.44), cover), box((-1.04, -0.85, -0.45), (-1.0, 0, 0.45), wood)]
    return [*out, ball((-0.7, -0.52, 0), (0.2, 0.1, 0.33), pal.material("cloth", "plain"))]


def _desk(pal: Palette) -> Shapes:
    """Build a desk with things on it and a chair before it, at a wall at +z."""
    width = pal.rng.uniform(1.0, 1.5)
    top = clutter(pal, int(pal.rng.integers(2, 6)), (0.4 * width, 0.22), 0.74)
    seat = place(chair(pal), (pal.rng.normal(0, 0.1), 0, -0.42), rotation=TURNS[2])
    return table(pal, width, 0.6, 0.74) + top + seat


def _boxes(pal: Palette) -> Shapes:
    """Build two large cartons, one on the other."""
    out: Shapes = []
    foot = 0.0
    for _ in range(2):
        w, h, d = pal.rng.uniform(0.25, 0.55, 3)
        carton = box((-w / 2, -h, -d / 2), (w / 2, 0, d / 2), pal.material("label", "printed", "plain"))
        out += place([carton], (0, foot, 0), yaw=pal.rng.normal(0, 0.2))
        foot -= h
    return out


def _shelf(pal: Palette) -> Shapes:
    return shelf(pal, pal.rng.uniform(0.7, 1.4), pal.rng.uniform(1.1, 2.1))


def _kitchen(pal: Palette) -> Shapes:
    return _cabinet(pal, pal.rng.uniform(1.6, 2.4), 0.6, 0.9)


def _chest(pal: Palette) -> Shapes:
    return _cabinet(pal, pal.rng.uniform(0.6, 1.2), 0.42, pal.rng.uniform(0.7, 1.1))


def _plant(pal: Palette) -> Shapes:
    return plant(pal, pal.rng.uniform(0.6, 1.3), int(pal.rng.integers(20, 60)))


def small_plant(pal: Palette) -> Shapes:
    """Build a plant that leaves room in a corridor."""
    return plant(pal, pal.rng.uniform(0.4, 0.6), 20)


def sideboard(pal: Palette) -> Shapes:
    """Build a narrow chest of drawers for a corridor."""
    return _cabinet(pal, pal.rng.uniform(0.7, 1.3), 0.32, pal.rng.uniform(0.7, 0.9))


def _lamp(pal: Palette) -> Shapes:
    return lamp(pal, pal.rng.uniform(1.2, 1.7))


KINDS: tuple[tuple[Maker, ...], ...] = (  # what stands at the walls of a room; kinds of rooms take turns at random
    (sofa, _shelf, _chest, _plant, _lamp, chair, _shelf),
    (_desk, _shelf, _desk, _shelf, _plant, _boxes),
    (_bed, _chest, _lamp, chair, _shelf, _plant),
    (_kitchen, _kitchen, chair, _chest, _plant),
    (_shelf, _shelf, _boxes, _boxes, _shelf, _boxes, _chest),
)


def furnish(pal: Palette, plan: RoomPlan) -> Shapes:
    """Put furniture at the walls and in the middle, clear of the walk; in the room's frame."""
    rng, w, d = pal.rng, plan.width / 2, plan.depth
    walk = np.concatenate([np.linspace(a, b, 12)[:, [0, 2]] for a, b in itertools.pairwise(room_loop(plan))])
    half = (rng.uniform(0.5, 0.8) * w, rng.uniform(0.25, 0.4) * d)
    rug = quad((0, -0.006, d / 2), half, pal.material("carpet", "cloth"), LYING)
    middle = place(_middle(pal, 1.3 * (min(w, d / 2) - 1.85)), (0, 0, d / 2))
    middle = middle if _distance(walk, *_extent(middle)) > CLEARANCE else []
    pieces = [make(pal) for make in KINDS[rng.integers(len(KINDS))]]
    space = np.array([[-w, -CEILING, 0], [w, 0, d]])
    return [rug, *middle, *stand(rng, pieces, space, (0, 0, 1, 1, 2, 3, 3), walk)]


def stand(
    rng: np.random.Generator, pieces: Sequence[Shapes], space: Array, turns: Sequence[int], walk: Array
) -> Shapes:
    """Put pieces with their backs to walls of a space ``[2,3]`` where they touch neither one another nor the walk.

    ``turns`` are the walls, from which one is drawn at each try; a piece that fits nowhere is left out.
    """
    out: Shapes = []
    taken: list[tuple[Array, Array]] = []
    for piece in pieces:
        for _ in range(TRIES):
            turn = int(rng.choice(turns))
            moved = place(piece, rotation=TURNS[turn])
            low, high = _extent(moved)
            first, last = space[0] + 0.03 - low, space[1] - 0.03 - high
            at = first + rng.uniform(0, 1, 3) * (last - first)
            axis, end = ((2, last), (0, last), (2, first), (0, first))[turn]
            at[axis], at[1] = end[axis], 0.0
            low, high = low + at, high + at
            fits = (last >= first)[[0, 2]].all() and _distance(walk, low, high) > CLEARANCE
            if fits and not any((low < b).all() and (high > a).all() for a, b in taken):
                out += place(moved, at)
                taken.append((low, high))
                break
    return out


def _middle(pal: Palette, side: float) -> Shapes:
    """Build a small table, or a stool with a plant, for the middle of a room."""
    rng, height = pal.rng, pal.rng.uniform(0.42, 0.78)
    if rng.random() < 0.2:
        return plant(pal, 0.8, 30)
    return table(pal, side, side, height) + clutter(pal, int(rng.integers(2, 7)), (0.38 * side, 0.38 * side), height)


def _extent(shapes: Sequence[Shape]) -> tuple[Array, Array]:
    """Compute the lowest and the highest corner ``[3]`` of shapes together."""
    arrays = pack(shapes)
    reach = (np.abs(arrays.rotations) * bounds(arrays)[:, None]).sum(2)
    return (arrays.centres - reach).min(0), (arrays.centres + reach).max(0)


def _distance(walk: Array, low: Array, high: Array) -> float:
    """Compute the smallest distance of points ``[n,2]`` (x, z) from a box, seen from above."""
    away = np.maximum(np.maximum(low[[0, 2]] - walk, walk - high[[0, 2]]), 0)
    return float(np.sqrt((away * away).sum(1)).min())
