"""What may happen to a batch: it is killed, its processes are, the disk is full, somebody else is there."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from batches import FAST, NAMES, PATIENCE, finish, holders, records, results, start, statuses, until
from messages import ERROR, names, says

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc to see processes")


def outlive(pids: list[int]) -> bool:
    """Wait until processes have ended, which they do on their own; whether any has not."""
    deadline = time.monotonic() + PATIENCE
    while any(_runs(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.02)
    return any(_runs(pid) for pid in pids)


def _runs(pid: int) -> bool:
    """Whether a process runs; one that has ended and that nobody has asked about does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
def test_killed_again_and_again(rooms: Path, tmp_path: Path, undisturbed: dict[str, str]) -> None:
    """At random moments from the first scene on: what is recorded stays, what is not is done, once.

    No process of a run outlives it.
    """
    out, chance = tmp_path / "out", random.Random(0)
    for _ in range(4):
        process = start(rooms, "--output", out, *FAST, "--jobs", 2)
        workers = until(lambda: holders(out), process) or []
        time.sleep(chance.uniform(0, 0.5))
        process.kill()
        process.communicate()
        assert not outlive(workers)
        if sorted(statuses(out)) == NAMES:
            break
    process = start(rooms, "--output", out, *FAST, "--jobs", 2, "--json")
    said, errors = process.communicate()
    assert (process.returncode, errors) == (0, "")
    assert sorted(json.loads(line)["output"] for line in said.splitlines()) == NAMES
    assert results(out) == undisturbed
    assert statuses(out) == {name: ["done"] for name in NAMES}


@pytest.mark.slow
def test_two_runs_share_the_work(rooms: Path, tmp_path: Path, undisturbed: dict[str, str]) -> None:
    runs = [start(rooms, "--output", tmp_path, *FAST, "--jobs", 1, "--json") for _ in range(2)]
    said = [[json.loads(line) for line in process.communicate()[0].splitlines()] for process in runs]
    assert [process.returncode for process in runs] == [0, 0]
    assert results(tmp_path) == undisturbed
    assert statuses(tmp_path) == {name: ["done"] for name in NAMES}
    for lines in said:
        assert sorted(line["output"] for line in lines) == NAMES
    assert sum(line["status"] == "done" for lines in said for line in lines) == len(NAMES)


def test_a_killed_process_costs_its_scene_alone(rooms: Path, tmp_path: Path) -> None:
    process = start(rooms, "--output", tmp_path, *FAST, "--jobs", 1, "-q")
    workers = until(lambda: holders(tmp_path), process)
    os.kill(workers[0], signal.SIGKILL)
    errors = process.communicate()[1]
    assert process.returncode == 5
    assert names(errors, "1 of 4 scenes", rooms / "room0", "SIGKILL")
    assert errors.count("\n") == 1
    assert sorted(record["status"] for record in records(tmp_path)) == ["done"] * 3 + ["failed"]
    assert len(results(tmp_path)) == 3


@pytest.mark.usefixtures("foreground")
@pytest.mark.slow
def test_ctrl_c_ends_with_what_is_done(rooms: Path, tmp_path: Path, undisturbed: dict[str, str]) -> None:
    process = start(rooms, "--output", tmp_path, *FAST, "--jobs", 1)
    os.setpriority(os.PRIO_PROCESS, process.pid, 19)  # on a busy machine this side is to see the first scene done
    until(lambda: (tmp_path / "batch.jsonl").exists() and records(tmp_path), process)
    process.send_signal(signal.SIGINT)
    said, errors = process.communicate()
    assert process.returncode == 130
    assert errors.endswith("gsmerge: error: interrupted\n")
    done = [name for name, actual in statuses(tmp_path).items() if actual == ["done"]]
    assert 1 <= len(done) < len(NAMES)
    assert said.splitlines()[-1].startswith("4 scenes: ")
    assert " left" in said.splitlines()[-1]
    assert {name for name in results(tmp_path) if not name.startswith(".batch-")} <= set(NAMES)  # nothing half-done
    assert finish(rooms, "--output", tmp_path, *FAST, "--jobs", 1, "-q") == 0
    assert results(tmp_path) == undisturbed
    assert statuses(tmp_path) == {name: ["done"] for name in NAMES}


def limited(limit: int, *arguments: object) -> tuple[int, str]:
    """A batch that may write no file beyond a size, as on a disk that fills up."""
    code = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))\n"
    code += "import sys; from gsmerge.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "batch", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_nothing_is_lost(rooms: Path, tmp_path: Path, undisturbed: dict[str, str]) -> None:
    """Results do not fit and records do; then records do not either."""
    said = (rooms, "--output", tmp_path, *FAST, "--jobs", 1, "-q")
    code, errors = limited(30_000, *said)
    assert code == 5
    assert names(errors, "4 of 4", "room0.ply", "File too large")
    assert errors.count("\n") == 1
    assert results(tmp_path) == {}
    code, errors = limited((tmp_path / "batch.jsonl").stat().st_size + 100, *said)
    assert code == 3
    assert says(errors.removeprefix(ERROR), tmp_path / "batch.jsonl", "No space left", "--output")
    assert errors.count("\n") == 1
    assert finish(*said) == 0
    assert results(tmp_path) == undisturbed


def test_descriptors_that_the_caller_closed(smallest_scene: Path, tmp_path: Path) -> None:
    """The pipe to a process does not take the place of one of them."""
    words = (sys.executable, "-m", "gsmerge", "batch", smallest_scene, "--output", tmp_path / "out", *FAST)
    done = subprocess.run(["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *map(str, words)], check=False)
    assert done.returncode == 0
    assert len(results(tmp_path / "out")) == 1
