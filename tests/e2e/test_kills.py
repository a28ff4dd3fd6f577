"""Commands end well before a call that changes their folder: a few of the many of ``tools/kills.py``."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux" or shutil.which("gcc") is None, reason="preloads a library, with gcc"),
]


def kill(root: Path, *words: str) -> subprocess.CompletedProcess[str]:
    tool = [sys.executable, str(root / "tools" / "kills.py")]
    return subprocess.run([*tool, *words], cwd=root, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("command", ["compact", "extend"])
def test_killed_command_leaves_nothing_that_stops_the_next_run(command: str, root: Path) -> None:
    done = kill(root, "--calls", "3", "--commands", command)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith(f"{command}: kills before 3 calls")
    assert done.stdout.endswith(" 0 faults\n")


def test_files_that_are_not_synced_are_reported(root: Path) -> None:
    done = kill(root, "--calls", "1", "--commands", "extend", "--plant", "no syncs")
    assert done.returncode == 1, done.stderr
    assert "after a loss of power, a.gsm is half-written" in done.stdout
