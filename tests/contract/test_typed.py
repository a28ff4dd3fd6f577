"""Type checkers refuse wrong keywords, and know what results hold."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

WRONG = (
    'budgte="4%"', 'efort="draft"', 'effort="drft"', 'levels="2"', "seed=1.5", "fil=True", 'exposure="fix"',
    "poses=True", 'threads="4"', 'qualitty="30dB"',
)  # fmt: skip
RIGHT = 'budget="4%", effort="draft", k=2, superpixels="1%", quality=None, progress=None'


@pytest.mark.slow
def test_wrong_keywords_are_refused(tmp_path: Path, root: Path) -> None:
    """Takes what a type checker takes that reads the package for the first time."""
    pytest.importorskip("mypy")
    lines = [
        "import gsmerge",
        f"gsmerge.compact('a', {RIGHT})",
        "reveal_type(gsmerge.compact('a').gaussians.means)",
        "gsmerge.Compactor(max_vews=3)",
        *(f"gsmerge.compact('a', {words})" for words in WRONG),
    ]
    path = tmp_path / "user.py"
    path.write_text("\n".join(lines) + "\n")
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", str(path)], capture_output=True, text=True, check=False, cwd=root
    )
    assert "ndarray" in done.stdout
    wrong = {line.split(":")[1] for line in done.stdout.splitlines() if ": error:" in line}
    assert wrong == {str(number) for number in range(4, len(lines) + 1)}, done.stdout
