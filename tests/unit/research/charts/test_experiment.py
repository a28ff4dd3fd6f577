"""The grid: products, what is left out, and files that hold one."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsmerge.errors import SceneError, UsageError
from gsmerge.research.charts.experiment import Experiment, Grid, grid_settings, make_experiments, parse_grid, read_grid


def test_the_smallest_grid_is_the_input_and_the_defaults() -> None:
    made, notes = make_experiments([Path("room")], Grid())
    assert made == [Experiment(Path("room"), "input"), Experiment(Path("room"), "gsmerge")]
    assert notes == []


def test_the_product() -> None:
    grid = parse_grid({"k": "1,2", "budgets": "0.5%, 2%,4000", "fit": "full,none", "views": "3,all"})
    made, notes = make_experiments([Path("a"), Path("b")], grid)
    assert len(made) == 2 * 2 * (1 + 2 * 3 * 2)
    assert len({(e.scene, e.method, e.views, *sorted(e.settings.items())) for e in made}) == len(made)
    assert notes == []
    assert made[1] == Experiment(Path("a"), "gsmerge", {"budget": "0.5%"}, 3)
    assert Experiment(Path("b"), "gsmerge", {"budget": 4000, "k": 2, "fit": "none"}, None) in made


def test_rivals_run_once_per_size() -> None:
    combinations, notes = grid_settings(
        Grid(methods=("gsmerge", "voxel"), k=(1, 2), budgets=("1%",), superpixels=("10%",), fit=("full", "none"))
    )
    assert [settings for method, settings in combinations if method == "voxel"] == [
        {"budget": "1%"},
        {"superpixels": "10%"},
    ]
    assert len(combinations) == 1 + 2 * 2 * 2 + 2
    assert notes == ["voxel takes a size alone: 6 combination(s) left out"]


def test_methods_that_keep_all_run_once_and_fits_once_per_effort() -> None:
    grid = Grid(methods=("unmerged", "unmerged-fit"), budgets=("1%", "2%"), efforts=("fast", "default"), fit=("none",))
    combinations, notes = grid_settings(grid)
    assert combinations == [
        ("input", {}),
        ("unmerged", {}),
        ("unmerged-fit", {"effort": "fast"}),
        ("unmerged-fit", {}),
    ]
    assert notes == [
        "unmerged keeps all Gaussians: 1 combination(s) left out",
        "unmerged takes a size alone: 2 combination(s) left out",
        "unmerged-fit keeps all Gaussians: 2 combination(s) left out",
    ]


def test_what_changes_nothing_is_left_out() -> None:
    grid = Grid(segmentations=("rdseg", "slic"), fit=("full", "none"), efforts=("default", "fast"))
    combinations, notes = grid_settings(grid)
    assert len(combinations) == 1 + 8 - 1
    assert len(notes) == 1


@pytest.mark.parametrize(
    ("lists", "message"),
    [
        ({"k": "1,1"}, "k: expected every value once"),
        ({"k": " , "}, "k: expected at least one value"),
        ({"views": "some"}, "views: expected numbers"),
        ({"views": "0"}, "views: expected numbers from 1"),
        ({"views": "some"}, "views: expected numbers from 1"),
    ],
)
def test_lists_that_cannot_be(lists: dict[str, str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        parse_grid(lists)


@pytest.mark.parametrize(
    ("lists", "message"), [({"k": "9"}, "expected"), ({"fit": "some"}, "fit: expected"), ({"budgets": "x"}, "expected")]
)
def test_settings_that_the_library_refuses(lists: dict[str, str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make_experiments([Path("a")], parse_grid(lists))


def test_files(tmp_path: Path) -> None:
    grid = tmp_path / "grid.json"
    grid.write_text('{"k": [1, 2], "budgets": ["1%", 500], "views": "all"}')
    assert read_grid(grid) == Grid(k=(1, 2), budgets=("1%", 500), views=("all",))
    assert parse_grid({"k": "2", "fit": None}, read_grid(grid)) == Grid(k=(2,), budgets=("1%", 500))


def test_toml_files(tmp_path: Path) -> None:
    pytest.importorskip("tomllib")
    grid = tmp_path / "grid.toml"
    grid.write_text('methods = ["gsmerge", "voxel"]\nviews = [3, 6]\n')
    assert read_grid(grid) == Grid(methods=("gsmerge", "voxel"), views=(3, 6))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"densities": ["a"]}', "expected a share as a number, got 'a'"),
        ("{", "found a mistake"),
        ("[]", "found no table"),
        ('{"kk": [1]}', "found kk"),
        ('{"views": [0]}', "views: expected"),
        ('{"views": [[1]]}', "grid.json"),
    ],
)
def test_files_that_hold_no_grid(text: str, message: str, tmp_path: Path) -> None:
    grid = tmp_path / "grid.json"
    grid.write_text(text)
    with pytest.raises(SceneError, match=message):
        read_grid(grid)


def test_a_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="expected a TOML or JSON file"):
        read_grid(tmp_path / "grid.toml")


def test_fixed_settings_are_those_of_ours_alone() -> None:
    fixed = ("agreement=false", "match=none", "iterations=3")
    grid = Grid(methods=("gsmerge", "random"), budgets=("1%",), fixed=fixed)
    combinations, _ = grid_settings(grid)
    assert combinations[1:] == [
        ("gsmerge", {"budget": "1%", "agreement": False, "match": "none", "iterations": 3}),
        ("random", {"budget": "1%"}),
    ]


@pytest.mark.parametrize("text", ["match", "=1", ""])
def test_fixed_settings_are_names_and_values(text: str) -> None:
    with pytest.raises(UsageError, match="NAME=VALUE"):
        grid_settings(Grid(fixed=(text,)))


@pytest.mark.parametrize(
    "text",
    ["method=voxel", "seed=3", "threads=1", "min_contribution=[1]", "min_contribution={}", "min_contribution=NaN"],
)
def test_what_cannot_be_fixed(text: str) -> None:
    with pytest.raises(UsageError, match="fixed: expected"):
        grid_settings(Grid(fixed=(text,)))


def test_a_program_that_is_missing_is_told_before_anything_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSMERGE_SPLAT_TRANSFORM", "/nowhere/splat-transform")
    with pytest.raises(UsageError, match="install it with"):
        make_experiments([Path("scene")], Grid(methods=("gsmerge", "splat-transform"), budgets=("1%",)))
