"""Targets of quality, bytes, devices and levels of detail are met from the command line and from Python."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import scenes
from batches import InlinePool
from messages import noted
from shared import write_scene
from sweeps import sweep

from gsmerge import Scene, compact, read_ply
from gsmerge.errors import UsageError
from gsmerge.settings.budget import DEVICES

from .conftest import Run


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 32, 24), noise=0.01)


def test_each_level_has_a_quarter_of_the_gaussians_of_the_one_before(
    small_scene: Path, tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "chain.ply"
    sizes = ("--levels", 3, "--set", "fit_steps=20", "--set", "superpixels=300")
    said = run("compact", small_scene, "-o", out, *sizes, "--json", code=0)
    document = json.loads(said.out)
    paths = [out, tmp_path / "chain.level1.ply", tmp_path / "chain.level2.ply"]
    counts = [len(read_ply(path).gaussians) for path in paths]
    assert all(
        0.9 * most <= count <= most for count, most in zip(counts[1:], (counts[0] // 4, counts[0] // 16), strict=True)
    )
    assert [level["num_gaussians"] for level in document["levels"]] == counts[1:]
    assert [level["path"] for level in document["levels"]] == [str(path) for path in paths[1:]]
    assert all(level["choices"]["fit"]["method"] == "full" for level in document["levels"])
    psnrs = [document["psnr_input_views"]["after"], *(level["psnr_input_views"] for level in document["levels"])]
    assert psnrs == sorted(psnrs, reverse=True)


def test_level_replaces_no_file(small_scene: Path, tmp_path: Path, run: Run) -> None:
    (tmp_path / "chain.level2.ply").write_text("mine")
    said = run("compact", small_scene, "-o", tmp_path / "chain.ply", "--levels", 3, code=2)
    assert "chain.level2.ply: exists" in said.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["chain.level2.ply"]


def test_the_finest_level_is_the_result_without_levels(scene: Scene) -> None:
    alone, chain = compact(scene, fit_steps=12), compact(scene, fit_steps=12, levels=2)
    assert scenes.identical(alone.gaussians, chain.gaussians)
    assert len(chain.coarser) == 1
    assert alone.coarser == ()


def test_budget_beyond_the_scene_makes_no_more_gaussians_than_it_has(scene: Scene) -> None:
    result = compact(scene, budget="1M", fit="none")
    assert len(result.gaussians) <= scene.num_gaussians
    assert noted(result.report.notes, "1M", f"{scene.num_gaussians:,}")
    assert not noted(compact(scene, budget=200, fit="none").report.notes, "200")


@pytest.mark.slow
def test_sizes_and_shares_limit_the_automatic_count(tmp_path: Path, run: Run) -> None:
    """No more Gaussians are taken than new views gain from, unless all are asked for; a number is met exactly."""
    scene = write_scene(tmp_path / "scene", num_views=5, width=24, height=16)
    out, quick = tmp_path / "limited.ply", ("--set", "fit_steps=8", "--overwrite", "--json")

    def compacted(*words: object) -> tuple[int, list[str]]:
        document = json.loads(run("compact", scene, "-o", out, *words, *quick, code=0).out)
        return document["output"]["num_gaussians"], [note for note in document["notes"] if "new views better" in note]

    auto, said = compacted("--budget", "auto")
    assert said == []
    for limit in ("40%", "1MB", "quest3"):
        count, said = compacted("--budget", limit)
        assert count == auto
        assert len(said) == 1
        assert limit in said[0]
    total = len(read_ply(scene / "scene.ply").gaussians)
    assert compacted("--budget", "40%", "--set", "fill=true") == (int(0.4 * total), [])
    assert compacted("--budget", auto + 200) == (auto + 200, [])
    assert compacted("--budget", "2%") == (int(0.02 * total), [])


def test_psnr_target_is_met_with_fewer_gaussians(scene: Scene) -> None:
    usual = compact(scene, fit_steps=20)
    expected = usual.report.psnr_after - 1
    actual = compact(scene, fit_steps=20, quality=f"{expected}dB")
    assert actual.report.unmet is None
    assert actual.report.psnr_after >= expected
    assert len(actual.gaussians) < len(usual.gaussians)
    assert actual.report.choices["search"]["met"]


def test_psnr_target_is_measured_on_photos_left_out() -> None:
    """Of four or more; the result is made of all views, with the number that two builds without some reach it with."""
    wide = scenes.make_scene(scenes.room(), scenes.arc(6, 32, 24), noise=0.01)
    easy, hard = (compact(wide, fit_steps=20, quality=asked, checkpoint="none").report for asked in ("12dB", "50dB"))
    search = easy.choices["search"]
    assert easy.unmet is None
    assert search["met"]
    assert search["left_out"] == 1
    assert len(search["tried"]) <= 3
    assert easy.num_output == search["count"]
    assert "left out reach" in hard.unmet
    assert noted(easy.notes, "quality: photos that the search left out reach")
    assert hard.psnr_after > max(psnr for _, psnr in hard.choices["search"]["tried"])  # own photos, which the fit saw


def test_target_out_of_reach_ends_with_code_4_and_the_best_result(small_scene: Path, tmp_path: Path, run: Run) -> None:
    out = tmp_path / "best.ply"
    said = run(
        "compact", small_scene, "-o", out, "--quality", "90dB", "--set", "fit_steps=8", "--budget", "20KB", code=4
    )
    assert "quality: 90 dB " in said.err
    assert len(read_ply(out).gaussians) > 0
    assert out.stat().st_size <= 20_000
    assert str(out) in said.out


@pytest.mark.slow
def test_psnr_loss_is_read_off_a_curve(scene: Scene) -> None:
    result = compact(scene, fit_steps=6, quality="-2dB")
    curve = result.report.choices["curve"]
    assert curve[0]["count"] < len(result.gaussians) < curve[-1]["count"]
    assert [point["count"] for point in curve] == sorted(point["count"] for point in curve)
    assert all(0 < point["psnr"] < 60 and 0 < point["ssim"] <= 1 for point in curve)


def test_auto_without_a_fit_reports_its_curve(small_scene: Path, tmp_path: Path, run: Run) -> None:
    said = run("compact", small_scene, "-o", tmp_path / "a.ply", "--budget", "auto", "--fit", "none", code=0)
    assert len(re.findall(r"^ *[\d,]+  +\d+\.\d\d  \d\.\d{3}", said.out, re.MULTILINE)) == 4


def test_budget_of_a_device_limits_the_count(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    assert scenes.identical(compact(scene, fit="none", budget="quest3").gaussians, compact(scene, fit="none").gaussians)
    monkeypatch.setitem(DEVICES, "quest3", 30)
    assert len(compact(scene, fit_steps=12, budget="quest3").gaussians) == 30


def test_quality_without_photos_is_measured_against_the_input(scene: Scene) -> None:
    rows = replace(scene, images=None, pixels=None)
    low, high = (compact(rows, quality=quality, fit_steps=20).report for quality in ("20dB", "28dB"))
    for report, asked in ((low, 20), (high, 28)):
        assert report.unmet is None
        assert asked <= report.choices["fidelity"]["psnr"] == report.choices["search"]["psnr"]
    assert low.num_output < high.num_output
    with pytest.raises(UsageError, match=r"35dB.*photos"):
        compact(rows, quality="-0.2dB")


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
