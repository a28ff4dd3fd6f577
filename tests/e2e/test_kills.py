"""Commands that end before a call that changes their folder, a few of the many of ``benchmarks/kills.py``."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(sys.platform != "linux" or shutil.which("gcc") is None, reason="preloads a library, with gcc")
@pytest.mark.parametrize("command", ["compact", "extend"])
def test_nothing_is_half_written_and_the_next_run_succeeds(command: str, root: Path) -> None:
    words = [sys.executable, str(root / "benchmarks" / "kills.py"), "--calls", "6", "--commands", command]
    done = subprocess.run(words, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.startswith(f"{command}: kills before 6 calls")
    assert done.stdout.endswith(" 0 faults\n")
