"""Any picture and budget gives the exact count with every view kept, and smaller budgets nest in larger ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import make_features
from skimage.measure import label as connected_parts

from gsmerge.method.geometry.pooling import Members, gaussian_members
from gsmerge.method.stages.decode import split_counts
from gsmerge.method.stages.segment import RegionTree, SegmentOptions, cut_tree, region_tree, segment
from gsmerge.types import FeatureGaussians, Gaussians, Groups

FEW = settings(max_examples=25, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)


def random_tree(seed: int, num_views: int, colours: int) -> RegionTree:
    """Draw a tree of small views; few colours and depths make ties, some pixels do not count."""
    rng = np.random.default_rng(seed)
    height, width = rng.integers(3, 16, 2)
    shape = (num_views, height, width)
    images = (rng.integers(0, colours, (*shape, 3)) / max(colours - 1, 1)).astype(np.float32)
    depths = (1.0 + rng.integers(0, colours, shape)).astype(np.float32)
    valid = rng.random(shape) > 0.2
    groups = segment(images, SegmentOptions(), int(rng.integers(1, height * width + 1)))
    return region_tree(images, depths, groups, valid)


def is_union_of(coarse: Groups, fine: Groups) -> bool:
    for view, count in enumerate(fine.counts):
        pairs = np.stack([fine.labels[view].ravel(), coarse.labels[view].ravel()])
        if np.unique(pairs, axis=1).shape[1] != count:
            return False
    return True


@FEW
@given(seeds, st.integers(1, 4), st.integers(1, 5), st.floats(0, 1), st.floats(0, 1))
def test_cuts_have_exact_counts_that_nest(seed: int, num_views: int, colours: int, low: float, high: float) -> None:
    tree = random_tree(seed, num_views, colours)
    few, many = sorted(num_views + int(share * (len(tree) - num_views)) for share in (low, high))
    coarse, fine = cut_tree(tree, few), cut_tree(tree, many)
    for groups, count in ((coarse, few), (fine, many)):
        assert sum(groups.counts) == count
        assert min(groups.counts) >= 1
        for view, own in enumerate(groups.counts):
            labels = groups.labels[view]
            assert np.array_equal(np.unique(labels), np.arange(own))
            assert connected_parts(labels, connectivity=1, background=-1).max() == own
    assert is_union_of(coarse, fine)
    assert is_union_of(fine, tree.groups)
    assert (np.diff(tree.distortions) >= 0).all()


def random_groups(seed: int) -> tuple[FeatureGaussians, Members]:
    """Draw up to 12 groups of up to 20 members, some of them alike."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 20, rng.integers(1, 12))
    n, g = int(sizes.sum()), len(sizes)
    colours = rng.integers(0, 3, (n, 1, 3)) if seed % 2 else rng.normal(size=(n, 1, 3))
    columns = (rng.normal(size=(n, 3)) * 0.01, np.eye(4)[np.zeros(n, int)], np.full((n, 3), 0.01), rng.random(n))
    harmonics = colours, np.zeros((n, 0, 3))
    gaussians = Gaussians(*(np.ascontiguousarray(c, np.float32) for c in (*columns, *harmonics)))
    members = gaussian_members(gaussians, np.full(n, 0.01, np.float32))
    features = make_features(rng.normal(size=(g, 3)) * 0.01)
    starts = np.concatenate([[0], np.cumsum(sizes)])
    return replace(features, starts=starts, members=np.arange(n)), members


@FEW
@given(seeds, st.integers(0, 60), st.integers(0, 60), st.integers(1, 8))
def test_split_counts_are_exact_and_grow_with_the_budget(seed: int, one: int, other: int, max_children: int) -> None:
    features, members = random_groups(seed)
    most = split_counts(features, members, 10**6, max_children)
    few, many = (split_counts(features, members, extra, max_children) for extra in sorted((one, other)))
    assert few.sum() == min(len(features) + min(one, other), most.sum())
    assert many.sum() == min(len(features) + max(one, other), most.sum())
    assert (few <= many).all()
    assert (many <= most).all()
    assert (few >= 1).all()
