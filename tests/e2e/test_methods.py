"""Rival methods from the command line."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest

from gsmerge import read_ply
from gsmerge.settings.compact import method_names

from .conftest import Run, assert_refused, listing

FAKE = """#!{python}
import sys
from pathlib import Path

w, g, cpu, given, d, count, made = sys.argv[1:]
assert (w, g, cpu, d) == ("-w", "-g", "cpu", "-d")
head, rows = Path(given).read_bytes().split(b"end_header\\n", 1)
lines = head.decode().splitlines()
total = next(int(line.split()[-1]) for line in lines if line.startswith("element vertex"))
lines = [f"element vertex {{count}}" if line.startswith("element vertex") else line for line in lines]
Path(made).write_bytes("\\n".join([*lines, "end_header", ""]).encode() + rows[: len(rows) // total * int(count)])
"""


def program(folder: Path, text: str) -> Path:
    path = folder / "splat-transform"
    path.write_text(text.format(python=sys.executable))
    path.chmod(0o755)
    return path


@pytest.fixture
def copied(smallest_scene: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(smallest_scene, tmp_path / "scene"))


@pytest.mark.parametrize("method", method_names())
def test_every_method_plans_and_writes_a_ply(
    method: str, smallest_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GSMERGE_SPLAT_TRANSFORM", str(program(tmp_path, FAKE)))
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
    elif method == "voxel":
        assert 90 <= count <= 100
    else:
        assert count == 100
    assert document["psnr_input_views"]["after"] > 5
    notes = [note for note in document["notes"] if note != document["worse"] and "fog" not in note]
    assert notes == ([f"method {method} does not use budget"] if method.startswith("unmerged") else [])

    plan = json.loads(run(*words, "--dry-run", "--json").out)
    assert plan["compact"]["method"] == method
    assert plan["compact"]["seconds"] > 0
    assert plan["notes"] == []
    assert (plan["compact"]["num_gaussians"] == total) == method.startswith("unmerged")
    if method in ("gsmerge", "voxel"):
        planned = run(*words, "--dry-run", code=0).out
        assert (f"method     {method}; fit" in planned) == ("merging" not in planned) == (method != "gsmerge")


def test_the_program_may_be_on_the_path(
    smallest_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("GSMERGE_SPLAT_TRANSFORM", raising=False)
    monkeypatch.setenv("PATH", str(program(tmp_path, FAKE).parent))
    run("compact", smallest_scene, "-o", tmp_path / "a.ply", "--set", "method=splat-transform", "--budget", 50, code=0)
    assert len(read_ply(tmp_path / "a.ply").gaussians) == 50


@pytest.mark.parametrize("named", [None, "no/such/program"])
def test_a_missing_program_is_one_line(
    named: str | None, copied: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("GSMERGE_SPLAT_TRANSFORM", named or "")
    before = listing(copied)
    said = run("compact", copied, "--set", "method=splat-transform")
    found = f"GSMERGE_SPLAT_TRANSFORM={named}" if named else "GSMERGE_SPLAT_TRANSFORM"
    assert_refused(said, 2, "method splat-transform", found, "npm install -g @playcanvas/splat-transform")
    assert listing(copied) == before


@pytest.mark.parametrize(
    ("text", "found"),
    [("#!{python}\nraise SystemExit('out of\\nmemory')\n", "code 1: out of memory"), ("#!{python}\n", "code 0")],
)
def test_a_failing_program_is_one_line(
    text: str, found: str, copied: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GSMERGE_SPLAT_TRANSFORM", str(program(tmp_path, text)))
    before = listing(copied)
    assert_refused(run("compact", copied, "--set", "method=splat-transform", "--quiet"), 1, "", found)
    assert listing(copied) == before


def test_missing_photos_are_one_line(copied: Path, run: Run) -> None:
    shutil.rmtree(copied / "images")
    said = run("compact", copied, "--set", "method=unmerged-fit", "--hint", "order=none", "--quiet")
    assert_refused(said, 2, "method unmerged-fit", "photos", "--images")
