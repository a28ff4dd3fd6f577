"""The grid: products, what is left out, files that hold one, and the scenes that it is run on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from messages import noted, refuses

from gsmerge.errors import SceneError, UsageError
from gsmerge.measure.evaluate import EvaluateOptions
from gsmerge.research.charts.grid import SettingsGrid, find_sources, list_settings, make_jobs, parse_grid, scene_names
from gsmerge.settings.compact import CompactOptions


def test_the_smallest_grid_is_the_input_and_the_defaults() -> None:
    assert list_settings(SettingsGrid()) == ([("input", {}), ("gsmerge", {})], [])


def test_the_product() -> None:
    grid = parse_grid(["k=1,2", "budget=0.5%, 2%,4000", "fit=full,none"])
    made, notes = list_settings(grid)
    assert len(made) == 1 + 2 * 3 * 2
    assert len({(method, *sorted(settings.items())) for method, settings in made}) == len(made)
    assert notes == []
    assert made[1] == ("gsmerge", {"budget": "0.5%", "k": 1})
    assert ("gsmerge", {"budget": 4000, "k": 2, "fit": "none"}) in made


@pytest.mark.parametrize("fixed", [{}, {"recipe": "paper"}, {"effort": "draft"}])
def test_every_label_is_a_result_of_its_own(fixed: dict[str, str]) -> None:
    """A recipe, or an effort, decides what no list decides, and nothing else: four labels are four results."""
    made, notes = list_settings(parse_grid(["fit=full,none", "match=overlap,aabb"], fixed))
    options = [CompactOptions().with_settings(settings) for method, settings in made if method == "gsmerge"]
    asked = {(one.fit.fit, one.match.match) for one in options}
    assert asked == {("full", "overlap"), ("full", "aabb"), ("none", "overlap"), ("none", "aabb")}
    assert notes == []
    (_, (_, alone)), _ = list_settings(SettingsGrid(fixed=fixed))
    assert CompactOptions().with_settings(alone) == CompactOptions().with_settings(fixed)


def test_baselines_run_once_per_size() -> None:
    combinations, notes = list_settings(
        SettingsGrid(method=("gsmerge", "voxel"), k=(1, 2), budget=("1%",), superpixels=("10%",), fit=("full", "none"))
    )
    assert [settings for method, settings in combinations if method == "voxel"] == [
        {"budget": "1%"},
        {"superpixels": "10%"},
    ]
    assert len(combinations) == 1 + 2 * 2 * 2 + 2
    assert notes == ["6 combination(s) left out: their method does not use the settings that differ"]


def test_methods_that_keep_all_run_once_and_fits_once_per_effort() -> None:
    grid = SettingsGrid(
        method=("unmerged", "unmerged-fit"), budget=("1%", "2%"), effort=("fast", "default"), fit=("none",)
    )
    combinations, notes = list_settings(grid)
    assert combinations == [("input", {}), ("unmerged", {}), ("unmerged-fit", {"effort": "fast"}), ("unmerged-fit", {})]
    assert noted(notes, "5 combination(s)")


def test_lists_that_cannot_be() -> None:
    for text, name, found in (
        ("k=1,1", "k", "1,1"), ("k= , ", "k", "none"), ("budget=", "budget", "none"), ("views=some", "views", "'some'"),
    ):  # fmt: skip
        with refuses(UsageError, "", name, found):
            parse_grid([text])


def test_settings_that_the_library_refuses() -> None:
    with refuses(UsageError, "k", "1 to 8", 9):
        make_jobs([], parse_grid(["k=9"]), EvaluateOptions(()))


def test_fixed_settings_are_those_of_ours_alone() -> None:
    grid = SettingsGrid(method=("gsmerge", "random"), budget=("1%",), fixed={"robust": False, "match": "none"})
    combinations, _ = list_settings(grid)
    assert combinations[1:] == [
        ("gsmerge", {"budget": "1%", "robust": False, "match": "none"}),
        ("random", {"budget": "1%"}),
    ]


@pytest.mark.parametrize("pairs", [["match=none,aabb"], ["k=1"], ["budget=2%"], []])
def test_what_is_decided_twice(pairs: list[str]) -> None:
    name = pairs[0].partition("=")[0] if pairs else "method"
    with refuses(UsageError, f"--set {name}", f"--grid {name}"):
        parse_grid(pairs, {name: "voxel"})


def test_lists_that_are_none() -> None:
    for pairs in (["kk=1"], ["k=1", "k=2"], ["k"]):
        with refuses(UsageError, f"--grid {pairs[0].partition('=')[0]}"):
            parse_grid(pairs)


def test_a_program_that_is_missing_is_told_before_anything_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSMERGE_SPLAT_TRANSFORM", "/nowhere/splat-transform")
    with refuses(UsageError, "splat-transform", "/nowhere/splat-transform", "@playcanvas/splat-transform@3.7"):
        make_jobs([], SettingsGrid(method=("gsmerge", "splat-transform"), budget=("1%",)), EvaluateOptions(()))


def test_names_are_as_short_as_can_be() -> None:
    assert scene_names([Path("a/room"), Path("b/fern.ply")]) == ["room", "fern"]
    assert scene_names([Path("a/scene.ply"), Path("b/scene.ply")]) == ["a/scene", "b/scene"]
    assert scene_names([]) == []
    assert scene_names([Path("room.1"), Path("room.2")]) == ["room.1", "room.2"]


def sources(*given: object, targets: str | None = None) -> list[Any]:
    return find_sources([str(one) for one in given], Path("nowhere"), targets)


def test_a_scene_is_found_once(scene_copy: Path) -> None:
    assert [source.name for source in sources(scene_copy, scene_copy / "scene.ply")] == ["scene"]


def test_targets_are_one_file_or_a_template(scene_copy: Path) -> None:
    ply = scene_copy / "scene.ply"
    for scene, template in (
        (scene_copy, "{scene}/targets/transforms.json"),
        (ply, "{parent}/targets/transforms.json"),
        (scene_copy, "{parent}/targets/transforms.json"),
        (ply, str(scene_copy / "targets" / "transforms.json")),
    ):
        (source,) = sources(scene, targets=template)
        assert source.targets == scene_copy / "targets" / "transforms.json"
        assert source.num_views == 5
    (named,) = sources(ply, targets="{parent}/{stem}.ply")
    assert named.targets == ply
    (scene_copy / "transforms.json").write_text("{")  # an error when the scene is read
    assert sources(scene_copy)[0].num_views is None
    with refuses(SceneError, "nothing.json", "cameras", "nothing"):
        sources(scene_copy, targets="{scene}/nothing.json")
    for template in ("{}/targets", "{scene.foo}/targets", "{stem[foo]}", "{"):
        with refuses(UsageError, "", "{scene}", template):
            sources(scene_copy, targets=template)


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("scene.ply", True),
        ("transforms.json", True),
        ("images/view_000.png", True),
        ("targets/transforms.json", True),
        ("targets/images/view_000.png", True),
        ("notes.txt", False),
    ],
)
def test_the_hash_knows_all_that_is_read(name: str, counts: bool, scene_copy: Path) -> None:
    def sha256() -> str:
        return str(sources(scene_copy, targets="{scene}/targets/transforms.json")[0].sha256)

    before = sha256()
    assert before == sha256()
    path = scene_copy / name
    path.write_bytes((path.read_bytes() if path.exists() else b"") + b" ")
    assert (sha256() != before) is counts


def test_results_beside_targets_do_not_count(scene_copy: Path) -> None:
    before = sources(scene_copy, targets="{scene}/targets")[0].sha256
    (scene_copy / "targets" / "charts").mkdir()
    (scene_copy / "targets" / "charts" / "batch.jsonl").write_text("{}")
    assert sources(scene_copy, targets="{scene}/targets")[0].sha256 == before


def test_a_copy_has_the_same_hash(scene_copy: Path, made_scene: Path) -> None:
    assert sources(scene_copy)[0].sha256 == sources(made_scene)[0].sha256


def test_jobs_are_runs_of_each_scene_with_files_of_their_own(made_scene: Path) -> None:
    fixed = {"checkpoint": "a/b.safetensors", "min_opacity": 0.1}
    grid = SettingsGrid(method=("gsmerge", "random"), budget=("1%",), views=(2, 5, 9, "all"), fixed=fixed)
    jobs, notes = make_jobs(sources(made_scene), grid, EvaluateOptions(()))
    assert len({job.output for job in jobs}) == len(jobs) == 2 * 3
    assert noted(notes, made_scene.name, "6 run(s)")  # of nine views, and of five, which are all
    assert all(job.output.startswith(f"{made_scene.name}/") and job.output.count("/") == 1 for job in jobs)
    assert jobs[1].num_gaussians == pytest.approx(0.4 * jobs[-1].num_gaussians)
    assert len({job.call.key(job.find_files()) for job in jobs}) == len(jobs)


def test_keys_depend_on_what_changes_measurements(made_scene: Path) -> None:
    def key(**more: Any) -> str:
        given = sources(made_scene), more.pop("grid", SettingsGrid()), more.pop("measured", EvaluateOptions(()))
        (_, job), _ = make_jobs(*given, **more)
        return job.call.key(job.find_files())

    assert key() == key(command="another")
    others = [key(measured=EvaluateOptions(("vgg",))), key(seed=1)]
    others += [key(grid=SettingsGrid(budget=("1%",)))]
    others += [key(measured=EvaluateOptions((), photo_side=476))]
    assert len({key(), *others}) == 5
