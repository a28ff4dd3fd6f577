"""What a caller may say about a file instead of having it detected."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

from gsmerge.io.alignment.layouts import ORDERS, Order

QuatChoice = Literal["auto", "wxyz", "xyzw", "xyzw-root", "camera"]
QUATS: tuple[str, ...] = get_args(QuatChoice)


@dataclass(frozen=True)
class ReadHints:
    """How to read a file where its values do not show it, or mislead; ValueError if a value is no possible one."""

    exporter: str = "auto"  # which one wrote it, of :data:`gsmerge.io.exporters.EXPORTERS`; "auto": recognised
    # How rotations are stored: "wxyz"; "xyzw"; "xyzw-root": xyzw, each applied twice, so the roots are used where the
    # pixels are known; "camera": wxyz, relative to the own view's camera; "auto": as the exporter says, and checked
    # against the surface where the pixels are known.
    quats: QuatChoice = "auto"
    order: Order = "auto"  # of the rows; "unordered": each may be made of a pixel; "none": they belong to no pixels
    scene_scale: float | None = None  # size of the Gaussians' world in units of the cameras'; None: solved for
    max_side: int = 1200  # longest side of the views of unaligned Gaussians, pixels; larger ones are resized

    def __post_init__(self) -> None:
        for name, known in (("quats", QUATS), ("order", ORDERS)):
            if getattr(self, name) not in known:
                raise ValueError(f"{name}: expected {_listed(known)}, got {getattr(self, name)!r}")
        if self.scene_scale is not None and not 0 < self.scene_scale < float("inf"):
            raise ValueError(f"scene_scale: expected a positive number, got {self.scene_scale}")
        if isinstance(self.max_side, bool) or not isinstance(self.max_side, int) or self.max_side < 16:
            raise ValueError(f"max_side: expected a whole number of at least 16 pixels, got {self.max_side!r}")


AUTO = ReadHints()


def make_hints(values: dict[str, Any]) -> ReadHints:
    """Hints from keyword arguments; ValueError if one is unknown or none of its possible values."""
    known = {field.name for field in fields(ReadHints)}
    unknown = sorted(values.keys() - known)
    if unknown:
        raise ValueError(f"expected {_listed(sorted(known))}, got {unknown[0]!r}")
    return ReadHints(**values)


def _listed(names: Iterable[str]) -> str:
    *first, last = (repr(name) for name in names)
    return f"{', '.join(first)} or {last}"
