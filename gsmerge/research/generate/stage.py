"""The result of a style: shapes with textures and light, and where cameras may be."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsmerge.research.generate.shapes import Array, Material, Shape
from gsmerge.research.generate.textures import KINDS, Picture

MAX_TEXTURES = {"label": 8, "printed": 6, "plain": 6, "foliage": 4, "cloth": 4}  # in a scene; other kinds 3


@dataclass
class Palette:
    """The textures of a scene, created on demand."""

    rng: np.random.Generator
    size: int  # side of the textures, pixels
    textures: list[Picture] = field(default_factory=list)
    by_kind: dict[str, list[int]] = field(default_factory=dict)  # their indices

    def material(self, *kinds: str, repeat: float = 0.0, gloss: float | None = None) -> Material:
        """A material of one of the kinds: with a new texture, or an old one if the scene has enough of the kind.

        ``repeat`` is in repeats per world unit, 0: once over every face. ``gloss`` is at random if None, mostly none.
        """
        kind = kinds[self.rng.integers(len(kinds))]
        known = self.by_kind.setdefault(kind, [])
        if len(known) < MAX_TEXTURES.get(kind, 3):
            known.append(len(self.textures))
            self.textures.append(KINDS[kind](self.rng, self.size).astype(np.float32))
        texture = known[self.rng.integers(len(known))] if len(known) == MAX_TEXTURES.get(kind, 3) else known[-1]
        shift = self.rng.uniform(0, 1, 2) if repeat else np.zeros(2)
        gloss = max(0.0, float(self.rng.uniform(-0.5, 0.5))) if gloss is None else gloss
        return Material(texture, repeat, gloss, (float(shift[0]), float(shift[1])))


@dataclass(frozen=True)
class Light:
    """The lights of a scene."""

    towards: Array  # [3] unit vector to the light
    lamp: Array | None  # [3] position, near which surfaces are brighter; None: far away, as the sun
    key: Array  # [3] linear colour of the direct light
    ambient: Array  # [3] linear colour of the light from all sides
    softness: float  # half width of the light, radians


@dataclass(frozen=True)
class Stage:
    """A scene before it is photographed; y points down, the middle of the views is along +z."""

    shapes: tuple[Shape, ...]
    textures: tuple[Picture, ...]  # indexed by the shapes' materials
    light: Light
    focus: Array  # [3] point at which cameras are aimed
    distance: tuple[float, float]  # range of the distance of cameras from the focus
    height: tuple[float, float]  # range of the height of cameras above the ground
    swing: float  # largest angle of cameras to either side of -z, seen from the focus, degrees
