"""Deflate streams of runs: zlib restores what was compressed, whatever it was."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsmerge.kernels.deflate import BLOCK, deflate_runs

RNG = np.random.default_rng(0)


def restore(stream: bytes) -> bytes:
    unpacker = zlib.decompressobj(wbits=-15)
    data = unpacker.decompress(stream)
    assert unpacker.eof
    assert unpacker.unused_data == b""
    return data


@given(st.binary(max_size=40), st.lists(st.tuples(st.integers(0, 3), st.integers(1, 700)), max_size=8))
def test_streams_are_restored(noise: bytes, runs: list[tuple[int, int]]) -> None:
    data = noise + b"".join(bytes([value]) * length for value, length in runs) + noise
    assert restore(deflate_runs(data)) == data


@pytest.mark.parametrize("size", [0, 1, 2, 3, 4, 257, 258, 259, 260, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK])
def test_one_run_of_any_length_is_restored(size: int) -> None:
    for data in (bytes(size), b"x" * size + b"y"):
        stream = deflate_runs(data)
        assert restore(stream) == data
        assert len(stream) < 500 + size / 200


@pytest.mark.parametrize("values", [1, 2, 3, 256])
def test_random_bytes_are_restored_and_hardly_grow(values: int) -> None:
    data = RNG.integers(0, values, 2 * BLOCK + 77).astype(np.uint8).tobytes()
    stream = deflate_runs(data)
    assert restore(stream) == data
    assert len(stream) < len(data) * (np.log2(values) + 0.5) / 8 + 1000


def test_codes_have_at_most_fifteen_bits() -> None:
    """Frequencies of Fibonacci's numbers have a Huffman code as long as their count, which is too long."""
    uses = [1, 1]
    while sum(uses) + uses[-1] < BLOCK:
        uses.append(uses[-1] + uses[-2])
    assert len(uses) > 20
    data = RNG.permutation(np.repeat(np.arange(len(uses), dtype=np.uint8), uses)).tobytes()
    stream = deflate_runs(data)
    assert restore(stream) == data
    assert len(stream) < 1.05 * len(zlib.compress(data, 1, wbits=-15))


def test_planes_of_numbers_take_as_much_as_those_of_zlib() -> None:
    steps = np.abs(RNG.normal(0, 30, 300_000)).astype("<u4").view(np.uint8).reshape(-1, 4).T.tobytes()
    packer = zlib.compressobj(1, wbits=-15, strategy=zlib.Z_RLE)
    assert len(deflate_runs(steps)) < 1.02 * len(packer.compress(steps) + packer.flush())
