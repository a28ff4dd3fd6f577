"""What a style builds: shapes with textures and light, and where cameras may stand."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsmerge.research.generate.shapes import Array, Look, Shape
from gsmerge.research.generate.textures import KINDS, Picture

MOST = {"label": 8, "printed": 6, "plain": 6, "foliage": 4, "cloth": 4}  # textures of a kind in a scene; others 3


@dataclass
class Palette:
    """The textures of a scene, made as they are asked for.

    Args:
        rng: Source of randomness.
        size: Side of the textures, pixels.
        textures: What has been made.
        made: Indices of them by kind.
    """

    rng: np.random.Generator
    size: int
    textures: list[Picture] = field(default_factory=list)
    made: dict[str, list[int]] = field(default_factory=dict)

    def look(self, *kinds: str, repeat: float = 0.0, gloss: float | None = None) -> Look:
        """A surface of one of the kinds: a new texture, or one that the scene has enough of.

        Args:
            kinds: Names of :data:`gsmerge.research.generate.textures.KINDS`.
            repeat: Repeats per world unit; 0: once over every face.
            gloss: Strength of highlights; None: at random, mostly none.
        """
        kind = kinds[self.rng.integers(len(kinds))]
        known = self.made.setdefault(kind, [])
        if len(known) < MOST.get(kind, 3):
            known.append(len(self.textures))
            self.textures.append(KINDS[kind](self.rng, self.size).astype(np.float32))
        texture = known[self.rng.integers(len(known))] if len(known) == MOST.get(kind, 3) else known[-1]
        shift = self.rng.uniform(0, 1, 2) if repeat else np.zeros(2)
        gloss = max(0.0, float(self.rng.uniform(-0.5, 0.5))) if gloss is None else gloss
        return Look(texture, repeat, gloss, (float(shift[0]), float(shift[1])))


@dataclass(frozen=True)
class Light:
    """Where light comes from.

    Args:
        towards: ``[3]`` unit vector to the light.
        lamp: ``[3]`` place that near things are brighter at; None: far away, as the sun.
        key: ``[3]`` linear colour of the direct light.
        ambient: ``[3]`` linear colour of the light from all sides.
        softness: Half width of the light, radians.
    """

    towards: Array
    lamp: Array | None
    key: Array
    ambient: Array
    softness: float


@dataclass(frozen=True)
class Stage:
    """A scene before it is photographed; y points down, the middle of the views is along +z.

    Args:
        shapes: What there is.
        textures: Indexed by the shapes' looks.
        light: The light.
        focus: ``[3]`` what cameras look at.
        distance: Least and most distance of cameras from the focus.
        height: Least and most height of cameras above the ground.
        swing: Most degrees that cameras may stand to either side of -z, seen from the focus.
    """

    shapes: tuple[Shape, ...]
    textures: tuple[Picture, ...]
    light: Light
    focus: Array
    distance: tuple[float, float]
    height: tuple[float, float]
    swing: float
