"""Draw textures from random numbers: square colour pictures that repeat without a seam.

Every function of ``KINDS`` takes a generator of random numbers and a side in pixels, and returns a texture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from gsmerge.method.kernels import pictures
from gsmerge.method.kernels.elementary import cos, power, sin
from gsmerge.research.generate.shapes import Material

Texture: TypeAlias = NDArray[Any]  # [size,size,3] float32 that repeats without a seam, sRGB in [0, 1]
Color: TypeAlias = NDArray[Any]  # [3] sRGB in [0, 1]
Grey: TypeAlias = NDArray[Any]  # [size,size] float32 that repeats without a seam, 0 to 1


def enlarge_texture(cells: NDArray[np.float64], size: int) -> Grey:
    """Enlarge a small periodic picture smoothly to ``[size,size]``."""
    return pictures.enlarge(cells, size, size, periodic=True)


def draw_octaves(
    rng: np.random.Generator, size: int, *, first: int = 4, fade: float = 0.6, stretch: int = 1, ridged: bool = False
) -> Grey:
    """Draw noise as a sum of octaves.

    Each octave has half the cell size and ``fade`` times the strength of the octave before.
    A ``fade`` of 0.3 gives clouds, and a ``fade`` of 0.9 gives grit. ``first`` is the number of cells of the coarsest
    octave along a side. ``stretch`` is the ratio of a cell's length to its height. Noise that is ``ridged`` has sharp
    crests, as in rock and bark.
    """
    out = np.zeros((size, size), np.float32)
    strength = 1.0
    cells = min(first, size // 2)
    while cells <= size // 2:
        layer = enlarge_texture(rng.uniform(-1, 1, (cells, max(1, cells // stretch))), size)
        out += strength * (1 - 2 * np.abs(layer) if ridged else layer)
        strength = strength * fade
        cells = cells * 2
    low, high = np.percentile(out, (1, 99))
    return np.clip((out - low) / (high - low), 0, 1).astype(np.float32)


def pixel_places(size: int) -> tuple[Grey, Grey]:
    """Return x and y ``[size,size]`` of the centres of all pixels, as shares of the picture's side."""
    centres = (np.arange(size, dtype=np.float32) + 0.5) / size
    x, y = np.meshgrid(centres, centres)
    return x, y


def draw_courses(
    rng: np.random.Generator, size: int, rows: int, columns: int, *, joint: float, offset: float
) -> tuple[Grey, Grey]:
    """Draw ``rows`` courses of ``columns`` bricks or tiles; return each pixel's random tone, and a mask of the joints.

    ``joint`` is the width of the joints as a share of a stone's height, and ``offset`` the shift of every second course
    as a share of a stone's width.
    """
    x, y = pixel_places(size)
    row = np.floor(y * rows).astype(int)
    along = x * columns + offset * (row % 2)  # place along the row, in bricks
    # place within the brick, 0 to 1
    down = y * rows - row
    across = along - np.floor(along)
    tones = rng.uniform(0, 1, (rows, columns)).astype(np.float32)
    width = joint * columns / rows
    lines = np.minimum(np.minimum(down, 1 - down) / joint, np.minimum(across, 1 - across) / width)
    return tones[row, np.floor(along).astype(int) % columns], np.clip(1.5 - 2 * lines, 0, 1).astype(np.float32)


def draw_pebbles(rng: np.random.Generator, size: int, count: int) -> tuple[Grey, Grey]:
    """Draw ``count``² pebbles; return the random tone of each pixel's pebble, and the distance to the pebble's edge.

    Pebbles are the Voronoi cells of random points, one point in each square of a grid.
    """
    points = (
        np.stack(np.meshgrid(np.arange(count), np.arange(count)), -1) + rng.uniform(0, 1, (count, count, 2))
    ) / count
    tones = rng.uniform(0, 1, (count, count)).astype(np.float32)
    x, y = pixel_places(size)
    column = np.floor(x * count).astype(int)
    row = np.floor(y * count).astype(int)
    nearest = np.full((size, size), 9.0, np.float32)
    second = np.full((size, size), 9.0, np.float32)
    tone = np.zeros((size, size), np.float32)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            neighbour = (row + i) % count, (column + j) % count
            dx = x - points[neighbour][..., 0]
            dy = y - points[neighbour][..., 1]
            distance = np.sqrt((dx - np.round(dx)) ** 2 + (dy - np.round(dy)) ** 2)
            tone = np.where(distance < nearest, tones[neighbour], tone)
            second = np.minimum(second, np.maximum(distance, nearest))
            nearest = np.minimum(nearest, distance)
    return tone, np.clip((second - nearest) * count, 0, 1).astype(np.float32)


def draw_letters(rng: np.random.Generator, count: int) -> NDArray[np.uint8]:
    """Draw masks ``[count,7,5]`` of the letters of an invented alphabet, a few strokes each."""
    out = np.zeros((count, 7, 5), np.uint8)
    for letter in out:
        for _ in range(rng.integers(2, 5)):
            if rng.random() < 0.5:
                letter[rng.integers(1, 7) if rng.random() < 0.8 else 0, rng.integers(0, 3) : rng.integers(3, 6)] = 1
            else:
                letter[rng.integers(0, 4) : rng.integers(4, 8), rng.integers(0, 5)] = 1
    return out


def draw_text_line(rng: np.random.Generator, alphabet: NDArray[np.uint8], height: int, width: int) -> Grey:
    """Draw one line of words; return the ink ``[height,width]``, from 0 for paper to 1."""
    line = np.zeros((7, max(6, 7 * width // height)), np.uint8)
    column = 0
    # pixels from letter to letter, and additional pixels between words
    pitch = 6
    word_space = 4
    while column < line.shape[1] - pitch:
        for letter in alphabet[rng.integers(0, len(alphabet), rng.integers(2, 10))]:
            if column < line.shape[1] - pitch:
                line[:, column : column + 5] = letter
            column += pitch
        column += word_space
    return cv2.resize(line.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)


def draw_color(
    rng: np.random.Generator,
    *,
    hue: tuple[float, float] | None = None,
    strength: tuple[float, float] = (0.05, 0.6),
    light: tuple[float, float] = (0.2, 0.85),
) -> Color:
    """Draw a random colour from ranges of hue (0 to 1), saturation (``strength``) and value (``light``).

    Without a range of hues, half of the colours are warm, and the other half has any hue.
    """
    if hue is not None:
        h = rng.uniform(*hue) % 1
    elif rng.random() < 0.5:
        h = rng.normal(0.08, 0.06) % 1
    else:
        h = rng.random()
    s = strength[0] + (strength[1] - strength[0]) * rng.random() ** 1.5
    v = rng.uniform(*light)
    pure = np.clip(np.abs(np.mod(6 * h + np.array([0, 4, 2]), 6) - 3) - 1, 0, 1)  # RGB of the hue at s = v = 1
    return (v * (1 - s * (1 - pure))).astype(np.float32)


def draw_shades(rng: np.random.Generator, base: Color, contrast: float) -> tuple[Color, Color]:
    """Draw a darker and a lighter variant of a colour."""
    tint = rng.normal(0, 0.03, 3) * contrast
    return np.clip(base * (1 - contrast) - tint, 0, 1), np.clip(base + (1 - base) * contrast * 0.6 + tint, 0, 1)


def mix_colors(low: Color, high: Color, amount: Grey) -> Texture:
    """Mix two colours; ``amount`` is the share of ``high`` at each pixel."""
    return low + (high - low) * amount[..., None].astype(np.float32)


def draw_plain(rng: np.random.Generator, size: int) -> Texture:
    """Draw paint: almost no texture."""
    base = draw_color(rng, light=(0.35, 0.95), strength=(0, 0.5))
    return mix_colors(*draw_shades(rng, base, rng.uniform(0.01, 0.05)), draw_octaves(rng, size, first=2, fade=0.5))


def draw_plaster(rng: np.random.Generator, size: int) -> Texture:
    """Draw rough paint, stone or concrete."""
    low, high = draw_shades(rng, draw_color(rng, strength=(0, 0.3)), rng.uniform(0.1, 0.4))
    clouds = draw_octaves(rng, size, fade=0.6)
    grit = draw_octaves(rng, size, first=64, fade=0.9)
    return mix_colors(low, high, 0.6 * clouds + 0.4 * grit)


def draw_granite(rng: np.random.Generator, size: int) -> Texture:
    """Draw speckles of three colours."""
    base = draw_color(rng, strength=(0, 0.25))
    out = mix_colors(*draw_shades(rng, base, 0.3), draw_octaves(rng, size, first=64, fade=0.9))
    speck = draw_octaves(rng, size, first=128, fade=0.7)[..., None]
    dark, pale = (base + rng.uniform(0.2, 0.8) * (draw_color(rng, light=v) - base) for v in ((0.05, 0.25), (0.75, 1)))
    return np.where(speck > 0.75, pale, np.where(speck < 0.22, dark, out)).astype(np.float32)


def draw_marble(rng: np.random.Generator, size: int) -> Texture:
    """Draw the veins of marble."""
    low, high = draw_shades(rng, draw_color(rng, strength=(0, 0.3), light=(0.4, 0.9)), 0.5)
    bend = draw_octaves(rng, size, fade=0.55)
    x, y = pixel_places(size)
    veins = power(np.abs(sin(np.pi * (2 * x + 2 * y + 3 * bend))), 0.4)
    return mix_colors(low, high, 0.8 * veins + 0.2 * draw_octaves(rng, size, first=16, fade=0.8))


def draw_wood(rng: np.random.Generator, size: int) -> Texture:
    """Draw planks with grain along x."""
    low, high = draw_shades(rng, draw_color(rng, hue=(0.04, 0.11), strength=(0.3, 0.7), light=(0.3, 0.8)), 0.45)
    planks = int(rng.integers(2, 7))
    tone, joint = draw_courses(rng, size, planks, int(rng.integers(1, 3)), joint=rng.uniform(0.01, 0.03), offset=0.5)
    rings = np.abs(sin(20 * draw_octaves(rng, size, first=16, fade=0.35, stretch=8) + 9 * tone))
    fibres = draw_octaves(rng, size, first=128, fade=0.8, stretch=32)
    out = mix_colors(low, high, 0.35 * rings + 0.35 * fibres + 0.3 * tone)
    return (out * (1 - 0.7 * joint[..., None])).astype(np.float32)


def draw_tiles(rng: np.random.Generator, size: int) -> Texture:
    """Draw tiles with joints, of one colour or chequered."""
    count = 2 * int(rng.integers(1, 5))
    base = draw_color(rng, strength=(0, 0.5))
    low, high = draw_shades(rng, base, rng.uniform(0.05, 0.3))
    tone, joint = draw_courses(rng, size, count, count, joint=rng.uniform(0.02, 0.05), offset=0.0)
    if rng.random() < 0.4:
        x, y = pixel_places(size)
        tone = 0.2 * tone + 0.8 * ((np.floor(x * count) + np.floor(y * count)) % 2)
    out = mix_colors(low, high, 0.6 * tone + 0.4 * draw_octaves(rng, size, first=8, fade=0.75))
    return out + (draw_color(rng, strength=(0, 0.2)) - out) * joint[..., None]


def draw_bricks(rng: np.random.Generator, size: int) -> Texture:
    """Draw courses of bricks or hewn stones."""
    rows = 2 * int(rng.integers(3, 7))
    stone = rng.random() < 0.5
    hue = (0.05, 0.13) if stone else (0.0, 0.07)
    base = draw_color(rng, hue=hue, strength=(0.05, 0.3) if stone else (0.35, 0.7), light=(0.4, 0.75))
    low, high = draw_shades(rng, base, 0.35)
    tone, joint = draw_courses(rng, size, rows, rows // 2, joint=rng.uniform(0.05, 0.1), offset=0.5)
    dx, dy = (draw_octaves(rng, size, first=16, fade=0.6) for _ in range(2))
    x, y = pixel_places(size)
    at_x, at_y = (((at + 0.01 * (shift - 0.5)) * size - 0.5) % size for at, shift in ((x, dx), (y, dy)))
    tone, joint = (
        cv2.remap(picture, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP) for picture in (tone, joint)
    )
    out = mix_colors(low, high, 0.5 * tone + 0.5 * draw_octaves(rng, size, first=8, fade=0.85))
    return out + (draw_color(rng, strength=(0, 0.15), light=(0.4, 0.8)) - out) * joint[..., None]


def draw_cloth(rng: np.random.Generator, size: int) -> Texture:
    """Draw a weave with stripes or checks."""
    x, y = pixel_places(size)
    count = int(rng.integers(3, 12))
    base = draw_color(rng, strength=(0.1, 0.8))
    other = draw_color(rng, strength=(0.0, 0.7))
    bands = [(np.mod(count * c, 1) < rng.uniform(0.2, 0.6)).astype(np.float32) for c in (x, y)]
    kind = rng.integers(0, 3)
    amounts = bands[0], 0.5 * bands[0] + 0.5 * bands[1], np.zeros_like(x)
    amount = amounts[kind]
    threads = 2 ** int(rng.integers(5, 8))
    weave = 0.5 + 0.5 * sin(2 * np.pi * threads * x) * sin(2 * np.pi * threads * y)
    shade = 0.75 + 0.15 * weave + 0.2 * (draw_octaves(rng, size, fade=0.7) - 0.5)
    return np.clip(mix_colors(base, other, amount) * shade[..., None], 0, 1).astype(np.float32)


def draw_carpet(rng: np.random.Generator, size: int) -> Texture:
    """Draw a carpet: plain pile, or an ornament of a few colours."""
    base = draw_color(rng, strength=(0.1, 0.7), light=(0.2, 0.6))
    out = mix_colors(*draw_shades(rng, base, 0.4), draw_octaves(rng, size, first=32, fade=0.95))
    if rng.random() < 0.5:
        motif = enlarge_texture(np.pad(rng.uniform(0, 1, (4, 4)), ((0, 4), (0, 4)), mode="symmetric"), size)
        mask = np.mod(3 * motif, 1)[..., None] > 0.5
        out = np.where(mask, out, 0.3 * out + 0.7 * draw_color(rng, strength=(0.2, 0.8)))
    return out.astype(np.float32)


def draw_bark(rng: np.random.Generator, size: int) -> Texture:
    """Draw bark with furrows along y."""
    base = draw_color(rng, hue=(0.04, 0.12), strength=(0.1, 0.5), light=(0.25, 0.55))
    return mix_colors(
        *draw_shades(rng, base, 0.6), draw_octaves(rng, size, first=32, fade=0.75, stretch=4, ridged=True).T
    )


def draw_foliage(rng: np.random.Generator, size: int) -> Texture:
    """Draw one leaf: veins from a middle rib."""
    base = draw_color(rng, hue=(0.2, 0.38), strength=(0.4, 0.85), light=(0.2, 0.6))
    if rng.random() < 0.25:  # a petal instead
        base = draw_color(rng, hue=(0.8, 1.12), strength=(0.4, 0.9), light=(0.6, 0.95))
    low, high = draw_shades(rng, base, 0.45)
    x, y = pixel_places(size)
    side = np.abs(x - 0.5)
    veins = np.clip(1 - np.abs(sin(np.pi * 12 * (y - side))) * 5, 0, 1) * 0.5
    rib = np.clip(1 - side * 30, 0, 1)
    return mix_colors(
        low, high, np.clip(0.35 * draw_octaves(rng, size, fade=0.7) + np.maximum(veins, rib) + 0.4 * (1 - y), 0, 1)
    )


def draw_crown(rng: np.random.Generator, size: int) -> Texture:
    """Draw distant leaves, as seen through a window."""
    tone, edge = draw_pebbles(rng, size, int(rng.integers(24, 56)))
    base = draw_color(rng, hue=(0.18, 0.36), strength=(0.35, 0.8), light=(0.25, 0.55))
    low, high = draw_shades(rng, base, 0.6)
    leaves = np.clip(0.5 * tone + 0.6 * draw_octaves(rng, size, first=4, fade=0.75) - 0.1, 0, 1)
    return mix_colors(low, high, leaves) * (0.25 + 0.75 * np.clip(4 * edge, 0, 1))[..., None]


def draw_gradient(rng: np.random.Generator, size: int) -> Texture:
    """Fade from one colour into another and back."""
    _, y = pixel_places(size)
    return mix_colors(draw_color(rng), draw_color(rng), 0.5 - 0.5 * cos(2 * np.pi * y))


def draw_printed(rng: np.random.Generator, size: int) -> Texture:
    """Draw a page with headings, lines of text and pictures."""
    paper = draw_color(rng, strength=(0, 0.12), light=(0.8, 1)) if rng.random() < 0.7 else draw_color(rng)
    ink = (
        draw_color(rng, light=(0.02, 0.3))
        if paper.mean() > 0.45
        else draw_color(rng, light=(0.85, 1), strength=(0, 0.2))
    )
    page = np.tile(paper, (size, size, 1)).astype(np.float32)
    letters = draw_letters(rng, 26)
    margin = size // 16
    y = size // 16
    page[: size // 64] = page[:, : size // 64] = 0.7 * paper
    while y < size - 2 * margin:
        chance = rng.random()
        left = margin
        is_heading = chance < 0.2
        is_picture = chance > 0.8
        height = size // int(rng.integers(6, 12)) if is_heading else size // int(rng.integers(22, 44))
        width = int(rng.uniform(0.5, 1) * (size - 2 * margin))
        if is_picture:  # with text beside it
            height = int(rng.uniform(0.1, 0.25) * size)
            picture_width = int(rng.uniform(0.2, 0.5) * size)
            area = page[y : y + height, left : left + picture_width]
            area[:] = mix_colors(draw_color(rng), draw_color(rng), draw_octaves(rng, size, first=4, fade=0.6))[
                : area.shape[0], : area.shape[1]
            ]
            left = left + picture_width + margin // 2
            width = size - 2 * margin - picture_width
            height //= 4
        line = draw_text_line(rng, letters, height, max(8, width))
        area = page[y : y + height, left : min(left + width, size - margin)]
        area += (ink - area) * line[: area.shape[0], : area.shape[1], None]
        y += int(height * rng.uniform(1.3, 1.7)) + (size // 8 if is_picture else 0)
    return page


def draw_label(rng: np.random.Generator, size: int) -> Texture:
    """Draw the front of a package: bands, discs, large and small letters."""
    x, y = pixel_places(size)
    page = mix_colors(draw_color(rng, strength=(0.3, 0.95)), draw_color(rng, strength=(0.2, 0.9)), np.abs(2 * y - 1))
    for _ in range(rng.integers(2, 6)):
        cx = rng.uniform(0, 1)
        cy = rng.uniform(0, 1)
        r = rng.uniform(0.06, 0.3)
        inside = np.square(x - cx) + np.square(y - cy) < r * r if rng.random() < 0.5 else np.abs(y - cy) < r / 3
        page = np.where(inside[..., None], draw_color(rng, strength=(0.1, 0.95)), page)
    letters = draw_letters(rng, 26)
    for _ in range(rng.integers(3, 9)):
        height = size // int(rng.integers(5, 30))
        top = int(rng.integers(0, size - height))
        left = int(rng.integers(0, size // 2))
        area = page[top : top + height, left : left + int(rng.integers(size // 5, size // 2))]
        ink = draw_color(rng, strength=(0, 0.4), light=(0.85, 1) if rng.random() < 0.5 else (0, 0.2))
        area += (ink - area) * draw_text_line(rng, letters, height, area.shape[1])[..., None]
    return np.clip(page * (0.97 + 0.06 * draw_octaves(rng, size, first=16)[..., None]), 0, 1).astype(np.float32)


def draw_spines(rng: np.random.Generator, size: int) -> Texture:
    """Draw the backs of a row of books of many colours."""
    page = np.zeros((size, size, 3), np.float32)
    letters = draw_letters(rng, 26)
    x = 0
    while x < size:
        width = int(rng.uniform(0.02, 0.09) * size)
        book = page[:, x : x + width]
        book[:] = draw_color(rng, strength=(0.1, 0.8), light=(0.15, 0.95))
        if book.shape[1] > size // 40:
            line = draw_text_line(rng, letters, book.shape[1], size)
            book += (draw_color(rng, strength=(0, 0.3), light=(0.8, 1)) - book) * line.T[:, : book.shape[1], None] * 0.8
        book *= np.sqrt(sin(np.linspace(0.5, 2.6, book.shape[1])))[None, :, None]
        book[: int(rng.uniform(0, 0.2) * size)] *= 0.12
        x += width
    return page


def draw_sky(rng: np.random.Generator, size: int) -> Texture:
    """Draw a blue or grey sky with clouds. The horizon is at y = 1/2."""
    _, y = pixel_places(size)
    high = draw_color(rng, hue=(0.56, 0.63), strength=(0.0, 0.6), light=(0.6, 0.95))
    low = np.array([0.9, 0.92, 0.95], np.float32)
    clouds = np.clip(
        rng.uniform(0.8, 2.5) * (draw_octaves(rng, size, first=4, fade=0.55) - rng.uniform(0.3, 0.8)), 0, 1
    )
    out = mix_colors(high, low, np.clip(1 - 2.2 * np.abs(y - 0.5), 0, 1) ** 2)
    return out + (0.97 - out) * clouds[..., None]


KINDS: dict[str, Callable[[np.random.Generator, int], Texture]] = {
    maker.__name__.removeprefix("draw_"): maker
    for maker in (
        draw_plain,
        draw_plaster,
        draw_granite,
        draw_marble,
        draw_wood,
        draw_tiles,
        draw_bricks,
        draw_cloth,
        draw_carpet,
        draw_bark,
        draw_foliage,
        draw_crown,
        draw_gradient,
        draw_printed,
        draw_label,
        draw_spines,
        draw_sky,
    )
}


def make_mipmaps(texture: Texture) -> list[Texture]:
    """Return a texture and its mipmaps, each half as large as the one before, down to sides of 8 pixels."""
    out: list[Texture] = [np.ascontiguousarray(texture, np.float32)]
    while len(out[-1]) > 8:
        half = len(out[-1]) // 2
        out.append(cv2.resize(out[-1], (half, half), interpolation=cv2.INTER_AREA))
    return out


MAX_TEXTURES = {"label": 8, "printed": 6, "plain": 6, "foliage": 4, "cloth": 4}  # most textures of a kind in a scene


@dataclass
class Palette:
    """The textures of a scene. A texture is drawn when a material needs it first."""

    rng: np.random.Generator
    size: int  # side of the textures, pixels
    textures: list[Texture] = field(default_factory=list)
    by_kind: dict[str, list[int]] = field(default_factory=dict)  # indices of the textures of each kind

    def material(self, *kinds: str, repeat: float = 0.0, gloss: float | None = None) -> Material:
        """Make a material of a random one of ``kinds``, with a new texture until the kind has its number of textures.

        ``repeat`` is the number of repeats per world unit. If ``repeat`` is 0, the texture covers every face once.
        ``gloss`` is random by default, and zero in about half of the cases.
        """
        kind = kinds[self.rng.integers(len(kinds))]
        other_textures = 3  # most textures of any other kind
        ids = self.by_kind.setdefault(kind, [])
        limit = MAX_TEXTURES.get(kind, other_textures)
        if len(ids) < limit:
            ids.append(len(self.textures))
            self.textures.append(KINDS[kind](self.rng, self.size).astype(np.float32))
        texture = ids[self.rng.integers(len(ids))] if len(ids) == limit else ids[-1]
        shift = self.rng.uniform(0, 1, 2) if repeat else np.zeros(2)
        gloss = max(0.0, float(self.rng.uniform(-0.5, 0.5))) if gloss is None else gloss
        return Material(texture, repeat, gloss, (float(shift[0]), float(shift[1])))
