"""Pooling, recursive bisection and decomposition match slow, obvious numpy in float64."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from messages import refuses

from gsmerge.method.kernels import elementary
from gsmerge.method.kernels.gaussians.pool import bisect, decompose, group_members, pool, split_errors
from gsmerge.types import SH_C0


def rotation(quat: np.ndarray) -> np.ndarray:
    w, x, y, z = quat / np.linalg.norm(quat) if np.linalg.norm(quat) > 0 else np.array([1.0, 0, 0, 0])
    axis = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * axis + 2 * axis @ axis


def pool_reference(members: dict[str, np.ndarray], rows: list[int], own: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the 13 numbers and the harmonics of one group, from the formulas in docs of the kernel."""
    means, scales = members["means"][rows].astype(float), members["scales"][rows].astype(float)
    opacities = np.minimum(members["opacities"][rows].astype(float), 0.995)
    footprints = members["footprints"][rows].astype(float)
    weights = opacities if opacities.sum() > 0 else np.ones(len(rows))
    if own:
        extents = scales.max(1) / footprints
        limit = 3 * np.sort(extents)[(len(rows) - 1) // 2]
        scales = scales * np.minimum(1, limit / np.maximum(extents, 1e-300))[:, None]
    mean = np.average(means, axis=0, weights=weights)
    covar = np.zeros((3, 3))
    for m, s, q, w in zip(means, scales, members["quats"][rows].astype(float), weights / weights.sum(), strict=True):
        half = rotation(q) * s
        covar += w * np.outer(m - mean, m - mean) + (w * half @ half.T if own else 0)
    footprint = np.average(footprints, weights=weights)
    covar += np.eye(3) * (0.1 * footprint) ** 2
    mass = (opacities * scales.prod(1)).sum() * (2 * np.pi) ** 1.5
    largest = np.sort(scales, 1)[:, 1:].prod(1)
    extinction = (-elementary.log(1 - opacities) * largest).sum()
    upper = covar[np.triu_indices(3)]
    return (
        np.concatenate([mean, upper, [opacities.sum(), mass, extinction, footprint]]),
        np.average(harmonics(members)[rows].astype(float), axis=0, weights=weights),
    )


def harmonics(members: dict[str, np.ndarray]) -> np.ndarray:
    return np.concatenate([members["sh0"], members["shN"]], 1)


def random_members(count: int, seed: int, coefficients: int = 4) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    columns = {
        "means": rng.normal(size=(count, 3)),
        "quats": rng.normal(size=(count, 4)) * rng.uniform(0.1, 5, (count, 1)),
        "scales": elementary.exp(rng.normal(size=(count, 3)) - 3),
        "opacities": rng.uniform(0, 1, count),
        "sh0": rng.normal(size=(count, 1, 3)),
        "shN": rng.normal(size=(count, coefficients - 1, 3)),
        "footprints": rng.uniform(0.01, 0.03, count),
    }
    return {name: values.astype(np.float32) for name, values in columns.items()}


def pooled(members: dict[str, np.ndarray], groups: list[list[int]], own: bool = True) -> tuple[np.ndarray, np.ndarray]:
    starts = np.concatenate([[0], np.cumsum([len(g) for g in groups])])
    ids = np.array([i for g in groups for i in g], np.int64)
    geometry = np.zeros((len(groups), 13))
    sh = np.zeros((len(groups), harmonics(members).shape[1], 3), np.float32)
    pool(starts, ids, *members.values(), own, geometry, sh)
    return geometry, sh


def assert_pooled_by_the_formulas(members: dict[str, np.ndarray], groups: list[list[int]], own: bool) -> None:
    geometry, sh = pooled(members, groups, own)
    for g, rows in enumerate(groups):
        expected, wanted_sh = pool_reference(members, rows, own)
        np.testing.assert_allclose(geometry[g], expected, rtol=2e-6, atol=1e-10)
        np.testing.assert_allclose(sh[g], wanted_sh, atol=2e-6)


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_pooled_groups_match_the_formulas(own: bool, seed: int) -> None:
    members = random_members(200, seed)
    rng = np.random.default_rng(seed)
    groups = [sorted(rng.choice(200, size, replace=False).tolist()) for size in (1, 2, 3, 30, 160)]
    assert_pooled_by_the_formulas(members, groups, own)


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize(("field", "value"), [("opacities", 0.0), ("opacities", 1.0), ("scales", 0.02), ("quats", 0.0)])
def test_pooled_groups_match_the_formulas_at_the_ends_of_values(field: str, value: float, own: bool) -> None:
    """Transparent groups take the plain mean, opaque ones have a finite depth."""
    members = random_members(50, 2)
    members[field][:] = value
    assert_pooled_by_the_formulas(members, [list(range(50)), [7]], own)


def test_pooled_covariance_is_exact_far_from_the_origin() -> None:
    members = random_members(50, 4)
    members["means"] = (members["means"] * 0.05 + 1e4).astype(np.float32)
    geometry, _ = pooled(members, [list(range(50))], False)
    expected, _ = pool_reference(members, list(range(50)), False)
    np.testing.assert_allclose(geometry[0, 3:9], expected[3:9], rtol=1e-6, atol=1e-9)


def test_empty_groups_stay_zero() -> None:
    geometry, sh = pooled(random_members(4, 5), [[0, 1], [], [2, 3]])
    assert not geometry[1].any()
    assert not sh[1].any()
    assert geometry[2].any()


def test_group_members_lists_the_members_of_each_label() -> None:
    rng = np.random.default_rng(0)
    labels = rng.integers(-1, 12, 500).astype(np.int32)
    labels[labels == 7] = 3  # a label without a member
    starts, ids = group_members(labels, 13)
    assert starts[0] == 0
    assert starts[-1] == len(ids) == (labels >= 0).sum()
    for label in range(13):
        np.testing.assert_array_equal(ids[starts[label] : starts[label + 1]], np.nonzero(labels == label)[0])


def rebuilt(covars: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    scales, quats = np.empty((len(covars), 3)), np.empty((len(covars), 4))
    decompose(covars, scales, quats)
    halves = np.stack([rotation(q) for q in quats]) * scales[:, None]
    return scales, quats, halves @ halves.transpose(0, 2, 1)


def random_covars(seed: int, count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    values = elementary.exp(rng.uniform(-12, 2, (count, 3)))
    return np.ascontiguousarray((axes * values[:, None]) @ axes.transpose(0, 2, 1))


def test_decompose_matches_eigh() -> None:
    covars = random_covars(0)
    covars = 0.5 * (covars + covars.transpose(0, 2, 1))
    scales, quats, again = rebuilt(covars)
    size = np.trace(covars, axis1=1, axis2=2)[:, None, None]
    np.testing.assert_allclose(again / size, covars / size, atol=1e-13)
    expected = np.linalg.eigvalsh(covars)
    np.testing.assert_allclose(scales**2, expected, atol=1e-13, rtol=1e-6)
    assert (np.diff(scales, axis=1) >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1, atol=1e-14)
    assert (quats[:, 0] >= 0).all()


@pytest.mark.parametrize(
    "covar",
    [
        np.eye(3),
        np.zeros((3, 3)),
        np.diag([3.0, 1.0, 2.0]),
        np.diag([1.0, 1.0, 4.0]),
        np.outer([1.0, 2, 3], [1, 2, 3]),
        np.ones((3, 3)) * 1e-20,
        np.diag([1e12, 1e-12, 1.0]) + 1e-3,
        -1e-18 * np.eye(3),
    ],
    ids=["equal", "zero", "unsorted", "pair", "rank one", "tiny", "wide range", "below zero by rounding"],
)
def test_decomposed_special_covariances_are_rebuilt(covar: np.ndarray) -> None:
    scales, quats, again = rebuilt(np.ascontiguousarray(covar[None], dtype=float))
    assert (scales >= 0).all()
    assert np.isfinite(quats).all()
    np.testing.assert_allclose(np.linalg.norm(quats), 1)
    np.testing.assert_allclose(again[0], covar, atol=1e-12 * max(np.abs(covar).max(), 1e-6))


def test_decompose_is_continuous_in_the_covariance() -> None:
    """Axes may jump under a small change where eigenvalues meet; covariances must not."""
    covars = np.repeat(np.diag([1.0, 1.0, 1.0 + 1e-9])[None], 50, 0)
    nudges = np.random.default_rng(0).normal(size=(50, 3, 3)) * 1e-7
    nudged = covars + nudges + nudges.transpose(0, 2, 1)
    np.testing.assert_allclose(rebuilt(nudged)[2], nudged, atol=1e-12)


@pytest.mark.parametrize("own", [True, False])
def test_the_bits_are_the_same_on_every_processor(each_target, own: bool) -> None:  # type: ignore[no-untyped-def]
    members = random_members(300, 6, coefficients=9)
    members["opacities"][:20] = [0.0, 1.0] * 10
    members["scales"][200] = np.inf
    members["means"][210], members["quats"][220], members["opacities"][230] = np.nan, np.nan, np.nan
    rng = np.random.default_rng(0)
    groups = [sorted(rng.choice(300, size, replace=False).tolist()) for size in (1, 2, 3, 30, 250)]
    with np.errstate(all="ignore"):
        geometry = each_target(lambda: pooled(members, groups, own))[0]
    assert np.isfinite(geometry[:, 3:9]).all(1).any()
    covars = np.concatenate([random_covars(1), np.full((1, 3, 3), np.nan), np.full((1, 3, 3), np.inf)])
    scales, quats = np.empty((len(covars), 3)), np.empty((len(covars), 4))

    def axes() -> tuple[np.ndarray, np.ndarray]:
        decompose(covars, scales, quats)
        return scales.copy(), quats.copy()

    each_target(axes)


def test_kernels_take_no_groups_and_no_members() -> None:
    assert [len(part) for part in group_members(np.empty(0, np.int32), 0)] == [1, 0]
    none = np.zeros(1, np.int64), np.empty(0, np.int64)
    pool(*none, *random_members(0, 0).values(), True, np.empty((0, 13)), np.empty((0, 4, 3), np.float32))
    decompose(np.empty((0, 3, 3)), np.empty((0, 3)), np.empty((0, 4)))


@pytest.mark.parametrize("row", [-1, 4, 2**31 - 1])
def test_ids_of_members_outside_are_refused(row: int) -> None:
    with refuses(ValueError, "pool_groups", "indices"):
        pooled(random_members(4, 0), [[0, row]])


@pytest.mark.parametrize("starts", [[0, 5], [0, -1], [-1, 2], [3, 2]])
def test_starts_of_groups_outside_are_refused(starts: list[int]) -> None:
    members = random_members(4, 0)
    with pytest.raises(ValueError, match="pool_groups: "):
        pool(
            np.array(starts), np.arange(4), *members.values(), True, np.zeros((1, 13)), np.zeros((1, 4, 3), np.float32)
        )


@pytest.mark.parametrize("label", [2, 2**31 - 1])
def test_labels_beyond_the_count_are_refused(label: int) -> None:
    with refuses(ValueError, "sort_labels", "indices"):
        group_members(np.array([0, label], np.int32), 2)


def member_features(
    means: np.ndarray, sh: np.ndarray, centre: np.ndarray, footprint: float, rows: np.ndarray
) -> np.ndarray:
    return np.concatenate(
        [SH_C0 * sh[rows, 0].astype(float), 0.012 / footprint * (means[rows].astype(float) - centre)], 1
    )


def scatter(features: np.ndarray, weights: np.ndarray) -> np.ndarray:
    delta = features - np.average(features, axis=0, weights=weights)
    return (weights[:, None] * delta).T @ delta


def split_reference(features: np.ndarray, weights: np.ndarray, count: int) -> list[list[int]]:
    """Halve the run of the largest principal scatter across its mean, with exact eigenvectors."""
    runs = [list(range(len(features)))]
    while len(runs) < count:
        tops = [np.linalg.eigh(scatter(features[r], weights[r])) for r in runs]
        for widest in sorted(range(len(runs)), key=lambda r: -tops[r][0][-1]):
            if tops[widest][0][-1] <= 1e-12:
                return runs
            run = np.array(runs[widest])
            side = (features[run] - np.average(features[run], axis=0, weights=weights[run])) @ tops[widest][1][:, -1]
            if 0 < (side > 0).sum() < len(run):
                runs[widest : widest + 1] = [run[side <= 0].tolist(), run[side > 0].tolist()]
                break
        else:
            return runs
    return runs


class Case:
    """Some groups of random members, elongated in a random direction so that the widest axis is clear."""

    def __init__(self, seed: int, sizes: tuple[int, ...] = (1, 2, 3, 17, 60)) -> None:
        rng = np.random.default_rng(seed)
        n = sum(sizes)
        self.starts = np.concatenate([[0], np.cumsum(sizes)])
        self.ids = rng.permutation(n)
        stretch = np.array([4.0, 1.0, 0.3])
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        self.means = ((rng.normal(size=(n, 3)) * stretch) @ turn * 0.05).astype(np.float32)
        self.sh = rng.normal(size=(n, 1, 3)).astype(np.float32) * np.float32(0.1)
        self.opacities = rng.uniform(0, 1, n).astype(np.float32)
        groups = [self.ids[a:b] for a, b in itertools.pairwise(self.starts)]
        self.centres = np.stack([self.means[g].mean(0, dtype=float) for g in groups])
        self.footprints = np.full(len(sizes), 0.002)
        self.groups = groups

    def arrays(self) -> tuple[np.ndarray, ...]:
        return self.starts, self.ids, self.means, self.sh, self.opacities, self.centres, self.footprints

    def children(self, count: int | np.ndarray) -> list[list[frozenset[int]]]:
        """Return the children of every group."""
        starts, ids, parents = bisect(*self.arrays(), count)
        assert (np.diff(starts) > 0).all()
        actual: list[list[frozenset[int]]] = [[] for _ in self.groups]
        for child, parent in enumerate(parents):
            actual[parent].append(frozenset(ids[starts[child] : starts[child + 1]].tolist()))
        assert (np.diff(parents) >= 0).all()
        return actual

    def features(self, group: int, rows: np.ndarray) -> np.ndarray:
        return member_features(self.means, self.sh, self.centres[group], self.footprints[group], rows)

    def weights(self, rows: np.ndarray) -> np.ndarray:
        return np.maximum(self.opacities[rows].astype(float), 1e-3)

    def error(self, group: int, parts: list[frozenset[int]]) -> float:
        """Return the weighted squared error of all children of a group."""
        rows = [np.array(sorted(p)) for p in parts]
        return sum(np.trace(scatter(self.features(group, r), self.weights(r))) for r in rows)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("count", [1, 2, 3, 4, 8])
def test_every_member_is_in_exactly_one_child(seed: int, count: int) -> None:
    case = Case(seed)
    for rows, parts in zip(case.groups, case.children(count), strict=True):
        assert sorted(i for part in parts for i in part) == sorted(rows.tolist())
        assert len(parts) == min(count, len(rows))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("coarse", "fine"), [(1, 2), (2, 3), (2, 4), (4, 8)])
def test_more_children_are_parts_of_fewer_children(coarse: int, fine: int, seed: int) -> None:
    case = Case(seed)
    for large, small in zip(case.children(coarse), case.children(fine), strict=True):
        assert all(any(part <= whole for whole in large) for part in small)


@pytest.mark.parametrize("seed", range(6))
def test_children_match_exact_eigenvectors(seed: int) -> None:
    """Seven power steps find the widest axis well enough to cut within a few percent of the exact cut's error."""
    case = Case(seed)
    for count in (2, 4):
        for group, (rows, parts) in enumerate(zip(case.groups, case.children(count), strict=True)):
            runs = split_reference(case.features(group, rows), case.weights(rows), count)
            expected = [frozenset(rows[run].tolist()) for run in runs]
            assert len(parts) == len(expected)
            assert case.error(group, parts) <= 1.1 * case.error(group, expected) + 1e-12


def test_identical_members_stay_one_child() -> None:
    case = Case(0, (12, 5))
    case.means[:], case.sh[:] = 0.5, 0.25
    assert [len(parts) for parts in case.children(8)] == [1, 1]


def test_transparent_members_are_still_dealt_out() -> None:
    case = Case(1)
    case.opacities[:] = 0
    assert [len(parts) for parts in case.children(4)] == [1, 2, 3, 4, 4]


def test_starts_of_groups_need_not_begin_at_zero() -> None:
    """A task works on a range of the groups: starts need not begin at zero."""
    case = Case(2)
    starts, ids, parents = bisect(
        case.starts[2:], case.ids, case.means, case.sh, case.opacities, case.centres[2:], case.footprints[2:], 2
    )
    parts = {frozenset(ids[a:b].tolist()) for a, b in itertools.pairwise(starts)}
    assert parts == {part for group in case.children(2)[2:] for part in group}
    assert parents.tolist() == [0, 0, 1, 1, 2, 2]


@pytest.mark.parametrize("seed", range(3))
def test_errors_of_splits_match_their_children(seed: int) -> None:
    """Colour about its mean and positions about their plane, weighted by opacity, times the number of members."""
    case = Case(seed, (1, 2, 7, 40))

    def error(group: int, rows: np.ndarray) -> float:
        weights = case.weights(rows)
        spread = len(rows) * scatter(case.features(group, rows), weights) / weights.sum()
        return float(np.trace(spread[:3, :3])) + 0.7 * max(np.linalg.eigvalsh(spread[3:, 3:])[0], 0)

    errors = split_errors(*case.arrays(), 6, 0.7)
    for count in range(1, 7):
        starts, ids, parents = bisect(*case.arrays(), count)
        actual, number = np.zeros(4), np.zeros(4)
        for child, parent in enumerate(parents):
            actual[parent] += error(parent, ids[starts[child] : starts[child + 1]])
            number[parent] += 1
        enough = number == count
        np.testing.assert_allclose(errors[enough, count - 1], actual[enough], rtol=1e-6, atol=1e-9)
        assert np.isnan(errors[~enough, count - 1]).all()


@pytest.mark.parametrize("seed", range(3))
def test_counts_of_single_groups_give_the_children_of_a_common_count(seed: int) -> None:
    case, counts = Case(seed), np.array([3, 1, 2, 5, 4])
    assert case.children(counts) == [case.children(int(count))[g] for g, count in enumerate(counts)]


def test_bits_of_halves_are_the_same_on_every_processor(each_target) -> None:  # type: ignore[no-untyped-def]
    case = Case(3, (1, 2, 3, 17, 60, 30, 30, 30))
    for i, value in enumerate((np.nan, np.inf, 1e30)):
        case.means[case.groups[5 + i][3], i] = value
    case.opacities[case.groups[4][5]] = np.nan

    def split() -> tuple[np.ndarray, ...]:
        with np.errstate(all="ignore"):
            return *bisect(*case.arrays(), 5), split_errors(*case.arrays(), 5, 0.7)

    starts, ids, _, errors = each_target(split)
    assert sorted(ids.tolist()) == sorted(case.ids.tolist())
    assert (np.diff(starts) > 0).all()
    assert np.isfinite(errors[:5, 0]).all()


def test_no_groups_have_no_children() -> None:
    case = Case(0, (1, 2))
    arrays = [np.zeros(1, np.int64), case.ids, case.means, case.sh, case.opacities, np.empty((0, 3)), np.empty(0)]
    starts, ids, parents = bisect(*arrays, 4)
    assert [starts.tolist(), ids.tolist(), parents.tolist()] == [[0], [], []]
    assert split_errors(*arrays, 4, 0.7).shape == (0, 4)


@pytest.mark.parametrize("row", [-1, 3, 2**31 - 1])
def test_ids_of_members_to_be_halved_outside_are_refused(row: int) -> None:
    case = Case(0, (1, 2))
    case.ids[1] = row
    with refuses(ValueError, "split_groups", "indices"):
        bisect(*case.arrays(), 2)


@pytest.mark.parametrize("starts", [[0, 1, 4], [-1, 1, 3], [2, 1, 3]])
def test_starts_of_groups_to_be_halved_outside_are_refused(starts: list[int]) -> None:
    _, *arrays = Case(0, (1, 2)).arrays()
    with pytest.raises(ValueError, match="split_groups: "):
        bisect(np.array(starts), *arrays, 2)


def test_count_of_zero_children_is_refused() -> None:
    with refuses(ValueError, "split_groups: counts", 0):
        bisect(*Case(0).arrays(), 0)
