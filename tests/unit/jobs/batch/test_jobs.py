"""Each scene of a batch is one job, and no two jobs write to one file."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from batches import touch
from messages import names, refuses

from gsmerge.errors import SceneError, UsageError
from gsmerge.jobs.batch import BatchOptions, find_jobs
from gsmerge.jobs.batch.jobs import output_name
from gsmerge.settings.compact import CompactOptions

OUT = Path("out")
pytestmark = pytest.mark.usefixtures("inside")


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"jobs": 0}, ("jobs", 1, 0)), ({"engine": "slurm"}, ("engine", "'slurm'")),
        ({"address": "auto"}, ("address", "ray", "local")),
    ],
)  # fmt: skip
def test_batch_settings_out_of_range_are_refused(wrong: dict[str, Any], named: tuple[object, ...]) -> None:
    with refuses(ValueError, *named):
        BatchOptions(**wrong)


@pytest.mark.parametrize(
    "template",
    ["{name}.ply", "{stem.real}.ply", "{0}.ply", "{}.ply", "{stem", "{stem}.txt", "/x/{stem}.ply", "../{stem}.ply"],
)
def test_impossible_output_templates_are_refused(template: str) -> None:
    with refuses(ValueError, "output"):
        BatchOptions(output=template)


def scenes_by_output(
    *arguments: str, options: BatchOptions | None = None, results: Collection[str] = ()
) -> dict[str, str]:
    jobs = find_jobs(arguments, OUT, options or BatchOptions(), results)
    return {job.output: Path(job.scene).as_posix() for job in jobs}


def clashes_by_scene(*arguments: str, options: BatchOptions | None = None) -> dict[str, bool]:
    return {Path(job.scene).as_posix(): bool(job.clash) for job in find_jobs(arguments, OUT, options or BatchOptions())}


def test_results_of_former_runs_are_no_scenes() -> None:
    touch("a.ply", "b.ply")
    assert scenes_by_output("*.ply", results={os.path.realpath("b.ply")}) == {"a.ply": "a.ply"}


def test_a_scene_given_several_times_is_one_job() -> None:
    touch("s/a/scene.ply", "s/b.ply")
    assert scenes_by_output("s", "s/a/scene.ply", "s/*", "s/b.ply") == {"b.ply": "s/b.ply", "a.ply": "s/a"}


@pytest.mark.parametrize("given", [["all/b", "all/a"], ["all/link.ply", "all/a"], ["all/*/*.ply"], ["linked/all"]])
def test_a_scene_is_named_by_the_path_with_the_fewest_links(given: list[str]) -> None:
    touch("all/room/scene.ply")
    for path, target in (("all/a", "room"), ("all/b", "room"), ("all/link.ply", "room/scene.ply"), ("linked", ".")):
        Path(path).symlink_to(target)
    expected = {"all/*/*.ply": "all/room/scene.ply", "linked/all": "linked/all/room"}.get(given[0], given[0])
    assert list(scenes_by_output(*given, options=BatchOptions(output="{parent}/{stem}.ply")).values()) == [expected]
    assert [*scenes_by_output("all/b", "all/link.ply", "linked/all", "all/room").values()] == ["all/room"]


def test_scenes_with_one_output_file_clash() -> None:
    touch("s/a/scene.ply", "t/a/scene.ply")
    touch("t/b/scene.ply")
    assert clashes_by_scene("t", "s") == {"t/a": True, "t/b": False, "s/a": True}
    assert names(find_jobs(["s", "t"], OUT, BatchOptions())[0].clash, "out/a.ply", "s/a and t/a", "--name")
    apart = scenes_by_output("s", "t/a", options=BatchOptions(output="{parent}/{stem}.ply"))
    assert apart == {"s/a.ply": "s/a", "t/a.ply": "t/a"}


def test_files_of_levels_clash_with_other_results() -> None:
    touch("a.ply", "a.level1.ply")
    levels = BatchOptions(CompactOptions().with_settings({"levels": 2}))
    assert len(scenes_by_output("*.ply")) == 2
    assert clashes_by_scene("*.ply", options=levels) == {"a.ply": True, "a.level1.ply": True}


def test_an_output_in_the_place_of_a_scene_is_a_clash() -> None:
    touch("out/a.ply", "b/c.ply")
    assert clashes_by_scene("out/a.ply", "b") == {"out/a.ply": True, "b/c.ply": False}
    assert names(find_jobs(["out/a.ply"], OUT, BatchOptions())[0].clash, "out/a.ply", "--output")


def test_counts_of_jobs_come_from_the_header_of_the_scene() -> None:
    touch("a.ply")
    Path("b.ply").write_text("no header")
    assert [job.num_gaussians for job in find_jobs(["a.ply", "b.ply"], OUT, BatchOptions())] == [7, 0]


def test_placeholders_of_the_output_name_are_filled_in(tmp_path: Path) -> None:
    options = BatchOptions(CompactOptions().with_settings({"k": 2}))

    def name(template: str, scene: str) -> str:
        return output_name(replace(options, output=template), Path(scene), 12)

    touch("set/room.v2/scene.ply")
    assert name("{stem}.ply", "set/room.v2") == "room.v2.ply"
    assert name("{stem}.ply", "set/room.v2/scene.ply") == "scene.ply"
    assert name("{parent}-{stem}.k{k}.ply", "set/a.ply") == "set-a.k2.ply"
    assert name("{index:04d}.ply", "a.ply") == "0012.ply"
    assert name("{stem}.ply", "a.compressed.ply") == "a.ply"
    assert name("{stem}.ply", ".") == f"{tmp_path.name}.ply"
    with refuses(UsageError, "--name", "{stem:d}.ply"):
        name("{stem:d}.ply", "a.ply")


def test_placeholders_of_cameras_and_photos_are_filled_in() -> None:
    touch("s/a/scene.ply", "s/b.ply", "photos/0.png")
    options = BatchOptions(cameras="{parent}/{stem}.json", images="photos", masks="{parent}/masks", protect="none")
    jobs = find_jobs(["s"], OUT, options)
    assert [job.cameras for job in jobs] == [Path("s/b.json"), Path("s/a/a.json")]
    assert [job.images for job in jobs] == [Path("photos")] * 2
    assert [job.masks for job in jobs] == [Path("s/masks"), Path("s/a/masks")]
    assert [job.protect for job in jobs] == ["none"] * 2
    with refuses(SceneError, "", "signs", "--protect '{parent}/signs'"):
        find_jobs(["s"], OUT, BatchOptions(protect="signs"))
    with refuses(UsageError, "", "{scene}", "{name}"):
        find_jobs(["s"], OUT, BatchOptions(cameras="{name}"))
