"""Settings of the files of a result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gsmerge.settings.placement import parse_triple
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
        "above the ellipsoid. Of the scene, y points down and z south; its unit is a metre.")  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        parse_triple("place", self.place)
