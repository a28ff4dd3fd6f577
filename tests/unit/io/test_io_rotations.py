"""Rotations that an exporter applied twice and stored with w last."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from exports import export_rows, save_export, smooth_scene, with_surface_rotations
from tiny_scene import Tiny

from gsmerge.geometry import covariances, quat_to_rotmat
from gsmerge.io import load_scene, read_scene
from gsmerge.io.alignment.rotations import square_roots

Q = torch.nn.functional.normalize


def product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Quaternions ``[n,4]`` wxyz: first b, then a."""
    w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(1, keepdim=True)
    v = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + torch.linalg.cross(a[:, 1:], b[:, 1:])
    return torch.cat([w, v], 1)


def discs(noise_degrees: float) -> Tiny:
    """Discs in a smooth surface, turned at random within it, their axes off by some degrees."""
    tiny, rng = with_surface_rotations(smooth_scene(48, 36)), torch.Generator().manual_seed(4)
    n = len(tiny.gaussians)
    spin = torch.rand(n, generator=rng) * 2 * np.pi
    within = torch.stack([(spin / 2).cos(), 0 * spin, 0 * spin, (spin / 2).sin()], 1)
    tilt = torch.randn(n, 3, generator=rng) * np.deg2rad(noise_degrees) / 2
    off = Q(torch.cat([torch.ones(n, 1), tilt], 1), dim=1)
    return replace(tiny, gaussians=replace(tiny.gaussians, quats=product(off, product(tiny.gaussians.quats, within))))


def applied_twice(tiny: Tiny) -> np.ndarray:
    """Rows with the square of each rotation, w last."""
    rows = export_rows(tiny)
    squares = product(tiny.gaussians.quats, tiny.gaussians.quats).numpy()
    for name, values in zip(("rot_3", "rot_0", "rot_1", "rot_2"), squares.T, strict=True):
        rows[name] = values
    return rows


def degrees_off(actual: torch.Tensor, tiny: Tiny) -> torch.Tensor:
    """``[n]`` angles between the thinnest axes."""
    axes = [quat_to_rotmat(quats)[:, :, 2] for quats in (actual, tiny.gaussians.quats)]
    return torch.rad2deg((axes[0] * axes[1]).sum(1).abs().clamp(max=1).acos())


def covariance_error(actual: torch.Tensor, tiny: Tiny) -> torch.Tensor:
    """``[n]`` distance of the covariances, as a share of the true ones' norm."""
    true = covariances(tiny.gaussians.quats, tiny.gaussians.scales)
    return (covariances(actual, tiny.gaussians.scales) - true).flatten(1).norm(dim=1) / true.flatten(1).norm(dim=1)


@pytest.mark.parametrize("noise", [0.0, 8.0])
def test_the_root_is_found(tmp_path: Path, noise: float) -> None:
    tiny = discs(noise)
    loaded = load_scene(save_export(tmp_path, tiny, applied_twice(tiny)))
    assert any("stored with w last and each applied twice" in note for note in loaded.notes)
    actual = loaded.pixel_scene().gaussians.quats
    assert degrees_off(actual, tiny).quantile(0.95) < 3 + 2 * noise
    assert covariance_error(actual, tiny).median() < 0.01
    assert covariance_error(actual, tiny).mean() < 0.1
    stored = read_scene(tmp_path, quats="xyzw").gaussians.quats
    assert covariance_error(stored, tiny).mean() > 0.3


def test_it_can_be_given(tmp_path: Path) -> None:
    tiny = discs(0.0)
    rows = applied_twice(tiny)
    rows["opacity"] = tiny.gaussians.opacities.numpy()
    folder = save_export(tmp_path, tiny, rows)
    for hints in ({"quats": "xyzw-root"}, {"exporter": "splatt3r"}):
        assert covariance_error(read_scene(folder, **hints).gaussians.quats, tiny).median() < 0.01


@pytest.mark.parametrize("noise", [0.0, 20.0, 40.0])
@pytest.mark.parametrize("last", [False, True])
def test_files_that_store_rotations_once(tmp_path: Path, noise: float, last: bool) -> None:
    tiny = discs(noise)
    rows = export_rows(tiny)
    if last:
        for name, values in zip(("rot_3", "rot_0", "rot_1", "rot_2"), tiny.gaussians.quats.numpy().T, strict=True):
            rows[name] = values
    notes = load_scene(save_export(tmp_path, tiny, rows)).notes
    assert not any("applied twice" in note for note in notes)
    assert last or not any("rotations are" in note for note in notes)


@pytest.mark.parametrize("spread", [0.0, 0.3])
@pytest.mark.parametrize("turns", ["random", "squared"])
def test_round_gaussians_say_nothing(tmp_path: Path, spread: float, turns: str) -> None:
    """As round as can be, or thinner along any axis by chance."""
    tiny, rng = discs(0.0), torch.Generator().manual_seed(9)
    n = len(tiny.gaussians)
    scales = 0.03 * torch.exp(spread * torch.randn(n, 3, generator=rng))
    quats = Q(torch.randn(n, 4, generator=rng), dim=1)
    quats = product(quats, quats) if turns == "squared" else quats
    tiny = replace(tiny, gaussians=replace(tiny.gaussians, scales=scales, quats=quats))
    loaded = load_scene(save_export(tmp_path, tiny, export_rows(tiny)))
    assert not any("rotations are" in note for note in loaded.notes)


def test_square_roots() -> None:
    quats = Q(torch.randn(200, 4, generator=torch.Generator().manual_seed(1)).double(), dim=1)
    quats[0] = torch.tensor([1.0, 0, 0, 0])
    quats[1] = torch.tensor([-1.0, 0, 0, 0])
    quats[2] = torch.tensor([0.0, 0, 1, 0])
    for root in square_roots(quats):
        assert torch.allclose(root.norm(dim=1), torch.ones(200).double())
        assert torch.allclose(quat_to_rotmat(product(root, root)), quat_to_rotmat(quats), atol=1e-9)
    first, second = (quat_to_rotmat(root) for root in square_roots(quats))
    assert (first - second).flatten(1).norm(dim=1).min() > 2  # half a turn apart
