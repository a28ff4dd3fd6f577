"""Hints for reading a file of Gaussians whose values do not show their encoding, or suggest a wrong one."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal

from gsmerge.settings.setting import Settings, setting

OpacityChoice = Literal["auto", "logit", "raw"]
ScaleChoice = Literal["auto", "log", "linear"]
QuatChoice = Literal["auto", "wxyz", "xyzw", "xyzw-root", "camera"]
Order = Literal["auto", "view-major", "view-fastest", "layer-major", "column-major", "unordered", "none"]

SCENE_ARGUMENTS = ("cameras", "images", "masks", "protect", "opacity")  # of read_scene, besides hints
NONE = "none"  # in place of a path: read the scene without cameras, photos or masks. Path(NONE) is a file of that name


@dataclass(frozen=True)
class ReadHints(Settings):
    """Hints for reading files whose values do not show their encoding, or suggest a wrong one."""

    exporter: str = setting("auto", "Program that wrote the file, such as da3 or depthsplat; auto recognises it.")
    quats: QuatChoice = setting("auto", "How the file stores rotations: wxyz, xyzw, xyzw-root (w last; the rotation "
        "applied twice), or camera (relative to the camera of each view).",
        "`auto`: as the exporter does. Where the pixels are known, this is checked against the surface.")  # fmt: skip
    scales: ScaleChoice = setting("auto", "How the file stores scales: log or linear; auto reads them as logarithms, "
        "unless the size of the scene shows that they are linear.")  # fmt: skip
    order: Order = setting("auto", "Order of the rows; none: the Gaussians belong to no pixels.",
        "`unordered`: each Gaussian may come from a pixel, but its row does not show which.")  # fmt: skip
    scene_scale: float | None = setting(None, "Scale of the Gaussians' world relative to that of the cameras; null: "
        "estimate it.", above=0, below=inf)  # fmt: skip
    max_side: int = setting(1200, "Longest side of a view, in pixels, if the Gaussians belong to no pixels; larger "
        "photos are resized.", least=16, unit="pixels")  # fmt: skip


@dataclass(frozen=True)
class FileHints(ReadHints):
    """Hints that ``--hint`` accepts: those of :class:`ReadHints`, and the encoding of opacity."""

    opacity: OpacityChoice = setting("auto", "How the file stores opacity: logit, or raw for values in [0, 1]; auto "
        "decides by the values.")  # fmt: skip
