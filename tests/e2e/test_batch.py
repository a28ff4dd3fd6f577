"""``gsmerge batch`` compacts folders of scenes, one of which is bad, resumes, plans, and tells it in JSON."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from batches import FAST, InlinePool, records, results, statuses
from messages import names
from shared import make_once, write_scene

import gsmerge
from gsmerge.cli import main
from gsmerge.cli.batch_command import Totals
from gsmerge.errors import USUAL, Note
from gsmerge.jobs.batch.records import record

from .conftest import Outcome, Run, listing

REPORT: dict[str, Any] = {
    "input": {"num_gaussians": 100, "num_photos": 1}, "output": {"num_gaussians": 4}, "ratio": 0.04,
    "psnr_input_views": {"before": 20.0, "after": None}, "unmet": None, "worse": None, "new_views": None,
    "choices": {}, "notes": ["of no weight"], "total_seconds": 1.5,
}  # fmt: skip


def write_rooms(folder: Path) -> None:
    """Write two folders with small scenes, and one with a damaged one."""
    for number in range(2):
        write_scene(folder / f"room{number}", num_views=3, width=24, height=16, seed=number)
    bad = Path(shutil.copytree(folder / "room0", folder / "bad"))
    (bad / "scene.ply").write_bytes((bad / "scene.ply").read_bytes()[:3000])


@pytest.fixture(scope="module")
def rooms() -> Path:
    """Return the folder of :func:`write_rooms`. Read only."""
    return make_once("bad-room", write_rooms)


def batch(run: Run, rooms: Path, out: Path, *options: object) -> Outcome:
    return run("batch", rooms, "--output", out, *FAST, *options)


@pytest.fixture(scope="module", autouse=True)
def _in_this_process() -> Iterator[None]:
    """Run batches in this process: those of ``test_batch_faults.py`` take seconds to start others."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsmerge.jobs.batch.run.ProcessPool", InlinePool)
        yield


def compact_rooms(out: Path) -> None:
    """Run a batch over all three rooms, one of which fails."""
    rooms = make_once("bad-room", write_rooms)
    assert main(["batch", str(rooms), "--output", str(out), *FAST, "-q", "--jobs", "2"]) == 5


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """Return a copy of what :func:`compact_rooms` leaves behind."""
    return Path(shutil.copytree(make_once("bad-room-out", compact_rooms), tmp_path / "out"))


def test_bad_scene_stops_no_other(rooms: Path, out: Path, run: Run, tmp_path: Path) -> None:
    names = [f"room{number}.ply" for number in range(2)]
    assert sorted(results(out)) == names
    assert statuses(out) == {"bad.ply": ["failed"], **{name: ["done"] for name in names}}
    cameras = [f"room{number}.cameras.json" for number in range(2)]
    assert sorted(path.name for path in out.iterdir()) == sorted(["batch.jsonl", *cameras, *names])
    lines = {record["output"]: record for record in records(out)}
    assert "truncated" in lines["bad.ply"]["error"]
    for line in lines.values():
        assert (line["schema_version"], line["tool"]["version"]) == (2, gsmerge.__version__)
    report = lines["room1.ply"]["report"]
    assert (report["input"]["num_gaussians"], report["options"]["threads"]) == (3 * 24 * 16, 1)
    assert report["output"]["bytes"] == lines["room1.ply"]["files"][0]["bytes"]
    assert run("compact", rooms / "room1", "-o", tmp_path / "one.ply", *FAST, "-q").code == 0
    for ending in (".ply", ".cameras.json"):
        assert (tmp_path / f"one{ending}").read_bytes() == (out / f"room1{ending}").read_bytes()


def test_second_run_repeats_only_the_scene_that_failed(rooms: Path, out: Path, run: Run) -> None:
    before = results(out)
    outcome = batch(run, rooms, out)
    assert outcome.code == 5
    assert names(outcome.out, "3 scenes", "0 done", "2 skipped", "1 failed")
    assert "failed: " in outcome.out
    assert "truncated" not in outcome.err.splitlines()[-1]  # which was said before
    assert len([line for line in outcome.err.splitlines() if "warning: " not in line]) == 1 + 3 + 1
    assert names(outcome.err, "1 of 3")
    assert results(out) == before
    assert statuses(out)["bad.ply"] == ["failed", "failed"]


def test_mended_scene_is_done_by_the_next_run_and_overwrite_does_all_again(
    rooms: Path, out: Path, run: Run, tmp_path: Path
) -> None:
    mended = Path(shutil.copytree(rooms, tmp_path / "rooms"))
    shutil.copy(mended / "room0" / "scene.ply", mended / "bad" / "scene.ply")
    outcome = batch(run, mended, out, "--json")
    assert (outcome.code, outcome.err) == (0, "")
    lines = [json.loads(line) for line in outcome.out.splitlines()]
    assert {line["output"]: line["status"] for line in lines}["bad.ply"] == "done"
    assert [line["status"] for line in lines].count("skipped") == 2
    again = batch(run, mended, out, "--overwrite", "--quiet")
    assert (again.code, again.out, again.err) == (0, "", "")
    assert [actual.count("done") for actual in statuses(out).values()] == [2] * 3


def test_a_dry_run_tells_what_is_left(rooms: Path, out: Path, run: Run) -> None:
    before = listing(out)
    outcome = batch(run, rooms, out, "--dry-run")
    assert outcome.code == 0
    assert f"{rooms / 'bad'} -> {out / 'bad.ply'}" in outcome.out
    assert "note: " not in outcome.out
    assert "1 of 3 scenes" in outcome.out
    assert listing(out) == before


def test_a_dry_run_tells_what_the_run_would_refuse(rooms: Path, out: Path, run: Run) -> None:
    before = listing(out)
    refused = batch(run, rooms, out, "--dry-run", "--json", "--seed", 1, "--jobs", 3)
    assert refused.code == 5
    assert names(refused.err, "2 of 3 scenes", "in the run")
    plan = json.loads(refused.out)
    assert (plan["dry_run"], plan["num_scenes"], plan["num_pending"], plan["jobs"]) == (True, 3, 1, 3)
    assert [scene["num_gaussians"] for scene in plan["scenes"]] == [0, 3 * 24 * 16, 3 * 24 * 16]  # one is cut
    assert ["settings" in str(scene["error"]) for scene in plan["scenes"]] == [False, True, True]
    assert listing(out) == before


def test_a_dry_run_makes_no_folder(rooms: Path, tmp_path: Path, run: Run) -> None:
    assert "3 of 3 scenes" in batch(run, rooms, tmp_path / "new", "--dry-run").out
    assert not (tmp_path / "new").exists()


def test_second_scene_of_a_name_fails_alone(rooms: Path, out: Path, run: Run, tmp_path: Path) -> None:
    """The night after: one whose result is there, one of the same name, and a new one."""
    for name in ("room1", "hall"):
        shutil.copytree(rooms / "room0", tmp_path / "later" / name)
    before = results(out)
    outcome = run("batch", rooms / "room1", tmp_path / "later", "--output", out, *FAST, code=5)
    assert names(outcome.out, tmp_path / "later/room1", out / "room1.ply", "1 done, 1 skipped, 1 failed")
    assert results(out) == before | {"hall.ply": before["room0.ply"]}


def test_the_table_at_the_end_has_the_first_results() -> None:
    totals, report = Totals(1000), REPORT
    for number in range(300):
        totals.add(record("done", f"{number}", f"{number}.ply", report=report))
        totals.add(record("failed", f"{number}", f"{number}.ply", error=f"no {number}"))
        totals.add(record("skipped", f"{number}", f"{number}.ply"))
    totals.add(record("skipped", "x", "x.ply", unmet="too few"))
    *table, last = totals.lines()
    header = ["result", "Gaussians", "of", "kept", "new views", "own before", "own after", "seconds"]
    assert table[0].split() == " ".join(header).split()
    assert len(table) == 1 + 20 + 1 + 1 + 20 + 1
    assert "missed target: x: too few" in table
    assert [line for line in table if "more" in line] == ["... and 280 more", "... and 280 more failures"]
    counts = "1,000 scenes: 300 done, 301 skipped, 300 failed, 99 left; 30,000 -> 1,200 Gaussians (4.00 %)"
    assert last == f"{counts}; 1 missed the target"
    assert Totals(0).lines() == ["0 scenes: 0 done"]


def test_each_kind_of_change_and_each_warning_is_printed_once() -> None:
    totals = Totals(6)
    for number in range(6):
        changes = [Note("borders filled", USUAL), f"{number} photos mended", *["sky left out"] * (number == 0)]
        report = REPORT | {"choices": {"changes": changes}}
        doubts = ["too dark", *["too small"] * (number == 1)]
        totals.add(record("done", f"s{5 - number}", f"{number}.ply", doubts=doubts, report=report))
    lines = totals.lines()
    assert [line for line in lines if line.startswith("changed: ")] == [
        "changed: s0, s1, s2, s3 and 2 more: ... photos mended",
        "changed: s5: sky left out",
    ]
    assert [line for line in lines if line.startswith("warning: ")] == [
        "warning: s0, s1, s2, s3 and 2 more: too dark",
        "warning: s4: too small",
    ]
    assert lines[-1].endswith("; 6 doubtful")


def test_folders_without_gaussians_are_noted_by_name(rooms: Path, tmp_path: Path, run: Run) -> None:
    top = Path(shutil.copytree(rooms / "room0", tmp_path / "rooms" / "room0")).parent
    shutil.copytree(top / "room0", top / "room1")
    (top / "room1/scene.ply").unlink()
    for options in (["--dry-run"], FAST):
        outcome = run("batch", top, "--output", tmp_path / "out", *options, code=0)
        assert names(outcome.out, f"note: no Gaussians are read from 1 folder beside the scenes: {top / 'room1'}")


def test_scenes_without_photos_or_cameras_are_noted(rooms: Path, tmp_path: Path, run: Run) -> None:
    """Photos in the named folder are tried for each scene, and used where they show it."""
    top = Path(shutil.copytree(rooms, tmp_path / "rooms"))
    shutil.rmtree(top / "bad")
    shutil.rmtree(top / "room1/images")
    (top / "room0/images").rename(top / "images")

    def notes(*options: object) -> list[str]:
        outcome = run("batch", *options, *FAST, code=0)
        return [line.removeprefix("note: ") for line in outcome.out.splitlines() if line.startswith("note: ")]

    outcome = run("batch", top, "--output", tmp_path / "out", *FAST, code=0)
    other = next(line for line in outcome.out.splitlines() if line.startswith(f"warning: {top / 'room1'}"))
    assert names(other, f"{top / 'room1'}: the photos in {top / 'images'} are left out")
    one = top / "room1"
    lacking = f"{one}: no photos found beside it or in the named folder; its numbers are of the model's own pixels"
    lacking += "; name them with --images"
    assert notes(one, "--output", tmp_path / "out1") == [lacking]
    bare, totals = {"num_gaussians": 8, "num_views": 0, "num_photos": 0}, Totals(1)
    totals.add(record("done", "x", "x.ply", report=REPORT | {"input": bare}))
    assert names("\n".join(totals.lines()), "note: x: no cameras found")


def test_missed_target_ends_with_code_4_and_keeps_the_result(rooms: Path, tmp_path: Path, run: Run) -> None:
    arguments = ("--effort", "draft", "--quality", "90dB", "--set", "superpixels=1%", "--jobs", 1)
    for status in ("done", "skipped"):
        outcome = run("batch", rooms / "room0", "--output", tmp_path, *arguments, code=4)
        assert names(outcome.err, "1 of 1 result", "target")
        assert names(outcome.out, f"missed target: {rooms / 'room0'}: quality: 90 dB", f"1 {status}")
    assert (tmp_path / "room0.ply").exists()
