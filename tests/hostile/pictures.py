"""Images that lie about their size, bombs, and images of rare kinds."""

from __future__ import annotations

import shutil
import struct
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from .case import EITHER, HEIGHT, READ, REFUSED, VIEWS, WIDTH, Case, Spoil, edit_json, names, sparse

Change = Callable[[bytes], bytes]


def first(change: Change) -> Spoil:
    """Other bytes in the first image."""

    def spoil(folder: Path) -> None:
        path = folder / "images" / f"{names()[0]}.png"
        path.write_bytes(change(path.read_bytes()))

    return spoil


def every(change: Change) -> Spoil:
    def spoil(folder: Path) -> None:
        for name in names():
            path = folder / "images" / f"{name}.png"
            path.write_bytes(change(path.read_bytes()))

    return spoil


def recoded(suffix: str, change: Change) -> Spoil:
    """All images as another format under its own suffix."""

    def spoil(folder: Path) -> None:
        for name in names():
            path = folder / "images" / f"{name}.png"
            image = cv2.imread(str(path))
            path.unlink()
            path.with_suffix(suffix).write_bytes(change(cv2.imencode(suffix, image)[1].tobytes()))

    return spoil


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, data: bytes, *, depth: int = 8, color: int = 2) -> bytes:
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def with_size(width: int, height: int) -> Change:
    """A PNG whose header tells another size than its rows have."""
    return lambda data: data[:8] + chunk(b"IHDR", struct.pack(">II", width, height) + data[24:29]) + data[33:]


@cache
def black(width: int, height: int) -> bytes:
    """A PNG of black pixels, a thousandth of their size."""
    packer, row = zlib.compressobj(1), bytes(1 + 3 * width)
    return png(width, height, b"".join(packer.compress(row) for _ in range(height)) + packer.flush())


def bomb(_: bytes) -> bytes:
    return black(9000, 9000)


def with_texts(data: bytes) -> bytes:
    text = zlib.compress(bytes(2**20), 9)
    return data[:33] + b"".join(chunk(b"zTXt", b"a%d\0\0" % i + text) for i in range(60)) + data[33:]


def with_empty_chunks(data: bytes) -> bytes:
    return data[:33] + chunk(b"IDAT", b"") * 1_000_000 + data[33:]


def with_tags(order: str) -> bytes:
    """A TIFF of 240 kB with 4,000 tags that refer to all of it, each."""
    size, rows = 240_000, {256: WIDTH, 257: HEIGHT, 258: 8, 259: 1, 262: 1, 273: 100_000, 277: 1, 278: HEIGHT, 279: 384}
    tags = [(tag, 4, 1, value) for tag, value in rows.items()] + [(1000 + i, 7, size - 8, 8) for i in range(4000)]
    head = struct.pack(f"{order}2sHIH", b"II" if order == "<" else b"MM", 42, 8, len(tags))
    return (head + b"".join(struct.pack(f"{order}HHII", *tag) for tag in tags)).ljust(size, b"\0")


def with_tile(side: int, order: str = "<", *more: tuple[int, int]) -> bytes:
    """A TIFF of one tile of a few deflated zeros, by far larger than the image, and more tags."""
    packed = zlib.compress(b"\0")
    tags = [(256, WIDTH), (257, HEIGHT), (258, 8), (259, 8), (262, 1), (277, 1), (322, side), (323, side)]
    tags += [(324, 8 + 2 + 12 * (len(tags) + 2 + len(more)) + 4), (325, len(packed)), *more]
    head = struct.pack(f"{order}2sHIH", b"II" if order == "<" else b"MM", 42, 8, len(tags))
    return head + b"".join(struct.pack(f"{order}HHII", tag, 4, 1, value) for tag, value in tags) + bytes(4) + packed


def as_masks(data: bytes) -> Spoil:
    """The bytes as the mask of every view."""

    def spoil(folder: Path) -> None:
        (folder / "masks").mkdir()
        for name in names():
            (folder / "masks" / f"{name}.tiff").write_bytes(data)

    return spoil


def one_photo(folder: Path) -> None:
    """300 frames that name the same photo of 4 million pixels of one colour, which has 0.2 kB."""
    shutil.rmtree(folder / "images")
    cv2.imwrite(str(folder / "p.webp"), np.zeros((2000, 2000, 3), np.uint8))

    def change(data: dict[str, Any]) -> None:
        frames = data["frames"] * (300 // VIEWS)
        data["frames"] = [  # each in a place of its own
            {"file_path": "p.webp", "transform_matrix": [[*row[:3], row[3] + 1e-6 * i] for row in pose]}
            for i, pose in enumerate(frame["transform_matrix"] for frame in frames)
        ]
        for key in ("w", "h"):
            del data[key]

    edit_json("transforms.json", change)(folder)


def jpeg_size(width: int, height: int) -> Change:
    def change(data: bytes) -> bytes:
        at = data.index(b"\xff\xc0") + 5
        return data[:at] + struct.pack(">HH", height, width) + data[at + 4 :]

    return change


def at(position: int, form: str, *values: int) -> Change:
    return lambda data: data[:position] + struct.pack(form, *values) + data[position + struct.calcsize(form) :]


def _cases() -> dict[str, Case]:
    sizes = [(60_000, 60_000), (2**31 - 1, 1), (2**32 - 1, 2**32 - 1), (0, 0), (25, 16)]
    bits = png(WIDTH, HEIGHT, zlib.compress(b"\0\xaa\xaa\xaa" * HEIGHT), depth=1, color=0)
    cases = {f"PNG that claims {w} x {h}": Case(first(with_size(w, h)), EITHER) for w, h in sizes}
    cases |= {
        "all PNG claim 60000 x 60000": Case(every(with_size(60_000, 60_000))),
        "8 GB of zeros": Case(lambda folder: sparse(folder / "images" / "view_000.png", 2**33)),
        "8 GB after a PNG": Case(
            lambda f: sparse(f / "images" / "view_000.png", 2**33, (f / "images" / "view_000.png").read_bytes())
        ),
        "three bombs": Case(every(bomb)),
        "solid of 8190 x 8190": Case(every(lambda _: black(8190, 8190))),
        "300 frames of one photo": Case(one_photo, says=("300 of 2000 x 2000",)),
        "60 texts of 1 MB": Case(every(with_texts), READ),
        "a million chunks without data": Case(every(with_empty_chunks), EITHER),
        "script": Case(first(lambda data: b"#!/bin/sh\ntouch executed\n")),
        "chunk of 4 GB": Case(first(at(33, ">I", 2**32 - 1)), EITHER),
        "JPEG of four channels": Case(every(cmyk), EITHER),
        "1 bit PNG": Case(every(lambda data: bits), READ),
        ".bmp upside down": Case(recoded(".bmp", at(22, "<i", -HEIGHT)), READ),
        ".bmp of least height": Case(recoded(".bmp", at(22, "<i", -(2**31)))),
        ".tiff whose directory is itself": Case(recoded(".tiff", at(4, "<I", 0))),
        ".tiff whose directory is far away": Case(recoded(".tiff", at(4, "<I", 2**32 - 1))),
    }
    for order in "<>":
        tags = recoded(".tiff", lambda _, order=order: with_tags(order))
        cases[f".tiff whose tags are all of it, {order}"] = Case(tags)
        masks = as_masks(with_tile(26_000, order))
        cases[f".tiff masks of a tile of 26000 x 26000, {order}"] = Case(masks, says=("view_000.tiff", "26000 x 26000"))
    cases[".tiff of a tile of 8192 x 8192"] = Case(recoded(".tiff", lambda _: with_tile(8192)))
    cases[".tiff of a tile of two sizes"] = Case(recoded(".tiff", lambda _: with_tile(8192, "<", (322, 16), (323, 16))))
    for suffix, lie in {
        ".jpg": jpeg_size(60_000, 60_000), ".bmp": at(18, "<ii", 60_000, 60_000), ".webp": at(26, "<HH", 16383, 16383),
        ".ppm": lambda data: data.replace(b"24 16", b"60000 60000", 1),
    }.items():  # fmt: skip
        cases[f"{suffix} that lies"] = Case(recoded(suffix, lie), EITHER if suffix == ".webp" else REFUSED)
    return cases


def cmyk(_: bytes) -> bytes:
    """A JPEG header with four components and no data for them."""
    parts = b"".join(bytes((i, 0x11, 0)) for i in range(1, 5))
    frame = struct.pack(">HBHHB", 20, 8, HEIGHT, WIDTH, 4) + parts
    tables = b"\xff\xdb" + struct.pack(">HB", 67, 0) + bytes([1] * 64)
    scan = b"\xff\xda" + struct.pack(">HB", 14, 4) + b"".join(bytes((i, 0)) for i in range(1, 5)) + b"\0\x3f\0"
    return b"\xff\xd8" + tables + b"\xff\xc0" + frame + scan + b"\0" * 50 + b"\xff\xd9"


CASES = {f"image: {name}": case for name, case in _cases().items()}
