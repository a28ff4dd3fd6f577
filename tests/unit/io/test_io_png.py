"""Damaged PNG files are refused, or read, without a line from the decoder."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsmerge.errors import SceneError
from gsmerge.io import read_images

PICTURE = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
DATA = cv2.imencode(".png", PICTURE[..., ::-1])[1].tobytes()


def chunk(kind: bytes, content: bytes, crc: int | None = None) -> bytes:
    own = zlib.crc32(kind + content) if crc is None else crc
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", own)


def beside(more: bytes) -> bytes:
    """A chunk between the header and the picture."""
    return DATA[:33] + more + DATA[33:]


def read(path: Path, data: bytes) -> np.ndarray:
    path.write_bytes(data)
    return (read_images([path], ["a"])[0] * 255).round().astype(np.uint8)


@pytest.mark.parametrize(
    "data",
    [
        DATA,
        DATA + b"junk",
        DATA[:-1] + b"x",
        beside(chunk(b"iCCP", b"ICC\0\0" + zlib.compress(b"no profile"))),
        beside(chunk(b"tEXt", b"a\0b", crc=0)),
        beside(chunk(b"gAMA", struct.pack(">I", 220_000))),
        beside(chunk(b"eXIf", b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0")),
    ],
    ids=["sound", "more behind", "end", "profile", "text", "gamma", "orientation"],
)
def test_what_is_beside_the_picture_does_not_matter(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], data: bytes
) -> None:
    assert np.array_equal(read(tmp_path / "a.png", data), PICTURE)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("share", [0.05, 0.3, 0.9, 0.999])
def test_cut_files_are_refused_silently(tmp_path: Path, capfd: pytest.CaptureFixture[str], share: float) -> None:
    with pytest.raises(SceneError, match="cannot be decoded"):
        read(tmp_path / "a.png", DATA[: int(share * len(DATA))])
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("place", [10, 20, 30, 40, 500, 1500])
def test_changed_bytes_are_refused_silently(tmp_path: Path, capfd: pytest.CaptureFixture[str], place: int) -> None:
    data = bytearray(DATA)
    data[place] ^= 0x55
    with pytest.raises(SceneError):
        read(tmp_path / "a.png", bytes(data))
    assert capfd.readouterr().err == ""


def test_an_unknown_critical_chunk_is_refused_silently(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SceneError, match="cannot be decoded"):
        read(tmp_path / "a.png", beside(chunk(b"ABCD", b"")))
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("kind", ["grey", "16 bit", "alpha", "palette"])
def test_kinds_of_png_are_decoded_as_ever(tmp_path: Path, kind: str) -> None:
    rng, path = np.random.default_rng(1), tmp_path / "a.png"
    pictures = {
        "grey": PICTURE[..., 0],
        "16 bit": rng.integers(0, 65535, (20, 30, 3), np.uint16),
        "alpha": rng.integers(0, 255, (20, 30, 4), np.uint8),
    }
    if kind == "palette":
        head = struct.pack(">IIBBBBB", 4, 1, 8, 3, 0, 0, 0)
        parts = (
            (b"IHDR", head),
            (b"PLTE", bytes(range(12))),
            (b"tRNS", b"\0\xff"),
            (b"IDAT", zlib.compress(b"\0\0\1\2\3")),
        )
        data = DATA[:8] + b"".join(chunk(*part) for part in (*parts, (b"IEND", b"")))
    else:
        data = cv2.imencode(".png", pictures[kind])[1].tobytes()
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(read(path, data), expected[..., ::-1])
