"""Runs: records that come back whatever is beside them, measurements and pictures."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scenes
from experiments import make_record

import gsmerge
from gsmerge.batch.records import DONE, FAILED, RECORDS, record
from gsmerge.facts.views import subset
from gsmerge.io.jsonl import append_line
from gsmerge.research.charts.measure_run import RunRecord, choose_views, hold_out, keep_pictures, read_runs


def line(run: RunRecord, **changes: Any) -> dict[str, Any]:
    """The record of a batch that a run ends as."""
    report = {"notes": [], "run": asdict(run)}
    return record(DONE, run.scene, run.output, key="k", files=[], report=report) | changes


def store(folder: Path, *runs: RunRecord) -> None:
    for run in runs:
        append_line(folder / RECORDS, line(run))


FERN, FOX = make_record("fern", "gsmerge", {"k": 2}, notes=("odd \u2028 line\n",)), make_record("fox", "voxel")


def test_records_come_back_as_they_were(tmp_path: Path) -> None:
    store(tmp_path, FERN, FOX)
    assert read_runs(tmp_path) == ([FERN, FOX], [])


def test_the_newest_run_counts(tmp_path: Path) -> None:
    again = replace(FERN, seconds=1.5)
    store(tmp_path, FERN, FOX, again)
    assert read_runs(tmp_path) == ([FOX, again], [])


def test_a_run_that_failed_stays_until_it_is_done(tmp_path: Path) -> None:
    store(tmp_path, FERN)
    append_line(tmp_path / RECORDS, record(FAILED, "fern", FERN.output, error="out of memory"))
    (failed,), _ = read_runs(tmp_path)
    assert (failed.scene, failed.label, failed.error) == ("fern", FERN.label, "out of memory")
    store(tmp_path, FERN)
    assert read_runs(tmp_path)[0] == [FERN]


def test_runs_of_other_files_under_the_same_name_are_left_out(tmp_path: Path) -> None:
    changed = make_record("fern", "voxel", scene_sha256="ff" * 32)
    store(tmp_path, FERN, FOX, changed)
    records, notes = read_runs(tmp_path)
    assert records == [FOX, changed]
    assert notes == ["1 run(s) left out, which read other files than the last one of their scene"]


ODD = (
    {"pictures": None}, {"settings": "k"}, {"settings": {"k": [1]}}, {"stages": {"fit": "long"}}, {"count": True},
    {"scene": 3}, {"notes": [1]}, {"scores": {"psnr_target": float("inf")}}, {"seconds": 10**400},
    {"record_version": 99},
)  # fmt: skip


@pytest.mark.parametrize("run", [None, [], "run", {}, *(asdict(FERN) | odd for odd in ODD)])
def test_records_of_other_kinds_or_versions_are_passed_over(run: object, tmp_path: Path) -> None:
    store(tmp_path, FOX)
    other = line(FERN)
    other["report"]["run"] = run
    with (tmp_path / RECORDS).open("a") as file:
        file.write(json.dumps(other) + "\n")
    records, notes = read_runs(tmp_path)
    assert records == [FOX]
    assert "1 record(s)" in notes[0]


def test_without_targets_some_photos_judge_all_runs(made_scene: Path) -> None:
    """Of fewer than four photos none can be spared."""
    scene = gsmerge.read_scene(made_scene)
    rest, held_out = hold_out(scene)
    assert held_out is not None
    assert (len(rest), held_out.names) == (4, (scene.names[1],))
    assert np.array_equal(held_out.images[0], scene.images[1])
    assert scene.names[1] not in rest.names
    part, targets = choose_views(rest, held_out, 2)
    assert targets is not None
    assert (len(part), targets.names) == (2, held_out.names)
    few = subset(scene, [0, 2, 4])
    assert hold_out(few) == (few, None)


def test_scores_have_names() -> None:
    assert FERN.value("psnr_context") == FERN.scores["psnr_context"]
    assert FERN.value("lpips_alex_target") is None
    assert FERN.value("count") == 528
    assert FERN.value("percent") == pytest.approx(4.4)


@pytest.mark.parametrize("factor", [1e-4, 1e4])
def test_units_change_no_picture(factor: float, tmp_path: Path) -> None:
    scene = scenes.make_scene(scenes.room(), scenes.arc(2))
    moved = scenes.move(scene, np.eye(3), factor, np.zeros(3))
    pictures = [keep_pictures(tmp_path / name, one.gaussians, one, None) for name, one in (("a", scene), ("b", moved))]
    assert [names for _, names in pictures] == [scene.names] * 2
    usual, other = (cv2.imread(str(paths[0])) for paths, _ in pictures)
    assert usual.mean() > 20
    assert np.abs(usual.astype(int) - other).mean() < 1
