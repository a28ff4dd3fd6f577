"""Elementary functions match NumPy's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from gsmerge.method.kernels.elementary import arccos, arctan2, cos, exp, expm1, log, log1p, log10, power, sin

RNG = np.random.default_rng(0)
ENDS = np.array([0.0, -0.0, 1.0, -1.0, np.inf, -np.inf, np.nan, -np.nan, 1e300, -1e300, 5e-324, 1e-310, -1e-17])
SPREAD = np.concatenate([RNG.normal(size=5000), RNG.uniform(-800, 800, 5000), RNG.lognormal(0, 50, 5000), ENDS])
CASES = {
    "exp": (exp, np.exp, (SPREAD,)),
    "log": (log, np.log, (SPREAD,)),
    "log near 1": (log, np.log, (1 + RNG.normal(size=5000) * 1e-3,)),
    "expm1": (expm1, np.expm1, (SPREAD,)),
    "expm1 near 0": (expm1, np.expm1, (RNG.normal(size=5000),)),
    "log10": (log10, np.log10, (SPREAD,)),
    "log1p": (log1p, np.log1p, (SPREAD,)),
    "log1p near 0": (log1p, np.log1p, (RNG.normal(size=5000) * 1e-3,)),
    "sin": (sin, np.sin, (SPREAD[np.abs(SPREAD) < 1e5],)),
    "cos": (cos, np.cos, (SPREAD[np.abs(SPREAD) < 1e5],)),
    "arccos": (arccos, np.arccos, (np.clip(RNG.normal(size=5000), -1, 1),)),
    "arctan2": (arctan2, np.arctan2, (SPREAD, RNG.permutation(SPREAD))),
    "arctan2 of the axes": (arctan2, np.arctan2, (np.repeat(ENDS[2:9], 7), np.tile(ENDS[2:9], 7))),
    "power": (power, np.power, (np.abs(SPREAD), RNG.uniform(-3, 3, len(SPREAD)))),
}


@pytest.mark.parametrize("name", CASES)
def test_functions_match_numpy_s(each_target, name: str) -> None:  # type: ignore[no-untyped-def]
    """Within two units of the last place; powers within as many as the exponent of e."""
    function, slow, arrays = CASES[name]
    with np.errstate(all="ignore"):
        (actual,), expected = each_target(lambda: (function(*arrays),)), slow(*arrays)
    np.testing.assert_allclose(actual, expected, rtol=2e-13 if name == "power" else 4.5e-16, atol=1e-307)


@pytest.mark.parametrize("name", ["exp", "expm1", "log", "log10", "log1p"])
def test_float32_is_within_two_units_of_the_last_place(each_target, name: str) -> None:  # type: ignore[no-untyped-def]
    function, slow, arrays = CASES[name]
    with np.errstate(all="ignore"):
        values = arrays[0].astype(np.float32)
        (actual,), expected = each_target(lambda: (function(values),)), slow(values.astype(np.float64))
        expected = expected.astype(np.float32)
    assert actual.dtype == np.float32
    both = np.isfinite(actual) & np.isfinite(expected)
    np.testing.assert_array_equal(actual[~both], expected[~both])
    actual, expected = actual[both], expected[both]
    assert (np.abs(actual - expected) <= 2 * np.spacing(np.abs(expected))).all()


@pytest.mark.parametrize(
    "function",
    [
        exp,
        log,
        expm1,
        log1p,
        log10,
        sin,
        cos,
        arccos,
        lambda values: arctan2(values, values),
        lambda values: power(values, 2),
    ],
)
def test_functions_keep_shapes_and_types_of_arrays(function: Callable[[np.ndarray], np.ndarray]) -> None:
    for dtype in (np.float32, np.float64):
        values = RNG.uniform(0.5, 1, (4, 3)).astype(dtype)
        for view in (values, values[:, ::2], values[:0]):
            assert (function(view).dtype, function(view).shape) == (dtype, view.shape)
    np.testing.assert_allclose(function(values[:, ::2]), function(values)[:, ::2], rtol=0)


def test_functions_of_numbers_give_float64() -> None:
    assert type(log10(2)) is np.float64
    assert exp(1.0) == pytest.approx(np.e, rel=1e-15)
    assert arctan2(1.0, 1.0) == pytest.approx(np.pi / 4, rel=1e-15)
    assert power(np.float32([2]), 0.5).dtype == np.float32


def test_powers_have_known_values() -> None:
    values = np.array([0.0, 0.25, 1.0, 4.0])
    np.testing.assert_allclose(power(values, 0.5), [0, 0.5, 1, 2], rtol=1e-15)
    np.testing.assert_array_equal(power(np.array([0.0, 3.0, np.nan]), 0), 1)
    assert np.isnan(power(np.array([-1.0]), 2)).all()
    np.testing.assert_allclose(power(values[1:], np.array([1.0, 2.0, 3.0])), [0.25, 1, 64], rtol=1e-15)
