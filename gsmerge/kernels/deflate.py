"""Compress bytes to a deflate stream of literals and runs, for numbers in planes and for pictures of few colours.

Other repetitions are rare in these. It takes a quarter of the time of zlib, and the bytes do not depend on its version.
"""

from __future__ import annotations

import zlib

import numpy as np

from gsmerge.kernels.signature import COUNT, declare, u1

BLOCK = 1 << 16  # bytes with a code of their own, as in deflate.c
HEAD = 256  # more than the bytes of the head of a block
EMPTY = zlib.compress(b"", wbits=-15)  # a stream without bytes

_deflate_runs = declare("deflate_runs", COUNT, data=u1("n"), out=u1("room", out=True))


def deflate_runs(data: bytes) -> bytes:
    """Compress to a deflate stream (RFC 1951), which ``zlib.decompress(stream, wbits=-15)`` restores."""
    if not data:
        return EMPTY
    out = np.empty(2 * len(data) + HEAD * (len(data) // BLOCK + 1), np.uint8)
    size = _deflate_runs(np.frombuffer(data, np.uint8), out)
    return out[:size].tobytes()
