"""One scene at a time: what is done, skipped, refused, locked, and what a kill at any moment leaves."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from batches import QUICK, one_task, records, results, statuses
from messages import names, refuses, says

from gsmerge.batch import task as tasks
from gsmerge.batch.records import BUSY, DONE, FAILED, SKIPPED, STUCK
from gsmerge.batch.task import (
    PREFIX,
    BusyError,
    clean_up,
    record_failure,
    run_lock,
    run_task,
    scene_lock,
)
from gsmerge.errors import SceneError, UsageError
from gsmerge.io import atomic


def test_a_lock_is_of_one_process_and_leaves_nothing(tmp_path: Path) -> None:
    with scene_lock(tmp_path, "a.ply") as begun:
        assert not begun.exists()
        with pytest.raises(BusyError), scene_lock(tmp_path, "a.ply"):
            pass
        with scene_lock(tmp_path, "b.ply") as other:
            assert other != begun
    assert list(tmp_path.iterdir()) == []
    with scene_lock(tmp_path, "a.ply") as again:
        assert again == begun


def test_a_full_disk_is_named(small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is written first; an error of the system in the middle of writing names no file."""
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    for name in ("pathlib.Path.write_text", "gsmerge.batch.task.compact_files"):
        out = tmp_path / name

        def fail(*_: object, **__: object) -> None:
            raise full

        with monkeypatch.context() as patch:
            patch.setattr(name, fail)
            outcome = run_task(*one_task(small_scene, out))
        assert outcome["status"] == FAILED
        assert says(outcome["error"], out if "write_text" in name else "", "No space")


TAKE_TURNS = """
import os, pathlib, sys
from gsmerge.batch.task import BusyError, scene_lock
folder, turns = pathlib.Path(sys.argv[1]), 0
while turns < 300:
    try:
        with scene_lock(folder, "a.ply"):
            os.close(os.open(folder / "taken", os.O_CREAT | os.O_EXCL))  # fails where another has the lock as well
            os.unlink(folder / "taken")
            turns += 1
    except BusyError:
        pass
"""


def test_processes_take_turns_though_each_removes_the_file(tmp_path: Path) -> None:
    processes = [subprocess.Popen([sys.executable, "-c", TAKE_TURNS, str(tmp_path)]) for _ in range(4)]
    assert [process.wait() for process in processes] == [0] * 4
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SceneError, match="File exists"), scene_lock(tmp_path / "file", "a.ply"):
        pass


def test_runs_share_a_folder_if_they_make_the_same(tmp_path: Path) -> None:
    (tmp_path / f"{PREFIX}old.0.1.gone.run").touch()  # of a run that was killed
    with run_lock(tmp_path, "same"), run_lock(tmp_path, "same"):
        found = f"(process {os.getpid()} on {socket.gethostname()})"
        with refuses(UsageError, tmp_path, found, "--output"), run_lock(tmp_path, "other"):
            pass
        with run_lock(tmp_path, "same"):
            pass
    with run_lock(tmp_path, "other"):
        pass
    assert list(tmp_path.iterdir()) == []


def run(scene: Path, out: Path, options: Any = QUICK) -> dict[str, Any]:
    return run_task(*one_task(scene, out, options))


@pytest.fixture
def scene(made_scene: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made_scene, tmp_path / "room"))


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


@pytest.fixture(scope="module")
def undisturbed(made_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What the made scene comes to."""
    out = tmp_path_factory.mktemp("undisturbed")
    scene = shutil.copytree(made_scene, out / "room")
    run(scene, out / "out")
    return results(out / "out")


def test_what_is_done_is_skipped_and_what_changed_is_not(scene: Path, out: Path) -> None:
    first = run(scene, out)
    assert (first["status"], first["error"], first["attempt"]) == (DONE, None, 1)
    assert first["report"]["options"]["effort"] == "draft"
    assert first["report"]["input"]["sha256"]
    assert records(out) == [first]
    again = run(scene, out)
    assert (again["status"], again["key"], again["files"]) == (SKIPPED, first["key"], first["files"])
    assert run(scene, out, replace(QUICK, retries=5, jobs=3))["status"] == SKIPPED
    assert run(scene, out, replace(QUICK, rerun=True))["status"] == DONE
    seed = replace(QUICK, settings=QUICK.settings.with_settings({"seed": 1}))
    assert run(scene, out, seed)["status"] == DONE
    assert run(scene, out)["status"] == DONE  # back to the first settings: the file is of the others
    (out / "room.ply").write_bytes(b"spoiled")
    assert run(scene, out)["status"] == DONE
    photo = next((scene / "images").iterdir())
    photo.write_bytes(photo.read_bytes() + b"\0")
    assert run(scene, out)["status"] == DONE
    assert run(scene, out)["status"] == SKIPPED
    assert list(results(out)) == ["room.ply"]


def test_a_scene_that_moved_is_still_the_same(scene: Path, out: Path, tmp_path: Path) -> None:
    run(scene, out)
    (tmp_path / "elsewhere").mkdir()
    moved = scene.rename(tmp_path / "elsewhere" / "room")
    assert run(moved, out)["status"] == SKIPPED


def test_a_new_version_does_it_again(scene: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(scene, out)
    monkeypatch.setattr(tasks, "__version__", "99")
    assert run(scene, out)["status"] == DONE


def test_a_checkpoint_counts_by_what_is_in_it(scene: Path, out: Path, tmp_path: Path) -> None:
    networks = tmp_path / "networks.safetensors"
    networks.write_bytes(b"no networks")  # which is a note, and the analytic stages go on
    said = replace(QUICK, settings=QUICK.settings.with_settings({"checkpoint": str(networks)}))
    assert run(scene, out, said)["status"] == DONE
    other = Path(shutil.copy(networks, tmp_path / "same.safetensors"))
    same = replace(QUICK, settings=QUICK.settings.with_settings({"checkpoint": str(other)}))
    assert run(scene, out, same)["status"] == SKIPPED
    other.write_bytes(b"no networks either")
    assert run(scene, out, same)["status"] == DONE


@pytest.mark.parametrize("ending", [".compressed.ply", ".spz"])
def test_results_in_other_formats(ending: str, scene: Path, out: Path) -> None:
    said = replace(QUICK, settings=QUICK.settings.with_settings({"levels": 2}), output="{stem}" + ending)
    actual = run(scene, out, said)
    assert [file["path"] for file in actual["files"]] == [f"room{ending}", f"room.level1{ending}"]
    assert sorted(results(out)) == sorted(file["path"] for file in actual["files"])
    start = {".compressed.ply": b"ply\n", ".spz": b"\x1f\x8b"}[ending]
    assert (out / f"room{ending}").read_bytes().startswith(start)
    assert run(scene, out, said)["status"] == SKIPPED
    (out / f"room.level1{ending}").unlink()
    assert run(scene, out, said)["status"] == DONE
    assert run(scene, out)["files"][0]["bytes"] > 2 * actual["files"][0]["bytes"]


def test_a_named_checkpoint_is_no_file(scene: Path, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(scene, out)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "auto").write_bytes(b"something else")
    assert run(scene, out)["status"] == SKIPPED


def test_unexpected_errors_are_recorded(scene: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("odd\nthing")

    monkeypatch.setattr(tasks, "compact_files", broken)
    assert run(scene, out)["error"] == "ZeroDivisionError: odd thing"

    def greedy(*_: Any, **__: Any) -> None:
        raise MemoryError

    monkeypatch.setattr(tasks, "compact_files", greedy)
    assert run(scene, out)["error"].startswith("out of memory")


def test_files_that_no_batch_wrote_are_not_replaced(scene: Path, out: Path) -> None:
    out.mkdir()
    (out / "room.ply").write_bytes(b"mine")
    for _ in range(2):  # the first refusal is no claim
        actual = run(scene, out)
        assert names(actual["error"], "exists", "batch", "--overwrite")
        assert (out / "room.ply").read_bytes() == b"mine"
    assert list(results(out)) == ["room.ply"]
    assert run(scene, out, replace(QUICK, overwrite=True))["status"] == DONE


def test_what_another_run_has_done_meanwhile_is_skipped(scene: Path, out: Path) -> None:
    task, context, later = one_task(scene, out)
    assert run(scene, out)["status"] == DONE
    assert run_task(task, context, later)["status"] == SKIPPED
    task, context, later = one_task(scene, out, replace(QUICK, rerun=True))
    assert run_task(task, context, later)["status"] == DONE
    assert run_task(task, context, later)["status"] == SKIPPED  # done again since the run began


def test_what_another_run_works_on_is_left_to_it(scene: Path, out: Path) -> None:
    task, context, later = one_task(scene, out)
    with scene_lock(out, "room.ply"):
        (out / left_by_a_dead_process()).touch()
        assert run_task(task, context, later)["status"] == BUSY
        assert record_failure(task, context, "died")["status"] == BUSY
        clean_up([task], context)
        assert len(results(out)) == 2  # the lock, and the file that the other process may yet clean up
    assert not (out / "batch.jsonl").exists()


def test_warnings_become_notes(scene: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import warnings

    compact_files = tasks.compact_files

    def odd(*args: Any, **kwargs: Any) -> Any:
        warnings.warn("odd thing", stacklevel=1)
        return compact_files(*args, **kwargs)

    monkeypatch.setattr(tasks, "compact_files", odd)
    assert run(scene, out)["report"]["notes"][-1] == "odd thing"


KILLS = {
    "while it reads": ("gsmerge.batch.task.scene_key", True),
    "while it writes": ("gsmerge.compaction.files.write_gaussians", False),
    "before the result is renamed": ("gsmerge.io.atomic._flush", True),
    "before the record": ("gsmerge.batch.task.append_line", True),
    "before the lock is gone": ("gsmerge.batch.task.Path.unlink", True),
}


@pytest.mark.parametrize(
    "moment", [pytest.param(name, marks=[] if name == "before the record" else [pytest.mark.slow]) for name in KILLS]
)
def test_a_kill_at_any_moment_loses_nothing(
    moment: str, scene: Path, out: Path, root: Path, undisturbed: dict[str, str]
) -> None:
    where, before = KILLS[moment]
    code = f"""
import os, signal, sys
sys.path.insert(0, {str(root / "tests" / "helpers")!r})
from pathlib import Path
from batches import one_task
from gsmerge.batch.task import run_task
target, name = {where!r}.rsplit(".", 1)
owner = __import__("pkgutil").resolve_name(target)
kept = getattr(owner, name)
def killed(*args, **kwargs):
    if not {before}:
        kept(*args, **kwargs)
    os.kill(os.getpid(), signal.SIGKILL)
setattr(owner, name, killed)
run_task(*one_task(Path({str(scene)!r}), Path({str(out)!r})))
"""
    killed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert list(out.glob(".batch-*"))
    after = run(scene, out)
    recorded = moment == "before the lock is gone"
    assert after["status"] == (SKIPPED if recorded else DONE)
    assert results(out) == undisturbed
    assert statuses(out) == {"room.ply": [DONE]}


def test_a_record_cut_in_the_middle_is_done_again(scene: Path, out: Path, undisturbed: dict[str, str]) -> None:
    run(scene, out)
    path = out / "batch.jsonl"
    with scene_lock(out, "room.ply") as begun:
        begun.touch()
    path.write_bytes(path.read_bytes()[:100])
    assert run(scene, out)["status"] == DONE
    assert results(out) == undisturbed
    assert len(records(out)) == 1


def failing(code: int, where: Path) -> Any:
    def refuse(*_: Any, **__: Any) -> None:
        raise OSError(code, os.strerror(code), str(where))

    return refuse


def test_a_full_disk_fails_the_scene_and_leaves_nothing(
    scene: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsmerge.compaction.files.write_gaussians", failing(errno.ENOSPC, out))
    actual = run(scene, out)
    assert actual["status"] == FAILED
    assert says(actual["error"], "room.ply", "No space")
    assert results(out) == {}
    monkeypatch.undo()
    assert run(scene, out)["status"] == DONE


def test_where_nothing_can_be_recorded_nothing_is_forgotten(
    scene: Path, out: Path, monkeypatch: pytest.MonkeyPatch, undisturbed: dict[str, str]
) -> None:
    def refuse(path: Path, _: Any) -> None:
        raise SceneError(path, "cannot be written (No space left on device)")

    monkeypatch.setattr(tasks, "append_line", refuse)
    actual = run(scene, out)
    assert actual["status"] == STUCK
    assert says(actual["error"], "batch.jsonl", "No space")
    task, context, _ = one_task(scene, out)
    assert record_failure(task, context, "died")["status"] == STUCK
    clean_up([task], context)
    monkeypatch.undo()
    assert run(scene, out)["status"] == DONE  # the result is there without a record, and known as ours
    assert results(out) == undisturbed


def test_a_folder_that_cannot_be_written_fails_the_scene(
    scene: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.open

    def refuse(path: Any, *args: Any, **kwargs: Any) -> int:
        if str(path).endswith(".ply"):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return real(path, *args, **kwargs)

    monkeypatch.setattr(atomic.os, "open", refuse)
    assert "Permission denied" in run(scene, out)["error"]


def left_by_a_dead_process() -> str:
    """The name of a temporary file whose process has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return atomic.temporary_path(Path("room.ply")).name.replace(f"-{os.getpid()}-", f"-{process.pid}-")


def killed(out: Path) -> Path:
    """What a process leaves that was killed while it worked on the scene; the mark that it had begun."""
    (out / left_by_a_dead_process()).touch()
    with scene_lock(out, "room.ply") as begun:
        begun.touch()
    return begun


def test_who_is_given_up_leaves_a_record_and_nothing_else(scene: Path, out: Path) -> None:
    task, context, _ = one_task(scene, out)
    killed(out)
    (out / ".room-mine.ply").touch()
    actual = record_failure(replace(task, attempt=2), context, "killed")
    assert (actual["status"], actual["error"], actual["attempt"]) == (FAILED, "killed", 2)
    assert records(out) == [actual]
    assert list(results(out)) == [".room-mine.ply"]


def test_who_is_stopped_leaves_nothing(scene: Path, out: Path) -> None:
    task, context, _ = one_task(scene, out)
    killed(out)
    clean_up([task], context)
    assert list(out.iterdir()) == []


def test_who_is_stopped_between_result_and_record_leaves_the_mark_that_says_whose_it_is(scene: Path, out: Path) -> None:
    task, context, _ = one_task(scene, out)
    begun = killed(out)
    (out / "room.ply").write_bytes(b"ours")
    clean_up([task], context)
    assert sorted(out.iterdir()) == sorted([begun, out / "room.ply"])
    assert run(scene, out)["status"] == DONE
    assert list(results(out)) == ["room.ply"]
