"""Damaged photos and masks lie about their size, unpack to far more than they have, or are of rare kinds."""

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

from .case import Change, Damage, accept, allow, refuse
from .changes import cut, edit_bytes, edit_json, fill_with_zeros, put_numbers, write
from .sounds import NAMES, TINY

Bytes = Callable[[bytes], bytes]
WIDTH, HEIGHT, VIEWS = TINY.width, TINY.height, len(NAMES)
ALL = "images"  # what is named where no photo can be used


def edit_all(change: Bytes) -> Change:
    """Change all photos."""

    def both(path: Path) -> None:
        for photo in path.parent.iterdir():
            photo.write_bytes(change(photo.read_bytes()))

    return both


def recode(suffix: str, change: Bytes) -> Change:
    """Encode all photos in another format under its own suffix, and change them."""

    def both(path: Path) -> None:
        for photo in list(path.parent.iterdir()):
            image = cv2.imread(str(photo))
            photo.unlink()
            photo.with_suffix(suffix).write_bytes(change(cv2.imencode(suffix, image)[1].tobytes()))

    return both


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, data: bytes, *, depth: int = 8, color: int = 2) -> bytes:
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def claim_size(width: int, height: int) -> Bytes:
    """Let the header of a PNG tell another size than its rows have."""
    return lambda data: data[:8] + chunk(b"IHDR", struct.pack(">II", width, height) + data[24:29]) + data[33:]


@cache
def black(width: int, height: int) -> bytes:
    """Return a PNG of black pixels, a thousandth of their size."""
    packer, row = zlib.compressobj(1), bytes(1 + 3 * width)
    return png(width, height, b"".join(packer.compress(row) for _ in range(height)) + packer.flush())


def add_chunks(more: bytes) -> Bytes:
    """Add chunks to a PNG between its header and its pixels."""
    return lambda data: data[:33] + more + data[33:]


def texts() -> bytes:
    packed = zlib.compress(bytes(2**20), 9)
    return b"".join(chunk(b"zTXt", b"a%d\0\0" % i + packed) for i in range(60))


def flip(place: int) -> Change:
    """Flip some bits of a byte."""
    return edit_bytes(lambda data: data[:place] + bytes([data[place] ^ 0x55]) + data[place + 1 :])


def name_one_photo(path: Path) -> None:
    """Write 300 frames that name the same photo of 4 million pixels of one colour, which has 0.2 kB."""
    scene = path.parent.parent
    shutil.rmtree(path.parent)
    cv2.imwrite(str(scene / "p.webp"), np.zeros((2000, 2000, 3), np.uint8))

    def change(data: dict[str, Any]) -> None:
        frames = data["frames"] * (300 // VIEWS)
        data["frames"] = [  # each in a place of its own
            {"file_path": "p.webp", "transform_matrix": [[*row[:3], row[3] + 1e-6 * i] for row in pose]}
            for i, pose in enumerate(frame["transform_matrix"] for frame in frames)
        ]
        for key in ("w", "h"):
            del data[key]

    edit_json(change)(scene / "transforms.json")


def claim_jpeg_size(width: int, height: int) -> Bytes:
    def change(data: bytes) -> bytes:
        start = data.index(b"\xff\xc0") + 5
        return data[:start] + struct.pack(">HH", height, width) + data[start + 4 :]

    return change


def cmyk(_: bytes) -> bytes:
    """Return a JPEG header with four components and no data for them."""
    parts = b"".join(bytes((i, 0x11, 0)) for i in range(1, 5))
    frame = struct.pack(">HBHHB", 20, 8, HEIGHT, WIDTH, 4) + parts
    tables = b"\xff\xdb" + struct.pack(">HB", 67, 0) + bytes([1] * 64)
    scan = b"\xff\xda" + struct.pack(">HB", 14, 4) + b"".join(bytes((i, 0)) for i in range(1, 5)) + b"\0\x3f\0"
    return b"\xff\xd8" + tables + b"\xff\xc0" + frame + scan + b"\0" * 50 + b"\xff\xd9"


def of_png() -> dict[str, Damage]:
    sizes = [(60_000, 60_000), (2**31 - 1, 1), (2**32 - 1, 2**32 - 1), (0, 0), (WIDTH + 1, HEIGHT)]
    bits = png(WIDTH, HEIGHT, zlib.compress(b"\0\xaa" * HEIGHT), depth=1, color=0)
    return {
        **{f"a PNG that claims {w} x {h}": allow(edit_bytes(claim_size(w, h))) for w, h in sizes},
        "all PNGs claim 60000 x 60000": refuse(edit_all(claim_size(60_000, 60_000)), place=ALL),
        "8 GB of zeros in its place": refuse(fill_with_zeros(2**33)),
        "all photos black, of 9000 x 9000": refuse(edit_all(lambda _: black(9000, 9000)), place=ALL, slow=True),
        "all photos black, of 8190 x 8190": refuse(edit_all(lambda _: black(8190, 8190)), place=ALL, slow=True),
        "300 frames with one photo of 2000 x 2000": refuse(
            name_one_photo, "300 of 2000 x 2000", place="scene", compacts=True, slow=True
        ),
        "60 packed texts of 1 MB in every PNG": accept(edit_all(add_chunks(texts())), slow=True),
        "300,000 empty chunks in every PNG": allow(edit_all(add_chunks(chunk(b"IDAT", b"") * 300_000)), slow=True),
        "a shell script in its place": refuse(edit_bytes(lambda data: b"#!/bin/sh\ntouch executed\n")),
        "a chunk that claims 4 GB": refuse(edit_bytes(put_numbers(33, ">I", 2**32 - 1))),
        "all photos as JPEG of four channels without pixels": allow(edit_all(cmyk)),
        "all photos as PNG of 1 bit": accept(edit_all(lambda _: bits)),
    }


def of_other_formats() -> dict[str, Damage]:
    lies = {
        ".jpg": claim_jpeg_size(60_000, 60_000), ".bmp": put_numbers(18, "<ii", 60_000, 60_000),
        ".webp": put_numbers(26, "<HH", 16383, 16383), ".ppm": lambda data: data.replace(b"6 4", b"60000 60000", 1),
    }  # fmt: skip
    return {
        **{
            f"all photos as {suffix} that claim a huge size": (allow if suffix == ".webp" else refuse)(
                recode(suffix, lie), place=ALL
            )
            for suffix, lie in lies.items()
        },
        "all photos as .bmp upside down": accept(recode(".bmp", put_numbers(22, "<i", -HEIGHT))),
        "all photos as .bmp of a height of -2^31": refuse(recode(".bmp", put_numbers(22, "<i", -(2**31))), place=ALL),
    }


def write_progressive(scans: int) -> Change:
    """Write a progressive JPEG of 4 million pixels, with its last scan as many times."""
    picture = np.zeros((2048, 2048), np.uint8)

    def change(path: Path) -> None:
        data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
        path.write_bytes(data[:-2] + data[data.rindex(b"\xff\xda") : -2] * (scans - 1) + data[-2:])

    return change


DAMAGES: dict[str, dict[str, Damage]] = {
    "photos": of_png() | of_other_formats(),
    "photo.png": {
        **{f"bits of byte {place} flipped": refuse(flip(place)) for place in (10, 20, 30, 40, -20)},
        "an unknown critical chunk": refuse(edit_bytes(add_chunks(chunk(b"ABCD", b"")))),
        "bytes that are no picture in its place": refuse(write(b"\0no image"), "decoded"),
        "text in its place": refuse(write(b"no image"), "text"),
        "an empty file": refuse(write(b""), "empty"),
        "cut off after 50%": refuse(cut(0.5), "decoded"),
    },
    "photo.jpg": {
        "a progressive JPEG of a few scans": accept(write_progressive(1)),
        "a progressive JPEG of 5,006 scans": refuse(write_progressive(5001), "5,006 scans"),
    },
}
