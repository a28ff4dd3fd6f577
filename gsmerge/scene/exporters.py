"""Hints on how to read a file, by its caller and by the exporters that are known by name.

To add an exporter, add an :class:`Exporter` to the tuple below and a row to docs/reference/exporters.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal

from gsmerge.alignment import MAY_BE_UNALIGNED, WITH_PHOTOS, Layout
from gsmerge.geometry import Similarity
from gsmerge.settings.reading import QuatChoice, ReadHints

if TYPE_CHECKING:
    from gsmerge.io.formats.read import FileInfo

FrameKind = Literal["same", "scaled", "shifted", "first", "middle", "upright", "other"]


AUTO = ReadHints()


def make_hints(values: dict[str, Any]) -> ReadHints:
    """Make hints from keyword arguments; ValueError if a name or a value is unknown."""
    names = {field.name for field in fields(ReadHints)}
    unknown = sorted(values.keys() - names)
    if unknown:
        raise ValueError(f"expected {_listed(sorted(names))}, got {unknown[0]!r}")
    return ReadHints(**values)


def _listed(names: Iterable[str]) -> str:
    *first, last = (repr(name) for name in names)
    return f"{', '.join(first)} or {last}"


@dataclass(frozen=True)
class Exporter:
    """A program that writes files of Gaussians, and the properties by which its files are known."""

    name: str  # as on the command line
    title: str  # as people call it
    opacity: Literal["logit", "raw"]  # how it stores opacities
    order: str  # order of its rows; "unordered": none, but each is made of a pixel; "none": they belong to no pixels
    kinds: tuple[str, ...] = ("full",)  # which pixels it keeps; see ``gsmerge/alignment/layouts.py``
    # where its Gaussians may lie in the frame of the cameras; see :class:`gsmerge.geometry.Similarity`
    frames: tuple[FrameKind, ...] = ("same",)
    per_pixel: tuple[int, ...] = (1,)  # Gaussians per pixel
    degrees: tuple[int, ...] = (0,)  # SH degrees that it writes
    normals: bool = True  # whether it writes the columns nx, ny, nz
    quats: QuatChoice = "wxyz"  # how it stores rotations
    check_rotations: bool = True  # whether another reading of the rotations may be tried
    elements: tuple[str, ...] = ()  # elements besides ``vertex`` that it always writes
    byte_columns: tuple[str, ...] = ()  # columns that it writes as bytes
    comment: str = ""  # part of a comment in the header that it always writes
    cameras: tuple[str, ...] = ()  # formats of cameras that it writes; empty: none, any may be given

    def may_have_written(self, info: FileInfo, layout: Layout | None, frame: Similarity | None, cameras: str) -> bool:
        """Return whether a file looks as if this exporter had written it; see :func:`choose_exporters`."""
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
            return self.order in MAY_BE_UNALIGNED
        order = self.order if len(layout.views) > 1 or self.order != "view-fastest" else "view-major"
        return (
            order == layout.order
            and layout.kind in self.kinds
            and layout.per_pixel in self.per_pixel
            and frame.kind in self.frames
        )


# The pixelSplat family shares code but differs in order, trimming and rotations. Its worlds are recentred on the
# median, divided by a quantile and rotated upright: a scale and a shift that are stored nowhere.
_UPRIGHT: tuple[FrameKind, ...] = ("upright",)
_ANY: tuple[FrameKind, ...] = ("same", "scaled", "shifted", "other")
_NORMALS = ("nx", "ny", "nz")

_EXPORTERS = (
    # Border and far pixels dropped, cameras of the nested model in another unit. Its own renderer uses its rotations
    # as they are stored, so they are never read in another way.
    Exporter(
        "da3", "Depth Anything 3", "logit", "view-major", ("box+depth", "box", "pruned"), _ANY, check_rotations=False,
        cameras=("DA3 npz", "COLMAP binary", "COLMAP text", WITH_PHOTOS),
    ),
    Exporter("pixelsplat", "pixelSplat", "raw", "view-major", ("full",), _UPRIGHT, per_pixel=(1, 2, 3), quats="camera"),
    Exporter(
        "pixelsplat-script", "pixelSplat's figure script", "raw", "view-fastest", ("trim", "pruned"), _UPRIGHT,
        per_pixel=(1, 2, 3), quats="camera",
    ),
    Exporter("mvsplat", "MVSplat", "raw", "view-fastest", ("trim", "pruned"), _UPRIGHT),
    Exporter("spfsplat", "SPFSplat", "raw", "view-fastest", ("trim",), _UPRIGHT),
    Exporter("depthsplat", "DepthSplat", "logit", "view-fastest", ("trim",), ("first", "same")),
    Exporter("volsplat", "VolSplat", "logit", "none", frames=("first", "same")),
    Exporter(
        "resplat", "ReSplat", "logit", "view-major", ("full",), ("middle", "same"), degrees=(3,), quats="camera"
    ),
    Exporter("noposplat", "NoPoSplat", "raw", "view-major", ("full",), _ANY, degrees=(0, 4)),
    Exporter("yonosplat", "YoNoSplat", "raw", "view-fastest", ("trim", "pruned"), _ANY, quats="camera"),
    Exporter("vicasplat", "VicaSplat", "logit", "unordered", ("pruned",), degrees=(0, 4)),
    Exporter("flash3d", "Flash3D", "raw", "layer-major", ("full",), _UPRIGHT, per_pixel=(2,)),
    Exporter("splatt3r", "Splatt3R", "raw", "view-major", ("full",), _ANY, quats="xyzw-root"),
    # Gaussians merged in voxels.
    Exporter("anysplat", "AnySplat", "raw", "none"),
    Exporter("worldmirror", "WorldMirror", "raw", "none"),
    # Models of one image, or of a few of one object.
    Exporter(
        "sharp", "SHARP", "logit", "layer-major", ("full",), per_pixel=(2,), normals=False,
        elements=("extrinsic", "intrinsic"),
    ),
    Exporter(
        "splatter-image", "Splatter Image", "logit", "view-major", ("pruned", "full"), ("same", "scaled", "other"),
        degrees=(1,),
    ),
    # Normals as bytes, 45 harmonics whatever the degree, sorted by opacity once it prunes.
    Exporter(
        "longlrm", "Long-LRM", "logit", "view-major", ("full", "pruned"), _ANY, degrees=(3,), byte_columns=_NORMALS
    ),
    Exporter(
        "longlrm-sorted", "Long-LRM, sorted by opacity", "logit", "unordered", ("pruned",), ("same", "scaled"),
        degrees=(3,), byte_columns=_NORMALS,
    ),
    # Scenes that were optimised, not predicted.
    Exporter("inria", "INRIA 3DGS", "logit", "none", degrees=(0, 1, 2, 3), cameras=("INRIA cameras.json",)),
    Exporter("nerfstudio", "nerfstudio", "logit", "none", degrees=(0, 1, 2, 3), comment="Nerstudio"),
    Exporter("gsplat", "gsplat", "logit", "none", degrees=(0, 1, 2, 3), normals=False),
)  # fmt: skip
EXPORTERS = {exporter.name: exporter for exporter in _EXPORTERS}


def find_exporter(name: str) -> Exporter | None:
    """Return the exporter with a name; None for "auto", ValueError if there is none."""
    if name != "auto" and name not in EXPORTERS:
        raise ValueError(f"exporter: expected 'auto' or one of {', '.join(EXPORTERS)}, got {name!r}")
    return EXPORTERS.get(name)


def choose_exporters(
    name: str, info: FileInfo, layout: Layout | None, frame: Similarity | None, cameras: str
) -> tuple[Exporter, ...]:
    """Return the exporter with a name; for "auto", all exporters that may have written the file.

    Exporters that leave a mark of their own in the header go before those that leave none. ``layout`` and ``frame``
    are those of the rows; None where the rows belong to no pixels.
    """
    exporter = find_exporter(name)
    if exporter is not None:
        return (exporter,)
    possible = [e for e in EXPORTERS.values() if e.may_have_written(info, layout, frame, cameras)]
    marked = [e for e in possible if e.elements or e.byte_columns or e.comment]
    return tuple(marked or possible)


def exporter_names(exporters: Sequence[Exporter]) -> str:
    """Join the titles of exporters for a message."""
    if not exporters:
        return "none that is known by name"
    titles = [exporter.title for exporter in exporters]
    return titles[0] if len(titles) == 1 else f"{', '.join(titles[:-1])} or {titles[-1]}"
