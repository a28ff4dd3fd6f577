"""Compute the layers of the networks on tables of tokens in float32. Every row is computed by itself."""

from __future__ import annotations

import numpy as np

from gsmerge.method.kernels.signature import STATUS, f4, i8, native, u1

VECTOR_LANES = 16  # number of floats in a vector of the processor, to which weights are padded
PLAIN, GELU, TANH = range(3)  # activations of dense layers


@native(
    STATUS, x=f4("rows", "inputs"), weight=f4("blocks", "inputs", VECTOR_LANES), bias=f4("blocks", VECTOR_LANES),
    residual=f4("rows", "outputs", optional=True), activation=i8(least=0, most=2), out=f4("rows", "outputs", out=True),
)  # fmt: skip
def dense(x, weight, bias, residual, activation, out):
    """Write ``activation(x W + b + residual)``, with the weights W and the bias b from :func:`pack_weights`.

    ``activation`` is PLAIN, GELU or TANH. TANH gives 0 for NaN. Without a ``residual`` (None), nothing is added.
    """


@native(x=f4("rows", "width"), gains=f4("width"), shifts=f4("width"), out=f4("rows", "width", out=True))
def normalise(x, gains, shifts, out):
    """Normalise the rows of ``x`` to mean 0 and variance 1, multiply them by ``gains``, and add ``shifts``."""


@native(
    STATUS, query=f4("sets", "queries", "width"), pairs=f4("sets", "tokens", "columns"), mask=u1("sets", "tokens"),
    heads=i8(least=1), scratch=f4("space", out=True), out=f4("sets", "queries", "mixed", out=True),
)  # fmt: skip
def attend(query, pairs, mask, heads, scratch, out):
    """Run attention: write, for each query, a mean of the values of the tokens in its set.

    Tokens are weighted by the similarity of their keys to the query.

    Args:
        query: ``[sets,queries,width]`` queries, head by head.
        pairs: ``[sets,tokens,columns]`` keys of the width of the queries, then values. The values of each head are
            padded to :func:`padded` columns.
        mask: ``[sets,tokens]`` uint8, 0 for tokens to leave out.
        heads: Number of heads.
        scratch: Scratch for the keys of a set, see :func:`scratch_size`.
        out: ``[sets,queries,mixed]``, written: means of the values, of which each head is padded.
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
    padded_weight = np.zeros((padded(outputs), inputs), np.float32)
    padded_bias = np.zeros(padded(outputs), np.float32)
    padded_weight[:outputs] = weight
    padded_bias[:outputs] = bias
    blocks = padded_weight.reshape(-(-outputs // VECTOR_LANES), VECTOR_LANES, inputs).swapaxes(1, 2)
    return np.ascontiguousarray(blocks), padded_bias.reshape(-1, VECTOR_LANES)
