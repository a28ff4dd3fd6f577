"""Type checkers know what functions take and what results hold."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_type_checker_knows_arguments_and_results_of_compact(tmp_path: Path, root: Path) -> None:
    """By the settings of the package, so that what ``tasks.py types`` has read need not be read again: a minute.

    The package exports its names explicitly there, and the user's calls are checked as strictly as ``--strict`` does.
    """
    pytest.importorskip("mypy")
    path = tmp_path / "user.py"
    path.write_text(
        "# mypy: disallow-untyped-calls, disallow-any-generics, warn-return-any, strict-equality, extra-checks\n"
        "import gsmerge\nreveal_type(gsmerge.compact('a', k=2).gaussians.means)\ngsmerge.compact('a', progress=3)\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "mypy", str(path)], capture_output=True, text=True, check=False, cwd=root
    )
    assert "ndarray" in done.stdout
    assert [line.split(":")[1] for line in done.stdout.splitlines() if ": error:" in line] == ["4"], done.stdout
