"""Formats that the program splat-transform reads and writes in our place, with it, with a stand-in, and without."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scenes
from messages import refuses
from slow_readers import corners, drawn
from splat_transform_programs import (
    needs_program,
    put_stand_in,
    write_ksplat,
    write_lcc,
    write_lcc2,
    write_sog_1,
    write_unbundled,
)

from gsmerge import Gaussians, Scene, read_gaussians
from gsmerge.errors import GsmergeError, SceneError, UsageError
from gsmerge.inspection.file_checks import check_content
from gsmerge.io import write_ply
from gsmerge.io.formats import splat_transform
from gsmerge.io.formats.arrays import to_columns
from gsmerge.io.formats.splat_transform import VARIABLE
from gsmerge.scene.files import find_scene_files

from .test_write import psnr

PACKAGE = "@playcanvas/splat-transform@3.7"


def sog_1(folder: Path, gaussians: Gaussians) -> Path:
    write_sog_1(folder, gaussians)
    return folder / "meta.json"


def sog_2(folder: Path, gaussians: Gaussians) -> Path:
    write_unbundled(folder, to_columns(gaussians, 3))
    return folder / "meta.json"


def ksplat(folder: Path, gaussians: Gaussians) -> Path:
    folder.mkdir()
    write_ksplat(folder / "a.ksplat", gaussians)
    return folder / "a.ksplat"


MAKERS: dict[str, Callable[[Path, Gaussians], Path]] = {
    ".ksplat": ksplat, "SOG 1": sog_1, "SOG 2": sog_2, ".lcc": write_lcc, ".lcc2": write_lcc2,
}  # fmt: skip
PSNR = {".ksplat": 48, "SOG 1": 34, "SOG 2": 35}  # least dB; the others are turned


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(2, 48, 36))


def norms(rows: np.ndarray) -> np.ndarray:
    """Lengths of the rows, sorted: the same however they are turned and ordered."""
    return np.sort(np.linalg.norm(rows, axis=1))


@needs_program()
@pytest.mark.parametrize("name", MAKERS)
def test_what_the_program_reads_is_read(name: str, scene: Scene, tmp_path: Path) -> None:
    gaussians = drawn(scene, 0)
    path = MAKERS[name](tmp_path / "a", gaussians)
    actual = read_gaussians(path)
    assert len(actual.gaussians) == len(gaussians)  # of levels, the finest alone
    assert actual.info.opacity_encoding == "logit"
    if name in PSNR:
        assert psnr(scene, gaussians, actual.gaussians) > PSNR[name]
    for one, other in ((norms(getattr(g, key)) for g in (gaussians, actual.gaussians)) for key in ("means", "scales")):
        np.testing.assert_allclose(one, other, rtol=0.02)
    files = [path] if name == ".ksplat" else list(path.parent.iterdir())
    assert actual.info.file_bytes == sum(file.stat().st_size for file in files)
    if path.suffix == ".json":
        np.testing.assert_array_equal(read_gaussians(path.parent).gaussians.means, actual.gaussians.means)
        assert find_scene_files(path.parent).ply == path
    assert check_content(path).problems == ()


@needs_program()
@pytest.mark.parametrize("name", ["a.ksplat", "meta.json", "a.lcc", "a.lcc2"])
def test_damage_is_one_line(name: str, tmp_path: Path) -> None:
    for content, reason in ((b"", ""), (b"{}", ""), (b"\0" * 5000, "splat-transform")):
        (tmp_path / name).write_bytes(content)
        with refuses(SceneError, name, reason):  # what cannot be of its name is refused before the program sees it
            read_gaussians(tmp_path / name)


@pytest.fixture
def no_program(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv(VARIABLE, raising=False)


@pytest.mark.parametrize("name", MAKERS)
def test_without_the_program_one_line_has_the_command_that_converts(
    name: str, tmp_path: Path, no_program: None
) -> None:
    path = MAKERS[name](tmp_path / "a", corners())
    with pytest.raises(SceneError) as error:
        read_gaussians(path)
    target = path.with_name("scene.ply") if path.suffix == ".json" else path.with_suffix(".ply")
    assert str(error.value).endswith(f"convert it with npx {PACKAGE} {path} -L 0 {target}")


def test_without_the_program_nothing_is_written(tmp_path: Path, no_program: None) -> None:
    with refuses(UsageError, "splat-transform", f"npm install -g {PACKAGE}"):
        splat_transform.run_program("a.ply", "b.ply")
    assert list(tmp_path.iterdir()) == []


def test_a_stand_in_is_given_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    put_stand_in(tmp_path, monkeypatch)
    write_ply(tmp_path / "a.ply", corners())
    (tmp_path / "a.ply").rename(tmp_path / "a.lcc")
    np.testing.assert_array_equal(read_gaussians(tmp_path / "a.lcc").gaussians.means, corners().means)


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
def test_a_program_that_fails_is_one_line(
    script: str, limit: float, said: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(splat_transform, "TIME_LIMIT", limit)
    put_stand_in(tmp_path, monkeypatch, f"#!{{python}}\n{script}\n")
    with refuses(GsmergeError, tmp_path / "splat-transform", *said):
        splat_transform.run_program("a.ply", tmp_path / "b.ply")
    (tmp_path / "a.ksplat").write_bytes(b"\0any")
    with refuses(SceneError, "a.ksplat", *said):
        read_gaussians(tmp_path / "a.ksplat")


def test_a_meta_json_of_another_program_is_no_scene(tmp_path: Path) -> None:
    (tmp_path / "meta.json").write_text(json.dumps({"frames": []}))
    with refuses(SceneError, tmp_path, "none"):
        find_scene_files(tmp_path)
    assert check_content(tmp_path / "meta.json").kind != "Gaussians"
