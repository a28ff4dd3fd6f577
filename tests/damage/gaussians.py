"""Damages of ``.spz``, ``.splat`` and ``.glb`` have headers and tables that promise more than there is."""

from __future__ import annotations

import gzip
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from .case import Change, Damage, accept, allow, refuse
from .changes import document, edit_bytes, edit_json, pack_at, set_json, write
from .sounds import SOME

SPZ_HEADER = struct.Struct("<3I4B")
MAGIC = 0x5053474E
RECORD = 0xADBE0003  # of SPZ_ADOBE_coordinate_system
SIZES = slice(32, 32 + 16 * 6)  # the table of a file of version 4 with harmonics
PLACE_OF_COUNT = 8
SPLATTING = "KHR_gaussian_splatting"
DEEP = 100_000  # brackets, or nodes in one another


# .spz


def edit_stream(change: Callable[[bytes], bytes]) -> Change:
    """Change what is in the gzip stream."""
    return edit_bytes(lambda data: gzip.compress(change(gzip.decompress(data)), 1))


def edit_header(**changes: int) -> Change:
    names = ("magic", "version", "count", "degree", "fraction", "flags", "zero")

    def change(data: bytes) -> bytes:
        numbers = dict(zip(names, SPZ_HEADER.unpack_from(data), strict=True)) | changes
        return SPZ_HEADER.pack(*numbers.values()) + data[SPZ_HEADER.size :]

    return edit_stream(change)


def equal_bytes(count: int, degree: int = 0) -> bytes:
    """Return equal Gaussians, which pack a thousandfold."""
    numbers = SPZ_HEADER.pack(MAGIC, 3, count, degree, 12, 0, 0)
    return gzip.compress(numbers + bytes(count * (17 + 3 * (degree + 1) ** 2)), 1)


def equal_4(count: int) -> bytes:
    """Return the same in version 4, with more bytes behind, so that it is not refused for its ratio alone."""
    import zstandard

    columns = [bytes(width * count) for width in (9, 1, 3, 3, 4)]
    streams = [zstandard.compress(column) for column in columns]
    sizes = b"".join(struct.pack("<QQ", len(part), len(c)) for part, c in zip(streams, columns, strict=True))
    head = SPZ_HEADER.pack(MAGIC, 4, count, 0, 12, 0, 5) + struct.pack("<I12x", 32)
    return head + sizes + b"".join(streams) + bytes(20 * count // 1000)


def axes_record(number: int, size: int = 4, cut: int = 0) -> bytes:
    record = struct.pack("<2I", RECORD, size) + struct.pack("<I", number)[:size]
    return record[: len(record) - cut]


def add_record(data: bytes, more: bytes) -> bytes:
    """Put records into a file: before the table of version 4, or after the columns of an older one."""
    flagged = bytearray(data if data[:4] == b"NGSP" else gzip.decompress(data))
    flagged[14] |= 2
    if data[:4] != b"NGSP":
        return gzip.compress(flagged + more)
    return bytes(flagged[:16] + struct.pack("<I", 32 + len(more)) + flagged[20:32] + more + flagged[32:])


def put_record(more: bytes) -> Change:
    return edit_bytes(lambda data: add_record(data, more))


RECORDS = {
    "axes of an unknown number": refuse(put_record(axes_record(17)), "SPZ_ADOBE_coordinate_system", 17),
    "axes in two bytes instead of four": refuse(
        put_record(axes_record(4, 2)), "SPZ_ADOBE_coordinate_system", "damaged"
    ),
    "axes cut off": refuse(put_record(axes_record(4, cut=1)), "SPZ_ADOBE_coordinate_system", "damaged"),
}


def of_spz() -> dict[str, Damage]:
    return RECORDS | {
        "the first 40 bytes alone": refuse(edit_bytes(lambda data: data[:40]), 174, 9),
        "a byte less inside the gzip": refuse(edit_stream(lambda data: data[:-1]), 174, 173),
        "another magic number": refuse(edit_header(magic=1), "another file"),
        "the start of version 4 alone": refuse(write(b"NGSP\4\0\0\0"), "end of file"),
        "version 9": refuse(edit_header(version=9), "version 9"),
        "version 1 in the header of version 3": allow(edit_header(version=1)),
        "degree 4 in the header": refuse(edit_header(degree=4), 552, 174),
        "a fraction of 200 bits": refuse(edit_header(fraction=200), "version 1 to 4"),
        "a count of 0": refuse(edit_header(count=0), "a count of 0"),
        "a count of 2^32 - 1": refuse(edit_header(count=2**32 - 1), "64 MB"),
        "a count of one too many": refuse(edit_header(count=len(SOME) + 1), 203, 174),
        "1,000,001 equal Gaussians": refuse(write(equal_bytes(1_000_001)), "1,000,001"),
        "1,000,001 equal Gaussians in version 4": refuse(write(equal_4(1_000_001)), "1,000,001"),
        "500,000 equal Gaussians of degree 4": refuse(write(equal_bytes(500_000, 4)), "500,000"),
        "nine zero bytes inside the gzip": refuse(write(gzip.compress(bytes(9), 1))),
    }


def lengthen_stream(data: bytes) -> bytes:
    """Return the file with a first stream that unpacks to a megabyte."""
    import zstandard

    packed = zstandard.compress(bytes(10**6))
    (size,) = struct.unpack_from("<Q", data, SIZES.start)
    return (
        data[: SIZES.start] + struct.pack("<Q", len(packed)) + data[SIZES.start + 8 : SIZES.stop]
        + packed + data[SIZES.stop + size :]
    )  # fmt: skip


def of_spz4() -> dict[str, Damage]:
    frame = b"\x28\xb5\x2f\xfd\xe0" + b"\xff" * 7 + b"\0"
    return RECORDS | {
        "the first 15 bytes alone": refuse(edit_bytes(lambda data: data[:15]), "end of file"),
        "the first 60 bytes alone": refuse(edit_bytes(lambda data: data[:60]), "end of file"),
        "the last three bytes cut off": refuse(edit_bytes(lambda data: data[:-3]), "truncated"),
        "a count of 0": refuse(pack_at(PLACE_OF_COUNT, "<I", 0), "a count of 0"),
        "a count of 2^32 - 1": refuse(pack_at(PLACE_OF_COUNT, "<I", 2**32 - 1), "64 MB"),
        "degree 5 in the header": refuse(pack_at(12, "B", 5), "degree 5"),
        "three streams in the header": refuse(pack_at(15, "B", 3), "columns"),
        "a table that starts at 2 GB": refuse(pack_at(16, "<I", 2**31 - 1), "end of file"),
        "a stream of 2^63 bytes": refuse(pack_at(SIZES.start, "<Q", 2**63), "truncated"),
        "a stream that claims to unpack to 2^40 bytes": refuse(pack_at(SIZES.start + 8, "<Q", 2**40), "columns"),
        "bytes that are no Zstandard as a stream": refuse(pack_at(SIZES.stop, "4s", b"none"), "Zstandard"),
        "a stream whose frame claims another size": refuse(pack_at(SIZES.stop, f"{len(frame)}s", frame), "Zstandard"),
        "a stream that unpacks to 1 MB": refuse(edit_bytes(lengthen_stream), "sizes of its table"),
    }


# .glb


def edit_primitive(change: Callable[[dict[str, Any]], object]) -> Change:
    """Change the only primitive."""

    def both(parsed: dict[str, Any]) -> None:
        change(parsed["meshes"][0]["primitives"][0])

    return edit_json(both)


def edit_splats(**values: Any) -> Change:
    return edit_primitive(lambda p: p["extensions"][SPLATTING].update(values))


def lack_attribute(name: str) -> Damage:
    return refuse(edit_primitive(lambda p: p["attributes"].pop(f"{SPLATTING}:{name}")), f"{SPLATTING}:{name}")


def chain_nodes(parsed: dict[str, Any]) -> None:
    """Put nodes into one another, of which the last has the Gaussians."""
    parsed["nodes"] = [{"children": [i + 1], "scale": [2, 2, 2]} for i in range(DEEP // 5)] + parsed["nodes"]


def put_nodes(count: int, node: dict[str, int]) -> Change:
    """Put as many equal nodes into one; even empty ones take longer to place than their few bytes allow."""
    return set_json("nodes", value=[{"children": list(range(1, count + 1))}, *([node] * count)])


def share_positions(parsed: dict[str, Any]) -> None:
    """Let all harmonics be the positions."""
    names = [f"{SPLATTING}:SH_DEGREE_{d}_COEF_{i}" for d in (1, 2, 3) for i in range(2 * d + 1)]
    parsed["meshes"][0]["primitives"][0]["attributes"] |= dict.fromkeys(names, 0)


def of_glb() -> dict[str, Damage]:
    damages = {
        f"a document that claims {value} bytes": refuse(pack_at(12, "<I", value)) for value in (0, 2**31, 2**32 - 1)
    }
    for value in (float("nan"), 1e300):
        for part in ("translation", "scale"):
            damages[f"a node's {part} of {value}"] = allow(set_json("nodes", 0, part, value=[value] * 3))
    accessor, view = ("accessors", 2), ("bufferViews", 0)
    return damages | {
        "a header that claims 4 GB": refuse(pack_at(8, "<I", 2**32 - 1), "truncated"),
        "the same document written again": accept(edit_bytes(lambda data: document(data)[1](document(data)[0]))),
        "a mesh without Gaussians": refuse(edit_primitive(lambda p: p["extensions"].clear()), SPLATTING, "mesh"),
        "linear colours": refuse(edit_splats(colorSpace="lin_rec709_display"), "lin_rec709_display"),
        "an unknown kernel": refuse(edit_splats(kernel="customShape"), "customShape"),
        "Gaussians of an unknown compression": refuse(
            edit_splats(extensions={f"{SPLATTING}_spz_2": {}}), f"{SPLATTING}_spz_2"
        ),
        **{
            f"no attribute {name}": lack_attribute(name)
            for name in ("SCALE", "SH_DEGREE_1_COEF_2", "SH_DEGREE_0_COEF_0")
        },
        "an unknown extension required": refuse(
            set_json("extensionsRequired", value=["EXT_meshopt_compression"]), "EXT_meshopt_compression"
        ),
        "values in another file": refuse(set_json("buffers", 0, "uri", value="b.bin"), "another file"),
        "sparse values": refuse(set_json(*accessor, "sparse", value={}), "sparse"),
        "10^12 values of one attribute": refuse(set_json(*accessor, "count", value=10**12), "truncated"),
        "a number of positions of 400 digits": refuse(set_json("accessors", 0, "count", value=10**400), "count"),
        "10^9 positions": refuse(set_json("accessors", 0, "count", value=10**9), "truncated"),
        "fewer values of one attribute": refuse(set_json(*accessor, "count", value=5), "one per Gaussian"),
        "values of 2^62 bytes": allow(set_json(*view, "byteLength", value=2**62)),
        "values 2^62 bytes apart": allow(set_json(*view, "byteStride", value=2**62)),
        "a node that holds itself": refuse(set_json("nodes", 0, "children", value=[0]), "node 0"),
        "a node that stretches the Gaussians": refuse(set_json("nodes", 0, "scale", value=[1, 2, 1]), "stretches"),
        "a node that mirrors the Gaussians": refuse(set_json("nodes", 0, "scale", value=[-1, -1, -1]), "mirrors"),
        "two nodes with the same Gaussians": refuse(put_nodes(2, {"mesh": 0}), "same values"),
        "20,000 nodes in one another": refuse(edit_json(chain_nodes), slow=True),
        "100,000 nodes with the same Gaussians": refuse(put_nodes(DEEP, {"mesh": 0}), slow=True),
        "200,000 empty nodes": refuse(put_nodes(200_000, {}), slow=True),
        "positions as the values of all harmonics": refuse(edit_json(share_positions), "same values"),
    }


DAMAGES = {
    "spz": of_spz(),
    "spz of version 4": of_spz4(),
    "splat": {
        "33 zero bytes in its place": refuse(write(bytes(33)), "33 bytes"),
        "a row of NaN in its place": refuse(write(np.full(8, np.nan, "<f4").tobytes()), "NaN"),
    },
    "glb": of_glb(),
}
