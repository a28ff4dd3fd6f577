"""Scenes of a batch are spread, made, skipped or refused, and a kill at any moment leaves nothing half done."""

from __future__ import annotations

import errno
import math
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from batches import QUICK, InlinePool, one_job, records, results, statuses
from messages import names, refuses, says
from network_fixtures import noisy, untrained, written
from shared import write_scene

from gsmerge.errors import SceneError
from gsmerge.io import atomic
from gsmerge.jobs.batch import BatchOptions, Job, run_batch
from gsmerge.jobs.batch import jobs as calls
from gsmerge.jobs.batch import run as runs
from gsmerge.jobs.batch.jobs import CompactCall, find_jobs
from gsmerge.jobs.batch.records import DONE, FAILED, SKIPPED, prepare_folder
from gsmerge.jobs.batch.run import Run, choose_concurrency, lock_result, pending_jobs, remove_unfinished, run_job
from gsmerge.reading.exporters import NO_HINTS
from gsmerge.runtime.memory import memory_bytes
from gsmerge.runtime.processes import ProcessPool
from gsmerge.runtime.work import Call
from gsmerge.settings.compact import CompactOptions


def test_a_lock_of_a_result_is_held_once_and_leaves_no_file(tmp_path: Path) -> None:
    with lock_result(tmp_path, "a.ply", wait=False) as begun:
        assert not begun.exists()
        with lock_result(tmp_path, "a.ply", wait=False) as second:
            assert second is None
        with lock_result(tmp_path, "b.ply", wait=False) as other:
            assert other is not None
    assert list(tmp_path.iterdir()) == []


def test_a_lock_file_that_cannot_be_removed_is_used_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on Windows, which removes no open file: the release does it there."""

    def refuse(path: Path, *_: Any, **__: Any) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "unlink", refuse)
    for _ in range(2):
        with lock_result(tmp_path, "room.ply", wait=False) as begun:
            assert begun is not None
    assert [path.suffix for path in tmp_path.iterdir()] == ([] if sys.platform == "win32" else [".lock"])


TAKE_TURNS = """
import os, pathlib, sys
from gsmerge.jobs.batch.run import lock_result
folder, turns = pathlib.Path(sys.argv[1]), 0
while turns < 50:
    with lock_result(folder, "a.ply", wait=bool(turns % 2)) as lock:
        if lock is None:
            continue
        os.close(os.open(folder / "taken", os.O_CREAT | os.O_EXCL))  # fails where another has the lock as well
        os.unlink(folder / "taken")
        turns += 1
"""


@pytest.mark.slow
def test_processes_that_remove_the_lock_file_take_turns(tmp_path: Path) -> None:
    """Two processes that import the package: locks of one process say nothing about those of others."""
    processes = [subprocess.Popen([sys.executable, "-c", TAKE_TURNS, str(tmp_path)]) for _ in range(2)]
    assert [process.wait() for process in processes] == [0] * 2
    assert list(tmp_path.iterdir()) == []


def test_a_lock_file_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SceneError, match="exists"), lock_result(tmp_path / "file", "a.ply", wait=False):
        pass


def run(scene: Path, out: Path, options: Any = QUICK) -> dict[str, Any]:
    actual = run_job(*one_job(scene, out, options), wait=False)
    assert actual is not None
    return actual


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Write a scene of two views of 24 x 16."""
    return write_scene(tmp_path / "room", num_views=2, width=24, height=16)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return the files of a run that nothing disturbs."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    run(write_scene(out.with_name("room"), num_views=2, width=24, height=16), out)
    return results(out)


def test_a_finished_scene_is_skipped_by_the_next_run(scene: Path, out: Path) -> None:
    first = run(scene, out)
    assert (first["status"], first["error"]) == (DONE, None)
    assert first["report"]["options"]["effort"] == "draft"
    assert first["report"]["input"]["sha256"]
    assert records(out) == [first]
    again = run(scene, out)
    assert (again["status"], again["key"], again["files"]) == (SKIPPED, first["key"], first["files"])
    assert run(scene, out, replace(QUICK, jobs=3))["status"] == SKIPPED
    assert run(scene, out, replace(QUICK, overwrite=True))["status"] == DONE


def test_other_settings_are_refused_without_overwrite(scene: Path, out: Path) -> None:
    run(scene, out)
    seed = replace(QUICK, settings=QUICK.settings.with_settings({"seed": 1}))
    before = results(out)
    for _ in range(2):  # the first refusal is no claim
        assert says(run(scene, out, seed)["error"], out / "room.ply", "other settings", "--overwrite")
        assert results(out) == before
    assert run(scene, out)["status"] == SKIPPED  # what was refused leaves the others done
    assert run(scene, out, replace(seed, overwrite=True))["status"] == DONE
    assert says(
        run(scene, out)["error"], out / "room.ply", "settings"
    )  # back to the first settings: the file is of the others


def test_a_result_is_made_again_where_its_file_or_a_photo_changed(scene: Path, out: Path) -> None:
    run(scene, out)
    (out / "room.ply").unlink()
    assert run(scene, out)["status"] == DONE
    (out / "room.ply").write_bytes(b"spoiled")
    assert run(scene, out)["status"] == DONE
    photo = next((scene / "images").iterdir())
    photo.write_bytes(photo.read_bytes() + b"\0")
    assert run(scene, out)["status"] == DONE
    assert run(scene, out)["status"] == SKIPPED
    assert list(results(out)) == ["room.ply"]


def test_a_moved_scene_is_skipped_until_the_version_changes(
    scene: Path, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(scene, out)
    (tmp_path / "elsewhere").mkdir()
    moved = scene.rename(tmp_path / "elsewhere" / "room")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "auto").write_bytes(b"something else")  # the checkpoint "auto" is no file
    assert run(moved, out)["status"] == SKIPPED
    monkeypatch.setattr(calls, "__version__", "99")
    assert run(moved, out)["status"] == DONE


def test_a_checkpoint_is_known_by_its_content(scene: Path, out: Path, tmp_path: Path) -> None:
    networks = written(tmp_path / "networks.safetensors", untrained())
    said = replace(QUICK, settings=QUICK.settings.with_settings({"checkpoint": str(networks)}))
    assert run(scene, out, said)["status"] == DONE
    other = Path(shutil.copy(networks, tmp_path / "same.safetensors"))
    same = replace(QUICK, settings=QUICK.settings.with_settings({"checkpoint": str(other)}))
    assert run(scene, out, same)["status"] == SKIPPED
    written(other, noisy())
    assert says(run(scene, out, same)["error"], out / "room.ply", "other settings")
    assert run(scene, out, replace(same, overwrite=True))["status"] == DONE
    other.unlink()
    with refuses(SceneError, "same.safetensors", "no such file"):
        run(scene, out, same)


@pytest.mark.parametrize("ending", [".sog", pytest.param(".spz", marks=pytest.mark.slow)])
def test_results_in_other_formats_are_skipped_until_a_file_is_missing(ending: str, scene: Path, out: Path) -> None:
    said = replace(QUICK, settings=QUICK.settings.with_settings({"levels": 2}), output="{stem}" + ending)
    actual = run(scene, out, said)
    paths = [f"room{ending}", f"room.level1{ending}", "room.cameras.json"]
    assert [file["path"] for file in actual["files"]] == paths
    beside = ["batch.jsonl", *(["room.settings.json"] if ending == ".sog" else [])]
    assert sorted(path.name for path in out.iterdir()) == sorted([*paths, *beside])
    start = {".sog": b"PK", ".spz": b"\x1f\x8b"}[ending]
    assert (out / f"room{ending}").read_bytes().startswith(start)
    assert run(scene, out, said)["status"] == SKIPPED
    (out / f"room.level1{ending}").unlink()
    assert run(scene, out, said)["status"] == DONE


@pytest.mark.parametrize(
    ("error", "recorded"),
    [(ZeroDivisionError("odd\nthing"), "ZeroDivisionError: odd thing"), (MemoryError(), "out of memory.*")],
    ids=["two lines", "no memory"],
)
def test_unexpected_errors_are_recorded_in_one_line(
    error: Exception, recorded: str, scene: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calls, "compact_files", Mock(side_effect=error))
    assert re.fullmatch(recorded, run(scene, out)["error"])


def test_a_failure_says_that_the_earlier_result_stays(scene: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the run and in the plan, whatever the error; there is nothing to say before the first result."""
    ply = (scene / "scene.ply").read_bytes()
    (scene / "scene.ply").write_bytes(ply[:-9])
    assert "stays" not in run(scene, out)["error"]
    (scene / "scene.ply").write_bytes(ply)
    run(scene, out)
    (scene / "scene.ply").write_bytes(ply[:-9])
    assert says(run(scene, out)["error"], "scene.ply", f"its earlier result {out / 'room.ply'} stays")

    def refuse(*_: Any) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(scene / "scene.ply"))

    monkeypatch.setattr(calls, "content_hash", refuse)
    job, started = one_job(scene, out)
    [(_, foreseen)] = pending_jobs([job], out, QUICK)
    ended = run_job(job, started, wait=False)
    assert foreseen == ended["error"]
    assert says(foreseen, "scene.ply", "Permission denied", "stays")


def test_the_result_of_another_scene_is_not_overwritten(scene: Path, out: Path) -> None:
    """Also one whose name comes a night later, by itself or beside the first; each on its own."""
    other = Path(shutil.copytree(scene, scene.parent / "later" / "room"))
    (photo := next((other / "images").iterdir())).write_bytes(photo.read_bytes() + b"\0")
    run(scene, out)
    before = results(out)
    assert says(run(other, out)["error"], out / "room.ply", scene, "--name", "--overwrite")
    for options in (QUICK, replace(QUICK, overwrite=True)):
        both, started = find_jobs([str(other), str(scene)], out, options), Run(out, 1, options.overwrite)
        foreseen = {job.scene: refused for job, refused in pending_jobs(both, out, options)}
        ended = {job.scene: run_job(job, started, wait=False) for job in both}
        assert [line and line["status"] for line in ended.values()] == [FAILED, DONE if options.overwrite else SKIPPED]
        assert says(foreseen[str(other)], out / "room.ply", scene, other, "--name")
        assert foreseen.get(str(scene)) is None
        assert results(out) == before
    shutil.rmtree(scene)
    assert run(other, out)["status"] == DONE  # the scene was moved, or is gone


@pytest.mark.skipif(sys.platform == "win32", reason="folders cannot be locked there")
def test_a_finished_scene_is_skipped_in_a_folder_that_cannot_be_written(
    scene: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(scene, out)
    monkeypatch.setattr(os, "access", lambda path, _: Path(path) != out)
    monkeypatch.setattr(runs, "lock_file", None)
    monkeypatch.setattr(Path, "touch", None)
    prepare_folder(out)
    assert run(scene, out)["status"] == SKIPPED


def test_a_file_that_no_batch_wrote_is_not_replaced(scene: Path, out: Path) -> None:
    out.mkdir()
    (out / "room.ply").write_bytes(b"mine")
    for _ in range(2):  # the first refusal is no claim
        actual = run(scene, out)
        assert names(actual["error"], "exists", "batch", "--overwrite")
        assert (out / "room.ply").read_bytes() == b"mine"
    assert list(results(out)) == ["room.ply"]
    (out / "room.ply").unlink()
    (out / "room.ply").symlink_to("nowhere")
    assert says(run(scene, out)["error"], out / "room.ply", "link to nowhere", "--overwrite")
    (out / "room.ply").unlink()
    (out / "room.ply").mkdir()
    assert says(run(scene, out)["error"], out / "room.ply", "rename it")
    assert "--overwrite" not in run(scene, out)["error"]


def test_cameras_that_no_batch_wrote_are_not_replaced(scene: Path, out: Path) -> None:
    out.mkdir()
    (out / "room.cameras.json").write_bytes(b"mine")  # or those of a result in another format
    assert [file["path"] for file in run(scene, out)["files"]] == ["room.ply"]
    assert (out / "room.cameras.json").read_bytes() == b"mine"
    mine = Path(shutil.copy(scene / "transforms.json", out / "room.cameras.json"))
    run(scene, out, replace(QUICK, overwrite=True, cameras=str(mine)))
    assert mine.read_bytes() == (scene / "transforms.json").read_bytes()
    assert run(scene, out, replace(QUICK, overwrite=True))["status"] == DONE


def test_a_scene_that_another_run_works_on_is_left_to_that_run(scene: Path, out: Path) -> None:
    job, started = one_job(scene, out)
    with lock_result(out, "room.ply", wait=False) as begun:
        begun.touch()
        (out / left_by_a_dead_process()).touch()
        assert run_job(job, started, wait=False) is None
        assert run_job(job, started, False, "died") is None
        remove_unfinished(started, [job])
        assert len(results(out)) == 3  # lock, mark, and the file that the other process may yet clean up
    assert not (out / "batch.jsonl").exists()


def test_a_scene_that_another_run_works_on_comes_last(scene: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    @contextmanager
    def watched(folder: Path, output: str, *, wait: bool) -> Iterator[Path | None]:
        seen.append((output, wait))
        with lock_result(folder, output, wait=wait) as begun:
            yield None if len(seen) == 1 else begun

    monkeypatch.setattr(runs, "lock_result", watched)
    monkeypatch.setattr(runs, "ProcessPool", InlinePool)
    shutil.copytree(scene, scene.parent / "other")
    jobs = [one_job(scene.parent / name, out)[0] for name in ("room", "other")]
    assert [line["output"] for line in run_batch(jobs, out, QUICK)] == ["other.ply", "room.ply"]
    assert seen == [("room.ply", False), ("other.ply", False), ("room.ply", True)]


KILLS = {
    "while it reads": ("gsmerge.jobs.batch.jobs.content_hash", True),
    "while it writes": ("gsmerge.io.formats.write._write_ply", False),
    "before the result is renamed": ("gsmerge.io.atomic._flush", True),
    "before the record": ("gsmerge.jobs.batch.run.append_line", True),
    "before the mark is gone": ("gsmerge.jobs.batch.run.Path.unlink", True),
}


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="signals as POSIX has them")
@pytest.mark.parametrize(
    "moment", [pytest.param(name, marks=[] if name == "before the record" else [pytest.mark.slow]) for name in KILLS]
)
def test_a_run_killed_at_any_moment_is_made_good_by_the_next(
    moment: str, scene: Path, out: Path, root: Path, undisturbed: dict[str, str]
) -> None:
    where, before = KILLS[moment]
    code = f"""
import os, signal, sys
sys.path.insert(0, {str(root / "tests" / "helpers")!r})
from pathlib import Path
from batches import one_job
from gsmerge.jobs.batch.run import run_job
target, name = {where!r}.rsplit(".", 1)
owner = __import__("pkgutil").resolve_name(target)
kept = getattr(owner, name)
def killed(*args, **kwargs):
    if not {before}:
        kept(*args, **kwargs)
    os.kill(os.getpid(), signal.SIGKILL)
setattr(owner, name, killed)
run_job(*one_job(Path({str(scene)!r}), Path({str(out)!r})), wait=False)
"""
    killed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert list(out.glob(".batch-*"))
    after = run(scene, out)
    recorded = moment == "before the mark is gone"
    assert after["status"] == (SKIPPED if recorded else DONE)
    assert results(out) == undisturbed
    assert statuses(out) == {"room.ply": [DONE]}


@pytest.mark.parametrize(
    "name",
    [
        "gsmerge.jobs.batch.run.atomic_output",
        "gsmerge.jobs.batch.jobs.compact_files",
        "gsmerge.io.formats.write._write_ply",
    ],
)
def test_a_full_disk_fails_the_scene_without_a_file_left(
    name: str, scene: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever is written first; an error of the system in the middle of writing names no file."""

    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(name, fail)
        actual = run(scene, out)
    assert actual["status"] == FAILED
    assert says(actual["error"], "", "No space")
    assert results(out) == {}
    assert run(scene, out)["status"] == DONE


def test_a_result_that_could_not_be_recorded_is_made_again(
    scene: Path, out: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: dict[str, str]
) -> None:
    def refuse(path: Path, _: Any) -> None:
        raise SceneError(path, "cannot be written (No space left on device)")

    monkeypatch.setattr(runs, "append_line", refuse)
    with refuses(SceneError, "batch.jsonl", "No space"):
        run(scene, out)
    job, started = one_job(scene, out)
    with refuses(SceneError, "batch.jsonl", "No space"):
        run_job(job, started, False, "died")
    remove_unfinished(started, [job])
    monkeypatch.undo()
    assert run(scene, out)["status"] == DONE  # the result is there without a record, and known as ours
    assert results(out) == undisturbed


def left_by_a_dead_process() -> str:
    """Return the name of a temporary file whose process has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return atomic.temporary_path(Path("room.ply")).name.replace(f"-{os.getpid()}-", f"-{process.pid}-")


def leave_mark(out: Path) -> Path:
    """Leave the mark of a process that was killed while it worked on the scene."""
    with lock_result(out, "room.ply", wait=False) as begun:
        begun.touch()
    return begun


def leave_killed_run(out: Path) -> Path:
    """Leave all that such a process leaves; return the mark."""
    (out / left_by_a_dead_process()).touch()
    return leave_mark(out)


def test_a_run_that_is_given_up_leaves_only_its_record(scene: Path, out: Path) -> None:
    job, started = one_job(scene, out)
    leave_killed_run(out)
    (out / ".room-mine.ply").touch()
    actual = run_job(job, started, False, "killed")
    assert (actual["status"], actual["error"]) == (FAILED, "killed")
    assert records(out) == [actual]
    assert list(results(out)) == [".room-mine.ply"]


def test_a_stopped_run_leaves_no_file(scene: Path, out: Path) -> None:
    job, started = one_job(scene, out)
    leave_killed_run(out)
    remove_unfinished(started, [job])
    assert list(out.iterdir()) == []


def test_a_run_stopped_before_its_record_leaves_the_mark_of_its_result(scene: Path, out: Path) -> None:
    job, started = one_job(scene, out)
    mark = leave_killed_run(out)
    (out / "room.ply").write_bytes(b"ours")
    remove_unfinished(started, [job])
    assert sorted(out.iterdir()) == sorted([mark, out / "room.ply"])
    assert run(scene, out)["status"] == DONE
    assert list(results(out)) == ["room.ply"]


CALL = CompactCall(CompactOptions(), "auto", NO_HINTS)


def make_jobs(*counts: int) -> list[Job]:
    return [Job(f"{i}", (f"{i}.ply",), CALL, count) for i, count in enumerate(counts)]


def set_machine(monkeypatch: pytest.MonkeyPatch, processors: int, memory: int | None) -> None:
    monkeypatch.setattr(runs, "available_threads", lambda: processors)
    monkeypatch.setattr(runs, "free_memory", lambda: memory)


def test_processors_are_divided_among_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    set_machine(monkeypatch, 8, 10**12)

    def spread(count: int, **message: Any) -> tuple[int, int]:
        settings = CompactOptions().with_settings({"threads": message.pop("threads", None)})
        concurrency = choose_concurrency(make_jobs(*[1000] * count), BatchOptions(settings, **message))
        return concurrency.jobs, concurrency.threads

    assert spread(100) == (8, 1)
    assert spread(3) == (3, 2)
    assert spread(1) == (1, 8)
    assert spread(0) == (1, 8)
    assert spread(100, jobs=2) == (2, 4)
    assert spread(100, jobs=20) == (20, 1)
    assert spread(100, threads=4) == (2, 4)
    assert spread(100, threads=4, jobs=3) == (3, 4)
    assert spread(100, engine="ray") == (0, 1)
    assert spread(100, engine="ray", jobs=5, threads=2) == (5, 2)


def test_memory_limits_the_number_of_concurrent_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    large, small = 10_000_000, 10_000
    scenes, need = make_jobs(small, large, small, large, small), memory_bytes(large)

    def count(share: float | None, **message: Any) -> int:
        set_machine(monkeypatch, 4, None if share is None else int(share * need / runs.FREE_MEMORY_SHARE) + 1)
        return choose_concurrency(scenes, BatchOptions(**message)).jobs

    assert [count(3), count(1), count(None)] == [4, 4, 4]  # those that are larger than most wait for each other
    assert count(1, jobs=3) == 3  # who asks for it gets it
    scenes = make_jobs(small, large, large)
    assert [count(4), count(2), count(1.9), count(0.5), count(None)] == [3, 2, 1, 1, 3]
    assert choose_concurrency(scenes, BatchOptions(jobs=2)).memory == math.inf


class Gauge(InlinePool):
    """A pool of three calls at once, which end one after the other."""

    capacity, most = 3, 0

    def __init__(self, memory: float) -> None:
        super().__init__()
        self.memory, self.order, self.calls = memory, list[int](), dict[int, tuple[Call, None]]()

    has_room = ProcessPool.has_room  # type: ignore[assignment]

    def submit(self, _: Any, call: Call) -> None:
        self.calls[call.key] = call, None
        self.order.append(call.key)
        self.most = max(self.most, sum(running.memory for running, _ in self.calls.values()))

    def wait(self) -> list[tuple[Any, Any]]:
        key = next(iter(self.calls))
        return [(key, self.calls.pop(key)[0].memory)]


@pytest.mark.parametrize(("memory", "most"), [(math.inf, 15), (12, 12), (10, 9), (8, 9), (0, 9)])
def test_concurrent_calls_fit_into_the_memory_unless_one_is_alone(memory: float, most: int) -> None:
    pool, sizes = Gauge(memory), [2, 3, 9, 2, 4, 1]
    ended = dict(pool.run(int, (Call(key, (), size) for key, size in enumerate(sizes))))
    assert ended == dict(enumerate(sizes))
    assert pool.order == list(range(len(sizes)))
    assert pool.most == most


def test_a_scene_that_must_run_alone_comes_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    set_machine(monkeypatch, 4, 4 * memory_bytes(10))
    monkeypatch.setattr(runs, "ProcessPool", InlinePool)
    done = run_batch(make_jobs(10, 10**7, 10, 10), tmp_path, BatchOptions())
    assert [line["scene"] for line in done] == ["0", "2", "3", "1"]
