"""Small linear algebra matches NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from gsmerge.method.kernels.matrices import closest_rotation, determinant, eigh, invert, matmul, solve, solve_symmetric

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ((5, 3), (3, 3)), ((7, 4, 4), (7, 4, 4)), ((7, 4, 4), (4, 4)), ((4, 4), (7, 4, 4)), ((2, 5, 3, 3), (3,)),
        ((3, 3), (3,)), ((3,), (3, 4)), ((3,), (7, 3, 3)), ((0, 3), (3, 3)), ((2, 0), (0, 2)), ((6, 500), (500, 6)),
        ((1, 3, 3), (7, 3, 1)), ((0, 3, 3), (3,)),
    ],
)  # fmt: skip
def test_products_match_numpy_s(each_target, left, right):
    a, b = RNG.normal(size=left), RNG.normal(size=right)
    (actual,) = each_target(lambda: (matmul(a, b),))
    assert actual.shape == (a @ b).shape
    np.testing.assert_allclose(actual, a @ b, rtol=1e-12, atol=1e-12)


def test_products_of_strided_and_integer_arrays_match_numpy_s():
    a, b = RNG.normal(size=(6, 8)).astype(np.float32), RNG.integers(0, 9, (6, 3))
    np.testing.assert_allclose(matmul(a.T[::2], b), a.T[::2].astype(float) @ b, rtol=1e-12)


def test_every_sum_has_the_order_of_its_terms():
    a = RNG.normal(size=(3, 50))
    parts = np.ldexp(np.round(np.ldexp(a, 20)), -20)  # products are exact, so fusing them changes nothing
    slow = np.zeros((3, 3))
    for j in range(50):
        slow += parts[:, j, None] * parts[:, j]
    np.testing.assert_array_equal(matmul(parts, parts.T), slow)


@pytest.mark.parametrize("size", [1, 2, 3, 6, 16, 17, 40])
def test_solutions_match_numpy_s(each_target, size):
    a, b = RNG.normal(size=(4, size, size)), RNG.normal(size=(4, size, 2))
    a[0, :, 0] = 0
    a[0, -1, 0] = 1  # takes a pivot from below
    (actual, inverse) = each_target(lambda: (solve(a, b), invert(a)))
    np.testing.assert_allclose(actual, np.linalg.solve(a, b), rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(inverse, np.linalg.inv(a), rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(solve(a[1], b[1, :, 0]), actual[1, :, 0], rtol=1e-15)


def test_banded_equations_match_numpy_s(each_target):
    a = np.diag(np.full(90, 4.0)) - np.diag(np.ones(89), 1) - np.diag(np.ones(89), -1)
    (actual,) = each_target(lambda: (solve(a, np.arange(90.0)),))
    np.testing.assert_allclose(a @ actual, np.arange(90.0), atol=1e-12)


def test_singular_matrices_are_refused():
    with pytest.raises(np.linalg.LinAlgError, match="Singular"):
        invert(np.stack([np.eye(3), np.ones((3, 3))]))


def test_inverse_of_a_matrix_that_is_not_finite_is_not_finite():
    assert np.isnan(invert(np.full((2, 2), np.nan))).all()
    assert not np.isfinite(invert(np.array([[1.0, np.nan], [0, 1]]))).all()
    assert invert(np.empty((0, 4, 4))).shape == (0, 4, 4)


@pytest.mark.parametrize("size", [1, 2, 3, 4, 9])
def test_eigenvalues_and_eigenvectors_rebuild_the_matrix(each_target, size):
    a = RNG.normal(size=(20, size, size))
    a += a.swapaxes(1, 2)
    a[0], a[1] = np.eye(size), 0
    values, vectors = each_target(lambda: eigh(a))
    np.testing.assert_allclose(values, np.linalg.eigvalsh(a), atol=1e-13 * size)
    np.testing.assert_allclose(np.einsum("nik,nk,njk->nij", vectors, values, vectors), a, atol=1e-13 * size)
    np.testing.assert_allclose(
        np.einsum("nki,nkj->nij", vectors, vectors), np.tile(np.eye(size), (20, 1, 1)), atol=1e-14
    )


def test_eigenvalues_of_numbers_that_are_not_finite():
    values, _ = eigh(np.array([[np.nan, 1], [1, np.inf]]))
    assert not np.isfinite(values).any()


@pytest.mark.parametrize("rank", [3, 2, 0])
def test_least_squares_match_numpy_s(each_target, rank):
    columns = RNG.normal(size=(30, rank)) @ RNG.normal(size=(rank, 3))
    a, b = columns.T @ columns, columns.T @ RNG.normal(size=(30, 2))
    (actual,) = each_target(lambda: (solve_symmetric(a, b),))
    np.testing.assert_allclose(actual, np.linalg.lstsq(a, b, rcond=1e-12)[0], atol=1e-9)
    np.testing.assert_allclose(solve_symmetric(a, b[:, 0]), actual[:, 0], atol=1e-12)


def test_determinants_match_numpy_s():
    a = RNG.normal(size=(4, 5, 3, 3))
    np.testing.assert_allclose(determinant(a), np.linalg.det(a), rtol=1e-10)


@pytest.mark.parametrize("rank", [1, 2, 3])
def test_the_closest_rotation_is_that_of_singular_values(rank):
    for _ in range(20):
        a = RNG.normal(size=(3, rank)) @ RNG.normal(size=(rank, 3))
        u, _, vt = np.linalg.svd(a)
        slow = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        actual = closest_rotation(a)
        np.testing.assert_allclose(actual @ actual.T, np.eye(3), atol=1e-14)
        assert determinant(actual) == pytest.approx(1)
        assert (actual * a).sum() == pytest.approx((slow * a).sum())
        if rank > 1:
            np.testing.assert_allclose(actual, slow, atol=1e-6)


def test_results_of_float32_are_float32():
    a = RNG.normal(size=(2, 3, 3)).astype(np.float32)
    results = matmul(a, a), solve(a, a), invert(a), eigh(a + a.swapaxes(1, 2))[1]
    assert {one.dtype for one in results} == {np.dtype(np.float32)}
    assert matmul(a, a.astype(float)).dtype == np.float64
