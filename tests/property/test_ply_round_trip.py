"""Gaussians are the same after they were written to a ``.ply`` and read."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gsmerge.io import read_ply, write_ply
from gsmerge.method.kernels import elementary
from gsmerge.types import Gaussians


def floats(low: float, high: float) -> st.SearchStrategy[float]:
    # subnormal numbers are excluded: some processors flush them to zero
    return st.floats(low, high, width=32, allow_subnormal=False)


@st.composite
def gaussians(draw: st.DrawFn) -> Gaussians:
    n, degree = draw(st.integers(1, 12)), draw(st.integers(0, 4))

    def array(shape: tuple[int, ...], elements: st.SearchStrategy[float]) -> np.ndarray:
        return draw(hnp.arrays(np.float32, shape, elements=elements))

    means = array((n, 3), floats(-(2.0**30), 2.0**30))
    means[~means.any(1)] = 1  # empty or equal rows at the origin are taken for placeholders, which are no Gaussians
    return Gaussians(
        means=means,
        quats=array((n, 4), floats(-(2.0**10), 2.0**10)),
        scales=elementary.exp(array((n, 3), floats(-29, 29))),
        opacities=array((n,), st.one_of(floats(0, 1), st.sampled_from([0.0, 1.0]))),
        sh0=array((n, 1, 3), floats(-(2.0**10), 2.0**10)),
        shN=array((n, (degree + 1) ** 2 - 1, 3), floats(-(2.0**10), 2.0**10)),
    )


def round_trip(before: Gaussians) -> Gaussians:
    with tempfile.TemporaryDirectory() as folder:
        write_ply(Path(folder) / "a.ply", before)
        actual = read_ply(Path(folder) / "a.ply")
    assert actual.valid.all()
    assert actual.info.opacity_encoding == "logit"
    return actual.gaussians


@given(gaussians())
@settings(max_examples=15, deadline=None)
def test_written_gaussians_are_read_back(before: Gaussians) -> None:
    after = round_trip(before)
    for name in ("means", "sh0", "shN"):
        assert np.array_equal(getattr(after, name), getattr(before, name)), name
    assert np.allclose(after.scales, before.scales, rtol=5e-6, atol=0)  # a float32 logarithm up to 29
    assert np.allclose(after.opacities, before.opacities, rtol=0, atol=5e-7)
    length = np.linalg.norm(before.quats.astype(np.float64), axis=1, keepdims=True)
    unit = np.where(length > 0, before.quats / np.maximum(length, 1e-300), (1.0, 0, 0, 0))
    assert np.allclose(after.quats, unit, rtol=0, atol=1e-6)
