"""Fits have exact counts, and reach floors (floors.csv, dB) on photos that the scene was not made from."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from scripts import target_psnr
from shared import write_made
from sweeps import sweep

import gsmerge
from gsmerge.results.result import CompactResult

NUM_VIEWS = 5


@pytest.fixture(scope="module")
def compacted(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., tuple[CompactResult, float]]:
    """Return ``compacted(k=2)``: the result, and its PSNR (dB) on the targets; each is made once."""
    folder = write_made(tmp_path_factory.mktemp("fit") / "scene")
    scene, out = gsmerge.read_scene(folder), folder / "small.ply"

    @cache
    def call(**settings: Any) -> tuple[CompactResult, float]:
        result = gsmerge.compact(scene, **settings)
        gsmerge.write_ply(out, result.gaussians, overwrite=True)
        return result, target_psnr(folder / "targets", out)

    return call


@sweep(
    ("superpixels", "settings"),
    [(256, {}), (256, {"fit_steps": 300}), (256, {"k": 2}), (64, {})],
    ids=["defaults", "fit_steps=300", "k=2", "a quarter of the superpixels"],
)
def test_full_fit_reaches_the_floor_with_no_more_than_the_count(
    superpixels: int,
    settings: dict[str, Any],
    compacted: Callable[..., tuple[CompactResult, float]],
    floor: Callable[..., None],
) -> None:
    result, actual = compacted(superpixels=superpixels, **settings)
    assert result.report.choices["fit"]["method"] == "full"
    most = NUM_VIEWS * superpixels * settings.get("k", 1)
    assert 0.8 * most < len(result.gaussians) <= most
    floor(actual)


@sweep("steps", [20, 72])
def test_short_fits_reach_the_floor(
    steps: int, compacted: Callable[..., tuple[CompactResult, float]], floor: Callable[..., None]
) -> None:
    """They do not grow: what matching merges, nearly half of them here, is not spent again."""
    result, actual = compacted(superpixels=256, fit_steps=steps)
    assert 0.5 * NUM_VIEWS * 256 <= len(result.gaussians) <= 0.8 * NUM_VIEWS * 256
    floor(actual)


@pytest.mark.slow
@sweep("seed", [0, 1, 2])
def test_full_fit_beats_the_merge_alone(
    seed: int, compacted: Callable[..., tuple[CompactResult, float]], floor: Callable[..., None]
) -> None:
    none, full = (compacted(superpixels=256, fit=fit, checkpoint="none", seed=seed)[1] for fit in ("none", "full"))
    floor(full - none)


def test_plain_merging_reaches_the_floor(
    compacted: Callable[..., tuple[CompactResult, float]], floor: Callable[..., None]
) -> None:
    result, actual = compacted(superpixels=256, fit="none")
    assert len(result.gaussians) <= NUM_VIEWS * 256
    floor(actual)


def test_gain_over_the_input_reaches_the_floor(
    compacted: Callable[..., tuple[CompactResult, float]], made_scene: Path, floor: Callable[..., None]
) -> None:
    floor(compacted(superpixels=256)[1] - target_psnr(made_scene / "targets", made_scene / "scene.ply"))
