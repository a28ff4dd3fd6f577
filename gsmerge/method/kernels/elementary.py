"""Compute elementary functions of arrays with the same bits on every processor, which NumPy's functions do not ensure.

Results are exact up to two units of the last place. The functions take the same arguments as NumPy's functions, and
return float32 for float32 arrays and float64 for all others.
"""

from __future__ import annotations

import inspect
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from gsmerge.method.kernels.signature import declare, f4, f8


class Unary(Protocol):
    """A function of one array."""

    def __call__(self, values: ArrayLike, /) -> Any:
        """Return a new array of the same shape."""


class Binary(Protocol):
    """A function of two arrays, which are broadcast together."""

    def __call__(self, first: ArrayLike, second: ArrayLike, /) -> Any:
        """Return a new array of the common shape."""


def _make_function(name: str, doc: str, arguments: tuple[str, ...] = ("values",), narrow: bool = False) -> Any:
    """Return a function of arrays called ``name``, with the docstring ``doc``.

    The returned function flattens its arguments, and calls a function of the library: NAME_each for float64 results or,
    if ``narrow`` is true, NAME_floats for float32 results.
    """
    of_doubles = declare(f"{name}_each", **{key: f8("n") for key in arguments}, out=f8("n", out=True))
    of_floats = None
    if narrow:
        of_floats = declare(f"{name}_floats", **{key: f4("n") for key in arguments}, out=f4("n", out=True))

    def function(*arrays: ArrayLike) -> Any:
        """Broadcast the arrays, convert them to one type, and call the function of the library."""
        if all(isinstance(a, float) for a in arrays):  # for single numbers this takes half of the time
            single = np.empty(1)
            of_doubles(*(np.array([a]) for a in arrays), single)
            return single[0]
        dtypes = [a.dtype for a in arrays if isinstance(a, (np.ndarray, np.generic))]
        out_dtype = np.result_type(*dtypes, np.float32) if dtypes else np.dtype(np.float64)
        compute = of_doubles
        dtype = np.dtype(np.float64)
        if of_floats is not None and out_dtype == np.float32:
            compute = of_floats
            dtype = out_dtype
        typed = [np.asarray(a, dtype) for a in arrays]
        shape = np.broadcast_shapes(*(a.shape for a in typed))
        flat = [np.ascontiguousarray(a if a.shape == shape else np.broadcast_to(a, shape)).reshape(-1) for a in typed]
        out = np.empty(shape, dtype)
        compute(*flat, out.reshape(-1))
        return out.astype(out_dtype, copy=False)[()]  # [()] makes a scalar of an array without axes

    parameters = [inspect.Parameter(key, inspect.Parameter.POSITIONAL_ONLY) for key in arguments]
    function.__name__ = name
    function.__qualname__ = name
    function.__doc__ = doc
    function.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return function


exp: Unary = _make_function("exp", "Compute e to the power of an array.", narrow=True)
expm1: Unary = _make_function("expm1", "Compute e to the power of an array, less 1, without cancellation near 0.")
log: Unary = _make_function("log", "Compute the natural logarithm of an array, -inf at 0 and NaN below.", narrow=True)
log10: Unary = _make_function("log10", "Compute the decimal logarithm of an array, -inf at 0 and NaN below.")
log1p: Unary = _make_function("log1p", "Compute the natural logarithm of 1 plus an array, -inf at -1 and NaN below.")
sin: Unary = _make_function("sin", "Compute the sine of an array of radians between about -1e5 and 1e5.")
cos: Unary = _make_function("cos", "Compute the cosine of an array of radians between about -1e5 and 1e5.")
arccos: Unary = _make_function("arccos", "Compute the angles, radians from 0 to pi, of cosines, NaN outside -1 to 1.")
arctan2: Binary = _make_function(
    "arctan2",
    "Compute the angles of points ``(x, y)``, from -pi to pi, and 0 for the origin with zeros of any sign.",
    ("y", "x"),
)
power: Binary = _make_function(
    "power",
    "Raise an array of numbers of at least 0 to powers, an array or one number. The result is NaN for numbers below 0.",
    ("bases", "exponents"),
)
