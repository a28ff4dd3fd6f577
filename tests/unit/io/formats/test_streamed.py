"""Streamed SOG is written by splat-transform or a stand-in, read, and replaced as a whole."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from damage.changes import fill_with_zeros
from messages import NO_FOLDER, refuses
from slow_readers import corners, drawn
from splat_transform_programs import needs_program, put_stand_in, run_here, write_set

from gsmerge import Scene
from gsmerge.cli import main
from gsmerge.errors import SceneError, UsageError
from gsmerge.io import output_format, read_gaussians, write_gaussians
from gsmerge.io.formats import splat_transform
from gsmerge.io.formats.splat_transform import VARIABLE
from gsmerge.io.formats.streamed import read_index, read_level, write_levels
from gsmerge.reading.read_scene import load_scene

from .test_write import psnr


@pytest.fixture(scope="module")
def scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(2, 96, 72))


@pytest.mark.parametrize("degree", [0, 3])
def test_a_level_is_read_as_a_sog_of_its_gaussians(degree: int, scene: Scene, tmp_path: Path) -> None:
    gaussians = drawn(scene, degree)
    write_set(tmp_path / "lod-meta.json", [gaussians, gaussians[::4]], mip=True)
    for level, own in enumerate((gaussians, gaussians[::4])):
        write_gaussians(tmp_path / "a.sog", own, overwrite=True)
        expected, actual = read_gaussians(tmp_path / "a.sog"), read_level(tmp_path / "lod-meta.json", level)
        for name, array in vars(expected.gaussians).items():
            np.testing.assert_array_equal(getattr(actual.gaussians, name), array, name)
        assert actual.info.comments == ("SplatRenderMode: mip",)
    assert len(read_gaussians(tmp_path / "lod-meta.json").gaussians) == len(gaussians)


def test_other_files_beside_a_chunk_do_not_count_as_bytes(scene: Scene, tmp_path: Path) -> None:
    """They would raise the memory that reading may take."""
    write_set(tmp_path / "lod-meta.json", [drawn(scene, 1)])
    before = read_gaussians(tmp_path / "lod-meta.json").info.file_bytes
    for meta in list(tmp_path.rglob("*/meta.json")):
        fill_with_zeros(40 << 30)(meta.with_name("unused"))
    assert read_gaussians(tmp_path / "lod-meta.json").info.file_bytes == before
    assert load_scene(tmp_path / "lod-meta.json").recognised["bytes"] == before  # as reports have it
    assert before > 2 * (tmp_path / "lod-meta.json").stat().st_size


def test_a_tree_and_an_environment_are_read(scene: Scene, tmp_path: Path) -> None:
    gaussians, index = drawn(scene, 1), tmp_path / "lod-meta.json"
    write_set(index, [gaussians, gaussians[::4]], leaves=5, environment=gaussians[::50])
    actual = read_gaussians(index)
    assert len(actual.gaussians) == len(gaussians) + len(gaussians[::50])
    assert len(read_level(index, 1).gaussians) == len(gaussians[::4])
    of_level_1 = sum(path.stat().st_size for path in (tmp_path / "1_0").iterdir())
    files = sum(path.stat().st_size for path in tmp_path.rglob("*") if path.is_file())
    assert actual.info.file_bytes == files - of_level_1


@needs_program()
def test_splat_transform_writes_each_level(scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gaussians, index = drawn(scene, 1), tmp_path / "scene" / "lod-meta.json"
    levels = [gaussians, gaussians[::4], gaussians[::16]]
    write_levels(index, levels, comments=["SplatRenderMode: mip"])
    assert read_index(index).counts == list(map(len, levels))
    for level, expected in enumerate(levels):
        actual = read_level(index, level)
        assert actual.gaussians.sh_degree == 1
        assert psnr(scene, expected, actual.gaussians) > 35
        assert actual.info.comments == ("SplatRenderMode: mip",)
    assert main(["inspect", str(index)]) == 0
    capsys.readouterr()
    write_levels(index, levels[1:], overwrite=True)
    assert read_index(index).counts == list(map(len, levels[1:]))
    used = {chunk.parent.name for level in read_index(index).levels for chunk in level}
    assert {path.name for path in index.parent.iterdir()} == {index.name, *used}


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a stand-in for splat-transform in its place."""
    run_here(monkeypatch, put_stand_in(tmp_path / "program", monkeypatch))


@pytest.mark.slow
def test_failures_leave_only_existing_files(tmp_path: Path, program: None) -> None:
    index = tmp_path / "scene" / "lod-meta.json"
    bad = corners()
    bad.opacities[1] = np.nan
    for levels, words in (([corners(), bad], "finite"), ([corners(), bad[:0]], "none")):
        with pytest.raises(ValueError, match=words):
            write_levels(index, levels)
    assert not index.parent.exists()
    write_levels(index, [corners()])
    before = files_in(tmp_path)
    with refuses(SceneError, "lod-meta.json", "exists"):
        write_levels(index, [corners()])
    with refuses(ValueError, "", "finite", 1):
        write_levels(index, [bad], overwrite=True)
    assert files_in(tmp_path) == before
    with refuses(SceneError, "scene", *NO_FOLDER):
        write_levels(index / "scene" / "lod-meta.json", [corners()])
    with refuses(UsageError, "levels.json", "lod-meta.json"):
        write_levels(tmp_path / "levels.json", [corners()])


def test_a_streamed_set_is_replaced_as_a_whole(tmp_path: Path, program: None) -> None:
    """The chunks of the old one go, whatever else is in the folder stays."""
    index, alone = tmp_path / "scene" / "lod-meta.json", tmp_path / "alone" / "lod-meta.json"
    write_levels(index, [corners(), corners()[:2], corners()[:1]])
    second = next(iter(read_index(index).levels[1])).parent.name
    mine = {"notes.txt": b"mine", f"{second}/notes.txt": b"mine", "1_0/meta.json": b"another program's"}
    for name, data in mine.items():
        (index.parent / name).parent.mkdir(exist_ok=True)
        (index.parent / name).write_bytes(data)
    for path in (index, alone):
        write_levels(path, [corners(), corners()[:1]], overwrite=True)
    assert files_in(index.parent) == {**files_in(alone.parent), **mine}


@pytest.mark.parametrize("call", [0, 8])
def test_a_failed_rename_leaves_the_old_set_whole(
    call: int, tmp_path: Path, program: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever rename fails: the old set is whole, and so is the new one after the next run."""
    index, replace, calls = tmp_path / "scene" / "lod-meta.json", os.replace, iter(range(1000))
    write_levels(index, [corners()[:2]])

    def rename(*paths: Any) -> None:
        if next(calls) == call:
            raise OSError(errno.EIO, "Input/output error")
        replace(*paths)

    monkeypatch.setattr(os, "replace", rename)
    with refuses(SceneError, "", "Input/output error"):
        write_levels(index, [corners(), corners()[:1]], overwrite=True)
    assert len(read_gaussians(index).gaussians) == 2
    write_levels(index, [corners(), corners()[:1]], overwrite=True)
    assert len(read_gaussians(index).gaussians) == 3


def test_levels_without_the_program_are_refused_with_the_command_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path / "none"))
    with refuses(UsageError, "splat-transform", f"npm install -g {splat_transform.CONVERTER_PACKAGE}"):
        output_format("lod-meta.json")
    with refuses(UsageError, "splat-transform", f"npm install -g {splat_transform.CONVERTER_PACKAGE}"):
        write_levels(tmp_path / "scene" / "lod-meta.json", [corners()])
    assert list(tmp_path.iterdir()) == []


def test_the_file_name_chooses_the_format_where_levels_are_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, sys.executable)  # any program that exists
    assert output_format("scene/lod-meta.json").ending == "lod-meta.json"
    for name, alone in {"scene/lod-meta.json": True, "my-lod-meta.json": False, "LOD-meta.json": False}.items():
        with refuses(UsageError, name, ".ply", ".glb"):
            output_format(name, alone=alone)


def test_inspecting_reads_all_levels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_set(tmp_path / "lod-meta.json", [corners(), corners()[:1]])
    assert main(["inspect", str(tmp_path / "lod-meta.json")]) == 0
    assert "3 + 1 Gaussians at 2 levels" in capsys.readouterr().out
    second = next(iter(read_index(tmp_path / "lod-meta.json").levels[1]))
    second.with_name("sh0.webp").unlink()
    assert len(read_gaussians(tmp_path / "lod-meta.json").gaussians) == 3
    assert main(["inspect", str(tmp_path / "lod-meta.json")]) == 3
    assert f"{second.with_name('sh0.webp')}: no such file" in capsys.readouterr().err
