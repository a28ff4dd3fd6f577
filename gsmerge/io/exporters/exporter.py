"""What an exporter is known by, and how its files are to be read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gsmerge.io.alignment.layouts import MAY_BE_LOOSE, Layout
from gsmerge.io.alignment.similarity import Frame
from gsmerge.io.formats.ply import PlyInfo
from gsmerge.io.hints import QuatChoice

FrameKind = Literal["same", "scaled", "shifted", "first", "middle", "upright", "other"]


@dataclass(frozen=True)
class Exporter:
    """One exporter.

    Args:
        name: As on the command line.
        title: As people call it.
        opacity: How it stores opacities.
        order: Order of its rows; "unordered": none, but each is made of a pixel; "none": they belong to no pixels.
        kinds: Which pixels it keeps; see :class:`gsmerge.io.alignment.layouts.Layout`.
        frames: Where its Gaussians may lie, seen from the cameras.
        per_pixel: Gaussians per pixel.
        degrees: SH degrees that it writes.
        normals: Whether it writes the columns nx, ny, nz.
        quats: How it stores rotations.
        check_rotations: Whether another reading of the rotations may be tried.
        elements: Elements beside ``vertex`` that it always writes.
        byte_columns: Columns that it writes as bytes.
        comment: Part of a comment in the header that it always writes.
        cameras: Formats of cameras that it writes; empty: none, any may be given.
    """

    name: str
    title: str
    opacity: Literal["logit", "raw"]
    order: str
    kinds: tuple[str, ...] = ("full",)
    frames: tuple[FrameKind, ...] = ("same",)
    per_pixel: tuple[int, ...] = (1,)
    degrees: tuple[int, ...] = (0,)
    normals: bool = True
    quats: QuatChoice = "wxyz"
    check_rotations: bool = True
    elements: tuple[str, ...] = ()
    byte_columns: tuple[str, ...] = ()
    comment: str = ""
    cameras: tuple[str, ...] = ()

    def may_have_written(self, info: PlyInfo, layout: Layout | None, frame: Frame | None, cameras: str | None) -> bool:
        """Whether a file looks like one of this exporter's.

        Args:
            info: What was found in the file.
            layout: Which row is which pixel; None where the rows belong to no pixels.
            frame: Where the cameras stand in the frame of the Gaussians.
            cameras: Format of the cameras.
        """
        header = (
            info.sh_degree in self.degrees
            and self.normals == ("nx" in info.columns)
            and info.byte_columns == self.byte_columns
            and set(self.elements) <= set(info.extra_elements)
            and any(self.comment in comment for comment in info.comments or ("",))
        )
        if not header or info.opacity_encoding != self.opacity or (self.cameras and cameras not in self.cameras):
            return False
        if layout is None or frame is None:
            return self.order in MAY_BE_LOOSE
        order = self.order if len(layout.views) > 1 or self.order != "view-fastest" else "view-major"
        return (
            order == layout.order
            and layout.kind in self.kinds
            and layout.per_pixel in self.per_pixel
            and frame.kind in self.frames
        )
