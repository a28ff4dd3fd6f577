"""Damages of ``.ply`` files have headers that promise more than there is, and rows of values that overflow."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .case import Change, Damage, accept, allow, refuse
from .changes import edit_bytes, fill_with_zeros, swap, write_file
from .sounds import TINY

COUNT = len(TINY.gaussians)
COLUMNS = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
VERTEX, LAST = f"element vertex {COUNT}\n", "property float rot_3\n"
DIGITS = "9" * 5000
MANY = 600_000  # rows, which in one place take long to place


def insert_before(line: str, *more: str) -> Change:
    """Put lines into the header, before one."""
    return swap(line, "".join(f"{one}\n" for one in more) + line)


def rename(*names: str) -> Change:
    """Give columns names that say nothing."""

    def change(path: Path) -> None:
        for name in names:
            swap(f"property float {name}\n", f"property float {name}_before\n")(path)

    return change


def add_harmonics(*ids: int) -> Change:
    """Add columns of zeros for harmonics of these numbers."""

    def change(data: bytes) -> bytes:
        head, mark, body = data.partition(b"end_header\n")
        values = np.frombuffer(body, "<f4").reshape(COUNT, -1)
        names = "".join(f"property float f_rest_{i}\n" for i in ids)
        return head + names.encode() + mark + np.pad(values, ((0, 0), (0, len(ids)))).tobytes()

    return edit_bytes(change)


def rename_to_packed(path: Path) -> None:
    rename(*COLUMNS)(path)
    swap("x_before", "packed_position")(path)
    swap("y_before", "packed_scale")(path)


def edit_rows(change: Callable[[np.ndarray], None]) -> Change:
    """Change the values of the rows: ``[n,17]`` float32."""

    def change_rows(data: bytes) -> bytes:
        head, mark, body = data.partition(b"end_header\n")
        values = np.frombuffer(body, "<f4").reshape(COUNT, -1).copy()
        change(values)
        return head + mark + values.tobytes()

    return edit_bytes(change_rows)


def fill(columns: slice, value: float, which: slice = slice(None)) -> Change:
    def change(values: np.ndarray) -> None:
        values[which, columns] = value

    return edit_rows(change)


def random_bits(values: np.ndarray) -> None:
    values.view(np.uint32)[:] = np.random.default_rng(0).integers(0, 2**32, values.shape, dtype=np.uint32)


def write_rows(text: str, count: int = COUNT) -> Change:
    """Put text in the place of the rows."""

    def change(data: bytes) -> bytes:
        head = data.partition(b"end_header\n")[0].replace(b"binary_little_endian", b"ascii")
        return head.replace(VERTEX.encode(), f"element vertex {count}\n".encode()) + b"end_header\n" + text.encode()

    return edit_bytes(change)


def repeat_first_row(data: bytes) -> bytes:
    """Return many rows that are the first one."""
    head, mark, body = data.partition(b"end_header\n")
    return head.replace(VERTEX.encode(), f"element vertex {MANY}\n".encode()) + mark + body[: len(body) // COUNT] * MANY


def add_empty_lists(data: bytes) -> bytes:
    """Add a million lists of a byte each behind the rows, every one an object in memory."""
    lists = b"element face 1000000\nproperty list uchar uchar vertex_index\nend_header\n"
    return data.replace(b"end_header\n", lists) + bytes(1_000_000)


def write_huge_header(count: int | str, form: str = "binary_little_endian", *more: str) -> Callable[[Path], None]:
    """Write 8 GB of zeros behind a header."""

    def change(path: Path) -> None:
        head = path.read_bytes().partition(b"end_header\n")[0] + b"end_header\n"
        lines = "".join(f"{line}\n" for line in (*more, f"element vertex {count}"))
        head = head.replace(VERTEX.encode(), lines.encode()).replace(b"binary_little_endian", form.encode())
        fill_with_zeros(2**33, head)(path)

    return change


# Compressed files: as many chunks of noise between two values


RANGES = tuple(f"{end}_{part}{axis}" for part in ("", "scale_") for end in ("min", "max") for axis in "xyz")
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def write_noise(low: float = -3, high: float = 3, chunks: int | None = None) -> Change:
    def change(path: Path) -> None:
        lines = ["ply", "format binary_little_endian 1.0", f"element chunk {1 if chunks is None else chunks}"]
        lines += [f"property float {name}" for name in RANGES]
        lines += [f"element vertex {COUNT}", *(f"property uint {name}" for name in PACKED), "end_header", ""]
        limits = np.where([name.startswith("min") for name in RANGES], low, high).astype("<f4")
        words = np.random.default_rng(0).integers(0, 2**32, (COUNT, 4), dtype=np.uint32)
        write_file(path, "\n".join(lines).encode() + limits.tobytes() + words.tobytes())

    return change


def _counts() -> dict[str, Damage]:
    wrong = {-1: (-1,), 0: ("one Gaussian", 0), 2**31: (2**31,), 2**63: (), 10**30: (), DIGITS: ()}
    huge = f"element more {2**40}"
    return {
        **{
            f"a count of {n if n != DIGITS else '5,000 digits'}": refuse(swap(VERTEX, f"element vertex {n}\n"), *said)
            for n, said in wrong.items()
        },
        "a count of 2^62 before one line of text": refuse(write_rows("1 2 3\n", 2**62)),
        "an element of 2^40 rows after the Gaussians": refuse(
            insert_before("end_header\n", huge, "property double a"), "'more'"
        ),
        "an element of 2^40 rows before the Gaussians": refuse(
            insert_before(VERTEX, huge, "property double a"), "'more'"
        ),
        "an element of 2^40 rows without columns": refuse(insert_before(VERTEX, huge), "columns"),
    }


def _headers() -> dict[str, Damage]:
    elements = [line for i in range(20_000) for line in (f"element other_{i} 0", "property char a")]
    lists = ("element face 1000000", "property list uchar uint vertex_index")
    return {
        "an element named points": refuse(swap("element vertex", "element points"), "'vertex'", "'points'"),
        "an element's name with an escape sequence": refuse(swap("element vertex", "element \x1b[31mvertex")),
        "a column's name of 1 MB": refuse(swap(LAST, "property float " + "a" * 2**20 + "\n"), "1 MiB"),
        "a column's name that is not ASCII": refuse(swap("f_dc_0", "f_dc_\xe9"), "column f_dc_0"),
        "a keyword that is not ASCII": refuse(swap("comment", "c\xe9mment"), "line 3"),
        "a header without an end": refuse(swap("end_header\n", ""), "end of file"),
        "a first line other than ply": refuse(swap("ply\n", "plywood\n"), "'ply'"),
        "columns scale_1 and scale_2 missing": refuse(rename("scale_1", "scale_2"), "column scale_1"),
        "columns opacity and rot_2 missing": refuse(rename("opacity", "rot_2"), "columns opacity, rot_2"),
        "a point cloud without columns of Gaussians": refuse(
            rename(*COLUMNS[6:]), "f_dc_0, f_dc_1, f_dc_2, opacity", "this one has none"),
        "packed columns without their chunks": refuse(rename_to_packed, "compressed"),
        **{f"{n} columns f_rest": refuse(add_harmonics(*range(n)), f"{n} f_rest") for n in (1, 10, 46)},
        "columns f_rest with a gap in their numbers": refuse(add_harmonics(*range(8), 9), "9 f_rest"),
        "rot_3 as a list of floats": refuse(swap(LAST, "property list uchar float rot_3\n"), "list"),
        "20,000 more columns": refuse(insert_before(LAST, *(f"property uchar p{i}" for i in range(20_000)))),
        "20,000 empty elements": refuse(insert_before("end_header\n", *elements), "steps"),
        "3,000 columns f_rest": refuse(insert_before(LAST, *(f"property float f_rest_{i}" for i in range(3000)))),
        "a list in each row with a length of 32 bits": refuse(
            insert_before("property float x\n", "property list uint double many"), "list"
        ),
        "a list in each row with a signed length": refuse(
            insert_before("property float x\n", "property list char double many"), "list"
        ),
        "a million lists before the Gaussians": refuse(insert_before(VERTEX, *lists), "140 MB"),
        "a million empty lists after the Gaussians": refuse(edit_bytes(add_empty_lists), "140 MB"),
        "100,000 comments in the header": refuse(insert_before(VERTEX, *(["comment nothing"] * 100_000)), "1 MiB"),
        "a comment that is not ASCII": accept(insert_before(VERTEX, "comment \xff\xfe")),
        "a comment with an escape sequence": accept(insert_before(VERTEX, "comment \x1b[2J\x07")),
        "a line of 1 MB as text rows": refuse(write_rows("1" * 2**20)),
        "10,000 empty lines as text rows": refuse(write_rows("\n" * 10_000), f"{COUNT} rows", 0),
        "cut off in the middle": refuse(edit_bytes(lambda data: data[: len(data) // 2]), "'vertex'", COUNT,
                              place="scene.ply: truncated or damaged"),
    }  # fmt: skip


def _values() -> dict[str, Damage]:
    means, colors, opacity, scales, quats = slice(0, 3), slice(6, 9), slice(9, 10), slice(10, 13), slice(13, 17)
    return {
        "positions of 1e38": refuse(fill(means, 1e38), "no scene has"),
        "NaN in half of the positions": allow(fill(means, np.nan, slice(0, None, 2))),
        "one position of 1e30": accept(fill(means, 1e30, slice(5, 6))),
        "colours of 1e38": refuse(fill(colors, 1e38), "no scene has"),
        "opacities of 1e38": accept(fill(opacity, 1e38)),
        "scales of 1e38": refuse(fill(scales, 1e38), "no scene has"),
        "rotations of 1e38": accept(fill(quats, 1e38)),
        "zeros in all rows": refuse(fill(slice(None), 0), COUNT, "origin"),
        "random bits in all rows": allow(edit_rows(random_bits), slow=True),
        f"{MANY:,} equal rows": allow(edit_bytes(repeat_first_row), slow=True),
        "packed rows of noise": allow(write_noise(), slow=True),
        "packed rows between infinities": refuse(write_noise(-np.inf, np.inf), "NaN"),
        "packed rows between -3e38 and 3e38": allow(write_noise(-3e38, 3e38), slow=True),
        "packed rows with a count of 2^50 chunks": refuse(write_noise(chunks=2**50), "'chunk'"),
        "packed rows without chunks": refuse(write_noise(chunks=0), "1 chunks", COUNT, 0),
    }


def _huge() -> dict[str, Damage]:
    lists = ("element face 100000000", "property list uchar uchar vertex_index")
    return {
        "8 GB of zeros after the first line": refuse(fill_with_zeros(2**33, b"ply\n"), "1 MiB"),
        "8 GB of zeros in the header": refuse(
            lambda path: fill_with_zeros(2**33, path.read_bytes().partition(b"property")[0])(path), slow=True
        ),
        "8 GB of zeros as text rows": refuse(write_huge_header(2**26, "ascii"), slow=True),
        "8 GB of zeros as lists": refuse(write_huge_header(COUNT, "binary_little_endian", *lists), slow=True),
    }


# Of a compressed file


def of_compressed() -> dict[str, Damage]:
    return {
        "no chunks": refuse(
            edit_bytes(lambda data: re.sub(rb"element chunk \d+\n(property \w+ \w+\n)+", b"", data, count=1)),
            "lacks",
            "'chunk'",
        ),
        "fewer rows of harmonics than Gaussians": refuse(swap("element sh 6\n", "element sh 5\n"), 6, "'sh'"),
        "a column of ranges under another name": refuse(
            swap("property float min_y", "property float middle_y"), "min_y", "'chunk'", "f4"
        ),
    }


DAMAGES = {
    "ply as text": {"a first line other than ply": refuse(swap("ply\n", "plywood\n"), "text", "'plywood'")},
    "scene.ply": _counts() | _headers() | _values() | _huge(),
    "compressed ply": of_compressed(),
}
