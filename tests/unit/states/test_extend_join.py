"""New groups that become part of those that are there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from view_batches import fed, group, parts_of, room, same_group, state_of

from gsmerge.kernels import elementary
from gsmerge.settings.stages import MatchOptions
from gsmerge.states.extend_decoded import find_partners, merge_into
from gsmerge.states.groups import limit_children, select_groups, share
from gsmerge.states.state import Colors, GroupSet


@pytest.fixture(scope="module")
def sides() -> tuple[GroupSet, GroupSet]:
    """The groups of two views each, with photos that held the first."""
    first, second = parts_of(room(4), 2)
    return share(state_of(fed([first]))).groups, share(state_of(fed([second], fit="none"))).groups


@pytest.fixture(scope="module")
def actual(sides: tuple[GroupSet, GroupSet]) -> np.ndarray:
    old, new = sides
    return find_partners(old.features, new.features, MatchOptions())


def test_partners_show_the_same_surface(sides: tuple[GroupSet, GroupSet], actual: np.ndarray) -> None:
    old, new = sides
    joins = np.flatnonzero(actual >= 0)
    assert 10 < len(joins) < len(new)
    assert len(np.unique(actual[joins])) == len(joins)  # no group gets two
    assert int(actual.max()) < len(old)
    gaps = np.linalg.norm(old.features.means[actual[joins]] - new.features.means[joins], axis=1)
    sizes = np.sqrt(np.trace(old.features.covars[actual[joins]], axis1=1, axis2=2))
    assert float(np.median(gaps / sizes)) < 1


@pytest.mark.parametrize("method", ["overlap", "aabb"])
def test_groups_of_one_side_are_never_partners(method: str) -> None:
    """All in one place: each new one gets one, and what is left over none."""
    same = scenes.make_features(np.tile([[0.0, 0, 3]], (3, 1)), sizes=0.1)
    many = scenes.make_features(np.tile([[0.0, 0, 3]], (5, 1)), sizes=0.1)
    actual = find_partners(same, many, MatchOptions(match=method))
    partners = actual[actual >= 0].tolist()
    assert len(partners) == len(set(partners)) <= 3
    assert len(partners) >= 1


def test_no_partners_without_anything_there(sides: tuple[GroupSet, GroupSet]) -> None:
    old, new = sides
    none = select_groups(old, np.zeros(0, np.int64))
    assert (find_partners(none.features, new.features, MatchOptions()) == -1).all()
    assert len(find_partners(old.features, none.features, MatchOptions())) == 0
    assert (find_partners(old.features, new.features, MatchOptions(match="none")) == -1).all()


def joined_pairs(sides: tuple[GroupSet, GroupSet], actual: np.ndarray) -> tuple[GroupSet, np.ndarray]:
    """The new groups that join, and where."""
    joins = np.flatnonzero(actual >= 0)
    return select_groups(sides[1], joins), actual[joins]


def test_what_adds_up_adds_up(sides: tuple[GroupSet, GroupSet], actual: np.ndarray) -> None:
    new, rows = joined_pairs(sides, actual)
    after = merge_into(sides[0], new, rows, 4)
    for name in ("weights", "masses", "extinctions"):
        before, fresh = getattr(sides[0].features, name), getattr(new.features, name)
        np.testing.assert_allclose(getattr(after.features, name)[rows], before[rows] + fresh, rtol=1e-5)


def test_moments_are_pooled_by_weight(sides: tuple[GroupSet, GroupSet], actual: np.ndarray) -> None:
    new, rows = joined_pairs(sides, actual)
    old, after = select_groups(sides[0], rows).features, merge_into(sides[0], new, rows, 4).features
    share = (old.weights / (old.weights + new.features.weights)).astype(np.float64)[:, None]
    means = share * old.means + (1 - share) * new.features.means
    np.testing.assert_allclose(after.means[rows], means, atol=1e-5)
    colors = share[:, None] * old.sh0 + (1 - share[:, None]) * new.features.sh0
    np.testing.assert_allclose(after.sh0[rows], colors, atol=1e-4)
    gap = (old.means - new.features.means).astype(np.float64)
    spread = (share * (1 - share))[..., None] * gap[:, :, None] * gap[:, None]
    covars = share[..., None] * old.covars + (1 - share[..., None]) * new.features.covars + spread
    np.testing.assert_allclose(after.covars[rows], covars, atol=1e-6)


def test_other_groups_keep_their_bytes(sides: tuple[GroupSet, GroupSet], actual: np.ndarray) -> None:
    new, rows = joined_pairs(sides, actual)
    after = merge_into(sides[0], new, rows, 4)
    assert len(after) == len(sides[0])
    touched = set(rows.tolist())
    assert len(touched) < len(after)
    for row in range(len(after)):
        assert same_group(after, row, sides[0], row) == (row not in touched)
    np.testing.assert_array_equal(after.features.members, np.arange(len(after.children)))


def test_children_of_both_are_kept_up_to_the_most(sides: tuple[GroupSet, GroupSet], actual: np.ndarray) -> None:
    new, rows = joined_pairs(sides, actual)
    roomy, tight = merge_into(sides[0], new, rows, 8), merge_into(sides[0], new, rows, 4)
    sizes = np.diff(roomy.features.starts)[rows]
    both = np.diff(sides[0].features.starts)[rows] + np.diff(new.features.starts)
    np.testing.assert_array_equal(sizes, both.clip(max=8))
    assert int(np.diff(tight.features.starts).max()) == 4
    row = int(rows[int(sizes.argmax())])
    _, children = group(roomy, row)
    few = limit_children(select_groups(roomy, np.array([row])), 4)
    assert len(few.children) == 4
    depth = -elementary.log1p(-children.opacities) * np.sort(children.scales, 1)[:, 1:].prod(1)
    pooled = -elementary.log1p(-few.children.opacities) * np.sort(few.children.scales, 1)[:, 1:].prod(1)
    assert float(pooled.sum()) == pytest.approx(float(depth.sum()), rel=0.1)


def test_colours_that_photos_held_stay(sides: tuple[GroupSet, GroupSet], actual: np.ndarray) -> None:
    new, rows = joined_pairs(sides, actual)
    color_precision = np.zeros(len(sides[0]), np.float32)
    color_precision[rows[::2]] = 5.0
    before = replace(sides[0], colors=Colors(sides[0].colors.sh0 + 0.3, color_precision))
    after = merge_into(before, new, rows, 4)
    np.testing.assert_array_equal(after.colors.precision, color_precision)
    np.testing.assert_array_equal(after.colors.sh0[rows[::2]], before.colors.sh0[rows[::2]])
    np.testing.assert_array_equal(after.colors.sh0[rows[1::2]], after.features.sh0[rows[1::2]])
