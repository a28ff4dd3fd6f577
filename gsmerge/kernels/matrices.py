"""Linear algebra of small float64 matrices whose bits are the same on every processor: those of BLAS are not.

Arguments are arrays of any number type, with any leading axes; results are float64.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from gsmerge.native.signature import STATUS, f8, i4, native

Array = np.ndarray


@native(STATUS, a=f8("n", "i", "j"), b=f8("m", "j", "k"), out=f8("n", "i", "k", out=True))
def _multiply_matrices(a, b, out):
    """Write the products of matrices; ``b`` may be one for all."""


@native(i4(), a=f8("n", "d", "d", out=True), b=f8("n", "d", "k", out=True))
def _solve_equations(a, b):
    """Replace ``b`` by the solutions, overwriting ``a``, and return 0; 1 where a matrix is singular."""


@native(a=f8("n", "d", "d", out=True), v=f8("n", "d", "d", out=True))
def _diagonalise(a, v):
    """Replace symmetric matrices by their eigenvalues on the diagonal; write their eigenvectors to the columns."""


def matmul(a: ArrayLike, b: ArrayLike) -> Array:
    """Multiply matrices ``[...,i,j]`` and ``[...,j,k]``, or vectors ``[j]``, as ``a @ b`` does, in float64."""
    left, right = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if left.ndim == 1:
        return matmul(left[None], right)[..., 0, :]
    if right.ndim == 1:
        return matmul(left, right[:, None])[..., 0]
    if right.ndim == 2:  # one for all: all rows of the left are those of one matrix
        lead = left.shape[:-2]
        first, second = left.reshape(1, math.prod(left.shape[:-1]), left.shape[-1]), right[None]
    else:
        lead = np.broadcast_shapes(left.shape[:-2], right.shape[:-2])
        first, second = (
            np.broadcast_to(one, lead + one.shape[-2:]).reshape(math.prod(lead), *one.shape[-2:])
            for one in (left, right)
        )
    out = np.empty((*first.shape[:2], second.shape[2]))
    _multiply_matrices(np.ascontiguousarray(first), np.ascontiguousarray(second), out)
    return out.reshape(*lead, left.shape[-2], right.shape[-1])


def solve(a: ArrayLike, b: ArrayLike) -> Array:
    """Solve ``a x = b`` for matrices ``[...,d,d]`` and right sides ``[...,d,k]``, or one ``[d]``.

    Raises numpy.linalg.LinAlgError where a matrix is singular.
    """
    left, right = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if right.ndim == 1:
        return solve(left, right[:, None])[..., 0]
    lead, size = np.broadcast_shapes(left.shape[:-2], right.shape[:-2]), left.shape[-1]
    work = np.broadcast_to(left, (*lead, size, size)).reshape(-1, size, size).copy()
    solution = np.broadcast_to(right, (*lead, *right.shape[-2:])).reshape(-1, *right.shape[-2:]).copy()
    if _solve_equations(work, solution):
        raise np.linalg.LinAlgError("Singular matrix")
    return solution.reshape(*lead, *right.shape[-2:])


def invert(matrices: ArrayLike) -> Array:
    """Invert matrices ``[...,d,d]``; numpy.linalg.LinAlgError where one is singular."""
    matrices = np.asarray(matrices, np.float64)
    return solve(matrices, np.broadcast_to(np.eye(matrices.shape[-1]), matrices.shape))


def eigh(matrices: ArrayLike) -> tuple[Array, Array]:
    """Return eigenvalues ``[...,d]``, ascending, and in columns eigenvectors ``[...,d,d]`` of symmetric matrices."""
    matrices = np.asarray(matrices, np.float64)
    size = matrices.shape[-1]
    work = matrices.reshape(-1, size, size).copy()
    vectors = np.empty_like(work)
    _diagonalise(work, vectors)
    values = np.diagonal(work, axis1=1, axis2=2)
    order = np.argsort(values, axis=1, kind="stable")
    values = np.take_along_axis(values, order, 1)
    vectors = np.take_along_axis(vectors, order[:, None], 2)
    return values.reshape(matrices.shape[:-1]), vectors.reshape(matrices.shape)


def solve_symmetric(a: ArrayLike, b: ArrayLike, rcond: float = 1e-12) -> Array:
    """Solve ``a x = b`` for a matrix ``[d,d]`` of normal equations and ``b [d]`` or ``[d,k]``, by the shortest x.

    Eigenvalues of at most ``rcond`` times the largest count as zero.
    """
    values, vectors = eigh(a)
    used = values > rcond * values.max(initial=0)
    parts = matmul(vectors.T, b)
    scaled = np.where(used, 1 / np.where(used, values, 1), 0)
    return matmul(vectors, parts * (scaled if parts.ndim == 1 else scaled[:, None]))
