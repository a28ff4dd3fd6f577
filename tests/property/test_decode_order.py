"""Children do not depend on the order of members."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import assert_same_set, make_features

from gsmerge.method.geometry.pooling import Members, gaussian_members
from gsmerge.method.kernels.elementary import exp
from gsmerge.method.stages.decode import decode
from gsmerge.settings.stages import DecodeOptions
from gsmerge.types import FeatureGaussians, Gaussians

FEW = settings(max_examples=15, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)


def random_group(rng: np.random.Generator, count: int) -> tuple[FeatureGaussians, Members]:
    """Draw one group of ``count`` members."""
    columns = (
        rng.normal(size=(count, 3)) * 0.1, rng.normal(size=(count, 4)), exp(0.3 * rng.normal(size=(count, 3)) - 4),
        rng.uniform(0.2, 0.9, count), rng.normal(size=(count, 1, 3)) * 0.3, np.zeros((count, 0, 3)),
        np.full(count, 0.02),
    )  # fmt: skip
    *values, footprints = (np.ascontiguousarray(c, np.float32) for c in columns)
    members = gaussian_members(Gaussians(*values), footprints)
    feature = make_features(members.means.mean(0, keepdims=True), sizes=0.02)
    return replace(feature, starts=np.array([0, count]), members=np.arange(count)), members


@FEW
@given(seeds, st.integers(1, 60), st.sampled_from([2, 3, 4, 8]))
def test_children_do_not_depend_on_the_order_of_members(seed: int, count: int, k: int) -> None:
    rng = np.random.default_rng(seed)
    feature, members = random_group(rng, count)
    shuffled = replace(feature, members=rng.permutation(count))
    one, other = (decode(f, members, DecodeOptions(k=k)) for f in (feature, shuffled))
    assert_same_set(one, other, atol=1e-5)
