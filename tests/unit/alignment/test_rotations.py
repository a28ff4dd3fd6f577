"""Rotations that an exporter applied twice and stored with w last."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import export_rows, save_export, smooth_scene, with_surface_rotations
from sweeps import sweep
from tiny_scene import Tiny

from gsmerge.alignment.rotations import square_roots
from gsmerge.geometry import covariances, normalize, quat_to_rotmat
from gsmerge.kernels import elementary
from gsmerge.scene.read import load_scene, read_scene


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternions ``[n,4]`` wxyz: first b, then a."""
    w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(1, keepdims=True)
    v = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([w, v], 1)


def discs(noise_degrees: float) -> Tiny:
    """Discs in a smooth surface, turned at random within it, their axes off by some degrees."""
    tiny, rng = with_surface_rotations(smooth_scene(48, 36)), np.random.default_rng(4)
    n = len(tiny.gaussians)
    spin = rng.uniform(0, 2 * np.pi, n)
    within = np.stack([elementary.cos(spin / 2), 0 * spin, 0 * spin, elementary.sin(spin / 2)], 1)
    tilt = rng.normal(size=(n, 3)) * np.deg2rad(noise_degrees) / 2
    off = normalize(np.concatenate([np.ones((n, 1)), tilt], 1))
    quats = product(off, product(tiny.gaussians.quats, within)).astype(np.float32)
    return replace(tiny, gaussians=replace(tiny.gaussians, quats=quats))


def applied_twice(tiny: Tiny) -> np.ndarray:
    """Rows with the square of each rotation, w last."""
    rows = export_rows(tiny)
    squares = product(tiny.gaussians.quats, tiny.gaussians.quats)
    for name, values in zip(("rot_3", "rot_0", "rot_1", "rot_2"), squares.T, strict=True):
        rows[name] = values
    return rows


def degrees_off(actual: np.ndarray, tiny: Tiny) -> np.ndarray:
    """``[n]`` angles between the thinnest axes."""
    axes = [quat_to_rotmat(quats)[:, :, 2] for quats in (actual, tiny.gaussians.quats)]
    return np.rad2deg(elementary.arccos(np.abs((axes[0] * axes[1]).sum(1)).clip(max=1)))


def covariance_error(actual: np.ndarray, tiny: Tiny) -> np.ndarray:
    """``[n]`` distance of the covariances, as a share of the true ones' norm."""
    true = covariances(tiny.gaussians.quats, tiny.gaussians.scales)
    off = covariances(actual, tiny.gaussians.scales) - true
    return np.linalg.norm(off, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))


@pytest.mark.parametrize("noise", [0.0, 8.0])
def test_rotations_applied_twice_are_undone(tmp_path: Path, noise: float) -> None:
    tiny = discs(noise)
    loaded = load_scene(save_export(tmp_path, tiny, applied_twice(tiny)))
    assert any("applied twice" in note for note in loaded.notes)
    actual = loaded.pixel_scene().gaussians.quats
    assert np.quantile(degrees_off(actual, tiny), 0.95) < 3 + 2 * noise
    assert np.median(covariance_error(actual, tiny)) < 0.01
    assert covariance_error(actual, tiny).mean() < 0.1
    stored = read_scene(tmp_path, quats="xyzw").gaussians.quats
    assert covariance_error(stored, tiny).mean() > 0.3


@pytest.mark.parametrize("twice", [False, True])
def test_huge_positions_raise_no_warning(tmp_path: Path, twice: bool) -> None:
    tiny = discs(8.0)
    rows = applied_twice(tiny) if twice else export_rows(tiny)
    rows["x"][500:3000:500], rows["x"][504:3000:500] = 3e38, -3e38  # the pixels between overflow
    scene = read_scene(save_export(tmp_path, tiny, rows), quats="xyzw-root" if twice else "auto")
    stored = np.stack([rows[f"rot_{i}"] for i in range(4)], 1)
    assert np.isfinite(scene.gaussians.quats).all()
    assert np.allclose(scene.gaussians.quats, normalize(stored), atol=1e-6) is not twice


def test_it_can_be_given(tmp_path: Path) -> None:
    tiny = discs(0.0)
    rows = applied_twice(tiny)
    rows["opacity"] = tiny.gaussians.opacities
    folder = save_export(tmp_path, tiny, rows)
    for hints in ({"quats": "xyzw-root"}, {"exporter": "splatt3r"}):
        assert np.median(covariance_error(read_scene(folder, **hints).gaussians.quats, tiny)) < 0.01


@sweep("noise", [40.0, 0.0, 20.0])
@pytest.mark.parametrize("last", [False, True])
def test_files_that_store_rotations_once(tmp_path: Path, noise: float, last: bool) -> None:
    tiny = discs(noise)
    rows = export_rows(tiny)
    if last:
        for name, values in zip(("rot_3", "rot_0", "rot_1", "rot_2"), tiny.gaussians.quats.T, strict=True):
            rows[name] = values
    notes = load_scene(save_export(tmp_path, tiny, rows)).notes
    assert not any("applied twice" in note for note in notes)
    assert last or not any("rotations are" in note for note in notes)


@pytest.mark.parametrize(("turns", "spread"), [("random", 0.0), ("squared", 0.3)])
def test_round_gaussians_say_nothing(tmp_path: Path, spread: float, turns: str) -> None:
    tiny, rng = discs(0.0), np.random.default_rng(9)
    n = len(tiny.gaussians)
    scales = 0.03 * elementary.exp(spread * rng.normal(size=(n, 3))).astype(np.float32)
    quats = normalize(rng.normal(size=(n, 4)).astype(np.float32))
    quats = product(quats, quats) if turns == "squared" else quats
    tiny = replace(tiny, gaussians=replace(tiny.gaussians, scales=scales, quats=quats))
    loaded = load_scene(save_export(tmp_path, tiny, export_rows(tiny)))
    assert not any("rotations are" in note for note in loaded.notes)


def test_square_roots() -> None:
    quats = normalize(np.random.default_rng(1).normal(size=(200, 4)))
    quats[:3] = [(1, 0, 0, 0), (-1, 0, 0, 0), (0, 0, 1, 0)]
    for root in square_roots(quats):
        assert np.allclose(np.linalg.norm(root, axis=1), 1)
        assert np.allclose(quat_to_rotmat(product(root, root)), quat_to_rotmat(quats), atol=1e-9)
    first, second = (quat_to_rotmat(root) for root in square_roots(quats))
    assert np.linalg.norm(first - second, axis=(1, 2)).min() > 2  # half a turn apart
