"""Declare hints for reading files of Gaussians whose values do not show their encoding, or suggest a wrong one."""

from __future__ import annotations

from math import inf
from typing import Literal

from gsmerge.frozen import dataclass
from gsmerge.settings.setting import Settings, setting

OpacityChoice = Literal["auto", "logit", "raw"]
ScaleChoice = Literal["auto", "log", "linear"]
ColorChoice = Literal["auto", "sh", "rgb", "logit"]
QuatChoice = Literal["wxyz", "xyzw"]
Order = Literal["auto", "view-major", "view-fastest", "none"]

SCENE_ARGUMENTS = ("cameras", "images", "masks", "protect", "opacity")  # arguments of read_scene other than hints
NONE = "none"  # this text in place of a path means to read the scene without such files; Path("none") is a file


@dataclass(frozen=True)
class ReadHints(Settings):
    """Hints for reading files whose values do not show their encoding, or suggest a wrong one."""

    exporter: str = setting("auto", "Program that wrote the file, such as da3 or depthsplat; auto recognises it.")
    quats: QuatChoice = setting("wxyz", "How the file stores rotations: wxyz, or xyzw (w last).")
    scales: ScaleChoice = setting("auto", "How the file stores scales: log or linear; auto reads them as logarithms, "
        "unless the size of the scene shows that they are linear.")  # fmt: skip
    colors: ColorChoice = setting("auto", "What the file stores as f_dc: sh (harmonics), rgb or logit (of rgb); "
        "auto reads them as harmonics, unless all end at black and white as RGB does.")  # fmt: skip
    order: Order = setting("auto", "Order of the rows: view-major (view by view, line by line), view-fastest (the "
        "views of a pixel together), or none: the Gaussians belong to no pixels; auto tries all.")  # fmt: skip
    scene_scale: float | None = setting(None, "Scale of the Gaussians' world relative to that of the cameras; null: "
        "estimate it.", above=0, below=inf)  # fmt: skip
    max_side: int = setting(1200, "Longest side of a view, in pixels, if the Gaussians belong to no pixels; larger "
        "photos are resized.", least=16, unit="pixels")  # fmt: skip


@dataclass(frozen=True)
class FileHints(ReadHints):
    """Hints that ``--hint`` accepts: the fields of :class:`ReadHints`, and how the file stores opacity."""

    opacity: OpacityChoice = setting("auto", "How the file stores opacity: logit, or raw for values in [0, 1]; auto "
        "decides by the values.")  # fmt: skip
