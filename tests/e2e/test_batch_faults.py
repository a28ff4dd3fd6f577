"""A batch survives that it or its processes are killed, the disk is full, or another batch is there."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from batches import FAST, NAMES, PATIENCE, finish, has_record, holders, records, results, start, statuses, until
from messages import names
from shared import write_scene

from .conftest import Run

pytestmark = pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc to see processes")


def outlive(pids: list[int]) -> bool:
    """Wait until processes have ended, which they do on their own; whether any has not."""
    deadline = time.monotonic() + PATIENCE
    while any(_runs(pid) for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.02)
    return any(_runs(pid) for pid in pids)


def _runs(pid: int) -> bool:
    """Return whether a process runs; one that has ended and that nobody has asked about does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_was(rooms: Path, tmp_path: Path, undisturbed: dict[str, str]) -> None:
    """What is recorded stays, what is not is done, once. No process of a run outlives it."""
    process = start(rooms, "--output", tmp_path, *FAST, "--jobs", 2)
    workers = until(lambda: has_record(tmp_path) and holders(tmp_path), process)
    process.kill()
    process.communicate()
    assert not outlive(workers or [])
    assert finish(rooms, "--output", tmp_path, *FAST, "--jobs", 2, "-q") == 0
    assert results(tmp_path) == undisturbed
    assert statuses(tmp_path) == {name: ["done"] for name in NAMES}


@pytest.mark.slow
def test_killed_process_costs_its_scene_alone(tmp_path: Path, run: Run) -> None:
    """Two processes are started, each of which imports the package."""
    rooms, out = tmp_path / "rooms", tmp_path / "out"
    for number in range(2):
        write_scene(rooms / f"room{number}", num_views=3, width=24, height=16, seed=number)

    def kill() -> None:
        while not (workers := holders(out)):
            time.sleep(0.005)
        os.kill(workers[0], signal.SIGKILL)

    threading.Thread(target=kill, daemon=True).start()
    outcome = run("batch", rooms, "--output", out, *FAST, "--jobs", 1, "-q", code=5)
    assert names(outcome.err, "1 of 2 scenes", rooms / "room0", "--jobs")
    assert outcome.err.count("\n") == 1
    assert sorted(record["status"] for record in records(out)) == ["done", "failed"]
    assert len(results(out)) == 1


@pytest.mark.usefixtures("foreground")
@pytest.mark.slow
def test_ctrl_c_keeps_whole_results_that_the_next_run_completes(
    rooms: Path, tmp_path: Path, undisturbed: dict[str, str]
) -> None:
    process = start(rooms, "--output", tmp_path, *FAST, "--jobs", 1)
    os.setpriority(os.PRIO_PROCESS, process.pid, 19)  # on a busy machine this side is to see the first scene done
    until(lambda: has_record(tmp_path), process)
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


@pytest.mark.slow
def test_batch_runs_where_the_caller_closed_its_descriptors(smallest_scene: Path, tmp_path: Path) -> None:
    """The pipe to a process does not take the place of one of them."""
    words = (sys.executable, "-m", "gsmerge", "batch", smallest_scene, "--output", tmp_path / "out", *FAST)
    done = subprocess.run(["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *map(str, words)], check=False)
    assert done.returncode == 0
    assert len(results(tmp_path / "out")) == 1
