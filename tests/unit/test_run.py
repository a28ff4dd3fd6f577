"""In Python, results save themselves, doubts are warnings, and wrong arguments are refused in one clear line each."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from exports import export_rows, save_export, smooth_scene
from messages import names

import gsmerge
from gsmerge.types import NO_CAMERAS, Scene


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


def test_dir_lists_public_names_alone() -> None:
    assert set(dir(gsmerge)) == {*gsmerge.__all__, "integrations"}


SCENE = scenes.make_scene(scenes.room(), scenes.arc(2, 24, 18))
RESULT = gsmerge.compact(SCENE, budget=50, effort="draft")
ANY: Any = gsmerge
QUICK = gsmerge.EvaluateOptions(lpips=(), fog=False)
CALLS: dict[str, Callable[[], Any]] = {
    "results: expected Mapping[a text, a result or Gaussians]": lambda: ANY.evaluate(SCENE, [RESULT.gaussians]),
    "scene: expected Scene, got str; gsmerge.read_scene": lambda: ANY.evaluate("a.ply", {}),
    "results: expected ": lambda: ANY.view(SCENE, [RESULT]),
    "cameras: expected Cameras, got NoneType": lambda: ANY.render(SCENE.gaussians, None),
    "gaussians: expected Gaussians, got CompactResult; pass the .gaussians": lambda: ANY.render(RESULT, SCENE.cameras),
    "path: expected a path, got int": lambda: ANY.read_scene(3),
    "more: expected a path, got int": lambda: ANY.read_scene("a.ply", 3),
    "images: expected a path, got ndarray": lambda: ANY.inspect("a.ply", images=np.zeros(3)),
    "progress: expected a function, got int": lambda: ANY.compact(SCENE, progress=3),
    "scene: expected Scene or Gaussians or a path, got int; gsmerge.read_scene": lambda: ANY.compact(5),
    "options: expected CompactOptions, got dict; settings are named": lambda: ANY.compact(SCENE, {"k": 2}),
    "unknown setting 'output': result.save(path)": lambda: ANY.compact(SCENE, output="small.ply"),
    "unknown setting 'photos': read_scene(path, images=...)": lambda: ANY.compact(SCENE, photos="photos"),
    "unknown setting 'num_gaussians'; perhaps budget": lambda: ANY.compact(SCENE, num_gaussians=400),
    "path: expected a path, got Gaussians": lambda: ANY.write_ply(SCENE.gaussians, "a.ply"),
    "gaussians: expected Gaussians, got CompactResult; pass": lambda: ANY.write_ply("a.ply", RESULT),
    "levels: expected Sequence[Gaussians], got Gaussians": lambda: ANY.write_levels("lod-meta.json", SCENE.gaussians),
    "unknown argument 'foo'; expected cameras": lambda: ANY.read_scene("a.ply", foo=1),
    "unknown argument 'imges'; perhaps images": lambda: ANY.read_scene("a.ply", imges="photos"),
    "scene: expected Scene or a path, got int": lambda: ANY.Compactor().extend(3),
}


@pytest.mark.parametrize("line", CALLS)
def test_other_arguments_are_refused_in_one_line(line: str) -> None:
    with pytest.raises(TypeError if re.match(r"\w+: ", line) else ValueError) as caught:
        CALLS[line]()
    assert str(caught.value).startswith(line)


def test_a_share_as_a_number_is_refused_with_the_share_as_text() -> None:
    with pytest.raises(ValueError, match=r'^budget: .*perhaps "5%"'):
        ANY.compact(SCENE, budget=0.05)


@pytest.mark.parametrize(("name", "use"), [("load", "read_scene"), ("convert", "write_gaussians")])
def test_names_of_other_packages_lead_to_those_of_this_one(name: str, use: str) -> None:
    with pytest.raises(AttributeError, match=rf"'{name}'; use .*{use}"):
        getattr(gsmerge, name)


@pytest.mark.slow
def test_gaussians_alone_are_a_scene_without_views() -> None:
    alone = replace(SCENE, cameras=NO_CAMERAS, images=None, pixels=None, names=())
    one, other = (gsmerge.compact(each, budget=40, effort="draft") for each in (SCENE.gaussians, alone))
    assert one.gaussians == other.gaussians
    assert "40 Gaussians" in gsmerge.view(one).headline  # a result brings the scene that it was made from


def test_a_result_is_taken_where_its_gaussians_are_meant(tmp_path: Path) -> None:
    of_result, plain = (gsmerge.evaluate(SCENE, {"a": each}, options=QUICK) for each in (RESULT, RESULT.gaussians))
    assert [each.scores for each in of_result.results] == [each.scores for each in plain.results]
