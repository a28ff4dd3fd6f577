"""The optimiser's step and cuts at edges match slow, obvious twins in float64."""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise
from math import erf, exp, pi, sqrt
from typing import Any

import numpy as np
import pytest
from made_gaussians import random_gaussians
from messages import refuses

from gsmerge.method.geometry.transforms import covariances
from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.gaussians.optimise import (
    COLOR,
    COLUMNS,
    LOGIT,
    MAX_FIT_LOGIT,
    MIN_FIT_LOGIT,
    NUM_EDGES,
    QUAT,
    SIZE,
    adam,
    cut_at_edges,
)
from gsmerge.types import Gaussians

RATES = np.array([0.1] * 3 + [0.2] * 3 + [0.03] * 4 + [0.3] + [0.03] * 3)
# of the mean, log scale, logit; of the largest scale above the second, and above the least
LIMITS, BETAS = np.array([2.0, 2.5, 4.0, 1.1, 2.0]), np.array([0.7, 0.99])
REGS = np.array([0.02, 0.03], np.float32)
MEAN, TURN = slice(0, SIZE), slice(QUAT, LOGIT)


@dataclass
class Run:
    """All that a step reads and writes, n rows."""

    x: np.ndarray
    x0: np.ndarray
    m: np.ndarray
    v: np.ndarray
    units: np.ndarray
    box_shares: np.ndarray
    min_sizes: np.ndarray
    fixed: np.ndarray
    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray

    def copy(self) -> Run:
        return Run(*(getattr(self, f.name).copy() for f in fields(self)))


@dataclass
class Wanted:
    """Gradients of some rows, as the rasterizer gives them: of linear scales and opacities."""

    ids: np.ndarray
    means: np.ndarray
    quats: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray


def make_run(count: int, seed: int = 0) -> Run:
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, COLUMNS)).astype(np.float32)
    x[:, SIZE:QUAT] -= 3
    x[:, TURN] /= np.linalg.norm(x[:, TURN], axis=1, keepdims=True)
    x[:, COLOR:] = rng.uniform(0, 1, (count, 3))
    zeros = np.zeros_like(x)
    units = rng.uniform(0.02, 0.2, count).astype(np.float32)
    box_shares = rng.uniform(0.2, 1, count).astype(np.float32)
    opacities = 1 / (1 + elementary.exp(-x[:, LOGIT]))
    min_sizes = np.full(count, -np.inf, np.float32)
    return Run(
        x, x.copy(), zeros, zeros.copy(), units, box_shares, min_sizes, np.zeros(count, np.uint8),
        x[:, MEAN].copy(), x[:, TURN].copy(), elementary.exp(x[:, SIZE:QUAT]), opacities, x[:, COLOR:].copy(),
    )  # fmt: skip


def gradients(count: int, seed: int, share: float = 0.6, size: float = 1.0) -> Wanted:
    """Return random gradients of a part of the rows."""
    rng = np.random.default_rng(seed)
    ids = np.flatnonzero(rng.random(count) < share).astype(np.int32)

    def normal(*width: int) -> np.ndarray:
        return (size * rng.normal(size=(len(ids), *width))).astype(np.float32)

    return Wanted(ids, normal(3), normal(4), normal(3), normal(), normal(3))


def step_kernel(run: Run, g: Wanted, step: int, pieces: list[int] | None = None, rates: np.ndarray = RATES) -> None:
    edges = pieces or [0, len(g.ids)]
    for first, last in pairwise(edges):
        adam(
            run.x, run.x0, run.m, run.v, run.units, run.box_shares, run.min_sizes, run.fixed,
            g.ids, g.means, g.quats, g.scales, g.opacities, g.colors,
            rates.astype(np.float32), LIMITS.astype(np.float32), BETAS.astype(np.float32), REGS, step, first, last,
            run.means, run.quats, run.scales, run.opacities, run.colors,
        )  # fmt: skip


def step_slowly(run: Run, g: Wanted, step: int) -> None:
    """Step as the textbook (Kingma and Ba, 2015; Dozat, 2016) and the kernel's docstring say, row by row in float64."""
    for k, i in enumerate(g.ids):
        alpha = run.opacities[i]
        row = np.concatenate([
            g.means[k] * run.units[i], (g.scales[k] + REGS[1] / run.units[i]) * run.scales[i], g.quats[k],
            [(g.opacities[k] + REGS[0]) * alpha * (1 - alpha)], g.colors[k],
        ])  # fmt: skip
        energy = row**2
        energy[MEAN], energy[TURN] = energy[MEAN].mean(), energy[TURN].sum() / 3  # a rotation has three freedoms
        run.m[i] = BETAS[0] * run.m[i] + (1 - BETAS[0]) * row
        run.v[i] = BETAS[1] * run.v[i] + (1 - BETAS[1]) * energy
        ahead = BETAS[0] * run.m[i] + (1 - BETAS[0]) * row
        first, second = ahead / (1 - BETAS[0] ** (step + 1)), run.v[i] / (1 - BETAS[1] ** step)
        move = RATES * first / (np.sqrt(second) + 1e-15)
        move[MEAN] *= run.units[i]
        x, x0 = run.x[i] - move, run.x0[i]
        way = x[MEAN] - x0[MEAN]
        x[MEAN] = x0[MEAN] + way * min(
            1, run.box_shares[i] * LIMITS[0] * run.units[i] / max(np.linalg.norm(way), 1e-30)
        )
        reach = run.box_shares[i] * LIMITS[1]
        size = np.clip(x[SIZE:QUAT], x0[SIZE:QUAT] - reach, x0[SIZE:QUAT] + reach)
        x[SIZE:QUAT] = np.maximum(size, run.min_sizes[i])
        most = max(sorted(x[SIZE:QUAT])[1] + LIMITS[3], run.min_sizes[i] + LIMITS[4])
        x[SIZE:QUAT] = np.minimum(x[SIZE:QUAT], most)
        logit = np.clip(x[LOGIT], x0[LOGIT] - LIMITS[2], x0[LOGIT] + LIMITS[2])
        x[LOGIT] = np.clip(logit, MIN_FIT_LOGIT, MAX_FIT_LOGIT)
        x[COLOR:] = np.clip(x[COLOR:], np.minimum(x0[COLOR:], -0.05), np.maximum(x0[COLOR:], 1.05))
        x[TURN] /= np.linalg.norm(x[TURN])
        run.x[i] = x
        run.means[i], run.quats[i], run.colors[i] = x[MEAN], x[TURN], x[COLOR:]
        run.scales[i], run.opacities[i] = elementary.exp(x[SIZE:QUAT]), 1 / (1 + elementary.exp(-x[LOGIT]))


def test_steps_match_a_slow_twin() -> None:
    """Thirty steps, each with gradients of other rows; long enough for many to reach the box."""
    run = make_run(40)
    slow = Run(*(getattr(run, f.name).astype(np.float64) for f in fields(run)))
    for step in range(1, 31):
        g = gradients(40, seed=step)
        step_kernel(run, g, step)
        step_slowly(slow, g, step)
    for name in ("m", "v", "x", "means", "quats", "scales", "opacities", "colors"):
        np.testing.assert_allclose(getattr(run, name), getattr(slow, name), rtol=2e-4, atol=2e-5, err_msg=name)


def test_fixed_rows_take_no_step() -> None:
    """The others take the same step, whatever their number, as without gradients of the fixed ones."""
    run, g = make_run(40), gradients(40, seed=1)
    run.fixed[::3] = 1
    free, start = run.copy(), run.copy()
    step_kernel(run, g, 1)
    of_free = run.fixed[g.ids] == 0
    step_kernel(free, Wanted(*(np.ascontiguousarray(column[of_free]) for column in vars(g).values())), 1)
    for f in fields(run):
        np.testing.assert_array_equal(getattr(run, f.name), getattr(free, f.name), err_msg=f.name)
        np.testing.assert_array_equal(getattr(run, f.name)[::3], getattr(start, f.name)[::3], err_msg=f.name)
    assert not np.array_equal(run.x, start.x)


def test_colours_that_begin_outside_the_range_may_stay_there() -> None:
    run = make_run(4)
    run.x[:, COLOR:] = run.x0[:, COLOR:] = [[-0.5, 1.5, 0.5]] * 4
    g = gradients(4, seed=0, share=1.1)
    g.colors[:] = [[1, -1, 0]] * 4
    step_kernel(run, g, 1)
    np.testing.assert_array_equal(run.x[:, COLOR:], run.x0[:, COLOR:])
    g.colors[:] = [[-1, 1, 0]] * 4
    for step in range(2, 6):
        step_kernel(run, g, step)
    assert (run.x[:, COLOR] > -0.5).all()
    assert (run.x[:, COLOR + 1] < 1.5).all()


def test_sizes_stay_above_the_least_within_the_box_and_beyond() -> None:
    """Pulled smaller for thirty steps: half of them may not shrink at all, one begins below what is allowed."""
    run, g = make_run(20), gradients(20, seed=1, share=1.1)
    g.scales[:] = 1
    run.min_sizes[::2] = run.x[::2, SIZE:QUAT].min(1)
    run.min_sizes[1] = run.x[1, SIZE:QUAT].max() + 5
    for step in range(1, 31):
        step_kernel(run, g, step)
    assert (run.x[:, SIZE:QUAT] >= run.min_sizes[:, None]).all()
    np.testing.assert_array_equal(run.x[::2, SIZE:QUAT].min(1), run.min_sizes[::2])
    np.testing.assert_array_equal(run.x[1, SIZE:QUAT], run.min_sizes[1])
    assert (run.x[3::2, SIZE:QUAT] < run.x0[3::2, SIZE:QUAT]).all()
    np.testing.assert_allclose(run.scales, np.exp(run.x[:, SIZE:QUAT]), rtol=1e-5)


@pytest.mark.parametrize("pieces", [[0, 1, 33], [0, 16, 33], [0, 5, 6, 6, 20, 33]])
def test_steps_in_pieces_have_the_same_bits_as_at_once(pieces: list[int]) -> None:
    whole, split = make_run(33), make_run(33)
    for step in range(1, 8):
        g = gradients(33, seed=step, share=1.1)
        step_kernel(whole, g, step)
        step_kernel(split, g, step, pieces)
    for f in fields(Run):
        np.testing.assert_array_equal(getattr(split, f.name), getattr(whole, f.name), err_msg=f.name)


def test_step_from_a_zero_quaternion_is_finite() -> None:
    run = make_run(3)
    run.x[0, TURN] = run.quats[0] = 0
    g = gradients(3, seed=0, share=1.1)
    g.quats[0] = 0
    step_kernel(run, g, 1)
    assert np.isfinite(run.x).all()


@pytest.mark.parametrize("count", [0, 1, 2, 15, 16, 17, 50])
@pytest.mark.parametrize("hostile", [False, True])
def test_bits_are_the_same_on_every_processor(each_target: Any, count: int, hostile: bool) -> None:
    """Every row is listed, the last one too; what is not finite stays in its own."""
    start, steps = make_run(count), [gradients(count, seed=step, share=1.1) for step in range(1, 4)]
    for g in steps if hostile else ():
        g.means[1::5], g.quats[::7], g.scales[1::6], g.opacities[2::9] = np.nan, np.inf, 3e38, -np.inf

    def run() -> list[np.ndarray]:
        result = start.copy()
        for step, g in enumerate(steps, 1):
            step_kernel(result, g, step)
        return [np.nan_to_num(getattr(result, f.name)) for f in fields(Run)]

    each_target(run)


def test_rows_that_are_not_finite_leave_their_neighbours_alone() -> None:
    run, bad, g = make_run(20), make_run(20), gradients(20, seed=0, share=1.1)
    bad.x[7] = bad.v[7] = np.nan
    step_kernel(run, g, 1)
    step_kernel(bad, g, 1)
    for f in fields(Run):
        one, two = (np.delete(getattr(each, f.name), 7, 0) for each in (run, bad))
        np.testing.assert_array_equal(one, two, err_msg=f.name)


@pytest.mark.parametrize("wrong", [-1, 20, 2**31 - 1])
def test_ids_of_rows_outside_are_refused(wrong: int) -> None:
    run, g = make_run(20), gradients(20, seed=0, share=1.1)
    before = run.copy()
    g.ids[10] = wrong
    with refuses(ValueError, "adam", "indices"):
        step_kernel(run, g, 1)
    np.testing.assert_array_equal(run.x, before.x)


REACH = 2.0


def make_planes(views: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Make planes of cameras near the origin that look along z, each with a frustum of its own."""
    random = np.random.default_rng(seed)
    left, right, top, bottom = random.uniform([-0.9, 0.2, -0.7, 0.1], [-0.2, 0.9, -0.1, 0.7], (views, 4)).T
    zero, one = np.zeros(views), np.ones(views)
    sides = (-one, zero, left), (one, zero, -right), (zero, -one, top), (zero, one, -bottom)
    normals = np.stack([np.stack(side, 1) for side in sides], 1)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return normals, (normals * random.normal(0, 0.3, (views, 1, 3))).sum(2)


def cut_slowly(mean: np.ndarray, covar: np.ndarray, normals: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return mean and covariance of one Gaussian after two cuts at most, and whether it is cut."""
    is_cut = False
    for _ in range(2):
        sigmas = np.array([[sqrt(n @ covar @ n) for n in view] for view in normals])
        rooms = (offsets - normals @ mean) / sigmas
        view = int(rooms.min(1).argmax())
        edge = int(rooms[view].argmin())
        room, sigma, normal = rooms[view, edge], sigmas[view, edge], normals[view, edge]
        if not -REACH < room < REACH:
            break
        hazard = exp(-room * room / 2) / sqrt(2 * pi) / (0.5 + 0.5 * erf(room / sqrt(2)))
        across, is_cut = covar @ normal, True
        mean = mean - across / sigma * hazard
        covar = covar - np.outer(across, across) * hazard * (hazard + room) / sigma**2
    return mean, covar, np.array(is_cut)


def cut(gaussians: Gaussians, normals: np.ndarray, offsets: np.ndarray, *spans: tuple[int, int]) -> tuple:
    """Return the kernel's means, covariances and marks."""
    means, num = gaussians.means.astype(np.float32), len(gaussians)
    covars, is_cut = np.full((num, 3, 3), np.nan), np.zeros(num, np.uint8)
    columns = gaussians.quats.astype(np.float32), gaussians.scales.astype(np.float32)
    for first, last in spans or [(0, num)]:
        cut_at_edges(*columns, normals, offsets, first, last, means, covars, is_cut)
    return means, covars, is_cut.astype(bool)


@pytest.mark.parametrize(("count", "views", "seed"), [(300, 1, 0), (300, 5, 1), (200, 12, 2), (0, 3, 3), (1, 2, 4)])
def test_cut_gaussians_match_the_truncated_normal_distribution(count: int, views: int, seed: int) -> None:
    gaussians, planes = random_gaussians(count, seed, size=-2.0), make_planes(views, seed)
    means, covars, is_cut = cut(gaussians, *planes)
    whole = covariances(gaussians.quats.astype(np.float64), gaussians.scales.astype(np.float64))
    for i in range(count):
        mean, covar, expected = cut_slowly(gaussians.means[i].astype(np.float64), whole[i], *planes)
        assert is_cut[i] == expected
        np.testing.assert_allclose(means[i], mean, rtol=1e-5, atol=1e-5)
        if expected:
            np.testing.assert_allclose(covars[i], covar, rtol=1e-4, atol=1e-5 * np.trace(whole[i]))
    assert count < 200 or 0.1 < is_cut.mean() < 0.9


def test_gaussians_cut_in_pieces_are_those_cut_at_once() -> None:
    gaussians, planes = random_gaussians(100, 5), make_planes(3, 5)
    for whole, pieces in zip(
        cut(gaussians, *planes), cut(gaussians, *planes, (0, 33), (33, 33), (33, 100)), strict=True
    ):
        np.testing.assert_array_equal(whole, pieces)


def test_cut_gaussian_has_the_moments_of_the_part_inside() -> None:
    """Points drawn from a Gaussian that one edge cuts, those beyond left out."""
    normals = np.zeros((1, NUM_EDGES, 3))
    normals[0, :, 0] = 1
    gaussian = random_gaussians(1, 6)
    mean = gaussian.means[0].astype(np.float64)
    whole = covariances(gaussian.quats.astype(np.float64), gaussian.scales.astype(np.float64))[0]
    sigma = sqrt(whole[0, 0])
    offsets = mean[0] + sigma * np.array([[0.7, 9, 9, 9]])
    points = np.random.default_rng(7).multivariate_normal(mean, whole, 400_000)
    inside = points[points[:, 0] <= offsets[0, 0]]
    means, covars, is_cut = cut(gaussian, normals, offsets)
    assert is_cut.all()
    # the second cut of the kernel takes away what reaches beyond of the moments of the first
    first = cut_once(mean, whole, normals[0, 0], offsets[0, 0])
    np.testing.assert_allclose(inside.mean(0), first[0], atol=0.01 * sigma)
    np.testing.assert_allclose(np.cov(inside.T), first[1], atol=0.02 * np.trace(whole))
    assert normals[0, 0] @ means[0] < normals[0, 0] @ first[0]
    assert covars[0, 0, 0] < first[1][0, 0]


def cut_once(mean: np.ndarray, covar: np.ndarray, normal: np.ndarray, offset: float) -> tuple[np.ndarray, np.ndarray]:
    """Return moments of what lies inside of one plane."""
    sigma = sqrt(normal @ covar @ normal)
    room = (offset - normal @ mean) / sigma
    hazard = exp(-room * room / 2) / sqrt(2 * pi) / (0.5 + 0.5 * erf(room / sqrt(2)))
    across = covar @ normal
    return mean - across / sigma * hazard, covar - np.outer(across, across) * hazard * (hazard + room) / sigma**2


def test_gaussians_inside_or_far_outside_stay_uncut() -> None:
    normals, offsets = make_planes(1, 8)
    offsets = np.zeros_like(offsets)
    gaussians = random_gaussians(2, 8)
    gaussians.means[:] = [(0, 0, 5), (50, 0, 5)]
    gaussians.scales[:] = 0.01
    means, _, is_cut = cut(gaussians, normals, offsets)
    assert not is_cut.any()
    np.testing.assert_array_equal(means, gaussians.means)


def test_without_photos_nothing_is_cut() -> None:
    assert not cut(random_gaussians(20, 9), np.zeros((0, NUM_EDGES, 3)), np.zeros((0, NUM_EDGES)))[2].any()
