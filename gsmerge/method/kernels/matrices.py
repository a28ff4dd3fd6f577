"""Compute with small matrices with the same bits on every processor, which BLAS does not ensure.

All sums are taken in float64. Results are float32 if all arrays are float32, otherwise float64.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gsmerge.method.kernels.signature import STATUS, declare, f8, i4

Array = np.ndarray[Any, Any]
NARROW, WIDE = np.dtype(np.float32), np.dtype(np.float64)


# If m is 1, all matrices a are multiplied with the same matrix b
_multiply_matrices = declare(
    "multiply_matrices", STATUS, a=f8("n", "i", "j"), b=f8("m", "j", "k"), out=f8("n", "i", "k", out=True)
)


# Overwrites a, and replaces b by the solutions of a x = b. Returns 0, or 1 if a matrix is singular
_solve_equations = declare("solve_equations", i4(), a=f8("n", "d", "d", out=True), b=f8("n", "d", "k", out=True))


# Replaces symmetric matrices a by diagonal matrices of their eigenvalues, and writes the eigenvectors to the columns of
# v
_diagonalise = declare("diagonalise", a=f8("n", "d", "d", out=True), v=f8("n", "d", "d", out=True))


def _to_float64(*arrays: ArrayLike) -> tuple[list[Array], np.dtype[Any]]:
    """Return arrays as float64, and the type of the result: float32 if all arrays are float32, otherwise float64."""
    inputs = [np.asarray(array) for array in arrays]
    dtype = NARROW if all(array.dtype == NARROW for array in inputs) else WIDE
    return [array if array.dtype == WIDE else array.astype(WIDE) for array in inputs], dtype


def matmul(a: ArrayLike, b: ArrayLike) -> Array:
    """Multiply matrices ``[...,i,j]`` and ``[...,j,k]``, or vectors ``[j]``, as ``a @ b`` does."""
    (left, right), dtype = _to_float64(a, b)
    left_is_vector = left.ndim == 1
    right_is_vector = right.ndim == 1
    left = left[None] if left_is_vector else left
    right = right[:, None] if right_is_vector else right
    stack = left.shape[:-2]  # shape of the axes before the matrices
    if right.ndim == 2:  # all matrices on the left are multiplied with this one, so they form a single tall matrix
        a_list = left.reshape(1, math.prod(left.shape[:-1]), left.shape[-1])
        b_list = right[None]
    else:
        if stack != right.shape[:-2]:
            stack = np.broadcast_shapes(stack, right.shape[:-2])
            left, right = (np.broadcast_to(array, stack + array.shape[-2:]) for array in (left, right))
        a_list, b_list = (array.reshape(math.prod(stack), *array.shape[-2:]) for array in (left, right))
    out = np.empty((*a_list.shape[:2], b_list.shape[2]))
    _multiply_matrices(np.ascontiguousarray(a_list), np.ascontiguousarray(b_list), out)
    out = out.reshape(*stack, left.shape[-2], right.shape[-1])
    out = out[..., 0, :] if left_is_vector else out
    return (out[..., 0] if right_is_vector else out).astype(dtype, copy=False)


def solve(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the solutions x of ``a x = b`` for matrices ``a [...,d,d]`` and ``b [...,d,k]`` or one ``b [d]``.

    Raises numpy.linalg.LinAlgError if a matrix is singular.
    """
    (left, right), dtype = _to_float64(a, b)
    if right.ndim == 1:
        return solve(a, np.asarray(b)[:, None])[..., 0]
    stack = np.broadcast_shapes(left.shape[:-2], right.shape[:-2])  # shape of the axes before the matrices
    work, solution = (
        np.broadcast_to(array, (*stack, *array.shape[-2:])).reshape(math.prod(stack), *array.shape[-2:]).copy()
        for array in (left, right)
    )
    if _solve_equations(work, solution):
        raise np.linalg.LinAlgError("Singular matrix")
    return solution.reshape(*stack, *right.shape[-2:]).astype(dtype, copy=False)


def invert(matrices: ArrayLike) -> Array:
    """Return the inverses of matrices ``[...,d,d]``, or raise numpy.linalg.LinAlgError if one is singular."""
    matrices = np.asarray(matrices)
    return solve(matrices, np.eye(matrices.shape[-1], dtype=matrices.dtype))


def eigh(matrices: ArrayLike) -> tuple[Array, Array]:
    """Return the eigenvalues ``[...,d]`` of symmetric matrices, ascending, and the eigenvectors in columns."""
    (wide,), dtype = _to_float64(matrices)
    size = wide.shape[-1]
    work = wide.reshape(math.prod(wide.shape[:-2]), size, size).copy()
    vectors = np.empty_like(work)
    _diagonalise(work, vectors)
    values = np.diagonal(work, axis1=1, axis2=2)
    order = np.argsort(values, axis=1, kind="stable")
    values = np.take_along_axis(values, order, 1)
    vectors = np.take_along_axis(vectors, order[:, None], 2)
    return values.reshape(wide.shape[:-1]).astype(dtype), vectors.reshape(wide.shape).astype(dtype)


def transform(matrices: ArrayLike, vectors: ArrayLike) -> Array:
    """Multiply each of n matrices ``[n,i,j]`` by one of n vectors ``[n,j]``."""
    return matmul(matrices, np.asarray(vectors)[..., None])[..., 0]


def solve_symmetric(a: ArrayLike, b: ArrayLike, rcond: float = 1e-12) -> Array:
    """Return the shortest solution x of ``a x = b`` for a symmetric matrix ``[d,d]`` and ``b [d]`` or ``[d,k]``.

    Eigenvalues of at most ``rcond`` times the largest count as zero.
    """
    values, vectors = eigh(a)
    used = values > rcond * values.max(initial=0)
    coordinates = matmul(vectors.T, b)  # in the basis of the eigenvectors
    inverses = np.where(used, 1 / np.where(used, values, 1), 0)
    return matmul(vectors, coordinates * (inverses if coordinates.ndim == 1 else inverses[:, None]))


def determinant(matrices: ArrayLike) -> Array:
    """Return the determinants ``[...]`` of matrices ``[...,3,3]``."""
    first, second, third = np.moveaxis(np.asarray(matrices), -2, 0)
    return np.asarray((np.cross(first, second) * third).sum(-1))


def closest_rotation(matrix: ArrayLike) -> Array:
    """Return the rotation R ``[3,3]`` nearest to a matrix by least squares, so with the largest trace of R^T matrix.

    The quaternion of R is an eigenvector (Horn 1987), so R is never a reflection.
    """
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(matrix, np.float64)
    quaternion_form = np.array(
        [
            [a + e + i, h - f, c - g, d - b], [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h], [d - b, c + g, f + h, i - a - e],
        ]
    )  # fmt: skip
    w, x, y, z = eigh(quaternion_form)[1][:, -1]
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
