"""A budget in bytes is that of the file that is written, whatever its format."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from batches import InlinePool
from sweeps import sweep

from .conftest import Run

FORMATS = ("a.ply", "a.sog", "a.spz", "a.splat", "a.glb")
QUICK = ("--effort", "draft", "--set", "fit=none", "-q")


def file_bytes(folder: Path) -> int:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return sum(path.stat().st_size for path in files if not path.name.endswith(("cameras.json", "settings.json")))


@sweep("name", FORMATS, often=2)
def test_compact_meets_a_budget_in_bytes(name: str, small_scene: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "out"
    done = run("compact", small_scene, "-o", out / name, "--budget", "40KB", *QUICK, "--json", code=0)
    size = 40_000
    assert 0.97 * size <= file_bytes(out) <= size
    document = json.loads(done.out)
    assert document["output"]["bytes"] == file_bytes(out)


@pytest.mark.slow
def test_budget_in_bytes_counts_harmonics(tmp_path: Path, small_scene: Path, run: Run) -> None:
    """They take two thirds of a .sog, or nothing: what is built first is far off."""
    from dataclasses import replace

    import numpy as np

    import gsmerge

    gaussians = gsmerge.read_ply(small_scene / "scene.ply").gaussians
    for strength in (0.0, 0.2):
        shN = np.random.default_rng(0).normal(0, strength, (len(gaussians), 15, 3)).astype(np.float32)
        folder = tmp_path / f"{strength}"
        folder.mkdir()
        gsmerge.write_ply(folder / "scene.ply", replace(gaussians, shN=shN))
        (folder / "transforms.json").write_bytes((small_scene / "transforms.json").read_bytes())
        run("compact", folder, "-o", folder / "out" / "a.spz", "--budget", "40KB", *QUICK, code=0)
        assert 0.97 * 40_000 <= file_bytes(folder / "out") <= 40_000


@pytest.mark.slow
@sweep(("name", "size"), [("a.spz", 24_000), ("a.ply", 40_000), ("a.sog", 20_000)])
def test_states_and_batches_meet_a_budget_in_bytes(
    name: str, size: int, small_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsmerge.jobs.batch.run.ProcessPool", InlinePool)
    many = ("--set", "superpixels=40%", "--set", "checkpoint=none", "-q")
    bare, filled = ("--fit", "none", "-q"), ("--set", "fill=true")
    run("extend", tmp_path / "a.gsm", small_scene, *many, code=0)
    run("compact", tmp_path / "a.gsm", "-o", tmp_path / "out" / name, "--budget", f"{size}B", *filled, *bare, code=0)
    assert 0.97 * size <= (tmp_path / "out" / name).stat().st_size <= size
    folder = tmp_path / "batch"
    size_asked = ("--budget", f"{size}B", *filled)
    run("batch", small_scene, "-o", folder, "--name", name, *size_asked, *QUICK[:-1], "--quiet", code=0)
    (written,) = folder.rglob(name)
    assert 0.97 * size <= written.stat().st_size <= size


def test_a_size_that_nothing_fits_into_is_refused(small_scene: Path, tmp_path: Path, run: Run) -> None:
    done = run("compact", small_scene, "-o", tmp_path / "a.sog", "--budget", "5B", *QUICK)
    assert done.code == 2
    assert "13 bytes" in done.err
