"""PLY files that are cut, that lie, or that are absurd."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from .case import EITHER, HEIGHT, READ, REFUSED, VIEWS, WIDTH, Case, Spoil, sparse, write

COUNT = VIEWS * HEIGHT * WIDTH
COLUMNS = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
LINES = (
    *("ply", "format binary_little_endian 1.0", f"element vertex {COUNT}"),
    *(f"property float {name}" for name in COLUMNS),
    "end_header",
)
ROW = 4 * len(COLUMNS)
MANY = 600_000
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
RANGES = (
    *(f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"),
    *(f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"),
)


def parts(folder: Path) -> tuple[list[str], bytes]:
    head, body = (folder / "scene.ply").read_bytes().split(b"end_header\n", 1)
    return [*head.decode().splitlines(), "end_header"], body


def put(folder: Path, lines: list[str], body: bytes) -> None:
    (folder / "scene.ply").write_bytes("\n".join([*lines, ""]).encode("latin-1") + body)


def header(change: Callable[[list[str]], list[str]]) -> Spoil:
    """Another header before the same rows."""

    def spoil(folder: Path) -> None:
        lines, body = parts(folder)
        put(folder, change(lines), body)

    return spoil


def swap(old: str, new: str) -> Spoil:
    return header(lambda lines: [new if line == old else line for line in lines])


def insert(before: str, *new: str) -> Spoil:
    return header(lambda lines: [x for line in lines for x in ((*new, line) if line == before else (line,))])


def cut(size: int) -> Spoil:
    def spoil(folder: Path) -> None:
        path = folder / "scene.ply"
        path.write_bytes(path.read_bytes()[:size])

    return spoil


def rows(change: Callable[[np.ndarray], None]) -> Spoil:
    """Other values in the same rows: ``[n,17]`` float32."""

    def spoil(folder: Path) -> None:
        lines, body = parts(folder)
        values = np.frombuffer(body, "<f4").reshape(-1, len(COLUMNS)).copy()
        change(values)
        put(folder, lines, values.tobytes())

    return spoil


def fill(columns: slice, value: float, which: slice = slice(None)) -> Spoil:
    def change(values: np.ndarray) -> None:
        values[which, columns] = value

    return rows(change)


def text(change: Callable[[list[str]], list[str]]) -> Spoil:
    """The same scene as ascii, its rows changed as lines."""

    def spoil(folder: Path) -> None:
        lines, body = parts(folder)
        values = np.frombuffer(body, "<f4").reshape(-1, len(COLUMNS))
        lines[1] = "format ascii 1.0"
        words = [" ".join(f"{v:.9g}" for v in row) for row in values]
        put(folder, [*lines, *change(words)], b"")

    return spoil


def packed(
    lines: tuple[str, ...] = (), *, chunks: int = -(-COUNT // 256), low: float = -3, high: float = 3, word: str = "uint"
) -> Spoil:
    """A compressed file of noise, with further header lines before the vertices."""

    def spoil(folder: Path) -> None:
        head = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
        head += [f"property float {name}" for name in RANGES]
        head += [*lines, f"element vertex {COUNT}", *(f"property {word} {name}" for name in PACKED), "end_header"]
        limits = np.where([name.startswith("min") for name in RANGES], low, high).astype("<f4")
        words = np.random.default_rng(0).integers(0, 2**32, (COUNT, 4), dtype=np.uint32)
        put(folder, head, np.tile(limits, (chunks, 1)).tobytes() + words.tobytes())

    return spoil


def huge_file(size: int, start: bytes) -> Spoil:
    return lambda folder: sparse(folder / "scene.ply", size, start)


def _truncations() -> dict[str, Case]:
    ends = np.cumsum([len(line) + 1 for line in LINES])
    cases = {f"header cut after {line!r}": Case(cut(int(end) - 1)) for line, end in zip(LINES, ends, strict=True)}
    start = int(ends[-1])
    sizes = {"no rows": 0, "one byte": 1, "one column": 4, "one row less a byte": ROW - 1, "one row": ROW}
    sizes |= {"all rows but one": (COUNT - 1) * ROW, "all but a byte": COUNT * ROW - 1, "one view": COUNT // 3 * ROW}
    cases |= {f"body cut to {words}": Case(cut(start + size)) for words, size in sizes.items()}
    counts = {"a third": COUNT // 3, "nearly all": COUNT - 1, "nothing": 0}
    cases |= {
        f"body cut within row {rows}": Case(cut(start + rows * ROW + 9), says=("truncated", f"found {rows}"))
        for rows in counts.values()
    }
    cases["header cut"] = Case(cut(100), says=("PLY", "end of file"))
    contents = (b"", b"p", b"ply", b"notes, not Gaussians\n" * 100, b"\x89PNG\r\n\x1a\n", b"plywood\n")
    for content in contents:
        cases[f"file of {content[:8]!r}"] = Case(write("scene.ply", content), says=("scene.ply", "PLY"))
    return cases


def _counts() -> dict[str, Case]:
    line = f"element vertex {COUNT}"
    wrong = [-1, 0, -(2**31), COUNT + 1, 2**31 - 1, 2**31, 2**32, 2**63, 10**18, 10**30, "9" * 5000, "1e3", "0x10",
             "12.5", "nan", "", "1 2"]  # fmt: skip
    cases = {f"count {str(count)[:20]}": Case(swap(line, f"element vertex {count}")) for count in wrong}
    cases["count 0"] = Case(swap(line, "element vertex 0"), says=("one Gaussian", "found 0"))
    cases["count one less"] = Case(swap(line, f"element vertex {COUNT - 1}"), EITHER)
    for count in (-1, 2**31, 2**62):
        words = [f"element vertex {count}" if x == line else x for x in LINES]
        words[1] = "format ascii 1.0"
        cases[f"ascii count {count}"] = Case(lambda folder, words=words: put(folder, words, b"1 2 3\n"))
    for count in (-1, 10, 2**40):
        cases[f"further element of {count} rows"] = Case(
            insert("end_header", f"element more {count}", "property double a")
        )
    cases["first element of 2^40 rows"] = Case(insert(line, f"element more {2**40}", "property double a"))
    cases["rows without columns"] = Case(insert(line, f"element more {2**40}"))
    cases["vertices without columns"] = Case(header(lambda x: [*x[:3], "end_header"]))
    return cases


def _headers() -> dict[str, Case]:
    vertex, last = f"element vertex {COUNT}", "property float rot_3"
    many = [f"property uchar p{i}" for i in range(20_000)]
    cases = {
        "unknown format": swap(LINES[1], "format binary_middle_endian 1.0"),
        "unknown version": swap(LINES[1], "format binary_little_endian 9.0"),
        "no format": header(lambda x: [x[0], *x[2:]]),
        "two formats": insert(vertex, LINES[1]),
        "unknown type": swap(last, "property quaternion rot_3"),
        "python type": swap(last, "property object rot_3"),
        "type of 0 words": swap(last, "property"),
        "property without a name": swap(last, "property float"),
        "two vertex elements": insert("end_header", "element vertex 1", "property float x"),
        "a column twice": insert(last, last),
        "a column before any element": insert(vertex, "property float x"),
        "no end of the header": header(lambda x: x[:-1]),
        "end of the header with more": swap("end_header", "end_header now"),
        "name with a zero byte": swap(last, "property float rot\x00_3"),
        "name with an escape sequence": swap(vertex, f"element \x1b[31mvertex {COUNT}"),
        "name that is not ascii": swap(last, "property float r\xf6t_3"),
        "name of a megabyte": swap(last, "property float " + "a" * 2**20),
        "20,000 columns": insert(last, *many),
        "list of rotations": swap(last, "property list uchar float rot_3"),
        "list of floats by floats": swap(last, "property list float float rot_3"),
        "list of 2^32": insert("property float x", "property list uint double many"),
        "list of a negative length": insert("property float x", "property list char double many"),
        "list after the vertices": insert("end_header", "element face 2", "property list uint uint vertex_index"),
        "million empty lists": insert(vertex, "element face 1000000", "property list uchar uint vertex_index"),
        "f_rest of 7 columns": insert(last, *(f"property float f_rest_{i}" for i in range(7))),
        "f_rest of 3000 columns": insert(last, *(f"property float f_rest_{i}" for i in range(3000))),
    }
    out = {name: Case(spoil) for name, spoil in cases.items()}
    lacking = {"rot_3": last, "scale_1": "property float scale_1"}
    renamed = header(lambda x: [f"property float other_{i}" if y in lacking.values() else y for i, y in enumerate(x)])
    out["two columns missing"] = Case(renamed, says=tuple(lacking))
    out["no vertices"] = Case(swap(vertex, f"element points {COUNT}"), says=("'vertex'", "'points'"))
    out["points without a look"] = Case(
        header(lambda x: [*x[:6], "end_header"]), says=("f_dc_0", "opacity", "scale_0", "rot_0", "rot_3")
    )
    out["100,000 comments"] = Case(insert(vertex, *(["comment nothing"] * 100_000)))
    out["1000 comments"] = Case(insert(vertex, *(["comment nothing"] * 1000)), READ)
    out["comment that is not ascii"] = Case(insert(vertex, "comment \xff\xfe"), READ)
    out["comment with an escape sequence"] = Case(insert(vertex, "comment \x1b[2J\x07"), READ)
    elements = [line for i in range(20_000) for line in (f"element other_{i} 0", "property char a")]
    out["20,000 elements"] = Case(insert("end_header", *elements), says=("scene.ply", "elements"))
    out["empty element"] = Case(insert("end_header", "element nothing 0", "property float a"), EITHER)
    out["big-endian by name only"] = Case(swap(LINES[1], "format binary_big_endian 1.0"))
    out["ascii by name only"] = Case(swap(LINES[1], "format ascii 1.0"))
    out["CR LF header"] = Case(header(lambda x: [line + "\r" for line in x]), EITHER)
    out["bytes after the rows"] = Case(
        lambda folder: put(folder, parts(folder)[0], parts(folder)[1] + b"\0" * 1000), READ
    )
    return out


def _values() -> dict[str, Case]:
    every = slice(None)
    means, colors, opacity, scales, quats = slice(0, 3), slice(6, 9), slice(9, 10), slice(10, 13), slice(13, 17)
    cases = {
        "all NaN": Case(fill(every, np.nan), says=("scene.ply", "NaN", f"all {COUNT:,} rows")),
        "all inf": Case(fill(every, np.inf)),
        "positions 1e38": Case(fill(means, 1e38)),
        "positions 1e-38": Case(fill(means, 1e-38), EITHER),
        "positions all one": Case(fill(means, 1.0), EITHER),
        "one finite row": Case(
            fill(every, np.nan, slice(1, None)), says=("scene.ply", f"{COUNT - 1:,} of {COUNT:,} rows")
        ),
        "half of the positions NaN": Case(fill(means, np.nan, slice(0, None, 2)), EITHER),
        "one view NaN": Case(fill(means, np.nan, slice(0, COUNT // 3)), EITHER),
        "one position 1e30": Case(fill(means, 1e30, slice(5, 6)), READ),
        "colours 1e38": Case(fill(colors, 1e38), READ),
        "colours -1e38": Case(fill(colors, -1e38), READ),
        "opacities 1e38": Case(fill(opacity, 1e38), READ),
        "opacities -inf": Case(fill(opacity, -np.inf), READ),
        "opacities NaN": Case(fill(opacity, np.nan)),
        "scales 1e38": Case(fill(scales, 1e38), READ),
        "scales -1e38": Case(fill(scales, -1e38), READ),
        "scales -inf": Case(fill(scales, -np.inf), READ),
        "rotations zero": Case(fill(quats, 0), READ),
        "rotations 1e38": Case(fill(quats, 1e38), READ),
        "rotations 1e-45": Case(fill(quats, 1e-45), READ),
    }
    for seed in range(2):

        def change(values: np.ndarray, seed: int = seed) -> None:
            rng = np.random.default_rng(seed)
            values.view(np.uint32)[:] = rng.integers(0, 2**32, values.shape, dtype=np.uint32)

        cases[f"random bits {seed}"] = Case(rows(change), EITHER)
    return cases


def _texts() -> dict[str, Case]:
    changes: dict[str, tuple[Callable[[list[str]], list[str]], tuple[int, ...]]] = {
        "as it is": (lambda x: x, READ),
        "a word in it": (lambda x: ["x" + x[0], *x[1:]], REFUSED),
        "a number missing": (lambda x: [x[0].rsplit(" ", 1)[0], *x[1:]], REFUSED),
        "a number more": (lambda x: [x[0] + " 1", *x[1:]], REFUSED),
        "a line missing": (lambda x: x[:-1], REFUSED),
        "three lines missing": (lambda x: x[:-3], REFUSED),
        "no lines": (lambda _: [], REFUSED),
        "numbers beyond float32": (lambda x: [" ".join(["1e999"] * 17), *x[1:]], READ),
        "hexadecimal numbers": (lambda x: [" ".join(["0x1p3"] * 17), *x[1:]], REFUSED),
        "bytes that are not ascii": (lambda x: ["\xe9" + x[0], *x[1:]], REFUSED),
        "one line of a megabyte": (lambda _: ["1" * 2**20], REFUSED),
    }
    return {f"ascii with {name}": Case(text(change), codes) for name, (change, codes) in changes.items()}


def empty_lists(folder: Path) -> None:
    """A million lists of a byte each, every one an object in memory."""
    lines, body = parts(folder)
    lines[-1:] = ["element face 1000000", "property list uchar uchar vertex_index", "end_header"]
    put(folder, lines, body + bytes(1_000_000))


def parts_with(opacity: float, count: int = COUNT // VIEWS) -> Spoil:
    """A file for each view, the opacities of ``count`` rows of the second one changed."""

    def spoil(folder: Path) -> None:
        lines, body = parts(folder)
        (folder / "scene.ply").unlink()
        values = np.frombuffer(body, "<f4").reshape(VIEWS, -1, len(COLUMNS)).copy()
        values[1, :count, 9] = opacity
        for view, part in enumerate(values):
            head = "\n".join([*lines, ""]).replace(str(COUNT), str(len(part)))
            (folder / f"view_{view:03d}.ply").write_bytes(head.encode() + part.tobytes())

    return spoil


def _parts() -> dict[str, Case]:
    return {
        "parts": Case(parts_with(3.0), READ),
        "parts of logits and of opacities": Case(
            parts_with(0.9), says=("view_001.ply", "view_000.ply", "raw", "logit")
        ),
        "million empty lists after the vertices": Case(empty_lists, says=("scene.ply", "1,000,000")),
    }


def _packed() -> dict[str, Case]:
    return {
        "packed noise": Case(packed(), EITHER),
        "packed with too few chunks": Case(packed(chunks=1)),
        "packed without chunks": Case(packed(chunks=0)),
        "packed between NaN": Case(packed(low=np.nan, high=np.nan)),
        "packed between infinities": Case(packed(low=-np.inf, high=np.inf)),
        "packed between 3e38": Case(packed(low=-3e38, high=3e38), EITHER),
        "packed as floats": Case(packed(word="float")),
        "packed as bytes": Case(packed(word="uchar")),
        "packed as lists": Case(packed(word="list uchar uint")),
        "packed with harmonics that are missing": Case(
            packed(lines=(f"element sh {COUNT}", *(f"property uchar f_rest_{i}" for i in range(9))))
        ),
        "packed with lists of harmonics": Case(
            packed(lines=("element sh 0", *(f"property list uchar uchar f_rest_{i}" for i in range(9))))
        ),
        "packed with 2^50 chunks": Case(swap_chunks(2**50)),
        "packed with a chunk of text": Case(swap_chunks("many")),
    }


def swap_chunks(count: object) -> Spoil:
    def spoil(folder: Path) -> None:
        packed()(folder)
        path = folder / "scene.ply"
        path.write_bytes(path.read_bytes().replace(b"element chunk 5\n", f"element chunk {count}\n".encode(), 1))

    return spoil


def _huge() -> dict[str, Case]:
    start = "\n".join(LINES[:3]).encode()
    many = "\n".join([*LINES[:2], f"element vertex {2**26}", *LINES[3:], ""]).replace("binary_little_endian", "ascii")
    lists = ["element face 100000000", "property list uchar uchar vertex_index", f"element vertex {COUNT}"]
    meshy = "\n".join([*LINES[:2], *lists, *LINES[3:], ""])
    return {
        "8 GB of zeros": Case(huge_file(2**33, b"")),
        "8 GB of zeros after ply": Case(huge_file(2**33, b"ply\n")),
        "8 GB of zeros in the header": Case(huge_file(2**33, start)),
        "8 GB of zeros as ascii rows": Case(huge_file(2**33, many.encode())),
        "8 GB of zeros as lists": Case(huge_file(2**33, meshy.encode())),
    }


def _repeated() -> dict[str, Case]:
    def repeat(folder: Path) -> None:
        lines, body = parts(folder)
        row = body[:ROW] if len(body) == COUNT * ROW else bytes(len(body) // COUNT)
        put(folder, [line.replace(str(COUNT), str(MANY)) for line in lines], row * MANY)

    return {f"{MANY} rows of one place": Case(repeat, EITHER)}


GROUPS = (_truncations, _counts, _headers, _values, _texts, _parts, _packed, _huge, _repeated)
CASES = {f"ply: {name}": case for group in GROUPS for name, case in group().items()}
