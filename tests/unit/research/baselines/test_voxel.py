"""Voxels against means taken one by one."""

from __future__ import annotations

import numpy as np
import pytest
from clouds import some

from gsmerge import Gaussians
from gsmerge.geometry import normalize, quat_to_rotmat
from gsmerge.kernels.elementary import exp, log
from gsmerge.research.baselines.voxel import fuse, voxel_keys, voxel_size


def slow_voxels(gaussians: Gaussians, size: float) -> dict[tuple[int, ...], dict[str, np.ndarray]]:
    """Voxel -> its weighted means."""
    actual: dict[tuple[int, ...], list[int]] = {}
    for row, mean in enumerate(gaussians.means.astype(np.float64)):
        actual.setdefault(tuple(round(x / size) for x in mean), []).append(row)
    result = {}
    for voxel, rows in actual.items():
        opacities = gaussians.opacities[rows].astype(np.float64)
        shares = exp(opacities) / exp(opacities).sum()
        logit = sum(w * log(a / (1 - a)) for w, a in zip(shares, opacities, strict=True))
        result[voxel] = {
            "means": sum(w * gaussians.means[r].astype(np.float64) for w, r in zip(shares, rows, strict=True)),
            "scales": exp(
                sum(w * log(gaussians.scales[r].astype(np.float64)) for w, r in zip(shares, rows, strict=True))
            ),
            "opacities": 1 / (1 + exp(-logit)),
            "sh0": sum(w * gaussians.sh0[r].astype(np.float64) for w, r in zip(shares, rows, strict=True)),
            "shN": sum(w * gaussians.shN[r].astype(np.float64) for w, r in zip(shares, rows, strict=True)),
        }
    return result


@pytest.mark.parametrize("size", [0.3, 1.0, 5.0])
@pytest.mark.parametrize("degree", [0, 1])
def test_voxels_are_weighted_means(size: float, degree: int) -> None:
    gaussians = some(300, degree=degree)
    fused, slow = fuse(gaussians, voxel_keys(gaussians.means.astype(np.float64), size)), slow_voxels(gaussians, size)
    assert len(fused) == len(slow)
    for row, voxel in enumerate(sorted(slow)):
        for name, value in slow[voxel].items():
            np.testing.assert_allclose(getattr(fused, name)[row], value, atol=1e-5, err_msg=name)


def test_rotations_are_averaged_whatever_their_sign() -> None:
    two = some(2)
    near = normalize(np.array([[1.0, 0.1, 0, 0], [-1.0, 0.1, 0, 0]], np.float32))
    same = Gaussians(two.means, near, two.scales, np.full(2, 0.5, np.float32), two.sh0, two.shN)
    fused = fuse(same, np.zeros(2, np.int64))
    np.testing.assert_allclose(quat_to_rotmat(fused.quats)[0], np.eye(3), atol=1e-6, rtol=0)


@pytest.mark.parametrize("count", [1, 7, 100, 299, 300, 1000])
def test_sizes_meet_the_count_from_below(count: int) -> None:
    means = some(300).means.astype(np.float64)

    def occupied(size: float) -> int:
        return len(np.unique(voxel_keys(means, size)))

    size = voxel_size(means, count)
    assert occupied(size) <= count
    assert occupied(size) >= 0.9 * min(count, 300)


@pytest.mark.parametrize("spread", [0.0, 1e-9, 1e9])
def test_sizes_of_hostile_scenes(spread: float) -> None:
    means = spread * some(50).means.astype(np.float64)
    keys = voxel_keys(means, voxel_size(means, 10))
    assert 1 <= len(np.unique(keys)) <= 10
