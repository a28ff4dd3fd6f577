"""Gaussians as the numbers of a page match NumPy on the columns of a ``.spz``."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scenes

from gsmerge.io.formats.spz import COLOR_SCALE, spz_columns
from gsmerge.method.kernels.elementary import exp, log
from gsmerge.method.kernels.page_rows import LOOKS, pack_looks, pack_pixels
from gsmerge.types import SH_C0, Gaussians

N = 300


def numbers(moved: np.ndarray) -> np.ndarray:
    """Return sums of differences ``[c,m]`` whose sign is the lowest bit."""
    wide = moved.astype(np.int64)
    return np.cumsum((wide >> 1) ^ -(wide & 1), axis=1)


def packed_looks(given: Gaussians, rows: np.ndarray, steps: tuple[int, ...], levels: int, rest: int) -> np.ndarray:
    out = np.empty((LOOKS + rest, len(rows)), np.uint32)
    columns = (given.opacities[:, None], given.sh0[:, 0], given.scales, given.quats, given.shN.reshape(N, -1))
    pack_looks(rows, *columns, SH_C0, COLOR_SCALE, np.array(steps, np.int32), levels, out)
    return out


def some_gaussians(degree: int) -> Gaussians:
    rng = np.random.default_rng(degree)
    quats, rest = rng.normal(size=(N, 4)), rng.normal(0, 0.7, (N, (degree + 1) ** 2 - 1, 3))
    scales, opacities, sh0 = exp(rng.normal(-3, 8, (N, 3))), rng.uniform(0, 1, N), rng.normal(0, 2, (N, 1, 3))
    scales[0], quats[0] = 0, (-1, 0, 0, 0)
    columns = (rng.normal(size=(N, 3)), quats, scales, opacities, sh0, rest)
    return Gaussians(*(column.astype(np.float32) for column in columns))


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize(("steps", "levels"), [((1, 1, 1), 255), ((16, 2, 2), 31)])
def test_packed_looks_are_those_of_spz_columns(
    degree: int, steps: tuple[int, ...], levels: int, each_target: Any
) -> None:
    given, rows = some_gaussians(3), np.arange(0, N, 2)
    _, opacities, colors, scales, _, fine = spz_columns(given[rows], degree)[1]
    # pages have coarser steps than a .spz, 8 of degree 1 and 16, of bytes that are rounded first
    whole = np.round(given.shN[rows].reshape(len(rows), -1)[:, : fine.shape[1]].clip(-2, 2) * 128) + 128
    coarse = np.where(np.arange(fine.shape[1]) < 9, 8, 16)
    harmonics = ((whole + coarse // 2) // coarse * coarse).clip(0, 255)
    quats = given.quats[rows].astype(np.float64) / np.linalg.norm(given.quats[rows], axis=1, keepdims=True)
    quats *= np.where(quats[:, :1] < 0, -1, 1)
    turns = np.round(levels * (quats[:, 1:] / (1 + quats[:, :1])))
    parts = [np.round(part / step) for part, step in zip((opacities, colors, scales), steps, strict=True)]
    parts[1][:, ::2] -= parts[1][:, 1:2]
    (out,) = each_target(lambda: [packed_looks(given, rows, steps, levels, harmonics.shape[1])])
    np.testing.assert_array_equal(numbers(out).T, np.concatenate([*parts, turns, harmonics], 1))


def test_packed_pixels_have_shifts_and_depths(each_target: Any) -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(3, 16, 12), noise=0.05)
    ids, means, (width, height) = np.arange(3 * 16 * 12), scene.gaussians.means.astype(np.float32), (16, 12)
    rows, cameras = ids[5::3].copy(), scene.cameras
    out = np.empty((4, len(rows)), np.uint32)
    viewmats, Ks = cameras.viewmats.astype(np.float64), cameras.Ks.astype(np.float64)
    call = (rows, ids, means, viewmats, Ks, width, height, 8, 1024, out)

    def pack() -> list[np.ndarray]:
        assert pack_pixels(*call) == len(rows)
        return [out.copy()]

    each_target(pack)
    views, pixels = rows // (width * height), rows % (width * height)
    seen = (viewmats[views, :3, :3] @ means[rows, :, None])[..., 0] + viewmats[views, :3, 3]
    images = (Ks[views] @ seen[..., None])[..., 0]
    shifts = images[:, :2] / images[:, 2:] - np.stack([pixels % width, pixels // width], 1) - 0.5
    expected = [rows, *np.round(8 * shifts.T), np.round(1024 * log(images[:, 2]))]
    np.testing.assert_array_equal(numbers(out), expected)
    means[rows[7]] = -viewmats[0, :3, :3].T @ viewmats[0, :3, 3]  # where the camera is
    assert pack_pixels(*call) == 7
    assert pack_pixels(rows, ids, means, viewmats[:1], Ks[:1], width, height, 8, 1024, out) <= 62  # of the first view


def test_there_is_room_for_the_harmonics_that_there_are() -> None:
    with pytest.raises(ValueError, match="pack_looks"):
        packed_looks(some_gaussians(1), np.arange(N), (1, 1, 1), 255, rest=10)
