"""Sixteen triples at once: what the registers do, in one line of numpy each; and rows at the end of an array."""

from __future__ import annotations

import numpy as np
import pytest

from gsmerge.kernels.jit import kernel
from gsmerge.kernels.raster.harmonics_backward import view_colors_backward
from gsmerge.kernels.raster.triples import spread_triples, turn, weigh_triples


@kernel
def run(rows, at, color, out, to):
    weigh_triples(rows, at, color[0], color[1], color[2], out, to)
    spread_triples(rows, at, color[0], color[1], color[2], out, to + 16)
    turn(rows, at, 17, out, to + 64, 18)


def test_triples_and_squares() -> None:
    generator = np.random.default_rng(0)
    rows, color = generator.normal(size=300).astype(np.float32), np.float32([0.5, -2.0, 3.0])
    at, to = 5, 3
    out = np.zeros(400, np.float32)
    run(rows, at, color, out, to)
    np.testing.assert_allclose(out[to : to + 16], rows[at : at + 48].reshape(16, 3) @ color, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(out[to + 16 : to + 64].reshape(16, 3), np.outer(rows[at : at + 16], color))
    square = np.stack([rows[at + 17 * i : at + 17 * i + 16] for i in range(16)])
    turned = np.stack([out[to + 64 + 18 * q : to + 64 + 18 * q + 16] for q in range(16)])
    np.testing.assert_array_equal(turned, square.T)


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("n", [1, 2, 7, 130])
def test_nothing_is_read_or_written_beyond_the_ends(n: int, degree: int) -> None:
    """Inside larger arrays full of NaN, a part of the Gaussians at a time: the same bits, and the NaNs stay."""
    generator, num = np.random.default_rng(n), (degree + 1) ** 2 - 1

    def normal(*shape: int) -> np.ndarray:
        return generator.normal(size=shape).astype(np.float32)

    means, shN, ids, eye = normal(n, 3), normal(n, num, 3), np.arange(n, dtype=np.int32), normal(3)
    colors, grad_colors = np.abs(normal(n, 3)), normal(n, 3)
    around = np.full((n + 40, num, 3), np.nan, np.float32)
    around[20 : 20 + n] = shN
    answers = []
    for source, cuts in ((shN, [0, n]), (around[20 : 20 + n], [0, n // 3, n])):
        space = np.full((n + 40, num, 3), np.nan, np.float32)
        sh0, rest, moved = np.empty((n, 1, 3), np.float32), space[20 : 20 + n], np.empty((n, 3), np.float32)
        for i, first in enumerate(cuts[:-1]):
            view_colors_backward(
                means, source, ids, eye, first, cuts[i + 1], colors, grad_colors, sh0, rest, moved
            )  # fmt: skip
        assert np.isnan(space[:20]).all()
        assert np.isnan(space[20 + n :]).all()
        assert np.isfinite(rest).all()
        assert np.isfinite(moved).all()
        answers.append((sh0, rest.copy(), moved))
    for one, other in zip(*answers, strict=True):
        np.testing.assert_array_equal(one, other)
