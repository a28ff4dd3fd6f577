"""Grey patterns for textures: square, repeating without a seam, values 0 to 1, detail at every scale."""

from __future__ import annotations

from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

Grey: TypeAlias = NDArray[Any]  # float32


def enlarge(cells: NDArray[np.float64], size: int) -> Grey:
    """A small repeating picture, enlarged smoothly to ``[size,size]``."""
    rows, columns = cells.shape
    pad = 3
    wide = np.pad(cells, pad, mode="wrap").astype(np.float32)
    y = (np.arange(size, dtype=np.float32) + 0.5) * rows / size - 0.5 + pad
    x = (np.arange(size, dtype=np.float32) + 0.5) * columns / size - 0.5 + pad
    at_x, at_y = np.meshgrid(x, y)
    return cv2.remap(wide, at_x, at_y, cv2.INTER_CUBIC)


def noise(
    rng: np.random.Generator, size: int, *, first: int = 4, fade: float = 0.6, stretch: int = 1, ridged: bool = False
) -> Grey:
    """Octaves of random cells, each ``fade`` times as strong as the previous one: 0.3 gives clouds, 0.9 grit.

    ``first`` is the number of cells of the coarsest octave along a side, ``stretch`` the ratio of their length to their
    height; ``ridged`` gives sharp crests, as of rock and bark.
    """
    out, strength, cells = np.zeros((size, size), np.float32), 1.0, min(first, size // 2)
    while cells <= size // 2:
        layer = enlarge(rng.uniform(-1, 1, (cells, max(1, cells // stretch))), size)
        out += strength * (1 - 2 * np.abs(layer) if ridged else layer)
        strength, cells = strength * fade, cells * 2
    low, high = np.percentile(out, (1, 99))
    return np.clip((out - low) / (high - low), 0, 1).astype(np.float32)


def grid(size: int) -> tuple[Grey, Grey]:
    """x and y of every pixel, 0 to 1."""
    at = (np.arange(size, dtype=np.float32) + 0.5) / size
    x, y = np.meshgrid(at, at)
    return x, y


def warp(picture: Grey, dx: Grey, dy: Grey, amount: float) -> Grey:
    """The picture displaced by ``dx`` and ``dy`` (0 to 1) times ``amount``, a share of its side."""
    size = len(picture)
    x, y = grid(size)
    at_x = (x + amount * (dx - 0.5)) * size - 0.5
    at_y = (y + amount * (dy - 0.5)) * size - 0.5
    return cv2.remap(picture, at_x % size, at_y % size, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def courses(
    rng: np.random.Generator, size: int, rows: int, columns: int, *, joint: float, offset: float
) -> tuple[Grey, Grey]:
    """Bricks or tiles, ``rows`` courses of ``columns`` stones: a random tone for each, and 1 on the joints.

    ``joint`` is the width of the joints, as a share of a stone's height, and ``offset`` that of each second course, as
    a share of a stone's width.
    """
    x, y = grid(size)
    row = np.floor(y * rows).astype(int)
    along = x * columns + offset * (row % 2)
    down, across = y * rows - row, along - np.floor(along)
    tones = rng.uniform(0, 1, (rows, columns)).astype(np.float32)
    width = joint * columns / rows
    lines = np.minimum(np.minimum(down, 1 - down) / joint, np.minimum(across, 1 - across) / width)
    return tones[row, np.floor(along).astype(int) % columns], np.clip(1.5 - 2 * lines, 0, 1).astype(np.float32)


def cells(rng: np.random.Generator, size: int, count: int) -> tuple[Grey, Grey]:
    """Pebbles: a random tone for each of ``count``² cells, and the distance of a pixel from the cell's edge."""
    at = (np.stack(np.meshgrid(np.arange(count), np.arange(count)), -1) + rng.uniform(0, 1, (count, count, 2))) / count
    tones = rng.uniform(0, 1, (count, count)).astype(np.float32)
    x, y = grid(size)
    column, row = np.floor(x * count).astype(int), np.floor(y * count).astype(int)
    nearest, second = np.full((size, size), 9.0, np.float32), np.full((size, size), 9.0, np.float32)
    tone = np.zeros((size, size), np.float32)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            centre = at[(row + i) % count, (column + j) % count]
            dx, dy = x - centre[..., 0], y - centre[..., 1]
            d = np.hypot(dx - np.round(dx), dy - np.round(dy))
            tone = np.where(d < nearest, tones[(row + i) % count, (column + j) % count], tone)
            second = np.minimum(second, np.maximum(d, nearest))
            nearest = np.minimum(nearest, d)
    return tone, np.clip((second - nearest) * count, 0, 1).astype(np.float32)


def glyphs(rng: np.random.Generator, count: int) -> NDArray[np.uint8]:
    """``[count,7,5]`` letters of an invented alphabet, a few strokes each."""
    out = np.zeros((count, 7, 5), np.uint8)
    for letter in out:
        for _ in range(rng.integers(2, 5)):
            if rng.random() < 0.5:
                letter[rng.integers(1, 7) if rng.random() < 0.8 else 0, rng.integers(0, 3) : rng.integers(3, 6)] = 1
            else:
                letter[rng.integers(0, 4) : rng.integers(4, 8), rng.integers(0, 5)] = 1
    return out


def text_line(rng: np.random.Generator, alphabet: NDArray[np.uint8], height: int, width: int) -> Grey:
    """``[height,width]`` ink of one line of words."""
    line = np.zeros((7, max(6, 7 * width // height)), np.uint8)
    at = 0
    while at < line.shape[1] - 6:
        for letter in alphabet[rng.integers(0, len(alphabet), rng.integers(2, 10))]:
            if at < line.shape[1] - 6:
                line[:, at : at + 5] = letter
            at += 6
        at += 4
    return cv2.resize(line.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
