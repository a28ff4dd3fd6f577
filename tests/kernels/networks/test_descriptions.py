"""What the networks read matches the formulas, one Gaussian after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest
from messages import refuses
from network_fixtures import Made, made

from gsmerge.method.geometry.pooling import feature_to_gaussians
from gsmerge.method.geometry.transforms import quat_to_rotmat
from gsmerge.method.kernels.elementary import log
from gsmerge.method.networks.corrections import move_features, move_gaussians
from gsmerge.method.networks.options import FEATURE, MEMBER_COLUMNS, PART_COLUMNS, RESIDUAL
from gsmerge.method.networks.tokens import GroupFeatures, compute_group_features, contiguous, part_tokens
from gsmerge.method.stages.merge import take_features
from gsmerge.types import SH_C0, Gaussians

Each = Callable[..., list[np.ndarray]]


@pytest.fixture(scope="module")
def some() -> Made:
    return made()


def described(some: Made) -> GroupFeatures:
    return compute_group_features(some.features, some.members, some.scene.cameras)


def arrays_of(features: GroupFeatures) -> list[np.ndarray]:
    return [features.frames, features.sizes, features.group]


def slow_frame(mean: np.ndarray, viewmat: np.ndarray) -> np.ndarray:
    rotation = viewmat[:3, :3]
    away = mean - -rotation.T @ viewmat[:3, 3]
    away = away / np.linalg.norm(away) if np.linalg.norm(away) > 1e-12 else rotation[2]
    right = rotation[0] - rotation[0] @ away * away
    if np.linalg.norm(right) <= 1e-3:
        right = rotation[2] - rotation[2] @ away * away
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(away, right), away], 1)


def arcsinh(values: np.ndarray) -> np.ndarray:
    return np.sign(values) * log(np.abs(values) + np.sqrt(values * values + 1))


def logit(opacity: float) -> float:
    inside = min(max(float(opacity), 1e-4), 1 - 1e-4)
    return log(inside / (1 - inside))


def slow_group(features: GroupFeatures, row: int, viewmat: np.ndarray) -> list[float]:
    """Return the first 19 numbers of a group, see the kernel."""
    f, base = features.features, features.base
    mean, pixel, size = (np.float64(x[row]) for x in (base.means, f.footprints, features.sizes))
    frame, count = slow_frame(mean, viewmat), int(np.diff(f.starts)[row])
    local = arcsinh(frame.T @ f.covars[row].astype(np.float64) @ frame / size**2)
    place = viewmat[:3, :3] @ mean + viewmat[:3, 3]
    numbers = [*np.clip(log(base.scales[row] / pixel), -12, 12) / 4, logit(base.opacities[row]) / 3]
    numbers += [log(f.masses[row] / pixel**3) / 10, log(f.extinctions[row] / pixel**2) / 10, log(count) / 4]
    numbers += [f.weights[row] / count, *(SH_C0 * base.sh0[row, 0]), *local[np.triu_indices(3)]]
    return [*numbers, *np.clip(place[:2] / max(place[2], 1e-6), -3, 3)]


def slow_part(features: GroupFeatures, parts: Gaussians, part: int, owner: int) -> list[float]:
    """Return the numbers of a part relative to a group, as a member."""
    base, frame = features.base, features.frames[owner].astype(np.float64)
    size, pixel = float(features.sizes[owner]), float(features.footprints[owner])
    offset = frame.T @ (parts.means[part].astype(np.float64) - base.means[owner])
    scales = np.sort(parts.scales[part].astype(np.float64))
    normal = frame.T @ quat_to_rotmat(parts.quats[part].astype(np.float64))[:, np.argmin(parts.scales[part])]
    normal *= -(1 - scales[0] / scales[1]) * np.sign(normal[2])
    color = SH_C0 * (parts.sh0[part, 0].astype(np.float64) - base.sh0[owner, 0])
    numbers = [*arcsinh(offset / size), *np.clip(log(scales / pixel), -12, 12) / 4]
    numbers += [logit(parts.opacities[part]) / 3, *color, *normal]
    return [*numbers, *arcsinh(offset / pixel), *(SH_C0 * parts.sh0[part, 0])]


def test_descriptions_of_groups_match_the_formulas(some: Made, each_target: Each) -> None:
    frames, sizes, group = each_target(lambda: arrays_of(described(some)))
    features = described(some)
    viewmats = some.scene.cameras.viewmats[features.views]
    for row in range(0, len(some.features), 5):
        np.testing.assert_allclose(frames[row], slow_frame(features.base.means[row], viewmats[row]), atol=1e-6)
        expected = slow_group(features, row, viewmats[row])
        np.testing.assert_allclose(group[row, :19], expected, atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(sizes, np.sqrt(np.sort(features.base.scales, 1)[:, 1:].prod(1)), rtol=1e-6)
    nothing = compute_group_features(
        take_features(some.features, np.zeros(0, np.int64)), some.members, some.scene.cameras
    )
    assert nothing.group.shape == (0, group.shape[1])


def test_points_at_a_camera_or_on_its_axis_have_frames(some: Made) -> None:
    """Have frames, too: what is seen along the image's own right is level with the ray ahead."""
    features, viewmat = take_features(some.features, np.arange(3)), some.scene.cameras.viewmats[0]
    rotation, centre = viewmat[:3, :3], some.scene.cameras.centres[0]
    means = np.stack([centre, centre + rotation[2], centre + rotation[0]]).astype(np.float32)
    frames = compute_group_features(replace(features, means=means), some.members, some.scene.cameras).frames
    np.testing.assert_allclose(frames.swapaxes(1, 2) @ frames, np.tile(np.eye(3), (3, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(frames[1], rotation.T, atol=1e-5)


def test_tokens_of_parts_match_the_formulas(some: Made, each_target: Each) -> None:
    features, parts = described(some), contiguous(feature_to_gaussians(some.features))
    rng = np.random.default_rng(0)
    parts = replace(parts, quats=rng.normal(size=parts.quats.shape).astype(np.float32))
    parts = replace(parts, scales=rng.permuted(parts.scales, axis=1))
    ids, owners = rng.integers(0, len(parts), (2, 50))
    members, relative, wide = each_target(
        lambda: [
            part_tokens(parts, ids, owners, features, columns)
            for columns in (MEMBER_COLUMNS, PART_COLUMNS, PART_COLUMNS + 3)
        ]
    )
    expected = [slow_part(features, parts, *pair) for pair in zip(ids, owners, strict=True)]
    np.testing.assert_allclose(members, expected, atol=1e-5, rtol=1e-5)
    assert np.array_equal(members[:, :PART_COLUMNS], relative)
    assert np.array_equal(wide[:, :PART_COLUMNS], relative)
    assert not wide[:, PART_COLUMNS:].any()


@pytest.mark.parametrize("odd", [np.nan, np.inf, -np.inf, 0.0, 3e38])
def test_descriptions_of_odd_numbers_are_finite(some: Made, odd: float, each_target: Each) -> None:
    names = ("means", "covars", "masses", "extinctions", "weights", "footprints", "sh0")
    columns = {name: getattr(some.features, name).copy() for name in names}
    for column in columns.values():
        column[::2] = odd
    changed = replace(some, features=replace(some.features, **columns))
    with np.errstate(all="ignore"):
        group = each_target(lambda: arrays_of(described(changed))[2:])[0]
        features = described(changed)
    assert np.isfinite(group).all()
    parts = contiguous(feature_to_gaussians(some.features))
    for f in fields(parts):
        getattr(parts, f.name)[1::2] = odd
    ids = np.arange(len(parts))
    tokens = each_target(lambda: [part_tokens(parts, ids, ids[::-1].copy(), features, MEMBER_COLUMNS)])[0]
    assert np.isfinite(tokens).all()


def test_ids_outside_are_refused(some: Made) -> None:
    features = described(some)
    ids = np.zeros(3, np.int64)
    for wrong in (-1, len(some.features)):
        bad = np.array([0, wrong, 0])
        for name, pair in (("ids", (bad, ids)), ("owners", (ids, bad))):
            with refuses(ValueError, f"describe_parts: {name}", wrong):
                part_tokens(features.base, *pair, features)
        with refuses(ValueError, "correct_gaussians: owners", wrong):
            move_gaussians(features.base[:3], np.zeros((3, RESIDUAL), np.float32), bad, features.frames)
    with pytest.raises(ValueError, match="describe_parts"):
        part_tokens(features.base, ids, ids, features, PART_COLUMNS - 1)


def test_corrections_have_the_same_bits(some: Made, each_target: Each) -> None:
    features = described(some)
    residuals = np.random.default_rng(0).normal(size=(len(some.features), FEATURE)).astype(np.float32)
    residuals[::7] *= 30
    residuals[3] = np.nan
    own = np.arange(len(residuals))

    def run() -> list[np.ndarray]:
        moved = move_features(some.features, features.base, residuals, features.frames)
        gaussians = move_gaussians(features.base, residuals[:, :RESIDUAL].copy(), own, features.frames)
        return [moved.means, moved.covars, moved.masses, moved.extinctions, *vars(gaussians).values()]

    with np.errstate(all="ignore"):
        assert all(np.isfinite(column[4]).all() for column in each_target(run))
