"""Compute the layers of the networks on tables of tokens in float32; every row is computed by itself."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import STATUS, f4, i8, native, u1

VECTOR_LANES = 16  # floats of a vector; weights are padded to whole vectors
PLAIN, GELU, TANH = range(3)  # activations of dense layers


@native(
    STATUS, x=f4("rows", "inputs"), weight=f4("blocks", "inputs", VECTOR_LANES), bias=f4("blocks", VECTOR_LANES),
    residual=f4("rows", "outputs", optional=True), activation=i8(least=0, most=2), out=f4("rows", "outputs", out=True),
)  # fmt: skip
def dense(x, weight, bias, residual, activation, out):
    """Write ``activation(x W + b + residual)`` with weights and bias from :func:`pack_weights`.

    ``activation`` is PLAIN, GELU, or TANH, which is 0 for NaN. A ``residual`` of None is zero.
    """


@native(x=f4("rows", "width"), gains=f4("width"), shifts=f4("width"), out=f4("rows", "width", out=True))
def normalise(x, gains, shifts, out):
    """Write the rows of ``x`` with mean 0 and variance 1, times ``gains``, plus ``shifts``."""


@native(
    STATUS, query=f4("sets", "queries", "width"), pairs=f4("sets", "tokens", "columns"), mask=u1("sets", "tokens"),
    heads=i8(least=1), scratch=f4("space", out=True), out=f4("sets", "queries", "mixed", out=True),
)  # fmt: skip
def attend(query, pairs, mask, heads, scratch, out):
    """Write for each query the values of its set's tokens, weighted by the similarity of their keys to the query.

    Args:
        query: ``[sets,queries,width]``, head by head.
        pairs: ``[sets,tokens,columns]``: the keys, as wide as the queries, then the values, each head padded to
            :func:`padded` columns.
        mask: ``[sets,tokens]`` uint8, 0 for tokens that do not count.
        heads: Number of heads.
        scratch: Work space for the keys of a set, see :func:`scratch_size`.
        out: ``[sets,queries,mixed]``, written: the mixed values, each head padded.
    """


def padded(count: int) -> int:
    """Return a number of columns rounded up to whole vectors."""
    return -(-count // VECTOR_LANES) * VECTOR_LANES


def scratch_size(tokens: int, width: int) -> int:
    """Return the number of floats of scratch that :func:`attend` needs for ``tokens`` per set and keys of ``width``."""
    return (width + 2) * padded(tokens)


def pack_weights(weight: np.ndarray, bias: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Arrange weights ``[outputs,inputs]`` and bias ``[outputs]`` in blocks of sixteen outputs, padded with zeros."""
    outputs, inputs = weight.shape
    full, shift = np.zeros((padded(outputs), inputs), np.float32), np.zeros(padded(outputs), np.float32)
    full[:outputs], shift[:outputs] = weight, bias
    blocks = full.reshape(-(-outputs // VECTOR_LANES), VECTOR_LANES, inputs).swapaxes(1, 2)
    return np.ascontiguousarray(blocks), shift.reshape(-1, VECTOR_LANES)
