"""The table of formats in which files of Gaussians are read and written (docs/reference/formats.md)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np

from gsmerge.arrays import to_float32
from gsmerge.errors import UsageError
from gsmerge.frozen import dataclass, field
from gsmerge.io.atomic import AddOutput
from gsmerge.io.formats import ply
from gsmerge.io.formats.rows import FLAT_COMMENT, MIP_COMMENT, StoredRows
from gsmerge.runtime.memory import human_bytes
from gsmerge.runtime.plugins import lazy_functions
from gsmerge.settings.files import FileOptions
from gsmerge.settings.setting import join_words
from gsmerge.types import NO_CAMERAS, SH_C0, Cameras, Gaussians, StrPath

STATE_ENDING = ".gsm"  # ending of states, which gsmerge extend writes
INDEX = "lod-meta.json"  # name of a Streamed SOG, by which viewers recognise it


_lazy = lazy_functions(__package__)
WRITE_APART = _lazy("write.write_apart")


@dataclass(frozen=True, eq=False)
class Contents:
    """The content of an output. A format leaves out the parts that it cannot store."""

    levels: Sequence[Gaussians]  # the finest level of detail first
    comments: Sequence[str] = ()  # lines for the header
    cameras: Cameras = NO_CAMERAS
    names: Sequence[str] = ()  # names of the cameras
    title: str = ""
    options: FileOptions = field(default_factory=FileOptions)
    extra_columns: np.ndarray | None = None  # structured array ``[n]``: additional columns of a ``.ply`` with one level


PLAIN = Contents(())  # beside Gaussians, a file gets no comments and no cameras, and options have their defaults
# Type of functions that write all files of an output. The arguments are the function from
# :func:`gsmerge.io.atomic_outputs` that adds a temporary file, the path of the output, the temporary file of this path,
# and the content. The result is a dictionary: path of each level of detail, finest first -> temporary files of the
# level.
WriteOutput = Callable[[AddOutput, Path, Path, Contents], dict[Path, list[Path]]]


@dataclass(frozen=True)
class Held:
    """The numbers of one attribute that a format holds: those from ``low`` to ``high``, others become the nearest."""

    low: float
    high: float
    step: float  # between two numbers; of scales it is a factor less 1, and 0 stands for float32


@dataclass(frozen=True, eq=False)
class Format:
    """A format of files of Gaussians: its ending, and functions that read and write the format.

    All properties of a format that a run needs are here, so that a new format takes one module and one row of the table
    of formats. The table names most functions by text, so that a module is imported when its function is first called.
    The writers of pages are in another package, since they render the scene.
    """

    ending: str  # of names, in lower case; without a leading dot, it is the whole name of a folder's main file
    about: str  # description for people
    read: Callable[[Path], StoredRows] | None  # None: the format is only written
    # Returns a file with Gaussians, and with what the format stores of the rest of the content; None: ``write_ply`` or
    # ``write`` writes the file
    encode: Callable[[Gaussians, Contents], bytes] | None
    max_degree: int  # largest degree of harmonics that is written; -1: the format is only read
    first_view: bool = False  # True: viewers start at the first camera of a file, which always gets one
    beside: str = ""  # name of a file that is written beside an output; "": none
    # Name of a file beside the output that gives viewers their first camera. {stem} is the output's name without its
    # ending. "": there is no such file
    settings: str = ""
    write: WriteOutput = WRITE_APART  # by default, writes each level to a separate file
    require: Callable[[], object] = lambda: None  # raises UsageError if the writer's package or program is missing
    finish: Callable[[Path], object] = lambda _: None  # is called with the output's path after all files were renamed
    holds: Callable[[Path], bool] | None = None  # returns whether a file of this name has Gaussians; None: each has

    # How levels of detail are written: "apart" for a file per level, "inside" for all levels in one output, "" if the
    # format allows only one level
    levels: Literal["", "apart", "inside"] = "apart"
    has_cameras: bool = False  # True: the cameras of views are inside the output, not in a file beside it
    round_means: Callable[[np.ndarray], np.ndarray] = to_float32  # rounds positions as a file of the format does
    # Attribute of Gaussians, linear as in memory -> the numbers that the format holds; others have no limits
    values: Mapping[str, Held] = field(default_factory=dict)
    coarse: bool = (
        False  # whether rounding to these numbers is visible, so that scores are measured on what is read back
    )
    inside: str = ""  # ending of the file inside an output, if it is a file of another format
    columns: bool = False  # whether the user can choose which of INRIA's columns a file has
    marks: Sequence[str] | None = ()  # comments of the input that a copy keeps; None: all of ``copied_comments``
    max_gaussians: float = math.inf  # most Gaussians that its public readers read
    # Note for the user on harmonics that the format leaves out
    harmonics_note: str = "harmonics above degree {degree}, which {ending} cannot store, are left out"

    # Bytes of a Gaussian with harmonics up to degree 0, 1, 2 and 3; the numbers of packed formats are measured. Empty:
    # budgets in bytes are refused
    gaussian_bytes: Sequence[float] = ()
    other_bytes: Callable[[], int] = lambda: 0  # returns the bytes of an output besides those of its Gaussians
    # Returns how many Gaussians of a degree fit into a number of bytes; None if the values of Gaussians change the size
    count: Callable[[int, int], int] | None = None
    # Returns the bytes of an output of Gaussians, cameras and comments; None: as many as ``encode`` returns
    measure: Callable[[Gaussians, Cameras, Sequence[str]], int] | None = None

    def names(self, path: StrPath) -> bool:
        """Return whether the name of a path has the ending of this format."""
        name = Path(path).name
        return name.lower().endswith(self.ending) if self.ending[0] == "." else name == self.ending

    def settings_path(self, output: Path) -> Path | None:
        """Return the path of the file that gives viewers their first camera; None if the format has no such file."""
        stem = output.name.removesuffix(self.ending)
        return output.with_name(self.settings.format(stem=stem)) if self.settings else None

    def beside_path(self, output: Path) -> Path | None:
        """Return the path of the file that this format always writes beside an output; None if there is none."""
        return output.with_name(self.beside.format(stem=output.stem)) if self.beside else None


_page = lazy_functions("gsmerge.drawing.pages")
# Bytes of a Gaussian with harmonics up to degree 0, 1, 2 and 3
_SPZ = 17.0, 19.5, 22.8, 27.1
_SOG = 13.0, 22.0, 36.5, 56.5
_OPACITY = Held(0, 1, 1 / 255)
_SPZ_VALUES = {
    "scales": Held(math.exp(-10), math.exp(255 / 16 - 10), math.expm1(1 / 16)), "opacities": _OPACITY,
    "sh0": Held(-0.5 / 0.15, 0.5 / 0.15, 1 / 255 / 0.15), "shN": Held(-1, 127 / 128, 1 / 64),
}  # fmt: skip
_IN_TEXT = 4 / 3  # bytes of base64 per byte; a page has its .sog as base64
PLY = Format(
    ".ply", "everything as float32, in INRIA's columns", ply.read_rows, None, ply.MAX_DEGREE,
    gaussian_bytes=(68.0, 104.0, 164.0, 248.0), count=ply.count_for_bytes, columns=True, marks=None,
    values={"scales": Held(math.exp(-30), math.exp(30), 0)},
    harmonics_note="harmonics above degree {degree} are left out, since few programs read a .ply with them",
)  # fmt: skip
LEVELS = Format(
    INDEX, "levels of detail in chunks; written by splat-transform",
    _lazy("streamed.read_rows"), None, 3, require=_lazy("splat_transform.find_program"),
    write=_lazy("streamed.write_output"), finish=_lazy("streamed.remove_unused_chunks"), levels="inside",
    first_view=True, settings="settings.json", inside=".sog", round_means=_lazy("sog.round_means"),
    marks=(MIP_COMMENT, FLAT_COMMENT),
)  # fmt: skip
TILESET = Format(
    "tileset.json", "3D Tiles for Cesium: a .spz in a .glb beside it", _lazy("tileset.read_rows"), None, 3,
    holds=Path.is_file, write=_lazy("tileset.write_output"), levels="",
    round_means=_lazy("spz.round_means"), values=_SPZ_VALUES, coarse=True, inside=".spz",
    marks=(MIP_COMMENT,), max_gaussians=10_000_000, beside="tileset.glb",
    gaussian_bytes=_SPZ, other_bytes=_lazy("tileset.most_other_bytes"), measure=_lazy("tileset.most_bytes"),
)  # fmt: skip
HTML = Format(
    ".html", "a page with a viewer, which shows the .sog inside it", None, None, 3,
    write=_page("site.write_output"), levels="", has_cameras=True, inside=".sog", round_means=_lazy("sog.round_means"),
    gaussian_bytes=tuple(_IN_TEXT * sog_bytes for sog_bytes in _SOG), other_bytes=_page("site.least_bytes"),
    measure=_page("site.measure"),
)  # fmt: skip
FILES = (  # the first ending that matches counts, so .compressed.ply comes before .ply
    Format(
        ".compressed.ply", "PlayCanvas' packed .ply", ply.read_rows, None, -1, gaussian_bytes=(16.3, 25.3, 40.4, 61.4),
    ),
    PLY,
    Format(
        ".spz", "Niantic's format; written as version 3 or 2", _lazy("spz.read_rows"), _lazy("spz.spz_bytes"), 3,
        max_gaussians=10_000_000, gaussian_bytes=_SPZ,
        round_means=_lazy("spz.round_means"), values=_SPZ_VALUES, coarse=True, marks=(MIP_COMMENT,),
    ),
    Format(
        ".sog", "WebP textures in a zip; rows in another order", _lazy("sog.read_rows"), _lazy("sog.sog_bytes"), 3,
        gaussian_bytes=_SOG, round_means=_lazy("sog.round_means"), marks=(MIP_COMMENT, FLAT_COMMENT),
        first_view=True, settings="{stem}.settings.json",
    ),
    Format(
        ".splat", "antimatter15's format", _lazy("splat.read_rows"), _lazy("splat.splat_bytes"), 0,
        gaussian_bytes=(32.0,), coarse=True,
        values={"opacities": _OPACITY, "sh0": Held(-0.5 / SH_C0, 0.5 / SH_C0, 1 / 255 / SH_C0)},
    ),
    Format(
        ".glb", "binary glTF with KHR_gaussian_splatting", _lazy("glb.read_rows"), _lazy("glb.glb_bytes"), 3,
        first_view=True, holds=_lazy("glb.holds_gaussians"),
        gaussian_bytes=(52.1, 88.1, 148.1, 232.2),
    ),
)  # fmt: skip
STATE = Format(
    STATE_ENDING,
    "batches of views: Gaussians, cameras and pictures",
    _lazy("gsm.read_rows"),
    None,
    -1,
    gaussian_bytes=(56.0,),
)
META = "meta.json"  # name of the main file of a .sog that is a folder
SOG_FOLDER = Format(
    META, "a .sog without its zip", _lazy("sog.read_folder"), None, -1, holds=_lazy("sog.is_sog_meta"),
)  # fmt: skip
FORMATS = (*FILES, HTML, LEVELS, TILESET, STATE, SOG_FOLDER)
OUTPUT_FORMATS = tuple(row.ending for row in FILES if row.max_degree >= 0)
# Endings of results that a page shows
VIEWED = tuple(row.ending for row in FILES if row.max_degree >= 0 and row.read is not None)
# Endings of files that may hold other content than Gaussians, such as a .npz of cameras and depth maps
SEVERAL_USES = (".npz", *(row.ending for row in FORMATS if row.holds))
READ_ENDINGS = tuple(row.ending for row in FORMATS if row.read is not None)
SCENE_SUFFIXES = tuple(dict.fromkeys(Path(f"_{row.ending}").suffix for row in FILES if row.read is not None))


def count_for_bytes(format_: Format, max_bytes: int, sh_degree: int) -> int:
    """Return how many Gaussians fit into an output of at most ``max_bytes``; raise UsageError if none fits.

    The number is exact for a ``.ply``. The number is approximate for other formats, since their size depends on the
    values of Gaussians.
    """
    if format_.count is not None:
        return format_.count(max_bytes, sh_degree)
    gaussian_bytes = format_.gaussian_bytes[: sh_degree + 1][-1]
    fixed_bytes = format_.other_bytes()
    if max_bytes < fixed_bytes + gaussian_bytes:
        viewer = f"{fixed_bytes / 1e6:.2f} MB for the viewer of a page and " if fixed_bytes else ""
        problem = f"expected at least {viewer}{gaussian_bytes:.0f} bytes for one Gaussian"
        raise UsageError(f"budget: {problem}, got {human_bytes(max_bytes) if fixed_bytes else max_bytes}")
    return int((max_bytes - fixed_bytes) / gaussian_bytes)


def estimate_counts(paths: Sequence[Path]) -> tuple[int, int]:
    """Estimate the number of Gaussians in all files, and the largest number of columns ``f_rest_*`` in any file.

    The numbers of a ``.ply`` are read from its header. The numbers of other formats are estimated from the file's size.
    A file counts as empty if it cannot be read, or if it is too short for the rows in its header.
    """
    count = num_rest = 0
    for path in paths:
        format_ = find_format(path)
        if format_.read is ply.read_rows:
            file_count, file_rest = ply.header_counts(path, check_size=True)
            count = count + file_count
            num_rest = max(num_rest, file_rest)
        else:  # as if of degree 0
            with suppress(OSError):
                count += int(path.stat().st_size / (format_.gaussian_bytes or (math.inf,))[0])
    return count, num_rest


def find_format(path: StrPath) -> Format:
    """Return the format of a path by the end of its name; PLY for unknown endings."""
    return next((row for row in FORMATS if row.names(path)), PLY)


def may_hold_gaussians(path: Path) -> bool:
    """Return whether a file may hold Gaussians.

    The ending decides. If files with this ending may hold something else, the content decides.
    """
    holds = find_format(path).holds
    return (holds is None and path.suffix.lower() in SCENE_SUFFIXES) or (holds is not None and holds(path))


def output_format(path: StrPath, *, alone: bool = False) -> Format:
    """Return the format in which to write a path; raise UsageError for an unknown ending or a missing package.

    ``alone``: refuse pages, and formats with an index and files beside it.
    """
    format_ = next((row for row in FORMATS if row.names(path)), None)
    if alone and format_ is not None and (format_.has_cameras or format_.ending[0] != "."):
        format_ = None
    if format_ is None or format_.max_degree < 0:
        read_only = "" if format_ is None else f"{format_.ending} can be read but not written; "
        pages = [row.ending for row in FORMATS if row.has_cameras and row.ending[0] == "."]
        endings = join_words(OUTPUT_FORMATS if alone else (*OUTPUT_FORMATS, *pages))
        others = "" if alone else f", or the name {INDEX} or {TILESET.ending}, or a folder that exists"
        raise UsageError(f"{path}: {read_only}expected a name that ends in {endings}{others}")
    format_.require()
    return format_
