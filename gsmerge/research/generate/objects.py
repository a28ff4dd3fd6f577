"""Build the objects of a room, and the room itself. Objects stand at the origin; y points down, sizes are in metres."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gsmerge.method.kernels.elementary import cos, sin
from gsmerge.research.generate.photograph import Light, Room
from gsmerge.research.generate.shapes import (
    LYING,
    Array,
    Shape,
    axis_rotation,
    ball,
    blob,
    box,
    column,
    leaf,
    norm,
    place_shapes,
    quad,
    rod,
)
from gsmerge.research.generate.textures import Palette, draw_color

Shapes = list[Shape]


def build_table(pal: Palette, width: float, depth: float, height: float) -> Shapes:
    """Build a table with four legs, or a round table with one."""
    rng = pal.rng
    top = pal.material("wood", "wood", "plain", "plain", "marble", "granite", repeat=0.8)
    legs = pal.material("wood", "plain")
    thick = rng.uniform(0.02, 0.06)
    if rng.random() < 0.35:
        disc = column((0, -height + thick, 0), thick, width / 2, top)
        return [disc, rod((0, 0, 0), (0, thick - height, 0), 0.04, legs), column((0, 0, 0), 0.03, width / 4, legs)]
    out = [box((-width / 2, -height, -depth / 2), (width / 2, thick - height, depth / 2), top)]
    inset = rng.uniform(0.05, 0.12)
    radius = rng.uniform(0.012, 0.04)
    for x in (inset - width / 2, width / 2 - inset):
        out += [
            rod((x * 1.02, 0, z), (x, thick - height, z), radius, legs) for z in (inset - depth / 2, depth / 2 - inset)
        ]
    return out


def build_chair(pal: Palette) -> Shapes:
    """Build a chair with a slatted or closed back."""
    rng = pal.rng
    seat = pal.material("cloth", "wood", "plain")
    wood = pal.material("wood", "plain")
    # Width and height of the seat, and height of the back
    w = rng.uniform(0.38, 0.5)
    h = rng.uniform(0.42, 0.5)
    back = rng.uniform(0.8, 1.05)
    out = [box((-w / 2, -h, -w / 2), (w / 2, 0.05 - h, w / 2), seat)]
    for x in (-w / 2 + 0.02, w / 2 - 0.02):
        out += [rod((x, 0, 0.02 - w / 2), (x, -h, 0.02 - w / 2), 0.016, wood)]
        out += [rod((x, 0, w / 2 - 0.02), (x, -back, w / 2 + 0.03), 0.016, wood)]
    if rng.random() < 0.5:
        return [*out, box((-w / 2, -back, w / 2), (w / 2, -h - 0.12, w / 2 + 0.03), seat)]
    slats = np.linspace(-w / 2, w / 2, 6)
    out += [rod((x, -h, w / 2), (x, -back, w / 2 + 0.03), 0.008, wood) for x in slats]
    return [*out, rod((-w / 2, -back, w / 2 + 0.03), (w / 2, -back, w / 2 + 0.03), 0.02, wood)]


def build_shelf(pal: Palette, width: float, height: float) -> Shapes:
    """Build a shelf with books and small objects. The back is at z = 0."""
    rng = pal.rng
    board = pal.material("wood", "plain", "plaster", repeat=0.7)
    depth = 0.3
    out = [box((x - 0.012, -height, -depth), (x + 0.012, 0, 0), board) for x in (-width / 2, width / 2)]
    out.append(box((-width / 2, -height, -0.01), (width / 2, 0, 0), board))
    for y in np.arange(0.05, height, rng.uniform(0.28, 0.42)):
        out.append(box((-width / 2, -y - 0.02, -depth), (width / 2, -y, 0), board))
        if y + 0.3 > height:
            break
        if rng.random() < 0.7:
            left = -width / 2
            right = width / 2
            if rng.random() < 0.5:
                left, right = np.sort(rng.uniform(left, right, 2))
            top = y + rng.uniform(0.18, 0.26)
            front = -depth * rng.uniform(0.6, 0.95)
            out.append(box((left, -top, front), (max(right, left + 0.1), -y - 0.02, -0.02), pal.material("spines")))
        else:
            for x in rng.uniform(-width / 2.3, width / 2.3, rng.integers(1, 4)):
                out += place_shapes(build_small_object(pal), (x, -y - 0.02, -depth / 2), yaw=rng.uniform(0, 6))
    return out


def build_lamp(pal: Palette, height: float) -> Shapes:
    """Build a standing lamp on a thin pole."""
    pole = pal.material("plain", gloss=0.6)
    shade = pal.material("plain", "cloth")
    radius = pal.rng.uniform(0.1, 0.2)
    out = [column((0, 0, 0), 0.02, radius, pole), rod((0, 0, 0), (0, -height, 0), pal.rng.uniform(0.006, 0.015), pole)]
    return [*out, column((0, 0.1 - height, 0), 0.25, radius * 1.3, shade, top=0.6)]


def build_carton(pal: Palette) -> Shapes:
    """Build a package of cardboard."""
    w, h, d = pal.rng.uniform(0.04, 0.16, 3) * [1, 1.4, 1]
    return [box((-w / 2, -h, -d / 2), (w / 2, 0, d / 2), pal.material("label", "printed", "label", "plain"))]


def build_can(pal: Palette) -> Shapes:
    """Build a can, a jar or a mug."""
    rng = pal.rng
    r = pal.rng.uniform(0.025, 0.05)
    h = pal.rng.uniform(0.07, 0.16)
    wrapping = pal.material("label", "label", "plain", "marble", gloss=rng.uniform(0, 0.8))
    body = column((0, 0, 0), h, r, wrapping, top=rng.uniform(0.9, 1.15))
    return [body, column((0, -h, 0), 0.004, r * 0.85, pal.material("plain", gloss=0.8))]


def build_bottle(pal: Palette) -> Shapes:
    """Build a bottle or vase with a neck."""
    rng = pal.rng
    glass = pal.material("plain", "gradient", "marble", gloss=0.9)
    r = rng.uniform(0.025, 0.06)
    h = rng.uniform(0.12, 0.3)
    out = [column((0, 0, 0), 0.65 * h, r, glass), column((0, -0.65 * h, 0), 0.15 * h, r, glass, top=0.35)]
    out.append(column((0, -0.8 * h, 0), 0.2 * h, 0.35 * r, glass))
    return [*out, column((0, -0.12 * h, 0), 0.35 * h, r * 1.01, pal.material("label", "printed"))]


def build_bowl(pal: Palette) -> Shapes:
    """Build a bowl with fruit."""
    rng = pal.rng
    r = pal.rng.uniform(0.07, 0.14)
    out = [column((0, 0, 0), 0.06, r * 0.5, pal.material("plain", "cloth", gloss=0.5), top=2.0)]
    fruit = pal.material("plaster", "gradient", gloss=0.3)
    for _ in range(rng.integers(2, 7)):
        x, z = rng.normal(0, r * 0.35, 2)
        out.append(ball((x, -0.07, z), np.full(3, rng.uniform(0.03, 0.045)), fruit))
    return out


def build_toy(pal: Palette) -> Shapes:
    """Build a figure of uneven lumps."""
    rng = pal.rng
    skin = pal.material("plain", "cloth", "plaster")
    limbs = pal.material("plain", "cloth", "gradient")
    h = rng.uniform(0.12, 0.3)
    out = [blob((0, -0.35 * h, 0), h * np.array([0.26, 0.36, 0.24]), skin, rng, 0.15)]
    out.append(blob((0, -0.8 * h, 0), h * np.array([0.24, 0.22, 0.22]), skin, rng, 0.12))
    for side in (-1, 1):
        out.append(blob((0.24 * side * h, -0.45 * h, -0.05 * h), h * np.array([0.18, 0.08, 0.08]), limbs, rng, 0.2))
        out.append(blob((0.14 * side * h, -0.06 * h, -0.12 * h), h * np.array([0.09, 0.07, 0.16]), limbs, rng, 0.2))
        out.append(blob((0.2 * side * h, -1.0 * h, 0), h * np.array([0.07, 0.16, 0.04]), limbs, rng, 0.2))
        out.append(ball((0.09 * side * h, -0.84 * h, -0.2 * h), np.full(3, 0.03 * h), pal.material("plain", gloss=1.0)))
    return out


def build_books(pal: Palette) -> Shapes:
    """Build a pile of books."""
    rng = pal.rng
    y = 0.0
    out = []
    for _ in range(rng.integers(1, 6)):
        w = rng.uniform(0.12, 0.22)
        d = rng.uniform(0.1, 0.16)
        h = rng.uniform(0.01, 0.04)
        book = box((-w / 2, -h, -d / 2), (w / 2, 0, d / 2), pal.material("label", "printed", "cloth", "spines"))
        out += place_shapes([book], (0, y, 0), yaw=rng.normal(0, 0.25))
        y -= h
    return out


def build_paper(pal: Palette) -> Shapes:
    """Build a sheet of paper."""
    half = pal.rng.uniform(0.06, 0.15), pal.rng.uniform(0.08, 0.2)
    return [quad((0, -0.003, 0), half, pal.material("printed", "label", "printed"), LYING)]


def build_plant(pal: Palette, height: float, leaves: int) -> Shapes:
    """Build a pot with stems and leaves."""
    rng = pal.rng
    green = pal.material("foliage")
    stem = pal.material("plain", "bark")
    pot = 0.25 * height
    out = [column((0, 0, 0), pot, 0.16 * height, pal.material("plain", "plaster", "cloth", "marble"), top=1.3)]
    stems = [(rng.normal(0, 0.28, 3) * height + [0, -0.8 * height, 0]) for _ in range(max(2, leaves // 12))]
    out += [rod((0, -pot, 0), tip, 0.006 * height, stem) for tip in stems]
    for _ in range(leaves):
        at = stems[rng.integers(len(stems))] * rng.uniform(0.5, 1.05) + [0, -pot * 0.4, 0]
        size = height * rng.uniform(0.05, 0.14)
        out.append(leaf(at + rng.normal(0, 0.05, 3) * height, (0.4 * size, size), green, random_rotation(rng)))
    return out


def random_rotation(rng: np.random.Generator) -> Array:
    """Draw a random rotation ``[3,3]``."""
    first, second, third = rng.normal(size=(3, 3)).T
    x = first / norm(first)
    y = second - (x * second).sum() * x
    y /= norm(y)
    z = np.cross(x, y)
    sign = 1.0 if (z * third).sum() > 0 else -1.0  # axes of Gram and Schmidt that are left-handed are all reversed
    return np.stack([sign * x, sign * y, z], 1)


def build_wire(pal: Palette, start: Array, end: Array, sag: float, radius: float) -> Shapes:
    """Build a hanging cable."""
    t = np.linspace(0, 1, 9)[:, None]
    points = start + (end - start) * t + [0, 4 * sag, 0] * t * (1 - t)
    material = pal.material("plain", gloss=0.2)
    return [rod(a, b, radius, material) for a, b in itertools.pairwise(points)]


def build_window(pal: Palette, width: float, height: float) -> Shapes:
    """Build a window with frame and bars in the plane z = 0; the foot is at the origin."""
    pane = quad((0, -height / 2, -0.01), (width / 2, height / 2), pal.material("sky", "crown"))
    frame = pal.material("plain", "wood")
    t = pal.rng.uniform(0.03, 0.07)
    w = width / 2
    h = height
    bars = [((-w - t, -h - t), (w + t, -h)), ((-w - t, 0), (w + t, t)), ((-w - t, -h), (-w, 0)), ((w, -h), (w + t, 0))]
    bars += [((-t / 3, -h), (t / 3, 0)), ((-w, -0.55 * h - t / 3), (w, -0.55 * h + t / 3))]
    return [replace(pane, shell=True, glow=True), *(box((*a, -t), (*b, 0.0), frame) for a, b in bars)]


def build_picture(pal: Palette, width: float, height: float) -> Shapes:
    """Build a framed print; the back is at z = 0 and the foot at the origin."""
    material = pal.material("label", "printed", "marble", "crown", "spines", "sky", "cloth")
    t = pal.rng.uniform(0.01, 0.03)
    frame = box((-width / 2 - t, -height - t, -0.02), (width / 2 + t, t, 0), pal.material("plain", "wood"))
    return [quad((0, -height / 2, -0.022), (width / 2, height / 2), material), frame]


SMALL: tuple[Callable[[Palette], Shapes], ...] = (
    build_carton,
    build_carton,
    build_can,
    build_bottle,
    build_bowl,
    build_toy,
    build_books,
    build_books,
)


def build_small_object(pal: Palette) -> Shapes:
    """Build a random one of the objects that lie on tables and shelves."""
    return SMALL[pal.rng.integers(len(SMALL))](pal)


def spread_objects(pal: Palette, count: int, half: tuple[float, float], height: float) -> Shapes:
    """Spread at most ``count`` small objects over a rectangle with half sides ``half``, at a height.

    The objects do not touch. Papers and perhaps a cable lie between them.
    """
    rng = pal.rng
    out = []
    spots: list[Array] = []
    clearance = 0.16  # least distance between the middles of small objects, metres
    for _ in range(count * 4):
        spot = rng.uniform(-1, 1, 2) * half
        if len(spots) < count and all(norm(spot - occupied) > clearance for occupied in spots):
            spots.append(spot)
            out += place_shapes(build_small_object(pal), (spot[0], -height, spot[1]), yaw=rng.uniform(0, 2 * np.pi))
    for _ in range(rng.integers(0, count // 2 + 1)):
        x, z = rng.uniform(-1, 1, 2) * half
        out += place_shapes(build_paper(pal), (x, -height, z), yaw=rng.uniform(0, 2 * np.pi))
    if rng.random() < 0.5:
        ends = rng.uniform(-1, 1, (2, 2)) * half
        a, b = (np.array([x, -height - 0.004, z]) for x, z in ends)
        out += build_wire(pal, a, b, 0.0, rng.uniform(0.002, 0.005))
    return out


FACING = axis_rotation(1, np.pi / 2)  # rotates -z to -x


def draw_lights(rng: np.random.Generator, lamp_at: Array) -> Light:
    """Draw a direct and an ambient light of random colour and strength.

    The direct light comes from above and from behind the cameras.
    """
    side = rng.uniform(-1.2, 1.2)
    up = rng.uniform(0.5, 1.3)
    towards = np.array([sin(side), -up, -cos(side)])
    key = rng.uniform(0.8, 4.0) * (1 + (0.4 * draw_color(rng, strength=(0, 0.4), light=(0.9, 1)) - 0.4))
    ambient = rng.uniform(0.5, 1.1) * (
        1 + (0.3 * draw_color(rng, hue=(0.5, 0.7), strength=(0, 0.3), light=(0.9, 1)) - 0.3)
    )
    return Light(towards / norm(towards), lamp_at, key, ambient, rng.uniform(0.02, 0.2))


def _build_walls(pal: Palette, width: float, depth: float, height: float) -> Shapes:
    """Build floor, ceiling and four walls around the origin, with objects along the walls, a skirting and a pipe."""
    rng = pal.rng
    kinds = ("plain", "plain", "plain", "plaster", "bricks", "cloth", "tiles", "wood")
    papers = [pal.material(*kinds, repeat=rng.uniform(0.3, 0.8), gloss=0.0) for _ in range(2)]
    floor = pal.material("wood", "wood", "tiles", "carpet", "granite", "plaster", "plain", repeat=rng.uniform(0.3, 0.8))
    w = width / 2
    d = depth / 2
    h = height
    out = [quad((0, 0, 0), (w, d), floor, LYING), quad((0, -h, 0), (w, d), pal.material("plain", gloss=0.0), LYING)]
    out += [quad((0, -h / 2, z), (w, h / 2), papers[0]) for z in (d, -d)]
    out += [quad((x, -h / 2, 0), (d, h / 2), papers[k], FACING) for x, k in ((-w, 1), (w, rng.integers(2)))]
    out = [replace(shape, shell=True) for shape in out]
    skirting = pal.material("plain", "wood")
    out.append(box((-w, -0.09, d - 0.02), (w, 0, d), skirting))
    out += [box((x - 0.02, -0.09, -d), (x + 0.02, 0, d), skirting) for x in (-w, w)]
    for half_length, spot, facing in ((w, (0, 0, d), np.eye(3)), (d, (-w, 0, 0), FACING.T), (d, (w, 0, 0), FACING)):
        out += place_shapes(_build_wall_objects(pal, half_length, h), spot, rotation=facing)
    pipe = rng.uniform(-w, w)
    return [*out, rod((pipe, 0, d - 0.06), (pipe, -h, d - 0.06), rng.uniform(0.01, 0.04), skirting)]


def _build_wall_objects(pal: Palette, half: float, height: float) -> Shapes:
    """Build pictures, windows, shelves and doors at random, side by side on the plane z = 0."""
    rng = pal.rng
    out = []
    x = -half + 0.3
    while x < half - 0.5:
        wide = rng.uniform(0.3, 1.2)
        kind = ("picture", "picture", "window", "shelf", "door")[rng.integers(0, 5)]
        at = (x + wide / 2, 0.0, 0.0)
        if kind == "picture":
            frame = build_picture(pal, wide, min(wide * rng.uniform(0.6, 1.4), 0.45 * height))
            out += place_shapes(frame, (at[0], -rng.uniform(0.35, 0.5) * height, 0))
        elif kind == "window":
            pane = build_window(pal, wide, rng.uniform(0.35, 0.55) * height)
            out += place_shapes(pane, (at[0], -0.35 * height, 0))
        elif kind == "shelf":
            out += place_shapes(build_shelf(pal, wide, rng.uniform(0.4, 0.85) * height), at)
        else:
            out += place_shapes(
                [box((-0.45, -0.8 * height, -0.04), (0.45, 0, 0), pal.material("wood", "plain", "cloth"))], at
            )
        x += wide + rng.uniform(0.15, 0.8)
    return out


def build_room(pal: Palette) -> Room:
    """Build a furnished room: walls with pictures and shelves, tables, chairs, plants, lamps, cables."""
    rng = pal.rng
    # width, depth and height
    w = rng.uniform(4.0, 7.0)
    d = rng.uniform(4.5, 7.0)
    h = rng.uniform(2.3, 3.2)
    shapes = _build_walls(pal, w, d, h)
    spots = [(x * w, z * d) for x in (-0.3, 0.0, 0.3) for z in (0.05, 0.32)]  # x and z where furniture may stand
    for i in rng.permutation(len(spots))[: rng.integers(3, 6)]:
        at = spots[i][0] + rng.normal(0, 0.15), 0.0, spots[i][1] + rng.normal(0, 0.15)
        shapes += place_shapes(_build_furniture(pal), at, yaw=rng.normal(0, 0.5))
    plant = build_plant(pal, rng.uniform(0.6, 1.6), int(rng.integers(20, 90)))
    shapes += place_shapes(plant, (rng.uniform(-0.4, 0.4) * w, 0, 0.4 * d))
    shapes += place_shapes(
        build_lamp(pal, rng.uniform(1.1, 1.8)), (rng.uniform(-0.4, 0.4) * w, 0, rng.uniform(0, 0.4) * d)
    )
    a, b = (np.array([x * w, -h * rng.uniform(0.75, 1), rng.uniform(0, 0.45) * d]) for x in (-0.5, 0.5))
    shapes += build_wire(pal, a, b, rng.uniform(0.05, 0.4), rng.uniform(0.003, 0.008))
    focus = np.array([rng.normal(0, 0.2), -rng.uniform(0.4, 1.0), rng.uniform(0.15, 0.35) * d])
    lamp_at = np.array([rng.uniform(-0.3, 0.3) * w, -h + 0.1, rng.uniform(-0.3, 0.2) * d])
    farthest = focus[2] + 0.42 * d  # largest distance of cameras from the focus
    return Room(tuple(shapes), tuple(pal.textures), draw_lights(rng, lamp_at), focus, (0.6 * farthest, farthest))


def build_sofa(pal: Palette) -> Shapes:
    """Build a sofa with two pillows. The back is towards +z."""
    soft = pal.material("cloth", "carpet", repeat=0.9)
    seat = [box((-0.9, -0.42, -0.4), (0.9, 0, 0.4), soft), box((-0.9, -0.85, 0.25), (0.9, 0, 0.45), soft)]
    pillow = pal.material("cloth", "carpet", "label")
    return seat + [ball((x, -0.55, 0.1), (0.22, 0.18, 0.12), pillow) for x in pal.rng.uniform(-0.7, 0.7, 2)]


def _build_furniture(pal: Palette) -> Shapes:
    """Build a chair, a sofa, or a table with small objects and perhaps a chair."""
    rng = pal.rng
    kind = ("chair", "sofa", "table", "table")[pal.rng.integers(0, 4)]
    if kind == "chair":
        return build_chair(pal)
    if kind == "sofa":
        return build_sofa(pal)
    width = rng.uniform(0.7, 1.5)
    depth = rng.uniform(0.5, 0.9)
    height = rng.uniform(0.4, 0.8)
    top = spread_objects(pal, int(rng.integers(2, 7)), (0.3 * width, 0.3 * depth), height)
    out = build_table(pal, width, depth, height) + top
    return out + (place_shapes(build_chair(pal), (0, 0, -0.7), yaw=np.pi) if rng.random() < 0.5 else [])
