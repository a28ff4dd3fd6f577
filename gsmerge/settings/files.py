"""Declare the settings of written files: their content, and how they turn, scale and move a scene."""

from __future__ import annotations

import math
from typing import Literal

from gsmerge.frozen import dataclass
from gsmerge.settings.setting import Settings, setting

AXES = ("x", "-x", "y", "-y", "z", "-z")
# Endings of the names of files that ``gsmerge render`` can write
PICTURES = (".png", ".jpg", ".jpeg", ".webp")
TRANSPARENT = (".png", ".webp")  # those that hold alpha
GIF = ".gif"
CLIPS = (".mp4", ".webm", GIF)


@dataclass(frozen=True)
class FileOptions(Settings):
    """Options for writing a result."""

    normals: bool = setting(True, "Write the normals of a `.ply`, three columns of zeros that some viewers need: 12 of "
        "its 68 bytes per Gaussian. A `budget` in bytes counts them.")  # fmt: skip
    columns: str = setting("needed", "Columns of a `.ply`. needed: only those that are needed; full: all 62 columns of "
        "INRIA's files, with zeros for missing harmonics up to degree 3, which Unity's importer needs.",
        choices=("needed", "full"))  # fmt: skip
    viewer_cameras: bool = setting(True, "Write the cameras of the input views beside the result, as "
        "`NAME.cameras.json` for viewers.")  # fmt: skip
    spz_version: Literal[2, 3] = setting(3, "Version of a `.spz`; readers of before 2025 only read 2.")
    place: str | None = setting(None, "Where a `tileset.json` lies on the globe: LON,LAT,HEIGHT, in degrees and metres "
        "above the ellipsoid. The scene's y axis must point down, its z axis north; its unit is a metre.")  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.place is not None:
            parse_place(self.place)


def parse_place(text: str) -> tuple[float, float, float]:
    """Parse longitude and latitude in degrees and height in metres, separated by commas.

    Example:
        >>> parse_place("8.5,47.4,400")
        (8.5, 47.4, 400.0)
    """
    try:
        longitude, latitude, height = map(float, text.split(","))
        if abs(longitude) <= 180 and abs(latitude) <= 90 and math.isfinite(height):
            return longitude, latitude, height
    except ValueError:
        pass
    expected = "LON,LAT,HEIGHT, of -180 to 180 degrees, -90 to 90 degrees and metres"
    raise ValueError(f"place: expected {expected}, got {text!r}")


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
