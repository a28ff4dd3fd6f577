"""Declare the settings of the files of a result."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from gsmerge.settings.setting import Settings, setting


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
