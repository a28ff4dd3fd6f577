"""PLY files that promise more than they have, and values that overflow."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from .case import EITHER, HEIGHT, READ, VIEWS, WIDTH, Case, Spoil, sparse

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


def packed(low: float = -3, high: float = 3) -> Spoil:
    """A compressed file of noise."""
    chunks = -(-COUNT // 256)

    def spoil(folder: Path) -> None:
        head = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
        head += [f"property float {name}" for name in RANGES]
        head += [f"element vertex {COUNT}", *(f"property uint {name}" for name in PACKED), "end_header"]
        limits = np.where([name.startswith("min") for name in RANGES], low, high).astype("<f4")
        words = np.random.default_rng(0).integers(0, 2**32, (COUNT, 4), dtype=np.uint32)
        put(folder, head, np.tile(limits, (chunks, 1)).tobytes() + words.tobytes())

    return spoil


def huge_file(size: int, start: bytes) -> Spoil:
    return lambda folder: sparse(folder / "scene.ply", size, start)


def _counts() -> dict[str, Case]:
    line = f"element vertex {COUNT}"
    wrong = (-1, 2**31, 2**63, 10**30, "9" * 5000)
    cases = {f"count {str(count)[:20]}": Case(swap(line, f"element vertex {count}")) for count in wrong}
    words = [f"element vertex {2**62}" if x == line else x for x in LINES]
    words[1] = "format ascii 1.0"
    cases["ascii count 2^62"] = Case(lambda folder: put(folder, words, b"1 2 3\n"))
    cases["further element of 2^40 rows"] = Case(insert("end_header", f"element more {2**40}", "property double a"))
    cases["first element of 2^40 rows"] = Case(insert(line, f"element more {2**40}", "property double a"))
    cases["rows without columns"] = Case(insert(line, f"element more {2**40}"))
    return cases


def _headers() -> dict[str, Case]:
    vertex, last = f"element vertex {COUNT}", "property float rot_3"
    elements = [line for i in range(20_000) for line in (f"element other_{i} 0", "property char a")]
    return {
        "name with an escape sequence": Case(swap(vertex, f"element \x1b[31mvertex {COUNT}")),
        "name of a megabyte": Case(swap(last, "property float " + "a" * 2**20)),
        "20,000 columns": Case(insert(last, *(f"property uchar p{i}" for i in range(20_000)))),
        "20,000 elements": Case(insert("end_header", *elements)),
        "f_rest of 3000 columns": Case(insert(last, *(f"property float f_rest_{i}" for i in range(3000)))),
        "list of 2^32": Case(insert("property float x", "property list uint double many")),
        "list of a negative length": Case(insert("property float x", "property list char double many")),
        "million empty lists": Case(insert(vertex, "element face 1000000", "property list uchar uint vertex_index")),
        "million empty lists after the vertices": Case(empty_lists),
        "100,000 comments": Case(insert(vertex, *(["comment nothing"] * 100_000))),
        "comment that is not ascii": Case(insert(vertex, "comment \xff\xfe"), READ),
        "comment with an escape sequence": Case(insert(vertex, "comment \x1b[2J\x07"), READ),
        "a line of a megabyte": Case(text(lambda _: ["1" * 2**20])),
    }


def _values() -> dict[str, Case]:
    means, colors, opacity, scales, quats = slice(0, 3), slice(6, 9), slice(9, 10), slice(10, 13), slice(13, 17)
    cases = {
        "positions 1e38": Case(fill(means, 1e38)),
        "half of the positions NaN": Case(fill(means, np.nan, slice(0, None, 2)), EITHER),
        "one position 1e30": Case(fill(means, 1e30, slice(5, 6)), READ),
        "colours 1e38": Case(fill(colors, 1e38), READ),
        "opacities 1e38": Case(fill(opacity, 1e38), READ),
        "scales 1e38": Case(fill(scales, 1e38), READ),
        "rotations 1e38": Case(fill(quats, 1e38), READ),
    }

    def change(values: np.ndarray) -> None:
        bits = np.random.default_rng(0).integers(0, 2**32, values.shape, dtype=np.uint32)
        values.view(np.uint32)[:] = bits

    return cases | {"random bits": Case(rows(change), EITHER)}


def empty_lists(folder: Path) -> None:
    """A million lists of a byte each, every one an object in memory."""
    lines, body = parts(folder)
    lines[-1:] = ["element face 1000000", "property list uchar uchar vertex_index", "end_header"]
    put(folder, lines, body + bytes(1_000_000))


def _packed() -> dict[str, Case]:
    return {
        "packed noise": Case(packed(), EITHER),
        "packed between infinities": Case(packed(low=-np.inf, high=np.inf)),
        "packed between 3e38": Case(packed(low=-3e38, high=3e38), EITHER),
        "packed with 2^50 chunks": Case(swap_chunks(2**50)),
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


GROUPS = (_counts, _headers, _values, _packed, _huge, _repeated)
CASES = {f"ply: {name}": case for group in GROUPS for name, case in group().items()}
