"""All exporters, and telling them apart."""

from __future__ import annotations

from collections.abc import Sequence

from gsmerge.io.alignment.layouts import Layout
from gsmerge.io.alignment.similarity import Frame
from gsmerge.io.exporters import da3, longlrm, pixelsplat, single_image, trained, voxels
from gsmerge.io.exporters.exporter import Exporter
from gsmerge.io.formats.ply import PlyInfo

_MODULES = (da3, pixelsplat, voxels, single_image, longlrm, trained)
EXPORTERS: dict[str, Exporter] = {
    value.name: value for module in _MODULES for value in vars(module).values() if isinstance(value, Exporter)
}


def find_exporter(name: str) -> Exporter | None:
    """The exporter of that name; None for "auto".

    Raises:
        ValueError: If there is none of that name.
    """
    if name == "auto":
        return None
    if name not in EXPORTERS:
        raise ValueError(f"exporter: expected 'auto' or one of {', '.join(EXPORTERS)}, got {name!r}")
    return EXPORTERS[name]


def recognise(info: PlyInfo, layout: Layout | None, frame: Frame | None, cameras: str | None) -> tuple[Exporter, ...]:
    """All exporters that may have written a file; see :meth:`Exporter.may_have_written`.

    Those that leave a mark of their own in the header go before those that leave none.
    """
    found = [d for d in EXPORTERS.values() if d.may_have_written(info, layout, frame, cameras)]
    marked = [d for d in found if d.elements or d.byte_columns or d.comment]
    return tuple(marked or found)


def exporter_names(exporters: Sequence[Exporter]) -> str:
    """For people: the one exporter, or all that it may be."""
    if not exporters:
        return "none that is known by name"
    titles = [exporter.title for exporter in exporters]
    return titles[0] if len(titles) == 1 else f"{', '.join(titles[:-1])} or {titles[-1]}"
