"""In Python, results save themselves, doubts are warnings, notes are logged, and errors are clear."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest
import scenes
from exports import export_rows, save_export, smooth_scene
from messages import names

import gsmerge
from gsmerge.types import Scene


def make_scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(4, 32, 24))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


@pytest.fixture(scope="module")
def result() -> gsmerge.CompactResult:
    return gsmerge.compact(make_scene(), effort="draft", budget=60, levels=2)


@pytest.mark.parametrize(
    ("name", "files"),
    [
        ("a.ply", {"a.ply", "a.level1.ply", "a.cameras.json"}),
        ("a.sog", {"a.sog", "a.level1.sog", "a.cameras.json", "a.settings.json"}),
        ("a.html", {"a.html"}),
    ],
)
def test_a_result_saves_all_files_of_its_format(
    name: str, files: set[str], result: gsmerge.CompactResult, tmp_path: Path
) -> None:
    path = result.save(tmp_path / name)
    assert path.is_file()
    assert {each.relative_to(tmp_path).as_posix() for each in tmp_path.rglob("*") if each.is_file()} == files
    with pytest.raises(gsmerge.SceneError, match="exists already"):
        result.save(tmp_path / name)
    assert result.save(tmp_path / name, overwrite=True) == path


def test_names_of_views_are_saved(result: gsmerge.CompactResult, scene: Scene, tmp_path: Path) -> None:
    result.save(tmp_path / "a.ply")
    assert gsmerge.read_cameras(tmp_path / "a.cameras.json").names == scene.names == result.names


def test_saving_under_an_unknown_ending_is_refused(result: gsmerge.CompactResult, tmp_path: Path) -> None:
    with pytest.raises(gsmerge.GsmergeError, match="ends in"):
        result.save(tmp_path / "a.xyz")


def test_values_of_a_report_are_plain_json(result: gsmerge.CompactResult) -> None:
    assert json.loads(json.dumps(result.report.to_dict()))["num_output"] == 60


def test_doubts_of_a_run_are_warnings(scene: Scene) -> None:
    with pytest.warns(gsmerge.DoubtWarning, match="worse than the input"):
        gsmerge.compact(scene, effort="draft", budget=4, fit="none")


@pytest.mark.parametrize("is_read", [False, True])
def test_doubts_of_reading_are_in_the_report_of_a_run(is_read: bool, tmp_path: Path) -> None:
    smooth = smooth_scene(56, 40)
    folder = save_export(tmp_path / "scene", smooth, export_rows(smooth))
    (folder / "transforms.json").write_text("{")
    with pytest.warns(gsmerge.DoubtWarning, match="left out"):
        scene = gsmerge.read_scene(folder)
    with pytest.warns(gsmerge.DoubtWarning, match="left out"):
        report = gsmerge.compact(scene if is_read else folder, effort="draft", budget=60).report
    assert [names(doubt, "transforms.json", "left out") for doubt in report.doubts] == [True]


def test_notes_of_a_run_are_logged(scene: Scene, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "gsmerge"):
        result = gsmerge.compact(scene, effort="draft", budget="auto")
    assert set(result.report.notes) <= {record.message for record in caplog.records}


def test_arguments_of_a_wrong_type_are_refused_with_the_expected_one(
    result: gsmerge.CompactResult, tmp_path: Path
) -> None:
    with pytest.raises(TypeError, match="expected Scene or a path, got Gaussians"):
        gsmerge.compact(result.gaussians)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"pass the \.gaussians"):
        gsmerge.write_ply(tmp_path / "a.ply", result)  # type: ignore[arg-type]


def test_dir_lists_public_names_alone() -> None:
    assert set(dir(gsmerge)) == {*gsmerge.__all__, "integrations"}
