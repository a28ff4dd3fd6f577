"""Hints on reading a file of Gaussians whose values do not show how, or mislead."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal

from gsmerge.settings.setting import Settings, setting

OpacityChoice = Literal["auto", "logit", "raw"]
QuatChoice = Literal["auto", "wxyz", "xyzw", "xyzw-root", "camera"]
Order = Literal["auto", "view-major", "view-fastest", "layer-major", "column-major", "unordered", "none"]

OF_SCENE = ("cameras", "images", "masks", "protect", "opacity")  # arguments of reading a scene besides hints
NONE = "none"  # in the place of cameras, photos or masks: the scene is read without; Path(NONE) is a file of that name


@dataclass(frozen=True)
class ReadHints(Settings):
    """Hints for reading files whose values do not tell, or mislead about, how they are meant."""

    exporter: str = setting("auto", "The program that wrote the file, such as da3 or depthsplat; auto recognises it.")
    quats: QuatChoice = setting("auto", "How the file stores rotations: w first, w last, w last and applied twice, or "
        "relative to each view's camera.",
        "`auto`: as the exporter says, and checked against the surface where the pixels are known.")  # fmt: skip
    order: Order = setting("auto", "Order of the rows; none: the Gaussians belong to no pixels.",
        "`unordered`: each may be made of a pixel.")  # fmt: skip
    scene_scale: float | None = setting(None, "Size of the Gaussians' world in units of the cameras'; null: it is "
        "estimated.", above=0, below=inf)  # fmt: skip
    max_side: int = setting(1200, "Longest side of a view, pixels, where the Gaussians belong to no pixels; larger "
        "photos are resized.", least=16, unit="pixels")  # fmt: skip


@dataclass(frozen=True)
class FileHints(ReadHints):
    """Hints that ``--hint`` accepts: those of :class:`ReadHints`, and the opacity's encoding."""

    opacity: OpacityChoice = setting("auto", "How the file stores opacity: as logits, or raw in [0, 1]; auto decides "
        "by the values.")  # fmt: skip
