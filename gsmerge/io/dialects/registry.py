"""All exporters, and telling them apart."""

from __future__ import annotations

from collections.abc import Sequence

from gsmerge.io.dialects import da3, longlrm, pixelsplat, single_image, trained, voxels
from gsmerge.io.dialects.dialect import Dialect
from gsmerge.io.frame import Frame
from gsmerge.io.layouts import Layout
from gsmerge.io.ply import PlyInfo

_MODULES = (da3, pixelsplat, voxels, single_image, longlrm, trained)
DIALECTS: dict[str, Dialect] = {
    value.name: value for module in _MODULES for value in vars(module).values() if isinstance(value, Dialect)
}


def find_dialect(name: str) -> Dialect | None:
    """The exporter of that name; None for "auto".

    Raises:
        ValueError: If there is none of that name.
    """
    if name == "auto":
        return None
    if name not in DIALECTS:
        raise ValueError(f"dialect: expected 'auto' or one of {', '.join(DIALECTS)}, got {name!r}")
    return DIALECTS[name]


def recognise(info: PlyInfo, layout: Layout | None, frame: Frame | None, cameras: str | None) -> tuple[Dialect, ...]:
    """All exporters that may have written a file; see :meth:`Dialect.may_have_written`.

    Those that leave a mark of their own in the header go before those that leave none.
    """
    found = [d for d in DIALECTS.values() if d.may_have_written(info, layout, frame, cameras)]
    marked = [d for d in found if d.elements or d.byte_columns or d.comment]
    return tuple(marked or found)


def dialect_words(dialects: Sequence[Dialect]) -> str:
    """For people: the one exporter, or all that it may be."""
    if not dialects:
        return "none that is known by name"
    titles = [dialect.title for dialect in dialects]
    return titles[0] if len(titles) == 1 else f"{', '.join(titles[:-1])} or {titles[-1]}"
