from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gsmerge.geometry import covariances, project, quat_to_rotmat, rotmat_to_quat
from gsmerge.types import Cameras

HALF = math.sqrt(0.5)


@pytest.mark.parametrize(
    ("quat", "image_of_x"),
    [
        ([1.0, 0, 0, 0], [1.0, 0, 0]),
        ([HALF, 0, 0, HALF], [0.0, 1, 0]),  # a quarter turn about z
        ([HALF, 0, HALF, 0], [0.0, 0, -1]),  # about y
        ([HALF, HALF, 0, 0], [1.0, 0, 0]),  # about x
        ([0.0, 0, 0, 1], [-1.0, 0, 0]),
    ],
)
def test_quarter_turns(quat: list[float], image_of_x: list[float]) -> None:
    rotmat = quat_to_rotmat(torch.tensor(quat, dtype=torch.float64))
    assert torch.allclose(rotmat[:, 0], torch.tensor(image_of_x, dtype=torch.float64), atol=1e-12)


def test_rotations_are_rotations_whatever_the_length() -> None:
    quats = torch.randn(4, 50, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rotmats = quat_to_rotmat(quats)
    assert rotmats.shape == (4, 50, 3, 3)
    assert torch.allclose(rotmats @ rotmats.transpose(-1, -2), torch.eye(3).double().expand(4, 50, 3, 3), atol=1e-12)
    assert torch.allclose(torch.linalg.det(rotmats), torch.ones(4, 50).double())
    for other in (-quats, 1e-3 * quats, 1e3 * quats):
        assert torch.allclose(quat_to_rotmat(other), rotmats, atol=1e-12)


def test_covariance_by_hand() -> None:
    covar = covariances(torch.tensor([HALF, 0, 0, HALF]), torch.tensor([1.0, 2.0, 3.0]))
    assert torch.allclose(covar, torch.diag(torch.tensor([4.0, 1.0, 9.0])), atol=1e-6)


def test_projection_by_hand() -> None:
    """Eye at (1, 0, 0), looking along x: the world's y is to the left and its z up, which is -y in the image."""
    viewmat = torch.tensor([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, -1], [0, 0, 0, 1]])
    K = torch.tensor([[10.0, 0, 8], [0, 20, 6], [0, 0, 1]])
    points = torch.tensor([[3.0, 0, 0], [3, 1, 0], [3, 0, 1], [0, 0, 0]])
    where, depths = project(points, Cameras(viewmat[None], K[None], 16, 12))
    assert where.shape == (1, 4, 2)
    assert where.dtype == depths.dtype == torch.float64
    np.testing.assert_allclose(where[0, :3], [[8, 6], [3, 6], [8, -4]])
    np.testing.assert_allclose(depths[0], [2, 2, 2, -1])


def test_quaternions_of_rotations_and_back() -> None:
    """Half turns about every axis too, where a quaternion's first component is zero."""
    generator = torch.Generator().manual_seed(3)
    quats = torch.nn.functional.normalize(torch.randn(64, 4, generator=generator, dtype=torch.float64), dim=1)
    quats = torch.cat([quats, torch.eye(4, dtype=torch.float64)])
    actual = rotmat_to_quat(quat_to_rotmat(quats))
    torch.testing.assert_close((actual * quats).sum(1).abs(), torch.ones(68, dtype=torch.float64))
    assert (actual.gather(1, actual.abs().argmax(1, keepdim=True)) > 0).all()
