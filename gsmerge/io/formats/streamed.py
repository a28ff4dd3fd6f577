"""Streamed SOG version 1 (developer.playcanvas.com, "The Streamed SOG Format"): levels of detail that viewers load.

``lod-meta.json`` is a tree of boxes. For each level, a leaf names a run of rows in a chunk: an
unbundled ``.sog`` in a folder of its own. A viewer loads what it sees, at the level that fits:
by distance, or by the ``errors`` of the leaf, one for each level from 0 on. What an
``environment`` holds is shown with every level.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from gsmerge.errors import SceneError, UsageError
from gsmerge.geometry import morton_codes, quat_to_rotmat
from gsmerge.io.atomic import AddOutput, atomic_outputs, remove_stale
from gsmerge.io.bounds import ReadBudget, check_file, check_whole, read_json
from gsmerge.io.formats import arrays, sog
from gsmerge.io.formats.arrays import MIP_COMMENT
from gsmerge.io.formats.read import GaussianFile, convert_files
from gsmerge.io.formats.table import INDEX
from gsmerge.io.formats.write import check_readable
from gsmerge.kernels.elementary import exp, log1p
from gsmerge.types import Gaussians, StrPath

VERSION = 1
MAX_DEGREE = sog.MAX_DEGREE
# Gaussians in a chunk: all of them have harmonics of their own in its palette, and its .85 MB are one download
CHUNK_SIZE = 2**sog.PALETTE_BITS
# Gaussians of all levels in a leaf, for which a viewer chooses one level: a quarter of a chunk, so that
# the few hundred thousand of a room are some twenty places with levels of their own
LEAF_SIZE = CHUNK_SIZE // 4
ERROR_DIGITS = 4
MAX_LEVELS = 64  # no real file has more than a dozen
ENVIRONMENT = "env"
_CHUNK = re.compile(rf"(\d+_\d+|{ENVIRONMENT})-[0-9a-f]{{8}}")


@dataclass
class Leaf:
    """A place and its Gaussians at each level."""

    node: dict[str, Any]  # its part of the index
    rows: list[np.ndarray]  # of each level


# Errors [leaves, levels] of leaves, no smaller from level to level; 0 is the finest level's
LeafErrors = Callable[[Sequence[Leaf]], np.ndarray]


def write_levels(
    path: StrPath, levels: Sequence[Gaussians], *, overwrite: bool = False, comments: Sequence[str] = ()
) -> None:
    """Write levels of detail as Streamed SOG: an index, and chunks in folders beside it.

    A viewer loads the chunks that it sees, at the level that fits. All files are written, or none; the chunks of
    an index that is replaced are removed.

    Args:
        path: The index, a ``lod-meta.json``; its folder is made if it is missing.
        levels: Finite values, the finest level first.
        overwrite: Replace an existing index.
        comments: Lines as of :func:`write_gaussians`, of which "SplatRenderMode: mip" is kept.

    Raises:
        UsageError: If the name is another one.
        SceneError: If the file exists or cannot be written.
        ValueError: If there is NaN or inf, no Gaussian at some level, or a comment is no line of ASCII.

    Example:
        >>> result = gsmerge.compact("demo", effort="draft", budget=300, levels=2)
        >>> levels = [result.gaussians, *(level.gaussians for level in result.coarser)]
        >>> gsmerge.write_levels("demo/web/lod-meta.json", levels, overwrite=True)
    """
    path = Path(path)
    if path.name != INDEX:
        raise UsageError(f"{path}: expected the name {INDEX}, by which viewers recognise the format")
    with atomic_outputs(overwrite=overwrite) as add:
        add_levels(add, path, add(path), levels, comments)
    remove_unused_chunks(path)


def add_levels(
    add: AddOutput,
    path: Path,
    index: Path,
    levels: Sequence[Gaussians],
    comments: Sequence[str] = (),
    *,
    environment: Gaussians | None = None,
    measure: LeafErrors | None = None,
) -> list[tuple[Path, list[Path]]]:
    """Write the files of a Streamed SOG as part of :func:`atomic_outputs`; ``index`` is the temporary file of ``path``.

    ``environment`` and ``measure`` are as of :func:`streamed_files`. Returns, for each level, the final path
    of its first chunk's ``meta.json``, and the present paths of all its files; an environment's are the finest level's.
    """
    for gaussians in levels if environment is None else (*levels, environment):
        check_readable(gaussians, comments)
    firsts: dict[str, Path] = {}
    written: dict[str, list[Path]] = {}
    mip = MIP_COMMENT in comments
    for name, data in streamed_files(levels, mip=mip, environment=environment, measure=measure).items():
        if name == INDEX:
            index.write_bytes(data)
            continue
        target, level = path.parent / name, "0" if name.startswith(ENVIRONMENT) else name.partition("_")[0]
        same = target.is_file() and target.read_bytes() == data  # its name has a hash of its content
        written.setdefault(level, []).append(target if same else add(target))
        if not same:
            written[level][-1].write_bytes(data)
        if target.name == sog.META:
            firsts.setdefault(level, target)
    return [(firsts[level], files) for level, files in written.items()]


def streamed_files(
    levels: Sequence[Gaussians],
    *,
    mip: bool = False,
    environment: Gaussians | None = None,
    measure: LeafErrors | None = None,
) -> dict[str, bytes]:
    """Encode levels of detail, the finest first, as files by path below one folder; the index comes last.

    The name of a chunk's folder contains its level, its number and a hash of its content. So chunks of two results
    never mix, on disk or in a browser's cache. ``mip`` marks antialiased Gaussians; the ``environment`` belongs to no
    level; ``measure`` computes the errors of the leaves. ValueError if a level is empty or not finite.
    """
    if not levels or not all(len(level) for level in levels):
        raise ValueError("levels: expected Gaussians in each, got none")
    columns = [arrays.to_columns(level, MAX_DEGREE) for level in levels]
    leaves: list[Leaf] = []
    tree = _Boxes(columns).split(leaves)
    if measure is not None:
        for leaf, errors in zip(leaves, measure(leaves).tolist(), strict=True):
            leaf.node["errors"] = [float(f"{error:.{ERROR_DIGITS}g}") for error in errors]
    files: dict[str, bytes] = {}
    names: list[str] = []
    for level, level_columns in enumerate(columns):
        for number, members in enumerate(_pack([len(leaf.rows[level]) for leaf in leaves])):
            parts = [_along_curve(level_columns.means, leaves[i].rows[level]) for i in members]
            offsets = np.cumsum([0, *map(len, parts)])
            for i, part, offset in zip(members, parts, offsets, strict=False):
                run = {"file": len(names), "offset": int(offset), "count": len(part)}
                leaves[i].node["lods"][str(level)] = run
            chunk = sog.sog_files(level_columns.take(np.concatenate(parts)), mip=mip)
            folder = f"{level}_{number}-{_hash(chunk)}"
            files |= {f"{folder}/{name}": data for name, data in chunk.items()}
            names.append(f"{folder}/{sog.META}")
    counts = [len(level_columns) for level_columns in columns]
    index = {"version": VERSION, "asset": {"generator": sog.GENERATOR}, "count": sum(counts), "counts": counts}
    index |= {"lodLevels": len(counts), "lodErrors": measure is not None}
    if environment is not None:
        chunk = sog.sog_files(arrays.to_columns(environment, MAX_DEGREE), mip=mip)
        folder = f"{ENVIRONMENT}-{_hash(chunk)}"
        files |= {f"{folder}/{name}": data for name, data in chunk.items()}
        index["environment"] = f"{folder}/{sog.META}"
    index |= {"filenames": names, "tree": tree}
    return files | {INDEX: json.dumps(index).encode("ascii")}


class _Boxes:
    """The centres of all levels, and the boxes of what they show."""

    def __init__(self, columns: Sequence[arrays.Columns]) -> None:
        self.means = np.concatenate([level.means for level in columns])
        self.starts = np.cumsum([0, *map(len, columns)])  # first row of each level
        rotations = quat_to_rotmat(np.concatenate([level.quats for level in columns]))
        scales = exp(np.concatenate([level.log_scales for level in columns]))
        widths = (np.abs(rotations) * scales[:, None]).sum(-1)  # of the box about the turned ellipsoid
        logs = log1p(np.abs(self.means).max(0))
        rounding = (1 + np.abs(self.means)) * 2 * logs / 65535  # as far as a .sog moves a centre
        self.low = self.means - widths - rounding
        self.high = self.means + widths + rounding

    def split(self, leaves: list[Leaf], rows: np.ndarray | None = None) -> dict[str, Any]:
        """Halve rows along their longest side until they are few; return the node, and append its leaves."""
        rows = np.arange(len(self.means)) if rows is None else rows
        inside = self.means[rows]
        extent = np.ptp(inside, axis=0)
        node: dict[str, Any] = {
            "bound": {
                "min": [float(f"{value:.8g}") for value in self.low[rows].min(0)],
                "max": [float(f"{value:.8g}") for value in self.high[rows].max(0)],
            }
        }
        if len(rows) <= LEAF_SIZE or not extent.max() > 0:
            ends = np.searchsorted(rows, self.starts)
            level_rows = [rows[a:b] - start for a, b, start in zip(ends, ends[1:], self.starts, strict=False)]
            leaves.append(Leaf(node | {"lods": {}}, level_rows))
            return leaves[-1].node
        places = inside[:, int(extent.argmax())]
        middle = np.partition(places, len(rows) // 2)[len(rows) // 2]
        first = places < middle if places.min() < middle else places <= middle
        return node | {"children": [self.split(leaves, rows[first]), self.split(leaves, rows[~first])]}


def _pack(sizes: Sequence[int]) -> Iterator[list[int]]:
    """Yield the indices of neighbouring leaves that share a chunk; empty leaves have no chunk."""
    members: list[int] = []
    total = 0
    for i, size in enumerate(sizes):
        if members and total + size > CHUNK_SIZE:
            yield members
            members, total = [], 0
        if size:
            members.append(i)
            total += size
    if members:
        yield members


def _along_curve(means: np.ndarray, rows: np.ndarray) -> np.ndarray:
    return rows[np.argsort(morton_codes(means[rows]), kind="stable")]


def _hash(files: dict[str, bytes]) -> str:
    digest = hashlib.sha256()
    for name, data in files.items():
        digest.update(f"{name}:{len(data)}:".encode())
        digest.update(data)
    return digest.hexdigest()[:8]


@dataclass(frozen=True)
class StreamedIndex:
    """Content of an index: the chunks of each level, with their numbers of Gaussians."""

    levels: tuple[dict[Path, int], ...]
    environment: Path | None  # the ``meta.json`` of what is shown with every level

    @property
    def counts(self) -> list[int]:
        """Number of Gaussians of each level."""
        return [sum(chunks.values()) for chunks in self.levels]


def read_index(path: Path) -> StreamedIndex:
    """Read a ``lod-meta.json``; SceneError if its parts contradict each other."""
    document = read_json(path)
    try:
        return _check_index(path, document)
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        problem = f"expected the index of a Streamed SOG, found another file ({error})"
        raise SceneError(path, " ".join(problem.split()), "export it again") from error


def _check_index(path: Path, document: dict[str, Any]) -> StreamedIndex:
    version = document.get("version", VERSION)
    if version != VERSION:
        problem = f"expected Streamed SOG version {VERSION}, found {version}"
        raise SceneError(path, problem, "export it as that version")
    names = document["filenames"]
    num_levels = check_whole(document["lodLevels"], "lodLevels", 1, MAX_LEVELS)
    if not isinstance(names, list) or not names:
        raise ValueError("filenames: expected a list of paths")
    chunks = [_inside(path, name) for name in names]
    runs: list[list[tuple[int, int, int]]] = [[] for _ in range(num_levels)]
    for level, run in _walk_runs(document["tree"]):
        file = check_whole(run["file"], "file", 0, len(chunks) - 1)
        offset, count = (check_whole(run[key], key, 0) for key in ("offset", "count"))
        if count:
            runs[check_whole(level, "level", 0, num_levels - 1)].append((file, offset, count))
    levels = tuple(_cover(chunks, level) for level in runs)
    if len({chunk for level in levels for chunk in level}) != sum(map(len, levels)):
        raise ValueError("a chunk is that of two levels")
    environment = None if document.get("environment") is None else _inside(path, document["environment"])
    if any(environment in level for level in levels):
        raise ValueError("the environment is a chunk of a level")
    index = StreamedIndex(levels, environment)
    counts = index.counts
    for name, found in {"counts": counts, "count": sum(counts)}.items():
        if document.get(name, found) != found:  # older files have neither
            raise ValueError(f"{name}: the tree has {found}, not {document[name]}")
    return index


def _inside(index: Path, name: Any) -> Path:
    """Return the path of a chunk; ValueError if its name leads out of the folder of the index."""
    place = PurePosixPath(str(name))
    outside = place.is_absolute() or ".." in place.parts or "\\" in str(name) or "\0" in str(name)
    if outside or place.name != sog.META:
        raise ValueError(f"{name!r:.80}: expected the path of a {sog.META} inside the folder")
    return index.parent / place


def _walk_runs(tree: dict[str, Any]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield level and run of all leaves in order; ValueError for an invalid node."""
    nodes = [tree]
    while nodes:
        node = nodes.pop()
        low, high = (np.array(node["bound"][key], np.float64) for key in ("min", "max"))
        if low.shape != (3,) or high.shape != (3,) or not (low <= high).all():
            raise ValueError("bound: expected three numbers at each end, the lower ones first")
        if ("lods" in node) == ("children" in node):
            raise ValueError("a node has to have either children or lods")
        if "children" in node:
            nodes += reversed(node["children"])
        else:
            yield from ((int(level), run) for level, run in node["lods"].items())


def _cover(chunks: Sequence[Path], runs: Sequence[tuple[int, int, int]]) -> dict[Path, int]:
    """Return the number of Gaussians of each chunk; ValueError where runs leave a gap or overlap."""
    counts: dict[Path, int] = {}
    for file, offset, count in sorted(runs):
        end = counts.get(chunks[file], 0)
        if offset != end:
            raise ValueError(f"runs of file {file}: expected one from {end} on, found one from {offset}")
        counts[chunks[file]] = end + count
    return counts


def read_rows(path: Path, level: int = 0, index: StreamedIndex | None = None) -> arrays.StoredRows:
    """Read the Gaussians of one level; level 0, the finest, includes the environment.

    ``index``: result of :func:`read_index` for the path. SceneError if the index or a chunk cannot be read, or they
    contradict each other.
    """
    index = index or read_index(path)
    chunks: dict[Path, int | None] = {**index.levels[level]}
    if index.environment is not None and level == 0:
        chunks[index.environment] = None
    if not chunks:
        raise SceneError(path, f"expected Gaussians at level {level}, found none")
    contents = _read_chunks(path, chunks)
    sizes: dict[str, int] = {}
    for content in contents:
        for name, size in content.sizes.items():
            sizes[name] = sizes.get(name, 0) + size
    counts = " + ".join(f"{count:,}" for count in index.counts)
    name = f"Streamed SOG version {VERSION}, {counts} Gaussians at {len(index.levels)} level(s)"
    rows = arrays.to_stored([content.packed for content in contents], name, sizes, mip=contents[0].mip)
    return replace(rows, bytes_beside=sum(content.num_bytes for content in contents))


def read_level(path: Path, level: int, index: StreamedIndex | None = None) -> GaussianFile:
    """Read one level of detail of a ``lod-meta.json``; 0 is the finest. SceneError as in :func:`read_gaussians`."""
    return convert_files([path], [read_rows(path, level, index)], "auto")


def _read_chunks(path: Path, chunks: Mapping[Path, int | None]) -> list[sog.SogContent]:
    """Read chunks within the budget of all together.

    Each chunk comes with its number of Gaussians if the index has it.
    """
    root, seen = os.path.realpath(path.parent), set[Path]()
    contents: list[sog.SogContent] = []
    num_bytes, total, num_higher = check_file(path), 0, 0
    for chunk, count in chunks.items():
        place = Path(os.path.realpath(chunk))
        if not place.is_relative_to(root) or place in seen:
            problem = f"{chunk}: expected a file of its own inside the folder, found a link to another"
            raise SceneError(path, problem, "export it again")
        seen.add(place)
        contents.append(sog.read_unbundled(chunk))
        packed = contents[-1].packed
        if count not in (None, packed.count):
            problem = f"expected {count:,} Gaussians as {INDEX} says, found {packed.count:,}"
            raise SceneError(chunk, problem, "export it again")
        num_bytes, total = num_bytes + contents[-1].num_bytes, total + packed.count
        num_higher = max(num_higher, packed.num_higher)
        arrays.check_count(ReadBudget(path, num_bytes), total, num_higher, sog.PACKED_BYTES)
    return contents


def remove_unused_chunks(path: Path) -> None:
    """Remove chunks of :func:`streamed_files` beside an index that does not name them.

    Other files in the folders of the chunks stay, together with their folders; so do files that cannot be removed.
    """
    index = read_index(path)
    chunks = [chunk for level in index.levels for chunk in level]
    used = {chunk.parent.name for chunk in (*chunks, index.environment) if chunk is not None}
    with suppress(OSError), os.scandir(path.parent) as entries:
        for entry in list(entries):
            if _CHUNK.fullmatch(entry.name) and entry.name not in used and entry.is_dir(follow_symlinks=False):
                folder = Path(entry.path)
                remove_stale(folder)
                for name in sog.FILES if _is_ours(folder) else ():
                    with suppress(OSError):
                        os.unlink(folder / name)
                with suppress(OSError):
                    os.rmdir(folder)


def _is_ours(folder: Path) -> bool:
    try:
        return bool(read_json(folder / sog.META)["asset"]["generator"] == sog.GENERATOR)
    except (SceneError, LookupError, TypeError):
        return False
