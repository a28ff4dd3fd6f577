"""What projection, colours and the image loss do with arrays of any kind: none, one, not finite, indices outside.

Every processor gives the same bits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from messages import refuses
from slow_steps import differentiate_rows

from gsmerge.method.kernels.elementary import exp, sin
from gsmerge.method.kernels.raster import project
from gsmerge.method.kernels.raster import step as step_kernels

RNG = np.random.default_rng(0)
HOSTILE = np.array([np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-40, 0, -0.0], np.float32)
Columns = dict[str, np.ndarray]


def normal(*shape: int) -> np.ndarray:
    return RNG.normal(size=shape).astype(np.float32)


def columns_of(n: int, num: int = 3, *, hostile: bool = False) -> Columns:
    """Return Gaussians in front of the camera; every third number is a hostile one if that is asked for."""
    columns = {
        "means": normal(n, 3) + np.float32([0, 0, 3]), "quats": normal(n, 4), "scales": exp(normal(n, 3) - 3),
        "opacities": RNG.random(n, dtype=np.float32), "sh0": normal(n, 1, 3), "shN": normal(n, num, 3),
    }  # fmt: skip
    for column in columns.values() if hostile else ():
        chosen = RNG.random(column.shape) < 1 / 3
        column[chosen] = RNG.choice(HOSTILE, int(chosen.sum()))
    return columns


def camera_of(antialiased: bool = False) -> np.ndarray:
    """Return a camera of 60 x 40 pixels at the origin."""
    camera = np.zeros(project.CAMERA, np.float32)
    camera[: project.SHIFT] = np.eye(3).ravel()
    camera[project.FX : project.NEAR] = 50, 50, 30, 20, 60, 40
    camera[project.NEAR], camera[project.FAR], camera[project.EPS2D] = 0.01, 1e10, 0.3
    camera[project.LIMIT_X : project.ANTIALIASED] = 0.8, -0.8, 0.6, -0.6
    camera[project.ANTIALIASED] = antialiased
    return camera


def listed(n: int) -> np.ndarray:
    return np.arange(0, n, 2, dtype=np.int32)


def cull(c: Columns) -> list[np.ndarray]:
    n = len(c["means"])
    ids = np.full(n, -1, np.int32)
    keep, wanted = np.arange(n, dtype=np.uint8) % 3, np.zeros((4, 5), np.int32)
    wanted[1:, 1:] = 1  # the first tile
    head = c["means"], c["scales"], c["opacities"]
    counts = [project.cull(*head, None, None, camera_of(), 0, ids)]
    assert (np.diff(ids[: counts[0]]) > 0).all()
    counts.append(project.cull(*head, keep, wanted, camera_of(), 5, ids))
    assert counts[1] <= counts[0]
    return [ids, np.array(counts)]


def conics_of(c: Columns) -> list[np.ndarray]:
    ids = listed(len(c["means"]))
    results = []
    for antialiased in (False, True):
        m = len(ids)
        results += [np.empty((m, 8), np.float32), np.empty(m, np.float32), np.empty((m, 4), np.int16)]
        head = c["means"], c["quats"], c["scales"], c["opacities"], ids
        project.project(*head, camera_of(antialiased), *results[-3:])
        columns, lines = results[-1].reshape(-1, 2, 2).transpose(1, 2, 0)
        assert (columns >= 0).all()
        assert (columns <= 4).all()
        assert (lines >= 0).all()
        assert (lines <= 3).all()
    return results


def project_back(c: Columns) -> list[np.ndarray]:
    ids = listed(len(c["means"]))
    m, block = len(ids), project.BLOCK
    results = [np.empty(shape, np.float32) for shape in ((m, 3), (m, 4), (m, 3), m, (-(-m // block), 12))]
    sums = sin(np.arange(9 * m, dtype=np.float32)).reshape(m, 9)
    head = c["means"], c["quats"], c["scales"], c["opacities"], ids, sums, camera_of(True)
    project.project_backward(*head, 0, m, *results)
    parts = [np.empty_like(one) for one in results]
    for first in range(0, m, block):
        project.project_backward(*head, first, min(first + block, m), *parts[:4], None)
    for one, part in zip(results[:4], parts, strict=False):
        np.testing.assert_array_equal(one, part)
    return results


def colors_of(c: Columns) -> list[np.ndarray]:
    ids, eye = listed(len(c["means"])), np.array([0.1, 0.2, -1], np.float32)
    m, num = len(ids), c["shN"].shape[1]
    results = [np.empty(shape, np.float32) for shape in ((m, 3), (m, 1, 3), (m, num, 3), (m, 3))]
    project.view_colors(c["means"], c["sh0"], c["shN"], ids, eye, 0, m, results[0])
    grad = sin(np.arange(3 * m, dtype=np.float32)).reshape(m, 3)
    head = c["means"], c["shN"], ids, eye
    project.view_colors_backward(*head, 0, m, results[0], grad, *results[1:])
    parts = [np.empty_like(one) for one in results]
    for first, last in ((m // 3, m), (0, m // 3)):  # the later part first: nothing may be written outside a range
        project.view_colors(c["means"], c["sh0"], c["shN"], ids, eye, first, last, parts[0])
        project.view_colors_backward(*head, first, last, parts[0], grad, *parts[1:])
    for one, part in zip(results, parts, strict=True):
        np.testing.assert_array_equal(one, part)
    return results


def plain(arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the arrays with one NaN for all: its sign goes with the order of operands, which compilers choose."""
    return [np.where(np.isnan(array), np.float32(np.nan), array) for array in arrays]


KERNELS: list[Callable[[Columns], Sequence[np.ndarray]]] = [cull, conics_of, project_back, colors_of]


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("hostile", [False, True])
@pytest.mark.parametrize("n", [0, 1, 2, 33, 700])
def test_bits_are_the_same_on_every_processor(each_target: Any, kernel: Any, hostile: bool, n: int) -> None:
    columns = columns_of(n, hostile=hostile)
    each_target(lambda: plain(kernel(columns)))


@pytest.mark.parametrize("num", [0, 1, 2, 4, 5, 7, 8, 11, 15, 20, 24])
def test_missing_harmonics_of_a_degree_count_as_zero(each_target: Any, num: int) -> None:
    """Those of a degree may be given in part; the rest count as zero. The last Gaussian is one of those listed."""
    columns = columns_of(31, num)
    actual = each_target(lambda: colors_of(columns))
    full = next(k * k - 1 for k in range(1, 6) if k * k > num)
    columns["shN"] = np.pad(columns["shN"], ((0, 0), (0, full - num), (0, 0)))
    color, grad_sh0, grad_shN, grad_means = colors_of(columns)
    for one, expected in zip(actual, (color, grad_sh0, grad_shN[:, :num], grad_means), strict=True):
        np.testing.assert_allclose(one, expected, rtol=1e-5, atol=1e-5)


def test_a_gaussian_that_is_not_finite_leaves_its_neighbours_alone() -> None:
    columns, bad = columns_of(60, 8), columns_of(60, 8)
    for name, column in columns.items():
        bad[name][:] = column
        bad[name][22:24] = np.nan
    for kernel in (conics_of, colors_of):
        for one, other in zip(kernel(columns), kernel(bad), strict=True):
            np.testing.assert_array_equal(np.delete(one, 11, 0), np.delete(other, 11, 0))


@pytest.mark.parametrize("wrong", [-1, 10, 2**31 - 1, -(2**31)])
@pytest.mark.parametrize("place", [0, 4])
def test_indices_outside_are_refused(wrong: int, place: int) -> None:
    c, eye = columns_of(10), np.zeros(3, np.float32)
    ids = listed(10)
    ids[place] = wrong
    rows, flat = np.zeros((5, 3), np.float32), np.zeros(5, np.float32)
    quats, shN, sums = np.zeros((5, 4), np.float32), np.zeros((5, 3, 3), np.float32), np.zeros((5, 9), np.float32)
    shape = c["means"], c["quats"], c["scales"], c["opacities"], ids
    calls: list[Callable[[], None]] = [
        lambda: project.project(*shape, camera_of(), np.zeros((5, 8), np.float32), flat, np.zeros((5, 4), np.int16)),
        lambda: project.project_backward(*shape, sums, camera_of(), 0, 5, rows, quats, rows, flat, None),
        lambda: project.add_rows(ids, rows, np.zeros((10, 3), np.float32)),
        lambda: project.view_colors(c["means"], c["sh0"], c["shN"], ids, eye, 0, 5, rows),
        lambda: project.view_colors_backward(
            c["means"], c["shN"], ids, eye, 0, 5, rows, rows, rows[:, None].copy(), shN, rows
        ),
    ]
    for call in calls:
        with pytest.raises(ValueError, match="indices"):
            call()


def test_ranges_outside_are_refused() -> None:
    c, eye, colors = columns_of(10), np.zeros(3, np.float32), np.zeros((10, 3), np.float32)
    ids = np.arange(10, dtype=np.int32)
    for first, last in ((-1, 5), (0, 11), (7, 6)):
        with refuses(ValueError, f"view_colors: {'first' if first < 0 else 'last'}", first if first < 0 else last):
            project.view_colors(c["means"], c["sh0"], c["shN"], ids, eye, first, last, colors)
    head = c["means"], c["quats"], c["scales"], c["opacities"], ids, np.zeros((10, 9), np.float32), camera_of()
    results = colors, np.zeros((10, 4), np.float32), colors, np.zeros(10, np.float32), None
    with refuses(ValueError, "project_backward", "indices"):  # a range of blocks begins at one
        project.project_backward(*head, 1, 5, *results)


def test_added_rows_go_to_the_rows_of_their_ids() -> None:
    totals, rows = normal(6, 5), normal(3, 5)
    expected, ids = totals.copy(), np.array([4, 0, 5], np.int32)
    expected[ids] += rows
    project.add_rows(ids, rows, totals)
    np.testing.assert_array_equal(totals, expected)


@pytest.mark.parametrize("size", [(1, 1), (2, 33), (13, 64), (9, 65), (24, 97)])
@pytest.mark.parametrize("hostile", [False, True])
def test_loss_has_the_same_bits_on_every_processor(each_target: Any, size: tuple[int, int], hostile: bool) -> None:
    height, width = size
    photo, weight = RNG.random((height, 3 * width), dtype=np.float32), RNG.random(size, dtype=np.float32)
    image = photo + normal(height, 3 * width) / 10
    if hostile:
        image[height // 2, width // 2] = np.nan

    def run() -> list[np.ndarray]:
        gradient, errors = np.empty_like(image), np.empty(height, np.float32)
        differentiate_rows(image, photo, weight, 0.2, 1.2, 0, height, gradient, errors)
        return plain([gradient, errors])

    gradient, _ = each_target(run)
    far = np.abs(np.arange(3 * width) // 3 - width // 2 // 3) > 6
    assert np.isfinite(gradient[:, far]).all()


def test_memory_of_the_loss_that_is_too_small_is_refused() -> None:
    image, weight = np.zeros((4, 9), np.float32), np.zeros((4, 3), np.float32)
    terms, rows = (np.empty((*shape, step_kernels.SUM_CHUNK), np.float32) for shape in ((12, 3), (7,)))
    outputs = image.copy(), weight[:, 0].copy(), terms, rows
    with refuses(ValueError, "loss_gradient", "indices"):
        step_kernels.loss_gradient(image, image, weight, 0.2, 1.2, 0, 4, *outputs)
