"""Rival methods run from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from splat_transform_programs import put_stand_in, run_here

from gsmerge import read_ply
from gsmerge.settings.compact import method_names

from .conftest import Run, assert_refused, listing


@pytest.mark.parametrize("method", method_names())
def test_every_method_writes_a_ply(
    method: str, smallest_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_here(monkeypatch, put_stand_in(tmp_path, monkeypatch))
    out, settings = tmp_path / "small.ply", ["--set", "fit_steps=8"] if method == "unmerged-fit" else []
    words = ("compact", smallest_scene, "--set", f"method={method}")
    said = run(*words, "-o", out, "--budget", 100, *settings, "--json", code=0)
    document, total = json.loads(said.out), 3 * 24 * 16
    count = len(read_ply(out).gaussians)
    assert document["options"]["method"] == method
    assert document["output"]["num_gaussians"] == count
    if method == "unmerged":
        assert count == total
    elif method == "unmerged-fit":
        assert 100 < count <= total
    else:
        assert count == 100
    assert document["psnr_input_views"]["after"] > 5
    notes = [note for note in document["notes"] if note != document["worse"] and "fog" not in note]
    assert notes == ([f"method {method} does not use budget"] if method.startswith("unmerged") else [])


@pytest.mark.parametrize("method", method_names())
def test_every_method_has_a_plan(
    method: str, smallest_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_here(monkeypatch, put_stand_in(tmp_path, monkeypatch))
    words = ("compact", smallest_scene, "--set", f"method={method}")
    plan = json.loads(run(*words, "--dry-run", "--json").out)
    assert plan["compact"]["method"] == method
    assert plan["compact"]["seconds"] > 0
    assert plan["notes"] == []
    assert (plan["compact"]["num_gaussians"] == 3 * 24 * 16) == method.startswith("unmerged")
    if method in ("gsmerge", "random"):
        planned = run(*words, "--dry-run", code=0).out
        assert (f"method     {method}; fit" in planned) == ("merging" not in planned) == (method != "gsmerge")


def test_splat_transform_is_found_on_the_path(
    smallest_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(put_stand_in(tmp_path, monkeypatch).parent))
    monkeypatch.delenv("GSMERGE_SPLAT_TRANSFORM")
    run("compact", smallest_scene, "-o", tmp_path / "a.ply", "--set", "method=splat-transform", "--budget", 50, code=0)
    assert len(read_ply(tmp_path / "a.ply").gaussians) == 50


def test_failure_of_splat_transform_is_one_line(
    smallest_copy: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_stand_in(tmp_path / "program", monkeypatch, "#!{python}\nraise SystemExit('Error: out of\\nmemory')\n")
    before = listing(smallest_copy)
    said = run("compact", smallest_copy, "--set", "method=splat-transform", "--quiet")
    assert_refused(said, 1, tmp_path / "program" / "splat-transform", "code 1: out of")
    assert listing(smallest_copy) == before
