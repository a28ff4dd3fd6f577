"""The grid multiplies lists, finds its scenes, and reads its records back whatever is beside them."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from experiments import make_record
from messages import refuses

import gsmerge
from gsmerge.errors import SceneError, UsageError
from gsmerge.io.jsonl import append_line
from gsmerge.method.geometry.views import subset
from gsmerge.research.charts.grid import find_sources, list_settings, make_runs, parse_grid, scene_names
from gsmerge.research.charts.measure_run import RUNS, ChartScene, hold_out, read_runs
from gsmerge.scoring.evaluate import EvaluateOptions


def test_grid_multiplies_lists_other_than_sizes() -> None:
    assert list_settings({}, {}) == [("input", {}), ("gsmerge", {})]
    made = list_settings(parse_grid(["k=1,2", "budget=0.5%, 2%,4000", "superpixels=1%"]), {"robust": False})
    assert len(made) == 1 + 2 * 4
    assert made[1] == ("gsmerge", {"budget": "0.5%", "k": 1, "robust": False})
    assert ("gsmerge", {"superpixels": "1%", "k": 2, "robust": False}) in made


def test_baselines_run_once_for_the_settings_that_they_use() -> None:
    grid = parse_grid(["method=unmerged,unmerged-fit,greedy", "budget=1%,2%", "effort=fast,default"])
    assert list_settings(grid, {"seed": 3, "match": "none"})[1:] == [
        ("unmerged", {"seed": 3}),
        ("unmerged-fit", {"effort": "fast", "seed": 3}),
        ("unmerged-fit", {"effort": "default", "seed": 3}),
        ("greedy", {"budget": "1%", "seed": 3}),
        ("greedy", {"budget": "2%", "seed": 3}),
    ]


@pytest.mark.parametrize("pairs", [["kk=1"], ["k=1", "k=2"], ["k"], ["k= , "]])
def test_malformed_lists_of_a_grid_are_refused(pairs: list[str]) -> None:
    with refuses(UsageError, f"--grid {pairs[-1]}", "NAME=A,B"):
        parse_grid(pairs)


def test_wrong_values_and_missing_programs_are_refused_before_the_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSMERGE_SPLAT_TRANSFORM", "/nowhere/splat-transform")
    for pair, *named in (("k=9", "1 to 8"), ("method=nothing", "nothing"), ("method=splat-transform", "/nowhere")):
        with refuses(UsageError, "", *named):
            make_runs([], parse_grid([pair]), {}, EvaluateOptions(()))


def test_scene_names_are_as_short_as_they_can_differ() -> None:
    assert scene_names([Path("a/room"), Path("b/fern.ply")]) == ["room", "fern"]
    assert scene_names([Path("a/scene.ply"), Path("b/scene.ply")]) == ["a/scene", "b/scene"]
    assert scene_names([]) == []


def sources(*given: object, targets: str | None = None) -> list[ChartScene]:
    return find_sources([str(one) for one in given], Path("nowhere"), targets)


def test_targets_are_one_file_or_a_template(scene_copy: Path) -> None:
    ply = scene_copy / "scene.ply"
    assert [source.name for source in sources(scene_copy, ply)] == ["scene"]  # once
    for scene, template in ((scene_copy, "{scene}/targets"), (ply, "{parent}/targets"), (ply, f"{scene_copy}/targets")):
        assert sources(scene, targets=template)[0].targets == scene_copy / "targets"
    with refuses(SceneError, "nothing.json", "cameras", "nothing"):
        sources(scene_copy, targets="{scene}/nothing.json")
    for template in ("{}/targets", "{scene.foo}/targets", "{stem[foo]}", "{"):
        with refuses(UsageError, "", "{scene}", template):
            sources(scene_copy, targets=template)


@pytest.mark.parametrize(
    ("name", "counts"), [("scene.ply", 1), ("transforms.json", 1), ("targets/images/view_000.png", 1), ("notes.txt", 0)]
)
def test_keys_depend_on_what_changes_measurements(name: str, counts: bool, scene_copy: Path) -> None:
    def key(grid: list[str] = [], **measured: Any) -> str:  # noqa: B006
        found = sources(scene_copy, targets="{scene}/targets/transforms.json")
        return make_runs(found, parse_grid(grid), {}, EvaluateOptions((), **measured))[-1][1].key

    before = key()
    assert len({before, key(["budget=1%"]), key(["seed=1"]), key(photo_side=476)}) == 4
    path = scene_copy / name
    path.write_bytes((path.read_bytes() if path.exists() else b"") + b" ")
    assert (key() != before) is bool(counts)


def test_newest_whole_record_of_each_run_is_read_back(tmp_path: Path) -> None:
    fern, fox = make_record("fern", "gsmerge", {"k": 2}), make_record("fox", "greedy")
    again = replace(fern, seconds=1.5, notes=("odd \u2028 line\n",))
    for value in (asdict(fern), {"scene": "fern"}, asdict(fox), asdict(again) | {"views": 3}, asdict(again)):
        append_line(tmp_path / RUNS, value)
    with (tmp_path / RUNS).open("a") as file:
        file.write('{"scene": "fo')
    assert read_runs(tmp_path) == [again, fox]


def test_without_targets_some_photos_judge_all_runs(made_scene: Path) -> None:
    """Of fewer than four photos none can be spared."""
    scene = gsmerge.read_scene(made_scene)
    rest, held_out = hold_out(scene)
    assert (len(rest), held_out.names) == (4, (scene.names[1],))
    assert np.array_equal(held_out.images[0], scene.images[1])
    assert scene.names[1] not in rest.names
    few = subset(scene, [0, 2, 4])
    assert hold_out(few) == (few, None)
