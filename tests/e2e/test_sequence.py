"""Moments of one place, and a result that starts from that of another moment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gsmerge
from gsmerge.research.generate import GenerateOptions, generate

MOMENTS = 3


@pytest.fixture(scope="module")
def moments(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three moments of a room in 5 views of 96 x 72. Read only."""
    folder = tmp_path_factory.mktemp("sequence") / "walk"
    generate(folder, MOMENTS, GenerateOptions(views=(5, 5), width=96, height=72, style="room", moments=MOMENTS), seed=3)
    return folder


def test_moments_differ_by_a_ball_alone(moments: Path) -> None:
    first, second = (gsmerge.read_scene(moments / f"scene_000{i}") for i in range(2))
    assert np.allclose(first.cameras.viewmats, second.cameras.viewmats, atol=1e-3)  # errors are shares of the depth
    assert first.images is not None
    assert second.images is not None
    moved = np.abs(first.images - second.images).max(-1) > 0.06
    assert 0.01 < moved.mean() < 0.3
    assert np.abs(first.images - second.images)[~moved].max() > 0  # noise of its own
    assert not np.array_equal(first.gaussians.means, second.gaussians.means)


def test_compact_goes_on_from_a_result(moments: Path, tmp_path: Path, run: Any) -> None:
    first, second = (moments / f"scene_000{i}" for i in range(2))
    run("compact", first, "-o", tmp_path / "a.ply", "--effort", "draft", "--quiet", code=0)
    call = ("compact", second, "-o", tmp_path / "b.ply", "--earlier", tmp_path / "a.ply", "--effort", "draft")
    run(*call, "--report", tmp_path / "b.json", code=0)
    assert "taken_over" in (tmp_path / "b.json").read_text()
    missing = run("compact", second, "-o", tmp_path / "c.ply", "--earlier", tmp_path / "no.ply", "--dry-run", code=3)
    assert "no.ply" in missing.err
    assert "--up" in run(*call, "--overwrite", "--up=-y", code=2).err
    assert "a.ply" in run("compact", second, "-o", tmp_path / "a.ply", "--earlier", tmp_path / "a.ply", code=2).err
