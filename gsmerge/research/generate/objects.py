"""Objects of synthetic scenes, each standing at the origin; y points down. Sizes are in metres."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gsmerge.research.generate.shapes import (
    LYING,
    Array,
    Material,
    Shape,
    axis_rotation,
    ball,
    blob,
    box,
    column,
    leaf,
    place,
    quad,
    rod,
)
from gsmerge.research.generate.textures import Palette

Shapes = list[Shape]


def table(pal: Palette, width: float, depth: float, height: float) -> Shapes:
    """A table with four legs, or a round one with one."""
    rng, top = pal.rng, pal.material("wood", "wood", "plain", "plain", "marble", "granite", repeat=0.8)
    legs = pal.material("wood", "plain")
    thick = rng.uniform(0.02, 0.06)
    if rng.random() < 0.35:
        disc = column((0, -height + thick, 0), thick, width / 2, top)
        return [disc, rod((0, 0, 0), (0, thick - height, 0), 0.04, legs), column((0, 0, 0), 0.03, width / 4, legs)]
    out = [box((-width / 2, -height, -depth / 2), (width / 2, thick - height, depth / 2), top)]
    inset, radius = rng.uniform(0.05, 0.12), rng.uniform(0.012, 0.04)
    for x in (inset - width / 2, width / 2 - inset):
        out += [
            rod((x * 1.02, 0, z), (x, thick - height, z), radius, legs) for z in (inset - depth / 2, depth / 2 - inset)
        ]
    return out


def chair(pal: Palette) -> Shapes:
    """A chair with a slatted or closed back."""
    rng, seat, wood = pal.rng, pal.material("cloth", "wood", "plain"), pal.material("wood", "plain")
    w, h, back = rng.uniform(0.38, 0.5), rng.uniform(0.42, 0.5), rng.uniform(0.8, 1.05)
    out = [box((-w / 2, -h, -w / 2), (w / 2, 0.05 - h, w / 2), seat)]
    for x in (-w / 2 + 0.02, w / 2 - 0.02):
        out += [rod((x, 0, 0.02 - w / 2), (x, -h, 0.02 - w / 2), 0.016, wood)]
        out += [rod((x, 0, w / 2 - 0.02), (x, -back, w / 2 + 0.03), 0.016, wood)]
    if rng.random() < 0.5:
        return [*out, box((-w / 2, -back, w / 2), (w / 2, -h - 0.12, w / 2 + 0.03), seat)]
    slats = np.linspace(-w / 2, w / 2, 6)
    out += [rod((x, -h, w / 2), (x, -back, w / 2 + 0.03), 0.008, wood) for x in slats]
    return [*out, rod((-w / 2, -back, w / 2 + 0.03), (w / 2, -back, w / 2 + 0.03), 0.02, wood)]


def shelf(pal: Palette, width: float, height: float) -> Shapes:
    """Boards with books and objects on them, its back at z = 0."""
    rng, board, depth = pal.rng, pal.material("wood", "plain", "plaster", repeat=0.7), 0.3
    out = [box((x - 0.012, -height, -depth), (x + 0.012, 0, 0), board) for x in (-width / 2, width / 2)]
    out.append(box((-width / 2, -height, -0.01), (width / 2, 0, 0), board))
    for y in np.arange(0.05, height, rng.uniform(0.28, 0.42)):
        out.append(box((-width / 2, -y - 0.02, -depth), (width / 2, -y, 0), board))
        if y + 0.3 > height:
            break
        if rng.random() < 0.7:
            left, right = -width / 2, width / 2
            if rng.random() < 0.5:
                left, right = np.sort(rng.uniform(left, right, 2))
            top, front = y + rng.uniform(0.18, 0.26), -depth * rng.uniform(0.6, 0.95)
            out.append(box((left, -top, front), (max(right, left + 0.1), -y - 0.02, -0.02), pal.material("spines")))
        else:
            for x in rng.uniform(-width / 2.3, width / 2.3, rng.integers(1, 4)):
                out += place(small_object(pal), (x, -y - 0.02, -depth / 2), yaw=rng.uniform(0, 6))
    return out


def lamp(pal: Palette, height: float) -> Shapes:
    """A standing lamp on a thin pole."""
    pole, shade = pal.material("plain", gloss=0.6), pal.material("plain", "cloth")
    radius = pal.rng.uniform(0.1, 0.2)
    out = [column((0, 0, 0), 0.02, radius, pole), rod((0, 0, 0), (0, -height, 0), pal.rng.uniform(0.006, 0.015), pole)]
    return [*out, column((0, 0.1 - height, 0), 0.25, radius * 1.3, shade, top=0.6)]


def carton(pal: Palette) -> Shapes:
    """A package."""
    w, h, d = pal.rng.uniform(0.04, 0.16, 3) * [1, 1.4, 1]
    return [box((-w / 2, -h, -d / 2), (w / 2, 0, d / 2), pal.material("label", "printed", "label", "plain"))]


def can(pal: Palette) -> Shapes:
    """A can, a jar or a mug."""
    rng, r, h = pal.rng, pal.rng.uniform(0.025, 0.05), pal.rng.uniform(0.07, 0.16)
    wrapping = pal.material("label", "label", "plain", "marble", gloss=rng.uniform(0, 0.8))
    body = column((0, 0, 0), h, r, wrapping, top=rng.uniform(0.9, 1.15))
    return [body, column((0, -h, 0), 0.004, r * 0.85, pal.material("plain", gloss=0.8))]


def bottle(pal: Palette) -> Shapes:
    """A bottle or vase with a neck."""
    rng, glass = pal.rng, pal.material("plain", "gradient", "marble", gloss=0.9)
    r, h = rng.uniform(0.025, 0.06), rng.uniform(0.12, 0.3)
    out = [column((0, 0, 0), 0.65 * h, r, glass), column((0, -0.65 * h, 0), 0.15 * h, r, glass, top=0.35)]
    out.append(column((0, -0.8 * h, 0), 0.2 * h, 0.35 * r, glass))
    return [*out, column((0, -0.12 * h, 0), 0.35 * h, r * 1.01, pal.material("label", "printed"))]


def bowl(pal: Palette) -> Shapes:
    """A bowl with fruit."""
    rng, r = pal.rng, pal.rng.uniform(0.07, 0.14)
    out = [column((0, 0, 0), 0.06, r * 0.5, pal.material("plain", "cloth", gloss=0.5), top=2.0)]
    fruit = pal.material("plaster", "gradient", gloss=0.3)
    for _ in range(rng.integers(2, 7)):
        x, z = rng.normal(0, r * 0.35, 2)
        out.append(ball((x, -0.07, z), np.full(3, rng.uniform(0.03, 0.045)), fruit))
    return out


def toy(pal: Palette) -> Shapes:
    """A figure of uneven lumps."""
    rng, skin, other = pal.rng, pal.material("plain", "cloth", "plaster"), pal.material("plain", "cloth", "gradient")
    h = rng.uniform(0.12, 0.3)
    out = [blob((0, -0.35 * h, 0), h * np.array([0.26, 0.36, 0.24]), skin, rng, 0.15)]
    out.append(blob((0, -0.8 * h, 0), h * np.array([0.24, 0.22, 0.22]), skin, rng, 0.12))
    for side in (-1, 1):
        out.append(blob((0.24 * side * h, -0.45 * h, -0.05 * h), h * np.array([0.18, 0.08, 0.08]), other, rng, 0.2))
        out.append(blob((0.14 * side * h, -0.06 * h, -0.12 * h), h * np.array([0.09, 0.07, 0.16]), other, rng, 0.2))
        out.append(blob((0.2 * side * h, -1.0 * h, 0), h * np.array([0.07, 0.16, 0.04]), other, rng, 0.2))
        out.append(ball((0.09 * side * h, -0.84 * h, -0.2 * h), np.full(3, 0.03 * h), pal.material("plain", gloss=1.0)))
    return out


def books(pal: Palette) -> Shapes:
    """A pile of books."""
    rng, y, out = pal.rng, 0.0, []
    for _ in range(rng.integers(1, 6)):
        w, d, h = rng.uniform(0.12, 0.22), rng.uniform(0.1, 0.16), rng.uniform(0.01, 0.04)
        book = box((-w / 2, -h, -d / 2), (w / 2, 0, d / 2), pal.material("label", "printed", "cloth", "spines"))
        out += place([book], (0, y, 0), yaw=rng.normal(0, 0.25))
        y -= h
    return out


def paper(pal: Palette) -> Shapes:
    """A sheet of paper."""
    half = pal.rng.uniform(0.06, 0.15), pal.rng.uniform(0.08, 0.2)
    return [quad((0, -0.003, 0), half, pal.material("printed", "label", "printed"), LYING)]


def laptop(pal: Palette) -> Shapes:
    """A computer with a page on its screen."""
    case, lid = pal.material("plain", gloss=0.4), axis_rotation(0, pal.rng.uniform(-0.5, -0.1))
    screen = replace(quad((0, -0.11, -0.006), (0.15, 0.1), pal.material("printed", "label")), glow=True)
    keys = quad((0, -0.019, -0.02), (0.14, 0.07), pal.material("printed", "tiles"), LYING)
    cover = place([screen, box((-0.16, -0.22, -0.004), (0.16, 0, 0.004), case)], (0, -0.015, 0.11), rotation=lid)
    return [box((-0.16, -0.018, -0.11), (0.16, 0, 0.11), case), keys, *cover]


def plant(pal: Palette, height: float, leaves: int) -> Shapes:
    """A pot with stems and leaves."""
    rng, green, stem = pal.rng, pal.material("foliage"), pal.material("plain", "bark")
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
    """``[3,3]`` random rotation."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def bush(pal: Palette, radius: float, leaves: int) -> Shapes:
    """An uneven core covered with leaves."""
    rng, green = pal.rng, pal.material("foliage")
    radii = radius * rng.uniform(0.7, 1.2, 3)
    out = [blob((0, -0.8 * radii[1], 0), 0.8 * radii, pal.material("crown", repeat=1.2 / radius, gloss=0.0), rng, 0.5)]
    flower = pal.material("foliage")
    for _ in range(leaves):
        away = rng.normal(size=3)
        away *= radii * rng.uniform(0.8, 1.1) / np.linalg.norm(away)
        size = radius * rng.uniform(0.08, 0.22)
        material = flower if rng.random() < 0.15 else green
        out.append(leaf(away - np.array([0, 0.8 * radii[1], 0]), (0.42 * size, size), material, random_rotation(rng)))
    return out


def tree(pal: Palette, height: float, leaves: int) -> Shapes:
    """A trunk, branches, lumps of foliage and single leaves."""
    rng, bark, green = pal.rng, pal.material("bark", repeat=0.8, gloss=0.0), pal.material("foliage", gloss=0.1)
    crown = pal.material("crown", repeat=0.8, gloss=0.0)
    fork = np.array([rng.normal(0, 0.05), -0.5, rng.normal(0, 0.05)]) * height
    out = [rod((0, 0.1, 0), fork, 0.03 * height, bark)]
    for _ in range(rng.integers(4, 8)):
        tip = fork + rng.normal(0, 0.17, 3) * height + [0, -0.25 * height, 0]
        out.append(rod(fork, tip, 0.008 * height, bark))
        out.append(blob(tip, height * rng.uniform(0.06, 0.16, 3), crown, rng, 0.5))
        for _ in range(leaves // 6):
            size = height * rng.uniform(0.012, 0.035)
            out.append(leaf(tip + rng.normal(0, 0.1, 3) * height, (0.4 * size, size), green, random_rotation(rng)))
    return out


def steps(pal: Palette, width: float, count: int) -> Shapes:
    """Steps that go up away from the cameras."""
    material = pal.material("plaster", "granite", "wood", "bricks", repeat=0.7)
    rise, tread = pal.rng.uniform(0.12, 0.18), pal.rng.uniform(0.25, 0.35)
    return [
        box((-width / 2, -rise * (k + 1), tread * k), (width / 2, 0, tread * (count + 1)), material)
        for k in range(count)
    ]


def wire(pal: Palette, start: Array, end: Array, sag: float, radius: float) -> Shapes:
    """A hanging cable."""
    t = np.linspace(0, 1, 9)[:, None]
    points = start + (end - start) * t + [0, 4 * sag, 0] * t * (1 - t)
    material = pal.material("plain", gloss=0.2)
    return [rod(a, b, radius, material) for a, b in itertools.pairwise(points)]


def fence(pal: Palette, width: float, height: float) -> Shapes:
    """Thin bars between two rails."""
    material, gap = pal.material("plain", "wood", "bark"), pal.rng.uniform(0.1, 0.25)
    radius = pal.rng.uniform(0.006, 0.02)
    out = [rod((x, 0, 0), (x, -height, 0), radius, material) for x in np.arange(-width / 2, width / 2, gap)]
    return out + [
        rod((-width / 2, -h, 0), (width / 2, -h, 0), 1.4 * radius, material) for h in (0.15 * height, 0.9 * height)
    ]


def window(pal: Palette, width: float, height: float, material: Material, *, glow: bool) -> Shapes:
    """A pane with a frame and bars, in the plane z = 0, its foot at the origin."""
    pane = replace(quad((0, -height / 2, -0.01), (width / 2, height / 2), material), shell=glow, glow=glow)
    frame, t = pal.material("plain", "wood"), pal.rng.uniform(0.03, 0.07)
    w, h = width / 2, height
    bars = [((-w - t, -h - t), (w + t, -h)), ((-w - t, 0), (w + t, t)), ((-w - t, -h), (-w, 0)), ((w, -h), (w + t, 0))]
    bars += [((-t / 3, -h), (t / 3, 0)), ((-w, -0.55 * h - t / 3), (w, -0.55 * h + t / 3))]
    return [pane, *(box((*a, -t), (*b, 0.0), frame) for a, b in bars)]


def picture(pal: Palette, width: float, height: float) -> Shapes:
    """A framed print, its back at z = 0, its foot at the origin."""
    material = pal.material("label", "printed", "marble", "crown", "spines", "sky", "cloth")
    t = pal.rng.uniform(0.01, 0.03)
    frame = box((-width / 2 - t, -height - t, -0.02), (width / 2 + t, t, 0), pal.material("plain", "wood"))
    return [quad((0, -height / 2, -0.022), (width / 2, height / 2), material), frame]


SMALL: tuple[Callable[[Palette], Shapes], ...] = (carton, carton, can, bottle, bowl, toy, books, books)


def small_object(pal: Palette) -> Shapes:
    """A random object of those that stand on tables."""
    return SMALL[pal.rng.integers(len(SMALL))](pal)


def clutter(pal: Palette, count: int, half: tuple[float, float], height: float) -> Shapes:
    """Small objects spread over a rectangle without touching, with papers and cables between them."""
    rng, out = pal.rng, []
    taken: list[Array] = []
    for _ in range(count * 4):
        at = rng.uniform(-1, 1, 2) * half
        if len(taken) < count and all(np.hypot(*(at - other)) > 0.16 for other in taken):
            taken.append(at)
            out += place(small_object(pal), (at[0], -height, at[1]), yaw=rng.uniform(0, 2 * np.pi))
    for _ in range(rng.integers(0, count // 2 + 1)):
        x, z = rng.uniform(-1, 1, 2) * half
        out += place(paper(pal), (x, -height, z), yaw=rng.uniform(0, 2 * np.pi))
    if rng.random() < 0.5:
        ends = rng.uniform(-1, 1, (2, 2)) * half
        a, b = (np.array([x, -height - 0.004, z]) for x, z in ends)
        out += wire(pal, a, b, 0.0, rng.uniform(0.002, 0.005))
    return out
