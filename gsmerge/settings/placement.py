"""Declare the settings that turn, scale and move a scene when it is written, and limit its harmonics."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gsmerge.settings.setting import Settings, setting

AXES = ("x", "-x", "y", "-y", "z", "-z")


@dataclass(frozen=True)
class PlacementOptions(Settings):
    """Settings of the coordinate frame of a written scene, in the order in which they are applied."""

    up: str | None = setting(None, "Turn the scene so that its upward direction is this axis: y for most viewers, z "
        "for Blender.",
        "The upward direction is the mean of those of the cameras, or -y if no camera is known.",
        choices=AXES)  # fmt: skip
    scale: float | None = setting(None, "Enlarge the scene about the origin by this factor.", above=0, below=1e9)
    rotate: str | None = setting(None, "Turn the scene by these angles, in degrees, about the axes x, y and z, in this "
        "order.")  # fmt: skip
    translate: str | None = setting(None, "Move the scene along the axes x, y and z, in units after scaling.")
    sh_degree: int | None = setting(None, "Leave out spherical harmonics above this degree.", least=0, most=4)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("rotate", "translate"):
            parse_triple(name, getattr(self, name))

    @property
    def asked(self) -> bool:
        """True if any of these settings changes what is written."""
        return self.moves or self.sh_degree is not None

    @property
    def moves(self) -> bool:
        """True if the scene is turned, scaled or moved."""
        return any(value is not None for value in (self.up, self.scale, self.rotate, self.translate))


def parse_triple(name: str, text: str | None) -> tuple[float, float, float]:
    """Parse three numbers that are separated by commas; None stands for three zeros.

    Example:
        >>> parse_triple("rotate", "90,0,0")
        (90.0, 0.0, 0.0)
    """
    if text is None:
        return 0.0, 0.0, 0.0
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not math.isfinite(x + y + z):
        raise ValueError(f"{name}: expected three numbers X,Y,Z, got {text!r}")
    return x, y, z
