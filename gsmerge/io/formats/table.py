"""The table of formats of Gaussians, by which files are read and written (docs/guide/formats.md, "Adding a format")."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from gsmerge.errors import UsageError
from gsmerge.io.formats import compressed, glb, ply, sog, splat, spz, streamed
from gsmerge.io.formats.arrays import StoredRows
from gsmerge.types import Gaussians, StrPath


@dataclass(frozen=True)
class Format:
    """A format of files of Gaussians: its ending and how to read and write it."""

    ending: str  # of files' names, in lower case; without a dot, the whole name of an index
    read: Callable[[Path], StoredRows] | None  # None: it is only written
    # with comments for the header; None: :func:`gsmerge.io.write_ply` or :func:`gsmerge.io.write_levels` writes it
    encode: Callable[[Gaussians, Sequence[str]], bytes] | None
    max_degree: int  # of the harmonics that there is room for
    version: int | None = None  # where several are written
    require: Callable[[], object] = lambda: None  # raises UsageError where the writer's package is missing
    each: Sequence[float] = ()  # bytes of a Gaussian by degree: of a .sog or .spz those of results, as measured

    def names(self, path: StrPath) -> bool:
        """Return whether a path ends as files of this format do."""
        name = Path(path).name
        return name.lower().endswith(self.ending) if self.ending[0] == "." else name == self.ending


_SPZ, _SOG = (17.0, 18.5, 18.9, 19.2, 20.0), (13.0, 22.0, 36.5, 56.5)
PLY = Format(".ply", ply.read_rows, None, ply.MAX_DEGREE)
FORMATS = (  # of endings that end alike the longest first
    Format(
        ".compressed.ply",
        ply.read_rows,
        compressed.compressed_bytes,
        compressed.MAX_DEGREE,
        each=(16.3, 25.3, 40.4, 61.4),
    ),
    PLY,
    Format(".spz", spz.read_rows, spz.spz_bytes, spz.MAX_DEGREES[3], 3, each=_SPZ),
    Format(".spz", spz.read_rows, partial(spz.spz_bytes, version=4), spz.MAX_DEGREES[4], 4, spz.zstandard, _SPZ),
    Format(".sog", sog.read_rows, sog.sog_bytes, sog.MAX_DEGREE, each=_SOG),
    Format(".splat", splat.read_rows, splat.splat_bytes, splat.MAX_DEGREE, each=(32.0,)),
    Format(".glb", glb.read_rows, glb.glb_bytes, glb.MAX_DEGREE, each=(52.1, 88.1, 148.1, 232.2)),
    Format(streamed.INDEX, streamed.read_rows, None, streamed.MAX_DEGREE, each=_SOG),
)
OUTPUT_FORMATS = tuple(dict.fromkeys(row.ending for row in FORMATS[:-1]))
SCENE_SUFFIXES = tuple(dict.fromkeys(Path(f"_{row.ending}").suffix for row in FORMATS[:-1] if row.read is not None))


def count_for_bytes(chosen: Format, max_bytes: int, sh_degree: int) -> int:
    """Return how many Gaussians a file of at most ``max_bytes`` has room for; UsageError if for none.

    Exact of a ``.ply``, about right of other formats, whose bytes depend on their content.
    """
    if chosen is PLY:
        return ply.count_for_bytes(max_bytes, sh_degree)
    each = chosen.each[min(sh_degree, len(chosen.each) - 1)]
    if max_bytes < each:
        raise UsageError(f"budget: expected at least {each:.0f} bytes for one Gaussian, got {max_bytes}")
    return int(max_bytes / each)


def input_format(path: StrPath) -> Format:
    """Return the format in which to read a path; PLY for unknown endings."""
    return next((row for row in FORMATS if row.read is not None and row.names(path)), PLY)


def output_format(path: StrPath, spz_version: int = 3, *, levels: bool = False) -> Format:
    """Return the format in which to write a path; UsageError for an unknown ending or a missing package.

    ``levels``: the name may be that of an index of levels of detail. ValueError if there is no such version.
    """
    rows = [row for row in (FORMATS if levels else FORMATS[:-1]) if row.names(path)]
    if not rows:
        *first, last = OUTPUT_FORMATS
        index = f", or the name {streamed.INDEX}" if levels else ""
        raise UsageError(f"{path}: expected a name that ends in {', '.join(first)} or {last}{index}")
    chosen = next((row for row in rows if row.version in (None, spz_version)), None)
    if chosen is None:
        raise ValueError(f"spz_version: expected {' or '.join(str(row.version) for row in rows)}, got {spz_version}")
    chosen.require()
    return chosen
