"""The blocks of the README, of the index and of the guides run in the folder of a scene, one after the other.

A block that cannot run has the line ``<!-- not run: REASON -->`` above it. Commands that a shell would pass on as they
stand, and Python, run in this process, which has imported what they need, with fits of few steps.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import webbrowser
from dataclasses import replace
from pathlib import Path

import pytest
from page_folders import write_page_folder

from gsmerge.cli import main
from gsmerge.plan.efforts import EFFORTS

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt" or not shutil.which("bash"), reason="needs bash")]

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "docs" / "README.md", *sorted((ROOT / "docs" / "guide").glob("*.md"))]
BLOCK = re.compile(
    r"^(?:<!-- not run: (\S[^\n]*) -->\n)?```(bash|python)\n(.*?)^```$", re.DOTALL | re.MULTILINE
)  # reason, language, code
SIZE = re.compile(r"--width \d+ --height \d+")  # of a scene that a block makes, which is made small
INSTALLS = re.compile(r"\b(?:pip|pipx|uvx|npm|apt-get|docker|git|tasks\.py) ")
STEPS = 12  # of a fit, whose quality is nothing here
FOR_A_SHELL = re.compile(r"[^\w\s./:,%=-]")  # what a shell may change in a line, or take as more than words


def find_blocks(text: str) -> list[tuple[str, str, str]]:
    """Return the reason not to run, the language and the code of each block of bash and Python."""
    blocks = BLOCK.findall(text)
    lines = re.findall(r"<!-- not run.*", text)
    assert len(lines) == sum(bool(reason) for reason, *_ in blocks), f"each needs a reason and a block: {lines}"
    installs = [code for reason, _, code in blocks if not reason and INSTALLS.search(code)]
    assert installs == [], "blocks that install or download are not run"
    return blocks


def words_of(code: str) -> list[list[str]] | None:
    """Return the words of a block's commands if all are ``gsmerge`` and a shell would only split them."""
    lines = [line.partition(" #")[0] for line in code.splitlines()]
    if any(FOR_A_SHELL.search(line) or line.split()[:1] != ["gsmerge"] for line in lines):
        return None
    return [shlex.split(line)[1:] for line in lines]


def run_block(language: str, code: str, folder: Path) -> None:
    """Run a block in a folder, which this process is in."""
    commands = words_of(code)
    if language == "python":
        exec(compile(code, "block", "exec"), {"__name__": "__main__"})
    elif commands is not None:
        for words in commands:
            assert main(words) == 0, words
    else:
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", code], cwd=folder, env={**os.environ, "PATH": path},
            stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{code}\n{done.stdout[-1000:]}\n{done.stderr[-2000:]}"


# a block of a page may leave a file to be closed by Python, as `for line in open(...)` does
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_blocks_of_a_page_run_in_order(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = find_blocks(page.read_text(encoding="utf-8"))
    calls = [(language, SIZE.sub("--width 48 --height 32", code)) for reason, language, code in blocks if not reason]
    if not calls:
        pytest.skip("; ".join(reason for reason, *_ in blocks) or "no blocks")
    folder = write_page_folder(tmp_path / "page", "".join(code for _, code in calls))
    monkeypatch.setenv("BROWSER", "true")  # of a shell's commands
    monkeypatch.setattr(webbrowser, "open", lambda *_, **__: True)
    for name, effort in EFFORTS.items():
        monkeypatch.setitem(EFFORTS, name, replace(effort, steps=STEPS))
    monkeypatch.chdir(folder)
    for language, code in calls:
        run_block(language, code, folder)


def test_a_block_for_a_shell_is_left_to_it() -> None:
    assert words_of("gsmerge a.ply -o b.ply --budget 2%  # compacts\n") == [["a.ply", "-o", "b.ply", "--budget", "2%"]]
    for line in ("ls -d scenes/*", "gsmerge batch 'scenes/*'", "gsmerge a.ply > a.txt", "A=1 gsmerge a.ply"):
        assert words_of(f"{line}\n") is None


@pytest.mark.parametrize("line", ["<!-- not run: -->\n```bash\n", "<!-- not run: needs a GPU -->\nText.\n```bash\n"])
def test_a_line_without_a_reason_or_a_block_is_found(line: str) -> None:
    with pytest.raises(AssertionError, match="a reason and a block"):
        find_blocks(f"{line}gsmerge scene.ply\n```\n")


def test_a_block_that_installs_is_not_run() -> None:
    with pytest.raises(AssertionError, match="are not run"):
        find_blocks("```bash\npip install .\n```\n")
