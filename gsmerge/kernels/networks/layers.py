"""Compute the layers of the networks on tables of tokens in float32, every row by itself."""

from __future__ import annotations

import numpy as np

from gsmerge.kernels.signature import STATUS, f4, i8, native, u1

VECTOR_LANES = 16  # number of floats in a vector of the processor; weights are padded to whole vectors
PLAIN, GELU, TANH = range(3)  # activations of dense layers


@native(
    STATUS, x=f4("rows", "inputs"), weight=f4("blocks", "inputs", VECTOR_LANES), bias=f4("blocks", VECTOR_LANES),
    residual=f4("rows", "outputs", optional=True), activation=i8(least=0, most=2), out=f4("rows", "outputs", out=True),
)  # fmt: skip
def dense(x, weight, bias, residual, activation, out):
    """Write ``activation(x W + b + residual)``, with the weights W and the bias b from :func:`pack_weights`.

    ``activation`` is PLAIN, GELU or TANH. TANH gives 0 for NaN. A ``residual`` of None stands for zeros.
    """


@native(x=f4("rows", "width"), gains=f4("width"), shifts=f4("width"), out=f4("rows", "width", out=True))
def normalise(x, gains, shifts, out):
    """Normalise the rows of ``x`` to mean 0 and variance 1, and write them times ``gains`` plus ``shifts``."""


@native(
    STATUS, query=f4("sets", "queries", "width"), pairs=f4("sets", "tokens", "columns"), mask=u1("sets", "tokens"),
    heads=i8(least=1), scratch=f4("space", out=True), out=f4("sets", "queries", "mixed", out=True),
)  # fmt: skip
def attend(query, pairs, mask, heads, scratch, out):
    """Write for each query the mean of the values of its set's tokens, weighted by their keys' similarity to the query.

    Args:
        query: ``[sets,queries,width]`` queries, head by head.
        pairs: ``[sets,tokens,columns]`` keys, as wide as the queries, then values, in which each head is padded to
            :func:`padded` columns.
        mask: ``[sets,tokens]`` uint8, 0 for tokens that do not count.
        heads: Number of heads.
        scratch: Room for the keys of a set, see :func:`scratch_size`.
        out: ``[sets,queries,mixed]``, written: the means of the values, in which each head is padded.
    """


def padded(count: int) -> int:
    """Return a number of columns rounded up to whole vectors."""
    return -(-count // VECTOR_LANES) * VECTOR_LANES


def scratch_size(tokens: int, width: int) -> int:
    """Return how many floats of scratch :func:`attend` needs for sets of ``tokens`` and keys of ``width`` columns."""
    return (width + 2) * padded(tokens)


def pack_weights(weight: np.ndarray, bias: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return weights ``[outputs,inputs]`` and a bias ``[outputs]`` in blocks of sixteen outputs, padded with zeros."""
    outputs, inputs = weight.shape
    full, shift = np.zeros((padded(outputs), inputs), np.float32), np.zeros(padded(outputs), np.float32)
    full[:outputs], shift[:outputs] = weight, bias
    blocks = full.reshape(-(-outputs // VECTOR_LANES), VECTOR_LANES, inputs).swapaxes(1, 2)
    return np.ascontiguousarray(blocks), shift.reshape(-1, VECTOR_LANES)
