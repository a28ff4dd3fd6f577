"""Floor plan of a synthetic building, the walk through it, and the furniture of its rooms.

Rooms lie on both sides of a corridor, in one or two storeys. The corridor lies along x at z = 0, storeys above one
another, their stairs at the far end. A room's own frame has its door's wall at z = 0 and the room beyond it at z > 0,
the floor at y = 0. Furniture stands with its back to a wall, clear of the walk.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gsmerge.kernels.elementary import cos, sin
from gsmerge.research.generate.objects import Shapes, chair, clutter, lamp, plant, shelf, sofa, table
from gsmerge.research.generate.shapes import LYING, Array, Shape, ball, bounds, box, norm, pack, place, quad
from gsmerge.research.generate.textures import Palette

# Sizes are in metres.
STOREY, CEILING = 3.0, 2.6  # from floor to floor, and from floor to ceiling
WALL = 0.16  # thickness of the walls between rooms
HALF_CORRIDOR = 1.0
DOOR_WIDTH, DOOR_HEIGHT = 1.0, 2.05
LANDING, FLIGHT, TREADS = 1.0, 2.24, 8  # depth of the landings, run and treads of each of the two flights
STAIR_HALF = 1.3  # half the width of the stairs
STAIR_LENGTH = LANDING + FLIGHT + 1.25
LANE = 0.7  # of the walk from the middle of the stairs
ASIDE = 1.35  # distance of the walk round a room from the walls
VIEWS_PER_ROOM = 28
TWO_STOREYS = 4  # rooms from which on there are two
EYE = 1.5  # height of the cameras
STEP, TURN = 0.7, 0.5  # metres, and radians, that make one step of the walk
LONGEST = 1.3  # steps from one view to the next, at most
SPACING, WINDOW, GAZE_WINDOW = 0.05, 10, 16  # of the points on the walk; points on either side that smooth it
INTO = np.diag([1.0, 1.0, 1.0]), np.diag([-1.0, 1.0, -1.0])  # rotations of rooms beyond the corridor and before it
TURNS = (  # rotations of a wall's frame, whose room is at z < 0: far, right, near, left
    np.eye(3),
    np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]),
    np.diag([-1.0, 1.0, -1.0]),
    np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]]),
)
CLEARANCE = 0.35  # between furniture and the walk
TRIES = 8  # places at which a piece of furniture is tried
Maker = Callable[[Palette], Shapes]


@dataclass(frozen=True)
class RoomPlan:
    """Position and size of one room."""

    storey: int
    width: float
    depth: float
    door: float  # x of the door's middle in the room's frame
    at: Array  # [3] world position of its frame
    rotation: Array  # [3,3] of its frame

    def to_world(self, points: Array) -> Array:
        """Move points ``[n,3]`` from the room's frame into the world."""
        return points * np.diag(self.rotation) + self.at


@dataclass(frozen=True)
class FloorPlan:
    """Rooms of a building."""

    rooms: tuple[RoomPlan, ...]  # in the order of the walk
    storeys: int
    length: float  # of the corridors


def draw_plan(rng: np.random.Generator, num_views: int) -> FloorPlan:
    """Draw a random building with one room for every 28 views."""
    count = max(1, num_views // VIEWS_PER_ROOM)
    storeys = 2 if count >= TWO_STOREYS else 1
    rooms, length = [], 7.0
    for storey in range(storeys):
        ends = rng.uniform(0.0, 2.5, 2)  # of what is built on either side
        of_storey = []
        for _ in range((count + storeys - 1 - storey) // storeys):
            side = int(np.argmin(ends))
            width, depth = rng.uniform(5.0, 6.4, 2)
            door = rng.uniform(-0.5, 0.5) * (width - 3.0)
            at = np.array([ends[side] + width / 2, -STOREY * storey, (1 - 2 * side) * (HALF_CORRIDOR + WALL)])
            of_storey.append(RoomPlan(storey, width, depth, door, at, INTO[side]))
            ends[side] += width + WALL
        rooms += sorted(
            of_storey, key=lambda room: room.to_world(np.array([[room.door, 0, 0]]))[0, 0] * (1 - 2 * storey)
        )
        length = max(length, *ends)
    return FloorPlan(tuple(rooms), storeys, length)


def room_loop(room: RoomPlan) -> Array:
    """Return points ``[n,3]`` of a walk inside a room, in the room's frame: in, around the middle, and out."""
    half_x, half_z, middle = room.width / 2 - ASIDE, room.depth / 2 - ASIDE, room.depth / 2
    first = np.clip(room.door / half_x, -0.9, 0.9)  # the sine of the angle at which it begins
    way = -1.0 if first > 0 else 1.0  # the longer way comes first
    angles = np.linspace(0, 2 * np.pi, 33)
    start = np.array([first, -np.sqrt(1 - first * first)])
    x = start[0] * cos(angles) - way * start[1] * sin(angles)
    z = start[1] * cos(angles) + way * start[0] * sin(angles)
    ring = np.stack([half_x * x, np.zeros_like(x), middle + half_z * z], 1)
    door = np.array([[room.door, 0, 0.0], [room.door, 0, 0.6]])
    return np.concatenate([door, ring, door[::-1]])


def _stairs(length: float) -> Array:
    """List points ``[n,3]`` of the walk from the lower corridor's end to that of the upper one."""
    foot, top = length + WALL + LANDING, length + WALL + LANDING + FLIGHT
    turn = np.linspace(0, np.pi, 9)
    landing = np.stack([top + 0.55 * sin(turn), np.full(9, -STOREY / 2), LANE * cos(turn)], 1)
    start, arrival = (foot - 0.5, 0, LANE), (foot - 0.5, -STOREY, -LANE)
    points = [(length - 0.8, 0, 0), start, (foot, 0, LANE), *landing, (foot, -STOREY, -LANE), arrival]
    return np.array([*points, (length - 0.8, -STOREY, 0)])


def _way_points(plan: FloorPlan) -> tuple[Array, Array]:
    """List the walk's points ``[n,3]`` on the floor, and for each the middle of its room, or nan."""
    first = plan.rooms[0]
    door = first.to_world(np.array([[first.door, 0, 0]]))[0]
    parts, middles = [np.array([[max(door[0] - 1.8, 0.6), 0.0, 0.0]])], [np.full((1, 3), np.nan)]
    for i, room in enumerate(plan.rooms):
        if room.storey > plan.rooms[i - 1].storey and i:
            parts.append(_stairs(plan.length))
            middles.append(np.full((len(parts[-1]), 3), np.nan))
        loop = room.to_world(room_loop(room))
        outside = np.array([[loop[0, 0], loop[0, 1], 0.0]])
        inside = np.full((len(loop), 3), np.nan)
        inside[3:-2] = room.to_world(np.array([[0, 0, room.depth / 2]]))
        last = i == len(plan.rooms) - 1
        parts += [outside, loop[:-2] if last else loop, *([] if last else [outside])]
        middles += [np.full((1, 3), np.nan), inside[:-2] if last else inside, *([] if last else [inside[:1]])]
    return np.concatenate(parts), np.concatenate(middles)


def _smooth(values: Array, window: int) -> Array:
    """Average ``[n,3]`` over ``window`` neighbours on either side."""
    padded = np.pad(values, ((window, window), (0, 0)), mode="edge")
    return np.stack([padded[i : i + len(values)] for i in range(2 * window + 1)]).mean(0)


def _unit(vectors: Array) -> Array:
    return vectors / np.sqrt((vectors * vectors).sum(1, keepdims=True))


def _along(at: Array, places: Array, values: Array) -> Array:
    return np.stack([np.interp(at, places, column) for column in values.T], 1)


def draw_walk(rng: np.random.Generator, plan: FloorPlan, num_views: int) -> Callable[[float], tuple[Array, Array]]:
    """Draw a walk through the rooms: a function from 0 to 1 to position and viewing direction."""
    points, middles = _way_points(plan)
    lengths = np.concatenate([[0.0], np.cumsum([norm(b - a) for a, b in itertools.pairwise(points)])])
    at = np.arange(0.0, lengths[-1], SPACING)
    floor = _along(at, lengths, points)
    middle = middles[np.searchsorted(lengths, at, side="right") - 1]
    sway = 0.06 * sin(at / 1.7 + rng.uniform(0, 6.28))
    place = _smooth(floor, WINDOW) - np.array([0, EYE + rng.uniform(-0.1, 0.1), 0])
    place[:, 1] += sway * 0.5
    ahead = np.gradient(_smooth(place, WINDOW), axis=0)
    ahead[:, 1] *= 0.6  # the stairs are steep
    ahead = _unit(ahead)
    across = np.stack([-ahead[:, 2], np.zeros(len(at)), ahead[:, 0]], 1)
    glance = 0.3 * sin(at / 2.5 + rng.uniform(0, 6.28))
    inside = ~np.isnan(middle[:, 0])
    inward = _unit(np.where(inside[:, None], middle - floor, 1.0)) * inside[:, None]
    strength = 0.9 + 0.3 * sin(at / 2.5 + rng.uniform(0, 6.28))
    gaze = ahead + across * (glance * ~inside)[:, None] + inward * strength[:, None]
    gaze[:, 1] += 0.16 + 0.06 * sin(at / 2.0 + rng.uniform(0, 6.28))
    gaze = _unit(_smooth(_unit(gaze), GAZE_WINDOW))
    moved, turned = np.diff(place, axis=0) / STEP, np.diff(gaze, axis=0) / TURN
    moves = np.sqrt((moved * moved + turned * turned).sum(1))
    steps = np.concatenate([[0.0], np.cumsum(moves)])
    reach = min(float(steps[-1]), LONGEST * (num_views - 1))

    def walk(s: float) -> tuple[Array, Array]:
        now = np.array([s * reach])
        return _along(now, steps, place)[0], _unit(_along(now, steps, gaze))[0]

    return walk


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
    """Build a plant narrow enough for a corridor."""
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
    """Place furniture along the walls and in the middle, clear of the walk; in the room's frame."""
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
    """Place pieces against the walls of a space ``[2,3]``, clear of each other and of the walk.

    ``turns`` are the walls, one of which is drawn in each try. A piece that fits nowhere is left out.
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
