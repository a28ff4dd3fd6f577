"""Rooms, corridors and stairs of a synthetic building, each a stage of its own; y points down. Sizes are in metres."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmerge.research.generate.floor_plan import (
    CEILING,
    DOOR_HEIGHT,
    DOOR_WIDTH,
    FLIGHT,
    HALF_CORRIDOR,
    LANDING,
    STAIR_HALF,
    STAIR_LENGTH,
    STOREY,
    TREADS,
    TURNS,
    WALL,
    FloorPlan,
    RoomPlan,
    furnish,
    sideboard,
    small_plant,
    stand,
)
from gsmerge.research.generate.objects import Shapes, picture, window
from gsmerge.research.generate.photograph import Light, Portal, Stage, Zone
from gsmerge.research.generate.shapes import (
    LYING,
    Array,
    Material,
    Shape,
    ball,
    box,
    norm,
    place,
    quad,
    rod,
)
from gsmerge.research.generate.textures import Palette, color, mix, noise

SHARED = ("label", "printed", "spines", "foliage", "crown", "bark", "sky", "gradient", "granite", "marble")
OVERLAP = 0.01  # by which walls, floors and ceilings reach into one another, so that no ray passes between them
FRAME = 0.06  # width of a door's frame
PROUD = 0.02  # by which it stands out from the wall
Opening = tuple[float, float, float]  # of a wall: left, right, height


@dataclass(frozen=True)
class Wall:
    """A wall in its own frame: the room is at z < 0."""

    at: Array  # [3] of the middle of its foot
    turn: int  # index into TURNS
    half: float  # of its length
    openings: tuple[Opening, ...] = ()
    outside: bool = False  # whether it may have windows


def build_building(rng: np.random.Generator, size: int, plan: FloorPlan) -> tuple[list[Zone], list[Portal]]:
    """Build all rooms, corridors and stairs with their colours and furniture, and the openings between them.

    ``size`` is the size of textures. The order is corridors, stairs if there are any, and rooms.
    """
    common = Palette(rng, size)
    shared: dict[str, list[int]] = {kind: [] for kind in SHARED}

    def palette() -> Palette:
        return Palette(rng, size, common.textures, dict(shared))

    lobby = palette()
    zones = [_corridor(lobby, plan, storey) for storey in range(plan.storeys)]
    portals = []
    if plan.storeys > 1:
        zones.append(_stairs(lobby, plan))
        for storey in range(plan.storeys):
            low = np.array([plan.length, -STOREY * storey - DOOR_HEIGHT, -HALF_CORRIDOR + FRAME])
            high = np.array([plan.length + WALL, -STOREY * storey, HALF_CORRIDOR - FRAME])
            portals.append(_portal((storey, plan.storeys), low, high))
    for room in plan.rooms:
        portals.append(_portal((room.storey, len(zones)), *_sort(room.to_world(_door_box(room)))))
        zones.append(_room(palette(), room))
    return [replace(zone, stage=replace(zone.stage, textures=tuple(common.textures))) for zone in zones], portals


def _door_box(room: RoomPlan) -> Array:
    x = room.door + np.array([-0.5, 0.5]) * DOOR_WIDTH
    return np.stack([x, [-DOOR_HEIGHT, 0.0], [-WALL, 0.0]], 1)


def _sort(corners: Array) -> tuple[Array, Array]:
    return corners.min(0), corners.max(0)


def _portal(zones: tuple[int, int], low: Array, high: Array) -> Portal:
    """Make the opening between two zones from a box in the wall; the frame of the opening lies in that box."""
    around = FRAME + 2 * PROUD
    return Portal(zones, low - around, high + around)


def _panel(x: tuple[float, float], y: tuple[float, float], paper: Material) -> Shape:
    """Build a part of a wall between two x and two heights; its texture continues over the parts."""
    centre = np.array([(x[0] + x[1]) / 2, -(y[0] + y[1]) / 2, 0.0])
    shift = paper.shift[0] + centre[0] * paper.repeat, paper.shift[1] + centre[1] * paper.repeat
    half = (x[1] - x[0]) / 2 + OVERLAP, (y[1] - y[0]) / 2 + OVERLAP
    return replace(quad(centre, half, replace(paper, shift=shift)), shell=True)


def _wall(wall: Wall, height: float, paper: Material, skirting: Material | None) -> Shapes:
    """Build a wall with its openings, and with a skirting unless it stands on another wall."""
    out, x = [], -wall.half
    for left, right, top in (*sorted(wall.openings), (wall.half, wall.half, height)):
        if left > x:
            out.append(_panel((x, left), (0, height), paper))
            out += [box((x, -0.09, -0.015), (left, 0, 0), skirting)] if skirting is not None else []
        if top < height:
            out.append(_panel((left, right), (top, height), paper))
        x = right
    return place(out, wall.at, rotation=TURNS[wall.turn])


def _frame(opening: Opening, material: Material) -> Shapes:
    """Build the frame and the threshold of an opening in a wall, whose room lies at z < 0."""
    left, right, top = opening
    front, back = -PROUD, WALL + PROUD
    out = [box((x, -top - FRAME, front), (x + FRAME, 0, back), material) for x in (left - FRAME, right)]
    out.append(box((left, -top - FRAME, front), (right, -top, back), material))
    return [*out, box((left - FRAME, -0.012, front), (right + FRAME, 0.02, back), material)]


def _hang(pal: Palette, wall: Wall, height: float) -> Shapes:
    """Hang pictures on an inner wall, or windows on an outer wall, between its openings."""
    rng, out = pal.rng, []
    x = -wall.half + rng.uniform(0.3, 0.8)
    while True:
        wide = rng.uniform(0.5, 1.3) if wall.outside else rng.uniform(0.35, 1.0)
        if x + wide > wall.half - 0.25:
            break
        if all(x + wide < left - 0.2 or x > right + 0.2 for left, right, _ in wall.openings):
            if wall.outside and rng.random() < 0.65:
                thing, foot = window(pal, wide, rng.uniform(1.0, 1.3), pal.material("sky", "crown"), glow=True), 0.9
            else:
                thing, foot = picture(pal, wide, min(wide * rng.uniform(0.7, 1.4), 0.9)), rng.uniform(1.05, 1.35)
            out += place(thing, (x + wide / 2, -foot, 0))
        x += wide + rng.uniform(0.2, 0.9)
    return place(out, wall.at, rotation=TURNS[wall.turn])


def _ceiling(pal: Palette) -> Material:
    """Make pale paint."""
    paint = color(pal.rng, strength=(0, 0.12), light=(0.8, 0.97))
    pal.textures.append(mix(0.97 * paint, paint, noise(pal.rng, pal.size)))
    return Material(len(pal.textures) - 1, 0.4)


def _light(rng: np.random.Generator, lamp_at: Array | None) -> Light:
    """Draw a lamp's light from above, warm or cool; rooms are about equally bright."""
    towards = np.array([rng.uniform(-0.6, 0.6), -1.0, rng.uniform(-0.6, 0.6)])
    key = (
        rng.uniform(1.2, 2.4)
        * (1.0 if lamp_at is not None else 0.7)
        * (0.75 + 0.25 * color(rng, strength=(0, 0.5), light=(0.9, 1)))
    )
    ambient = rng.uniform(0.7, 1.0) * (0.8 + 0.2 * color(rng, strength=(0, 0.4), light=(0.9, 1)))
    return Light(towards / norm(towards), lamp_at, key, ambient, rng.uniform(0.05, 0.2))


def _box_of(low: Array, high: Array, floor: Material, ceiling: Material) -> Shapes:
    """Build floor and ceiling between two corners."""
    x, _, z = (low + high) / 2
    wide, _, deep = (high - low) / 2 + OVERLAP
    out = [quad((x, y, z), (wide, deep), look, LYING) for y, look in ((high[1], floor), (low[1], ceiling))]
    return [replace(shape, shell=True) for shape in out]


def _zone(shapes: Shapes, light: Light, low: Array, high: Array) -> Zone:
    middle = (low + high) / 2
    return Zone(Stage(tuple(shapes), (), light, np.array([middle[0], high[1], middle[2]])), low, high)


PAPERS = ("plain", "plain", "plaster", "bricks", "cloth", "tiles", "wood")
FLOORS = ("wood", "wood", "tiles", "carpet", "granite", "plaster")


def _room(pal: Palette, plan: RoomPlan) -> Zone:
    """Build a furnished room."""
    rng, w, d = pal.rng, plan.width / 2, plan.depth
    papers = [pal.material(*PAPERS, repeat=rng.uniform(0.3, 0.8), gloss=0.0) for _ in range(2)]
    floor = pal.material(*FLOORS, repeat=rng.uniform(0.3, 0.8))
    skirting = pal.material("plain", "wood")
    door = (-plan.door - DOOR_WIDTH / 2, -plan.door + DOOR_WIDTH / 2, DOOR_HEIGHT)
    walls = [
        Wall(np.array([0, 0, d]), 0, w, outside=True),
        Wall(np.array([w, 0, d / 2]), 1, d / 2),
        Wall(np.zeros(3), 2, w, (door,)),
        Wall(np.array([-w, 0, d / 2]), 3, d / 2),
    ]
    low, high = np.array([-w, -CEILING, 0]), np.array([w, 0, d])
    shapes = _box_of(low, high, floor, _ceiling(pal))
    for k, wall in enumerate(walls):
        shapes += _wall(wall, CEILING, papers[k % 2], skirting) + _hang(pal, wall, CEILING)
    shapes += place(_frame(door, skirting), rotation=TURNS[2])
    lamp_at = np.array([rng.uniform(-0.2, 0.2) * w, -CEILING + 0.35, d * rng.uniform(0.4, 0.6)])
    shade = ball(lamp_at, np.full(3, rng.uniform(0.1, 0.18)), pal.material("plain", gloss=0.0))
    cord = rod(lamp_at, lamp_at * [1, 0, 1] + [0, -CEILING, 0], 0.008, skirting)
    shapes += [replace(shade, shell=True, glow=True), replace(cord, shell=True)]
    shapes += furnish(pal, plan)
    light = _light(rng, plan.to_world(lamp_at[None])[0])
    low, high = _sort(plan.to_world(np.stack([low, high])))
    return _zone(place(shapes, plan.at, rotation=plan.rotation), light, low, high)


def _corridor(pal: Palette, plan: FloorPlan, storey: int) -> Zone:
    """Build a corridor with the openings of its doors, pictures, lights and a few things at the walls."""
    rng, c, length = pal.rng, HALF_CORRIDOR, plan.length
    paper = pal.material("plain", "plaster", repeat=rng.uniform(0.3, 0.6), gloss=0.0)
    floor, skirting = pal.material(*FLOORS, repeat=rng.uniform(0.3, 0.8)), pal.material("plain", "wood")
    low, high = np.array([0, -CEILING, -c]), np.array([length, 0, c])
    shapes = _box_of(low, high, floor, _ceiling(pal))
    doors: dict[int, list[Opening]] = {0: [], 2: []}
    walk = [np.linspace([0, 0], [length, 0], round(length / 0.1))]
    for room in plan.rooms:
        if room.storey == storey:
            turn = 0 if room.at[2] > 0 else 2
            left, right = _sort(room.to_world(_door_box(room)))
            span = np.sort((np.array([left[0], right[0]]) - length / 2) * (1 - turn))
            doors[turn].append((float(span[0]), float(span[1]), DOOR_HEIGHT))
            walk += [np.linspace([x, 0], [x, room.at[2]], 12) for x in (left[0] + 0.2, right[0] - 0.2)]
    passage = (-c + FRAME, c - FRAME, DOOR_HEIGHT)
    stairs = plan.storeys > 1
    walls = [Wall(np.array([length / 2, 0, s * c]), k, length / 2, tuple(doors[k])) for k, s in ((0, 1), (2, -1))]
    walls.append(Wall(np.array([length, 0, 0]), 1, c, (passage,) if stairs else (), outside=not stairs))
    walls.append(Wall(np.zeros(3), 3, c, outside=True))
    for wall in walls:
        shapes += _wall(wall, CEILING, paper, skirting) + _hang(pal, wall, CEILING)
    if stairs:
        shapes += place(_frame(passage, skirting), walls[2].at, rotation=TURNS[1])
    pieces = [(small_plant, sideboard)[rng.integers(2)](pal) for _ in range(round(length / 3))]
    shapes += stand(rng, pieces, np.stack([low, high]), (0, 2), np.concatenate(walk))
    pane = _ceiling(pal)
    for x in np.arange(1.5, length, 3.0):
        lit = box((x - 0.5, -CEILING, -0.12), (x + 0.5, 0.04 - CEILING, 0.12), pane)
        shapes.append(replace(lit, shell=True, glow=True))
    up = np.array([0, -STOREY * storey, 0])
    return _zone(place(shapes, up), _light(rng, None), low + up, high + up)


def _stairs(pal: Palette, plan: FloorPlan) -> Zone:
    """Build two flights of stairs with a landing between them, and the space around them."""
    rng, half, start = pal.rng, STAIR_HALF, plan.length + WALL
    tall, end, foot = STOREY + CEILING, start + STAIR_LENGTH, start + LANDING
    paper = pal.material("plain", "plaster", "bricks", repeat=rng.uniform(0.3, 0.6), gloss=0.0)
    floor, tread, rail = (
        pal.material(*FLOORS, repeat=0.5),
        pal.material("wood", "granite"),
        pal.material("wood", "plain"),
    )
    low, high = np.array([start, -tall, -half]), np.array([end, 0, half])
    shapes = _box_of(low, high, floor, _ceiling(pal))
    passage = (-HALF_CORRIDOR + FRAME, HALF_CORRIDOR - FRAME, DOOR_HEIGHT)
    middle = (start + end) / 2
    for foot_y, height in ((0.0, STOREY), (-STOREY, CEILING)):
        walls = [Wall(np.array([start, foot_y, 0]), 3, half, (passage,))]
        walls += [Wall(np.array([end, foot_y, 0]), 1, half, outside=True)]
        walls += [Wall(np.array([middle, foot_y, s * half]), k, STAIR_LENGTH / 2) for k, s in ((0, 1), (2, -1))]
        for wall in walls:
            shapes += _wall(wall, height, paper, None if foot_y else rail)
            shapes += _hang(pal, wall, height) if wall.turn != 1 and foot_y else []
    rise, run, top = STOREY / 2 / TREADS, FLIGHT / TREADS, foot + FLIGHT
    for x, y, turn in ((foot + 0.9, -1.5, 0), (end, -2.3, 1), (top - 0.1, -2.3, 2)):  # along the flights
        at = (x, y, half * (1, 0, -1)[turn])
        shapes += place(picture(pal, 1.2, rng.uniform(0.9, 1.2)), at, rotation=TURNS[turn])
    for k in range(TREADS):
        y, x = -rise * (k + 1), foot + run * k
        shapes.append(box((x, y, 0.08), (x + run + 0.02, min(0.0, y + 0.36), half), tread))
        x = top - run * (k + 1)
        shapes.append(box((x - 0.02, y - STOREY / 2, -half), (x + run, y - STOREY / 2 + 0.36, -0.08), tread))
    shapes.append(box((top, -STOREY / 2, -half), (end, 0.2 - STOREY / 2, half), tread))
    shapes.append(box((start - OVERLAP, -STOREY, -half), (foot, 0.25 - STOREY, half), tread))
    ramp = [np.array([x, y, 0.0]) for x, y in ((foot, 0.0), (top, -STOREY / 2), (foot, -STOREY))]
    shapes += _railing(ramp[0], ramp[1], rail) + _railing(ramp[1], ramp[2], rail)
    shapes += _railing(ramp[2], ramp[2] + [0, 0, half], rail)
    return _zone(shapes, _light(rng, None), low, high)


def _railing(start: Array, end: Array, material: Material) -> Shapes:
    """Build a handrail on balusters between two points of the floor."""
    up = np.array([0, -0.9, 0])
    count = max(2, round(norm(end - start) / 0.2))
    feet = [start + (end - start) * (k / count) for k in range(count + 1)]
    return [rod(start + up, end + up, 0.025, material), *(rod(foot, foot + up, 0.01, material) for foot in feet)]
