"""Commands that end at random moments, a few of the many of ``benchmarks/kills.py``."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from scripts import load_script

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="signals as POSIX has them"),
]


@pytest.mark.usefixtures("foreground")
@pytest.mark.parametrize("command", ["compact", "encode", "extend", "batch"])
def test_nothing_is_half_written_and_nothing_is_left(command: str, root: Path, tmp_path: Path) -> None:
    kills = load_script(root / "benchmarks" / "kills.py")
    trial = kills.Trial(command, kills.make_scenes(tmp_path / "scenes"), tmp_path / "out")
    trial.run(3, seed=1)
    assert trial.faults == []
    assert sum(trial.codes.values()) == 9
    assert any(name.startswith("SIGKILL -9") for name in trial.codes)
