"""Styles of scenes. Each function takes a palette and returns a stage; sizes are in metres, y points down."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gsmerge.research.generate import objects
from gsmerge.research.generate.objects import Shapes
from gsmerge.research.generate.photograph import Light, Stage
from gsmerge.research.generate.shapes import (
    LYING,
    Array,
    Shape,
    axis_rotation,
    ball,
    blob,
    box,
    column,
    place,
    quad,
    rod,
    sheet,
)
from gsmerge.research.generate.textures import Palette, color

FACING = axis_rotation(1, np.pi / 2)  # rotates -z to -x


def _shell(shapes: list[Shape], *, glow: bool = False) -> list[Shape]:
    return [replace(s, shell=True, glow=glow) for s in shapes]


def light(rng: np.random.Generator, lamp_at: Array | None) -> Light:
    """Sun or lamp from above and somewhere in front, warm or cool."""
    side, up = rng.uniform(-1.2, 1.2), rng.uniform(0.5, 1.3)
    towards = np.array([np.sin(side), -up, -np.cos(side)])
    key = rng.uniform(0.8, 4.0) * (1 + (0.4 * color(rng, strength=(0, 0.4), light=(0.9, 1)) - 0.4))
    ambient = rng.uniform(0.5, 1.1) * (1 + (0.3 * color(rng, hue=(0.5, 0.7), strength=(0, 0.3), light=(0.9, 1)) - 0.3))
    return Light(towards / np.linalg.norm(towards), lamp_at, key, ambient, rng.uniform(0.02, 0.2))


def _walls(pal: Palette, width: float, depth: float, height: float) -> Shapes:
    """Floor, ceiling and four walls about the origin, with pictures, a window, a skirting and a pipe."""
    rng = pal.rng
    kinds = ("plain", "plain", "plain", "plaster", "bricks", "cloth", "tiles", "wood")
    papers = [pal.material(*kinds, repeat=rng.uniform(0.3, 0.8), gloss=0.0) for _ in range(2)]
    floor = pal.material("wood", "wood", "tiles", "carpet", "granite", "plaster", "plain", repeat=rng.uniform(0.3, 0.8))
    w, d, h = width / 2, depth / 2, height
    out = [quad((0, 0, 0), (w, d), floor, LYING), quad((0, -h, 0), (w, d), pal.material("plain", gloss=0.0), LYING)]
    out += [quad((0, -h / 2, z), (w, h / 2), papers[0]) for z in (d, -d)]
    out += [quad((x, -h / 2, 0), (d, h / 2), papers[k], FACING) for x, k in ((-w, 1), (w, rng.integers(2)))]
    out = _shell(out)
    skirting = pal.material("plain", "wood")
    out.append(box((-w, -0.09, d - 0.02), (w, 0, d), skirting))
    out += [box((x - 0.02, -0.09, -d), (x + 0.02, 0, d), skirting) for x in (-w, w)]
    for half, spot, facing in ((w, (0, 0, d), np.eye(3)), (d, (-w, 0, 0), FACING.T), (d, (w, 0, 0), FACING)):
        out += place(_wall_objects(pal, half, h), spot, rotation=facing)
    pipe = rng.uniform(-w, w)
    return [*out, rod((pipe, 0, d - 0.06), (pipe, -h, d - 0.06), rng.uniform(0.01, 0.04), skirting)]


def _wall_objects(pal: Palette, half: float, height: float) -> Shapes:
    """Pictures, a window, a shelf or a door, side by side on the plane z = 0."""
    rng, out, x = pal.rng, [], -half + 0.3
    while x < half - 0.5:
        wide, kind = rng.uniform(0.3, 1.2), rng.integers(0, 5)
        at = (x + wide / 2, 0.0, 0.0)
        if kind <= 1:
            frame = objects.picture(pal, wide, min(wide * rng.uniform(0.6, 1.4), 0.45 * height))
            out += place(frame, (at[0], -rng.uniform(0.35, 0.5) * height, 0))
        elif kind == 2:
            pane = objects.window(pal, wide, rng.uniform(0.35, 0.55) * height, pal.material("sky", "crown"), glow=True)
            out += place(pane, (at[0], -0.35 * height, 0))
        elif kind == 3:
            out += place(objects.shelf(pal, wide, rng.uniform(0.4, 0.85) * height), at)
        else:
            out += place([box((-0.45, -0.8 * height, -0.04), (0.45, 0, 0), pal.material("wood", "plain", "cloth"))], at)
        x += wide + rng.uniform(0.15, 0.8)
    return out


def room(pal: Palette) -> Stage:
    """A furnished room: walls with pictures and shelves, tables, chairs, plants, lamps, cables."""
    rng = pal.rng
    w, d, h = rng.uniform(4.0, 7.0), rng.uniform(4.5, 7.0), rng.uniform(2.3, 3.2)
    shapes = _walls(pal, w, d, h)
    spots = [(x * w, z * d) for x in (-0.3, 0.0, 0.3) for z in (0.05, 0.32)]
    for i in rng.permutation(len(spots))[: rng.integers(3, 6)]:
        at = spots[i][0] + rng.normal(0, 0.15), 0.0, spots[i][1] + rng.normal(0, 0.15)
        shapes += place(_furniture(pal), at, yaw=rng.normal(0, 0.5))
    pot = objects.plant(pal, rng.uniform(0.6, 1.6), int(rng.integers(20, 90)))
    shapes += place(pot, (rng.uniform(-0.4, 0.4) * w, 0, 0.4 * d))
    shapes += place(objects.lamp(pal, rng.uniform(1.1, 1.8)), (rng.uniform(-0.4, 0.4) * w, 0, rng.uniform(0, 0.4) * d))
    a, b = (np.array([x * w, -h * rng.uniform(0.75, 1), rng.uniform(0, 0.45) * d]) for x in (-0.5, 0.5))
    shapes += objects.wire(pal, a, b, rng.uniform(0.05, 0.4), rng.uniform(0.003, 0.008))
    focus = np.array([rng.normal(0, 0.2), -rng.uniform(0.4, 1.0), rng.uniform(0.15, 0.35) * d])
    lamp_at = np.array([rng.uniform(-0.3, 0.3) * w, -h + 0.1, rng.uniform(-0.3, 0.2) * d])
    reach = focus[2] + 0.42 * d
    return Stage(tuple(shapes), tuple(pal.textures), light(rng, lamp_at), focus, (0.6 * reach, reach), (0.9, 1.8), 35)


def _furniture(pal: Palette) -> Shapes:
    rng, kind = pal.rng, pal.rng.integers(0, 4)
    if kind == 0:
        return objects.chair(pal)
    if kind == 1:
        soft = pal.material("cloth", "carpet", repeat=0.9)
        seat = [box((-0.9, -0.42, -0.4), (0.9, 0, 0.4), soft), box((-0.9, -0.85, 0.25), (0.9, 0, 0.45), soft)]
        pillow = pal.material("cloth", "carpet", "label")
        return seat + [ball((x, -0.55, 0.1), (0.22, 0.18, 0.12), pillow) for x in rng.uniform(-0.7, 0.7, 2)]
    width, depth, height = rng.uniform(0.7, 1.5), rng.uniform(0.5, 0.9), rng.uniform(0.4, 0.8)
    top = objects.clutter(pal, int(rng.integers(2, 7)), (0.3 * width, 0.3 * depth), height)
    out = objects.table(pal, width, depth, height) + top
    return out + (place(objects.chair(pal), (0, 0, -0.7), yaw=np.pi) if rng.random() < 0.5 else [])


def desk(pal: Palette) -> Stage:
    """Many small objects on a table from near, the room behind them."""
    rng = pal.rng
    w, d, h = rng.uniform(3.0, 5.0), rng.uniform(3.0, 5.0), rng.uniform(2.3, 3.0)
    height, width, depth = rng.uniform(0.6, 0.8), rng.uniform(1.2, 1.9), rng.uniform(0.7, 1.0)
    back = rng.uniform(0.5, 0.45 * d)
    shapes = _walls(pal, w, d, h)
    top = objects.table(pal, width, depth, height)
    top += objects.clutter(pal, int(rng.integers(5, 14)), (0.4 * width, 0.38 * depth), height)
    if rng.random() < 0.6:
        top += place(objects.laptop(pal), (rng.normal(0, 0.2), -height, 0.25 * depth), yaw=rng.normal(0, 0.4))
    if rng.random() < 0.5:
        top += place(objects.plant(pal, 0.4, 40), (rng.uniform(-0.4, 0.4) * width, -height, 0.3 * depth))
    shapes += place(top, (0, 0, d / 2 - back))
    focus = np.array([rng.normal(0, 0.1), -height - rng.uniform(0.02, 0.15), d / 2 - back])
    lamp_at = np.array([rng.uniform(-0.6, 0.6), -h + 0.3, d / 2 - back - rng.uniform(0, 0.6)])
    lights = light(rng, lamp_at)
    return Stage(tuple(shapes), tuple(pal.textures), lights, focus, (0.6, 1.3), (height + 0.2, height + 0.8), 60)


def _outside(pal: Palette, kinds: tuple[str, ...], size: float) -> Shapes:
    """Slightly uneven ground, trees far away, sky all around."""
    rng = pal.rng
    ground = pal.material(*kinds, repeat=rng.uniform(0.3, 0.8), gloss=0.0)
    under = quad((0, 0.25, 0), (40 * size, 40 * size), pal.material(*kinds, repeat=0.2, gloss=0.0), LYING)
    hills = sheet((0, 0.0, 0), (2.5 * size, 2.5 * size), ground, rng, rng.uniform(0.0, 0.06), length=0.6 * size)
    dome = ball((0, 0, 0), (30 * size, 18 * size, 30 * size), pal.material("sky", gloss=0.0))
    crowns, far = [pal.material("crown", repeat=2 / size, gloss=0.0) for _ in range(2)], []
    for angle in rng.uniform(0, 2 * np.pi, rng.integers(0, 25)):
        away, tall = size * rng.uniform(3, 12), size * rng.uniform(0.2, 0.9)
        spot = away * np.sin(angle), -0.4 * tall, away * np.cos(angle)
        far.append(blob(spot, (tall * rng.uniform(0.5, 2), tall, tall), crowns[rng.integers(2)], rng, 0.5))
    return [*_shell([under, hills, *far]), *_shell([dome], glow=True)]


def garden(pal: Palette) -> Stage:
    """Bushes, plants and trees, near and far, behind a fence or wires."""
    rng = pal.rng
    shapes = _outside(pal, ("grass", "gravel", "grass", "plaster"), 6.0)
    for _ in range(rng.integers(2, 5)):
        at = rng.uniform(-1.6, 1.6), 0, rng.uniform(-0.3, 1.2)
        shapes += place(objects.bush(pal, rng.uniform(0.25, 0.6), int(rng.integers(200, 500))), at)
    for _ in range(rng.integers(1, 4)):
        pot = objects.plant(pal, rng.uniform(0.4, 1.0), int(rng.integers(30, 120)))
        shapes += place(pot, (rng.uniform(-1.2, 1.2), 0, rng.uniform(-0.8, 0.4)))
    for _ in range(rng.integers(1, 5)):
        one = objects.tree(pal, rng.uniform(2.0, 4.5), int(rng.integers(30, 120)))
        shapes += place(one, (rng.uniform(-4, 4), 0, rng.uniform(2, 6)))
    if rng.random() < 0.6:
        shapes += place(objects.fence(pal, rng.uniform(2, 6), rng.uniform(0.6, 1.2)), (0, 0, rng.uniform(1.2, 2.5)))
    if rng.random() < 0.6:
        wall = pal.material("bricks", "plaster", "wood", repeat=0.4)
        shapes.append(box((-6, -rng.uniform(1, 3), 6.5), (6, 0, 7), wall))
    poles = [np.array([x, -2.4, 2.0]) for x in (-2.5, 2.5)]
    shapes += [rod((*pole[:1], 0, pole[2]), pole, 0.025, pal.material("bark", "plain")) for pole in poles]
    shapes += objects.wire(pal, poles[0], poles[1], rng.uniform(0.1, 0.4), rng.uniform(0.004, 0.012))
    focus = np.array([rng.normal(0, 0.2), -rng.uniform(0.2, 0.6), rng.uniform(0.0, 0.6)])
    return Stage(tuple(shapes), tuple(pal.textures), light(rng, None), focus, (1.4, 3.0), (0.5, 1.6), 50)


def facade(pal: Palette) -> Stage:
    """The front of a building: rows of windows, cornices, columns, steps, a door; trees next to it."""
    rng = pal.rng
    shapes = _outside(pal, ("gravel", "tiles", "grass", "plaster"), 10.0)
    w, h, z = rng.uniform(6, 12), rng.uniform(4, 8), 2.0
    wall = pal.material("bricks", "plaster", "plaster", "plain", repeat=0.35)
    trim = pal.material("plaster", "plain", "granite", repeat=0.5)
    shapes.append(box((-w / 2, -h, z), (w / 2, 0, z + 3), wall))
    floors, columns = int(rng.integers(2, 4)), int(rng.integers(3, 7))
    pane, pitch, storey = pal.material("gradient", "sky", gloss=0.9), w / columns, h / floors
    for i in range(floors):
        shapes.append(box((-w / 2 - 0.1, -storey * (i + 1), z - 0.14), (w / 2 + 0.1, 0.12 - storey * (i + 1), z), trim))
        for k in range(columns):
            x = (k + 0.5) * pitch - w / 2
            if i == 0 and abs(x) < 0.6 * pitch:
                continue
            wide, sill = 0.45 * pitch, -storey * (i + 0.25)
            shapes += place(objects.window(pal, wide, 0.55 * storey, pane, glow=False), (x, sill, z - 0.01))
            shapes.append(box((x - 0.6 * wide, sill, z - 0.12), (x + 0.6 * wide, 0.08 + sill, z), trim))
    count, porch = int(rng.integers(2, 6)), rng.uniform(1.0, 1.8)
    shapes += place(objects.steps(pal, 2.4 * porch, count), (0, 0, z - 0.3 * (count + 1)))
    door = pal.material("wood", "plain", "printed")
    shapes.append(box((-0.5 * porch, -0.75 * storey, z - 0.03), (0.5 * porch, 0, z), door))
    for x in (-porch, porch, -0.75 * porch, 0.75 * porch)[: 2 * int(rng.integers(0, 3))]:
        shapes.append(column((x, 0, z - 0.4), 0.9 * storey, 0.14, trim, top=0.85))
        shapes.append(box((x - 0.2, -0.9 * storey - 0.1, z - 0.6), (x + 0.2, -0.9 * storey, z - 0.2), trim))
    roof = pal.material("tiles", "bricks", repeat=0.5)
    shapes += [box((-w / 2 - 0.3, -h - 0.25, z - 0.3), (w / 2 + 0.3, -h, z + 3), trim)]
    shapes += [column((x, -h, z + 0.8), rng.uniform(1, 2), 0.9, roof, top=0.02) for x in (-w / 2 + 0.9, w / 2 - 0.9)]
    for x in rng.uniform(-0.7, 0.7, rng.integers(1, 4)) * w:
        green = objects.tree(pal, rng.uniform(2, 5), 60) if abs(x) > w / 2 else objects.bush(pal, 0.4, 250)
        shapes += place(green, (x, 0, z - rng.uniform(0.8, 2)))
    shapes += place(objects.fence(pal, rng.uniform(2, 5), 0.9), (rng.uniform(-4, 4), 0, z - 2.2))
    focus = np.array([rng.normal(0, 0.5), -rng.uniform(0.25, 0.5) * h, z])
    return Stage(tuple(shapes), tuple(pal.textures), light(rng, None), focus, (0.7 * w, 1.2 * w), (0.8, 2.5), 45)


def single(pal: Palette) -> Stage:
    """One object or a few on a surface, seen from near and from all sides; furniture or trees far behind."""
    rng, inside = pal.rng, pal.rng.random() < 0.6
    shapes = _walls(pal, 7.0, 7.0, 2.8) if inside else _outside(pal, ("tiles", "plaster", "gravel", "grass"), 6.0)
    for angle in rng.uniform(0, 2 * np.pi, 6):
        at = 2.7 * np.sin(angle), 0.0, 2.7 * np.cos(angle)
        shapes += place(_furniture(pal) if inside else objects.bush(pal, 0.5, 250), at, yaw=angle + np.pi)
    height = rng.uniform(0.3, 0.6)
    surface = pal.material("granite", "wood", "wood", "tiles", "cloth", "plain", "plain", "marble", repeat=1.5)
    shapes.append(column((0, 0, 0), height, rng.uniform(0.35, 0.6), surface))
    main = objects.toy(pal) if rng.random() < 0.5 else objects.small_object(pal)
    scale = rng.uniform(1.0, 1.6)
    shapes += place([_scale(s, scale) for s in main], (0, -height, 0), yaw=rng.uniform(0, 6))
    shapes += objects.clutter(pal, int(rng.integers(0, 5)), (0.22, 0.22), height)
    focus = np.array([0, -height - rng.uniform(0.06, 0.16), 0])
    lights = light(rng, np.array([0.8, -2.5, -0.8]) if inside else None)
    heights = height + 0.2, height + 0.6
    return Stage(tuple(shapes), tuple(pal.textures), lights, focus, (0.55, 1.1), heights, 180)


def _scale(shape: Shape, factor: float) -> Shape:
    x, y, z, taper = shape.size
    return replace(shape, size=(x * factor, y * factor, z * factor, taper), centre=shape.centre * factor)


STYLES: dict[str, Callable[[Palette], Stage]] = {
    "room": room,
    "desk": desk,
    "garden": garden,
    "facade": facade,
    "single": single,
}
