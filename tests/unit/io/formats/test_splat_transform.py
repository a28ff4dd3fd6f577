"""The program splat-transform is run, or named for the formats that it converts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from messages import refuses
from splat_transform_programs import put_stand_in

from gsmerge import read_gaussians
from gsmerge.errors import GsmergeError, SceneError, UsageError
from gsmerge.io.formats import splat_transform
from gsmerge.io.formats.splat_transform import VARIABLE
from gsmerge.jobs.file_checks import check_content
from gsmerge.reading.scene_files import find_scene_files


@pytest.mark.parametrize("name", ["a.ksplat", "my meta.lcc", "meta.lcc2"])
def test_formats_that_the_program_converts_are_refused_with_its_command(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(b"\0any")
    quoted = f"'{path}'" if " " in name else path
    for read, place in ((lambda: read_gaussians(path), name), (lambda: find_scene_files(tmp_path), tmp_path)):
        with refuses(SceneError, place, f"npx {splat_transform.CONVERTER_PACKAGE} {quoted} -L 0 scene.ply"):
            read()


def test_running_the_program_where_it_is_missing_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv(VARIABLE, raising=False)
    with refuses(UsageError, "splat-transform", f"npm install -g {splat_transform.CONVERTER_PACKAGE}"):
        splat_transform.run_program("a.ply", "b.ply")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("script", "limit", "said"),
    [
        ("raise SystemExit('x\\n  Error: out of\\tmemory\\n at line 5\\nfailed')", 60, ("code 1", "out of memory")),
        ("raise SystemExit('first\\nlast')", 60, ("code 1", "last")),
        ("", 60, ("code 0", "without output")),
        ("import time; time.sleep(60)", 0.2, ("0.2", "seconds")),
    ],
    ids=["fails", "says no error", "writes nothing", "does not end"],
)
def test_a_failure_of_the_program_is_one_line(
    script: str, limit: float, said: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(splat_transform, "TIME_LIMIT", limit)
    put_stand_in(tmp_path, monkeypatch, f"#!{{python}}\n{script}\n")
    with refuses(GsmergeError, tmp_path / "splat-transform", *said):
        splat_transform.run_program("a.ply", tmp_path / "b.ply")


def test_a_meta_json_of_another_program_is_no_scene(tmp_path: Path) -> None:
    (tmp_path / "meta.json").write_text(json.dumps({"frames": []}))
    with refuses(SceneError, tmp_path, "none"):
        find_scene_files(tmp_path)
    assert check_content(tmp_path / "meta.json").kind != "Gaussians"
