"""The blocks of the README, of the index and of the guides run in the folder of a scene, one after the other.

A block that cannot run has the line ``<!-- not run: REASON -->`` above it.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from page_folders import write_page_folder

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt" or not shutil.which("bash"), reason="needs bash")]

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "docs" / "README.md", *sorted((ROOT / "docs" / "guide").glob("*.md"))]
BLOCK = re.compile(
    r"^(?:<!-- not run: (\S[^\n]*) -->\n)?```(bash|python)\n(.*?)^```$", re.DOTALL | re.MULTILINE
)  # reason, language, code
SIZE = re.compile(r"--width \d+ --height \d+")  # of a scene that a block makes, which is made small
INSTALLS = re.compile(r"\b(?:pip|pipx|uvx|npm|apt-get|docker|git|tasks\.py) ")
RUNNERS = {"bash": ("bash", "-euo", "pipefail", "-c"), "python": (sys.executable, "-c")}


def find_blocks(text: str) -> list[tuple[str, str, str]]:
    """Return the reason not to run, the language and the code of each block of bash and Python."""
    blocks = BLOCK.findall(text)
    lines = re.findall(r"<!-- not run.*", text)
    assert len(lines) == sum(bool(reason) for reason, *_ in blocks), f"each needs a reason and a block: {lines}"
    installs = [code for reason, _, code in blocks if not reason and INSTALLS.search(code)]
    assert installs == [], "blocks that install or download are not run"
    return blocks


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_blocks_of_a_page_run_in_order(page: Path, tmp_path: Path) -> None:
    blocks = find_blocks(page.read_text(encoding="utf-8"))
    calls = [(language, SIZE.sub("--width 48 --height 32", code)) for reason, language, code in blocks if not reason]
    if not calls:
        pytest.skip("; ".join(reason for reason, *_ in blocks) or "no blocks")
    folder = write_page_folder(tmp_path / "page", "".join(code for _, code in calls))
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for language, code in calls:
        done = subprocess.run(
            [*RUNNERS[language], code], cwd=folder, env={**os.environ, "PATH": path, "BROWSER": "true"},
            stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{code}\n{done.stdout[-1000:]}\n{done.stderr[-2000:]}"


@pytest.mark.parametrize("line", ["<!-- not run: -->\n```bash\n", "<!-- not run: needs a GPU -->\nText.\n```bash\n"])
def test_a_line_without_a_reason_or_a_block_is_found(line: str) -> None:
    with pytest.raises(AssertionError, match="a reason and a block"):
        find_blocks(f"{line}gsmerge scene.ply\n```\n")


def test_a_block_that_installs_is_not_run() -> None:
    with pytest.raises(AssertionError, match="are not run"):
        find_blocks("```bash\npip install .\n```\n")
