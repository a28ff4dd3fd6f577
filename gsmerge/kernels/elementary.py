"""Elementary functions of arrays whose bits are the same on every processor: NumPy's are not, for these.

They are within two units of the last place, take what NumPy's take, and return float32 for float32 arrays, otherwise
float64.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gsmerge.kernels.signature import f4, f8, native

Array = np.ndarray[Any, Any]


@native(values=f8("n"), out=f8("n", out=True))
def _exp_each(values, out):
    """Do what :func:`exp` does."""


@native(values=f4("n"), out=f4("n", out=True))
def _exp_floats(values, out):
    """Do what :func:`exp` does."""


@native(values=f8("n"), out=f8("n", out=True))
def _expm1_each(values, out):
    """Do what :func:`expm1` does."""


@native(values=f8("n"), out=f8("n", out=True))
def _log_each(values, out):
    """Do what :func:`log` does."""


@native(values=f4("n"), out=f4("n", out=True))
def _log_floats(values, out):
    """Do what :func:`log` does."""


@native(values=f8("n"), out=f8("n", out=True))
def _log10_each(values, out):
    """Do what :func:`log10` does."""


@native(values=f8("n"), out=f8("n", out=True))
def _log1p_each(values, out):
    """Do what :func:`log1p` does."""


@native(values=f8("n"), out=f8("n", out=True))
def _sin_each(values, out):
    """Do what :func:`sin` does."""


@native(values=f8("n"), out=f8("n", out=True))
def _cos_each(values, out):
    """Do what :func:`cos` does."""


@native(values=f8("n"), out=f8("n", out=True))
def _arccos_each(values, out):
    """Do what :func:`arccos` does."""


@native(y=f8("n"), x=f8("n"), out=f8("n", out=True))
def _arctan2_each(y, x, out):
    """Do what :func:`arctan2` does."""


@native(bases=f8("n"), exponents=f8("n"), out=f8("n", out=True))
def _power_each(bases, exponents, out):
    """Do what :func:`power` does."""


def _apply(function: Callable[..., None], *arrays: ArrayLike, narrow: Callable[..., None] | None = None) -> Any:
    """Call a function of flat float64 arrays; the result is float32 where all arrays are, numbers aside.

    ``narrow``: the same function of float32, for arrays of that type.
    """
    kinds = [a.dtype for a in arrays if isinstance(a, (np.ndarray, np.generic))]
    kind = np.result_type(*kinds, np.float32) if kinds else np.dtype(np.float64)
    inner = np.dtype(np.float64)
    if narrow is not None and kind == np.float32:
        function, inner = narrow, kind
    typed = [np.asarray(a, inner) for a in arrays]
    shape = np.broadcast_shapes(*(a.shape for a in typed))
    flat = [np.ascontiguousarray(a if a.shape == shape else np.broadcast_to(a, shape)).reshape(-1) for a in typed]
    out = np.empty(shape, inner)
    function(*flat, out.reshape(-1))
    return out.astype(kind, copy=False)[()]


def exp(values: ArrayLike) -> Any:
    """Compute e to the power of an array."""
    return _apply(_exp_each, values, narrow=_exp_floats)


def expm1(values: ArrayLike) -> Any:
    """Compute e to the power of an array, less 1, without cancellation near 0."""
    return _apply(_expm1_each, values)


def log(values: ArrayLike) -> Any:
    """Compute the natural logarithm of an array; -inf at 0, NaN below."""
    return _apply(_log_each, values, narrow=_log_floats)


def log10(values: ArrayLike) -> Any:
    """Compute the decimal logarithm of an array; -inf at 0, NaN below."""
    return _apply(_log10_each, values)


def log1p(values: ArrayLike) -> Any:
    """Compute the natural logarithm of 1 plus an array; -inf at -1, NaN below."""
    return _apply(_log1p_each, values)


def sin(values: ArrayLike) -> Any:
    """Compute the sine of an array of radians, up to some 1e5."""
    return _apply(_sin_each, values)


def cos(values: ArrayLike) -> Any:
    """Compute the cosine of an array of radians, up to some 1e5."""
    return _apply(_cos_each, values)


def arccos(values: ArrayLike) -> Any:
    """Compute the angles, radians from 0 to pi, of cosines; NaN outside -1 to 1."""
    return _apply(_arccos_each, values)


def arctan2(y: ArrayLike, x: ArrayLike) -> Any:
    """Compute the angle of points ``(x, y)``, -pi to pi; 0 for the origin, whatever its zeros' signs."""
    return _apply(_arctan2_each, y, x)


def power(bases: ArrayLike, exponents: ArrayLike) -> Any:
    """Raise an array of numbers from 0 on to powers, an array or one number; NaN below 0."""
    return _apply(_power_each, bases, exponents)
