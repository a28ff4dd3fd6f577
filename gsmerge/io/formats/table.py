"""The table of formats of Gaussians, by which files are read and written (docs/guide/formats.md, "Adding a format")."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from gsmerge.errors import UsageError
from gsmerge.io.formats import compressed, glb, ply, sog, splat, spz, streamed
from gsmerge.io.formats.arrays import MIP_COMMENT, StoredRows
from gsmerge.types import Gaussians, StrPath

# What encodes Gaussians with lines for the header and, where there are such, columns of normals, as parts of a file
Encode = Callable[[Gaussians, Sequence[str], bool], Iterable[bytes | memoryview]]


@dataclass(frozen=True)
class Format:
    """A format of Gaussians."""

    ending: str  # of files' names, in lower case; without a dot, the whole name of an index
    read: Callable[[Path], StoredRows] | None  # None: it is only written
    encode: Encode | None  # None: :func:`gsmerge.io.write_levels` writes it
    max_degree: int  # of the harmonics that there is room for
    version: int | None = None  # where several are written
    require: Callable[[], object] = lambda: None  # raises UsageError where the writer's package is missing

    def names(self, path: StrPath) -> bool:
        """Return whether a file of this name has the format."""
        name = Path(path).name
        return name.lower().endswith(self.ending) if self.ending[0] == "." else name == self.ending


PLY = Format(
    ".ply", ply.read_rows, lambda rows, lines, normals: ply.ply_blocks(rows, lines, normals=normals), ply.MAX_DEGREE
)
FORMATS = (  # of endings that end alike the longest first
    Format(
        ".compressed.ply", ply.read_rows, lambda rows, lines, _: [compressed.compressed_bytes(rows, lines)],
        compressed.MAX_DEGREE,
    ),
    PLY,
    Format(
        ".spz", spz.read_rows, lambda rows, lines, _: [spz.spz_bytes(rows, mip=MIP_COMMENT in lines)],
        spz.MAX_DEGREES[3], version=3,
    ),
    Format(
        ".spz", spz.read_rows, lambda rows, lines, _: [spz.spz_bytes(rows, mip=MIP_COMMENT in lines, version=4)],
        spz.MAX_DEGREES[4], version=4, require=spz.zstandard,
    ),
    Format(
        ".sog", sog.read_rows, lambda rows, lines, _: [sog.sog_bytes(rows, mip=MIP_COMMENT in lines)], sog.MAX_DEGREE
    ),
    Format(".splat", splat.read_rows, lambda rows, *_: [splat.splat_bytes(rows)], splat.MAX_DEGREE),
    Format(".glb", None, lambda rows, *_: [glb.glb_bytes(rows)], glb.MAX_DEGREE),
    Format(streamed.INDEX, streamed.read_rows, None, streamed.MAX_DEGREE),
)  # fmt: skip
OUTPUT_FORMATS = tuple(dict.fromkeys(row.ending for row in FORMATS if row.encode is not None))
SCENE_SUFFIXES = tuple(dict.fromkeys(Path(f"_{row.ending}").suffix for row in FORMATS[:-1] if row.read is not None))


def input_format(path: StrPath) -> Format:
    """Return the format of a name to read; PLY for a name that is none's."""
    return next((row for row in FORMATS if row.read is not None and row.names(path)), PLY)


def output_format(path: StrPath, spz_version: int = 3, *, levels: bool = False) -> Format:
    """Return the format that a name asks for; UsageError if there is none or a package is missing.

    ``levels``: the name may be that of an index of levels of detail. ValueError if there is no such version.
    """
    rows = [row for row in FORMATS if (levels or row.encode is not None) and row.names(path)]
    if not rows:
        *first, last = OUTPUT_FORMATS
        index = f", or the name {streamed.INDEX}" if levels else ""
        raise UsageError(f"{path}: expected a name that ends in {', '.join(first)} or {last}{index}")
    chosen = next((row for row in rows if row.version in (None, spz_version)), None)
    if chosen is None:
        raise ValueError(f"spz_version: expected {' or '.join(str(row.version) for row in rows)}, got {spz_version}")
    chosen.require()
    return chosen
