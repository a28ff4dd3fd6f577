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


@pytest.mark.parametrize("method", method_names())
def test_every_method_writes_a_ply(
    method: str, made_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GSMERGE_SPLAT_TRANSFORM", str(program(tmp_path, FAKE)))
    out, settings = tmp_path / "small.ply", ["--set", "fit_steps=8"] if method == "unmerged-fit" else []
    said = run(
        "compact", made_scene, "-o", out, "--set", f"method={method}", "--budget", 400, *settings, "--json", code=0
    )
    document, total = json.loads(said.out), 5 * 96 * 64
    count = len(read_ply(out).gaussians)
    assert document["options"]["method"] == method
    assert document["output"]["num_gaussians"] == count
    if method == "unmerged":
        assert count == total
    elif method == "unmerged-fit":
        assert 400 < count <= total
    elif method == "voxel":
        assert 380 <= count <= 400
    else:
        assert count == 400
    assert document["psnr_input_views"]["after"] > 5
    notes = [note for note in document["notes"] if note != document["worse"]]
    assert notes == ([f"method {method} does not use budget"] if method.startswith("unmerged") else [])


def test_the_program_may_be_on_the_path(
    made_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("GSMERGE_SPLAT_TRANSFORM", raising=False)
    monkeypatch.setenv("PATH", str(program(tmp_path, FAKE).parent))
    out = tmp_path / "small.ply"
    said = run("compact", made_scene, "-o", out, "--set", "method=splat-transform", "--budget", 50, "--json", code=0)
    assert len(read_ply(out).gaussians) == 50
    assert "reduce" in json.loads(said.out)["seconds"]


@pytest.mark.parametrize("named", [None, "no/such/program"])
def test_a_missing_program_is_one_line(
    named: str | None, small_copy: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("GSMERGE_SPLAT_TRANSFORM", named or "")
    before = listing(small_copy)
    said = run("compact", small_copy, "--set", "method=splat-transform")
    found = f"GSMERGE_SPLAT_TRANSFORM={named}" if named else "GSMERGE_SPLAT_TRANSFORM"
    assert_refused(said, 2, "method splat-transform", found, "npm install -g @playcanvas/splat-transform")
    assert listing(small_copy) == before


@pytest.mark.parametrize(
    ("text", "found"),
    [("#!{python}\nraise SystemExit('out of\\nmemory')\n", "code 1: out of memory"), ("#!{python}\n", "code 0")],
)
def test_a_failing_program_is_one_line(
    text: str, found: str, small_copy: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GSMERGE_SPLAT_TRANSFORM", str(program(tmp_path, text)))
    before = listing(small_copy)
    assert_refused(run("compact", small_copy, "--set", "method=splat-transform", "--quiet"), 1, "", found)
    assert listing(small_copy) == before


def test_missing_photos_are_one_line(small_copy: Path, run: Run) -> None:
    shutil.rmtree(small_copy / "images")
    said = run("compact", small_copy, "--set", "method=unmerged-fit", "--hint", "order=none", "--quiet")
    assert_refused(said, 2, "method unmerged-fit", "photos", "--images")


@pytest.mark.parametrize("method", method_names())
def test_a_plan_names_the_method(
    method: str, small_scene: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GSMERGE_SPLAT_TRANSFORM", str(program(tmp_path, FAKE)))
    said = run("compact", small_scene, "--set", f"method={method}", "--dry-run", "--budget", 400, code=0)
    assert (f"method     {method}; fit" in said.out) == (method != "gsmerge")
    assert ("merging" in said.out) == (method == "gsmerge")
    document = json.loads(run("compact", small_scene, "--set", f"method={method}", "--dry-run", "--json").out)
    assert document["compact"]["method"] == method
    assert document["compact"]["seconds"] > 0
    assert document["notes"] == []
    kept = document["compact"]["num_gaussians"]
    assert (kept == 5 * 48 * 32) == method.startswith("unmerged")
