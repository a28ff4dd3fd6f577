"""Recursive bisection and the errors of its children match slow, obvious numpy in float64."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from messages import refuses

from gsmerge.kernels.gaussians.pool import bisect, split_errors
from gsmerge.types import SH_C0


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


def test_the_bits_are_the_same_on_every_processor(each_target) -> None:  # type: ignore[no-untyped-def]
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
def test_ids_of_members_outside_are_refused(row: int) -> None:
    case = Case(0, (1, 2))
    case.ids[1] = row
    with refuses(ValueError, "split_groups", "indices"):
        bisect(*case.arrays(), 2)


@pytest.mark.parametrize("starts", [[0, 1, 4], [-1, 1, 3], [2, 1, 3]])
def test_starts_of_groups_outside_are_refused(starts: list[int]) -> None:
    _, *arrays = Case(0, (1, 2)).arrays()
    with pytest.raises(ValueError, match="split_groups: "):
        bisect(np.array(starts), *arrays, 2)


def test_count_of_zero_children_is_refused() -> None:
    with refuses(ValueError, "split_groups: counts", 0):
        bisect(*Case(0).arrays(), 0)
