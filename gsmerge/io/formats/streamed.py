"""Read and write levels of detail as Streamed SOG version 1 (developer.playcanvas.com, "The Streamed SOG Format").

The index ``lod-meta.json`` is a tree of boxes. For each level of detail, a leaf names a run, which is a range of rows
in a chunk. Each chunk is an unzipped ``.sog`` in a separate folder. A viewer loads the visible chunks at the level that
suits their distance, and always shows the Gaussians of the ``environment``. The program splat-transform of PlayCanvas
writes the index and the chunks.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from gsmerge.errors import SceneError, UsageError, count_words
from gsmerge.frozen import dataclass, replace
from gsmerge.io.atomic import AddOutput, atomic_outputs
from gsmerge.io.bounds import ReadBudget, check_file, check_whole, read_json
from gsmerge.io.formats import rows as arrays
from gsmerge.io.formats import sog
from gsmerge.io.formats.read_gaussians import GaussianFile, convert_stored
from gsmerge.io.formats.splat_transform import blame_program, run_program
from gsmerge.io.formats.table import INDEX, Contents
from gsmerge.io.formats.write import write_ply
from gsmerge.runtime.arguments import check_arguments
from gsmerge.settings.reading import FileHints
from gsmerge.types import Gaussians, StrPath

VERSION = 1  # of the format, as the index states it
MAX_DEGREE = sog.MAX_DEGREE
# A viewer chooses a level of detail for each region of space. The number is how many thousand Gaussians a region has. A
# room of a few hundred thousand Gaussians has about twenty regions.
CHUNK_THOUSANDS = 16
_CHUNK_NAME = re.compile(r"\d+_\d+-[0-9a-f]{8}")  # name of a chunk's folder: level, number, hash


@check_arguments
def write_levels(
    path: StrPath, levels: Sequence[Gaussians], *, overwrite: bool = False, comments: Sequence[str] = ()
) -> None:
    """Write levels of detail as Streamed SOG, an index with chunks beside it, by the program splat-transform.

    A viewer loads the visible chunks at the level that suits their distance. Either all files are written or none. If
    an index is replaced, the chunks of the old index are removed.

    Args:
        path: The index, a ``lod-meta.json``. A missing folder is made.
        levels: Gaussians with finite values, the finest level first.
        overwrite: Replace an existing index.
        comments: Lines as in :func:`write_gaussians`; "SplatRenderMode: mip" is kept.

    Raises:
        UsageError: If the path has another name than ``lod-meta.json``, or splat-transform is not installed.
        SceneError: If the file exists or cannot be written.
        ValueError: If there is NaN or inf, a level has no Gaussian, or a comment is not a line of ASCII.

    Example:
        >>> result = gsmerge.compact("demo", effort="draft", budget=300, levels=2)
        >>> levels = [result.gaussians, *(level.gaussians for level in result.coarser)]
        >>> gsmerge.write_levels("demo/web/lod-meta.json", levels, overwrite=True)
    """
    path = Path(path)
    if path.name != INDEX:
        raise UsageError(f"{path}: expected the name {INDEX}, by which viewers recognise the format")
    with atomic_outputs(overwrite=overwrite) as add:
        write_output(add, path, add(path), Contents(levels, comments))
    remove_unused_chunks(path)


def write_output(add: AddOutput, path: Path, index: Path, contents: Contents) -> dict[Path, list[Path]]:
    """Write the files of a Streamed SOG.

    ``add`` makes the temporary file of a path; ``index`` is the temporary file of ``path``. Return the path of each
    level, with its temporary files. The path of a coarser level is the ``meta.json`` of its first chunk.
    """
    with TemporaryDirectory(prefix="gsmerge-") as folder:
        arguments: list[object] = []
        for level, gaussians in enumerate(contents.levels):
            arguments += [ply := Path(folder) / f"{level}.ply", "-l", level]
            write_ply(ply, gaussians, sh_degree=min(gaussians.sh_degree, MAX_DEGREE), comments=contents.comments)
        program_index = Path(folder) / "made" / INDEX
        iterations = 1  # of the program's fit of palettes; ten take four times as long, and renders are not better
        run_program(*arguments, "--lod-chunk-count", CHUNK_THOUSANDS, "-i", iterations, program_index)
        with blame_program(path):
            # A hash of the content is appended to the name of each chunk's folder. With these hashes, caches never mix
            # chunks of two results
            document = read_json(program_index)
            for number, name in enumerate(document["filenames"]):
                chunk_folder = (program_index.parent / name).parent
                digest = hashlib.sha256()
                for file in sorted(chunk_folder.iterdir()):
                    digest.update(file.read_bytes())
                renamed = chunk_folder.rename(f"{chunk_folder}-{digest.hexdigest()[:8]}")
                document["filenames"][number] = f"{renamed.name}/{sog.META}"
            program_index.write_bytes(json.dumps(document).encode())
            levels = read_index(program_index).levels
        index.write_bytes(program_index.read_bytes())
        written = dict[Path, list[Path]]()
        for chunks in levels:
            files = [file for chunk in chunks for file in sorted(chunk.parent.iterdir())]
            targets = [path.parent / file.relative_to(program_index.parent) for file in files]
            temporaries = [add(target) for target in targets]
            for file, temporary in zip(files, temporaries, strict=True):
                temporary.write_bytes(file.read_bytes())
            is_finest = not written
            level_path = path if is_finest else next(target for target in targets if target.name == sog.META)
            written[level_path] = [index, *temporaries] if is_finest else temporaries
    return written


@dataclass(frozen=True)
class StreamedIndex:
    """Content of an index: the chunks of each level, each with its number of Gaussians."""

    levels: tuple[dict[Path, int], ...]
    environment: Path | None  # the ``meta.json`` of Gaussians that are shown with every level

    @property
    def counts(self) -> list[int]:
        """Number of Gaussians of each level."""
        return [sum(chunks.values()) for chunks in self.levels]


def read_index(path: Path) -> StreamedIndex:
    """Read a ``lod-meta.json``; raise SceneError if it is damaged or contradicts itself."""
    document = read_json(path)
    try:
        version = document.get("version", VERSION)
        if version != VERSION:
            problem = f"expected Streamed SOG version {VERSION}, found {version}"
            raise SceneError(path, problem, f"export it as version {VERSION}")
        levels = _list_levels(path, document)
        if len({chunk for level in levels for chunk in level}) != sum(map(len, levels)):
            raise ValueError("a chunk belongs to two levels")
        environment = None if document.get("environment") is None else _chunk_path(path, document["environment"])
        if any(environment in level for level in levels):
            raise ValueError("the environment is also a chunk of a level")
        index = StreamedIndex(levels, environment)
        for name, tree_count in {"counts": index.counts, "count": sum(index.counts)}.items():
            if document.get(name, tree_count) != tree_count:  # older files have neither
                raise ValueError(f"{name}: the tree has {tree_count}, and the document says {document[name]}")
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        problem = f"expected the index of a Streamed SOG, found another file ({error})"
        raise SceneError(path, problem, "export it again") from error
    return index


def _list_levels(path: Path, document: dict[str, Any]) -> tuple[dict[Path, int], ...]:
    """Return the chunks of each level with their numbers of Gaussians.

    Raise ValueError, LookupError or TypeError if the index is damaged, such as by runs that overlap or have gaps.
    """
    names = document["filenames"]
    max_levels = 64  # no real file has more than a dozen
    num_levels = check_whole(document["lodLevels"], "lodLevels", 1, max_levels)
    if not isinstance(names, list) or not names:
        raise ValueError("filenames: expected a list of paths")
    chunks = [_chunk_path(path, name) for name in names]
    # For each run of rows of a level: the index of its chunk, its first row and its number of rows
    runs: list[list[tuple[int, int, int]]] = [[] for _ in range(num_levels)]
    nodes = [document["tree"]]
    while nodes:
        node = nodes.pop()
        low, high = (np.array(node["bound"][key], np.float64) for key in ("min", "max"))
        if low.shape != (3,) or high.shape != (3,) or not (low <= high).all():
            raise ValueError("bound: expected three numbers of min and three of max, none of them below min")
        if ("lods" in node) == ("children" in node):
            raise ValueError("a node must have either children or lods")
        nodes += reversed(node.get("children", []))
        for level, run in node.get("lods", {}).items():
            number = int(level)
            file = check_whole(run["file"], "file", 0, len(chunks) - 1)
            offset, count = (check_whole(run[key], key, 0) for key in ("offset", "count"))
            if count:
                runs[check_whole(number, "level", 0, num_levels - 1)].append((file, offset, count))
    levels = list[dict[Path, int]]()
    for level_runs in runs:
        counts: dict[Path, int] = {}
        for file, offset, count in sorted(level_runs):
            end = counts.get(chunks[file], 0)
            if offset != end:
                raise ValueError(f"runs of file {file}: expected a run that starts at {end}, found one at {offset}")
            counts[chunks[file]] = end + count
        levels.append(counts)
    return tuple(levels)


def _chunk_path(index: Path, name: Any) -> Path:
    """Return the path of the chunk ``name`` of an index; raise ValueError for a path outside of the index's folder."""
    chunk = PurePosixPath(str(name))
    is_outside = chunk.is_absolute() or ".." in chunk.parts or "\\" in str(name) or "\0" in str(name)
    if is_outside or chunk.name != sog.META:
        raise ValueError(f"{name!r:.80}: expected the path of a {sog.META} inside the folder")
    return index.parent / chunk


def read_rows(path: Path, level: int = 0, index: StreamedIndex | None = None) -> arrays.StoredRows:
    """Read the Gaussians of one level; level 0, the finest, includes the environment.

    ``index``: result of :func:`read_index` for the path; None: read the index. Raise SceneError if the index or a chunk
    cannot be read, or if the two state different numbers of Gaussians.
    """
    index = index or read_index(path)
    chunks: dict[Path, int | None] = {**index.levels[level]}
    if index.environment is not None and level == 0:
        chunks[index.environment] = None
    if not chunks:
        raise SceneError(path, f"expected Gaussians at level {level}, found none", "export it again")
    # Together, the chunks may take as much memory as is allowed for one file of as many bytes
    root = os.path.realpath(path.parent)
    real_paths = set[Path]()
    contents: list[sog.SogContent] = []
    num_bytes = check_file(path)
    total = 0
    num_higher = 0
    for chunk, count in chunks.items():
        real_path = Path(os.path.realpath(chunk))
        if not real_path.is_relative_to(root) or real_path in real_paths:
            problem = f"{chunk}: expected a separate file inside the folder, found a link to another file"
            raise SceneError(path, problem, "export it again")
        real_paths.add(real_path)
        contents.append(sog.read_unzipped(chunk))
        packed = contents[-1].packed
        if count not in (None, packed.count):
            problem = f"expected {count:,} Gaussians, as {INDEX} says, found {packed.count:,}"
            raise SceneError(chunk, problem, "export it again")
        num_bytes = num_bytes + contents[-1].num_bytes
        total = total + packed.count
        num_higher = max(num_higher, packed.num_higher)
        arrays.check_gaussian_count(ReadBudget(path, num_bytes), total, num_higher, sog.PACKED_BYTES)
    sizes: dict[str, int] = {}
    for content in contents:
        for name, size in content.sizes.items():
            sizes[name] = sizes.get(name, 0) + size
    counts = " + ".join(f"{count:,}" for count in index.counts)
    name = f"Streamed SOG version {VERSION}, {counts} Gaussians at {count_words(len(index.levels), 'level')}"
    rows = arrays.to_stored([content.packed for content in contents], name, sizes, contents[0].mode)
    return replace(rows, bytes_beside=sum(content.num_bytes for content in contents))


def read_level(path: Path, level: int, index: StreamedIndex | None = None) -> GaussianFile:
    """Read one level of detail of a ``lod-meta.json``; 0 is the finest. Raise errors as :func:`read_gaussians`."""
    return convert_stored([path], [read_rows(path, level, index)], FileHints())


def remove_unused_chunks(path: Path) -> None:
    """Remove chunks beside an index that the index does not name, since they belong to an index that was replaced.

    Other files in the chunks' folders stay. A chunk that cannot be removed stays, too.
    """
    used_folders = {chunk.parent.name for level in read_index(path).levels for chunk in level}
    for folder in path.parent.iterdir():
        if (
            _CHUNK_NAME.fullmatch(folder.name)
            and folder.name not in used_folders
            and folder.is_dir()
            and not folder.is_symlink()
        ):
            with suppress(OSError):
                for name in sog.SOG_FILES:
                    (folder / name).unlink(missing_ok=True)
                folder.rmdir()
