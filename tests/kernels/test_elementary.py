"""Elementary functions against NumPy's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from gsmerge.kernels.elementary import arctan2, exp, log, power

RNG = np.random.default_rng(0)
ENDS = np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, 1e300, -1e300, 5e-324, 1e-310])
SPREAD = np.concatenate([RNG.normal(size=5000), RNG.uniform(-800, 800, 5000), RNG.lognormal(0, 50, 5000), ENDS])
CASES = {
    "exp": (exp, np.exp, (SPREAD,)),
    "log": (log, np.log, (SPREAD,)),
    "log near 1": (log, np.log, (1 + RNG.normal(size=5000) * 1e-3,)),
    "arctan2": (arctan2, np.arctan2, (SPREAD, RNG.permutation(SPREAD))),
    "arctan2 of the axes": (arctan2, np.arctan2, (np.repeat(ENDS[2:9], 7), np.tile(ENDS[2:9], 7))),
    "power": (power, np.power, (np.abs(SPREAD), RNG.uniform(-3, 3, len(SPREAD)))),
}


@pytest.mark.parametrize("name", CASES)
def test_results_are_numpys(each_target, name: str) -> None:  # type: ignore[no-untyped-def]
    """Within two units of the last place; powers within as many as the exponent of e."""
    function, slow, arrays = CASES[name]
    with np.errstate(all="ignore"):
        (actual,), expected = each_target(lambda: (function(*arrays),)), slow(*arrays)
    np.testing.assert_allclose(actual, expected, rtol=2e-13 if name == "power" else 4.5e-16, atol=1e-307)


@pytest.mark.parametrize(
    "function", [exp, log, lambda values: arctan2(values, values), lambda values: power(values, 2)]
)
def test_shapes_and_types_are_kept(function: Callable[[np.ndarray], np.ndarray]) -> None:
    for dtype in (np.float32, np.float64):
        values = RNG.uniform(0.5, 2, (4, 3)).astype(dtype)
        for view in (values, values[:, ::2], values[:0]):
            assert (function(view).dtype, function(view).shape) == (dtype, view.shape)
    np.testing.assert_allclose(function(values[:, ::2]), function(values)[:, ::2], rtol=0)


def test_numbers_are_float64() -> None:
    assert exp(1.0) == pytest.approx(np.e, rel=1e-15)
    assert arctan2(1.0, 1.0) == pytest.approx(np.pi / 4, rel=1e-15)
    assert power(np.float32([2]), 0.5).dtype == np.float32


def test_powers() -> None:
    values = np.array([0.0, 0.25, 1.0, 4.0])
    np.testing.assert_allclose(power(values, 0.5), [0, 0.5, 1, 2], rtol=1e-15)
    np.testing.assert_array_equal(power(np.array([0.0, 3.0, np.nan]), 0), 1)
    assert np.isnan(power(np.array([-1.0]), 2)).all()
    np.testing.assert_allclose(power(values[1:], np.array([1.0, 2.0, 3.0])), [0.25, 1, 64], rtol=1e-15)
