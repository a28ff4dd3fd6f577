"""Elementary functions of arrays whose bits are the same on every processor: NumPy's are not, for these."""

from __future__ import annotations

import numpy as np

from gsmerge.native.signature import f8, native


@native(values=f8("n"), out=f8("n", out=True))
def _exp_each(values, out):
    """Do what :func:`exp` does."""


@native(values=f8("n"), out=f8("n", out=True))
def _log_each(values, out):
    """Do what :func:`log` does."""


@native(y=f8("n"), x=f8("n"), out=f8("n", out=True))
def _arctan2_each(y, x, out):
    """Do what :func:`arctan2` does."""


@native(bases=f8("n"), exponents=f8("n"), out=f8("n", out=True))
def _power_each(bases, exponents, out):
    """Do what :func:`power` does."""


def _apply(function, *arrays):
    """Call a function of flat float64 arrays; the result is float32 where all arrays are, numbers aside."""
    kinds = [a.dtype for a in arrays if isinstance(a, np.ndarray)]
    kind = np.result_type(*kinds, np.float32) if kinds else np.float64
    wide = [np.asarray(a, np.float64) for a in arrays]
    out = np.empty(np.broadcast_shapes(*(a.shape for a in wide)))
    function(*(np.ascontiguousarray(np.broadcast_to(a, out.shape)).reshape(-1) for a in wide), out.reshape(-1))
    return out.astype(kind, copy=False)


def exp(values):
    """Compute e to the power of an array, float64 or float32."""
    return _apply(_exp_each, values)


def log(values):
    """Compute the natural logarithm of an array; -inf at 0, NaN below."""
    return _apply(_log_each, values)


def arctan2(y, x):
    """Compute the angle of points ``(x, y)``, -pi to pi; 0 for the origin, whatever its zeros' signs."""
    return _apply(_arctan2_each, y, x)


def power(bases, exponents):
    """Raise an array of numbers from 0 on to powers, an array or one number; NaN below 0."""
    return _apply(_power_each, bases, exponents)
