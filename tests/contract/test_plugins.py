"""The example of docs/internals/adding.md, laid out as an installer leaves it, adds its method and its command.

In processes of their own, about a second each: a package is found when its interpreter starts.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from gsmerge import plugin, read_ply

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "internals" / "adding.md"
PUBLIC = {"gsmerge", "gsmerge.plugin", "gsmerge.integrations"}
MAKER = {"gsmerge.research.generate"}  # what makes scenes to try, which examples may use


def test_pages_and_examples_import_what_is_public() -> None:
    """Others may change with any version."""
    pages = [PAGE, *(ROOT / "docs" / "guide").glob("*.md"), *(ROOT / "examples").rglob("*.py")]
    pages += (ROOT / "examples").rglob("*.ipynb")
    for page in pages:
        modules = set(re.findall(r"^[ \"]*(?:from|import) (gsmerge[\w.]*)", page.read_text("utf-8"), re.MULTILINE))
        assert modules <= PUBLIC | MAKER, page.name


def test_names_for_plugins_are_explained() -> None:
    names = {name for name in vars(plugin) if name[0] != "_" and name != "annotations"}
    assert names <= set(re.findall(r"``(\w+)``", str(plugin.__doc__)))


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """Return a folder with the example's module and the metadata of its package."""
    text = PAGE.read_text(encoding="utf-8")
    blocks = dict(re.findall(r"```\w+\n# (\S+)\n(.*?)```", text, re.DOTALL))
    site = tmp_path / "site"
    metadata = site / "gsmerge_nth-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: gsmerge-nth\nVersion: 1.0\n")
    groups = re.findall(r'\[project\.entry-points\."(.+?)"\]\n(.+?)\n\n?', blocks["pyproject.toml"] + "\n")
    assert len(groups) == 2
    (metadata / "entry_points.txt").write_text(
        "".join(f"[{name}]\n{line.replace(chr(34), '')}\n" for name, line in groups)
    )
    (site / "gsmerge_nth.py").write_text(blocks["gsmerge_nth.py"])
    return site


def run(site: Path, *commands: list[str]) -> tuple[list[int], str, str]:
    """Run commands one after the other in a process that finds the package; return exit codes and what they print."""
    path = os.pathsep.join([str(site), *sys.path])
    code = f"from gsmerge.cli import main\nprint([main(words) for words in {commands!r}])"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=True)
    *lines, codes = done.stdout.splitlines()
    return json.loads(codes), "\n".join(lines), done.stderr


@pytest.mark.slow
def test_example_of_the_page_adds_its_method_and_command(site: Path, small_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.ply"
    compact = ["compact", str(small_scene), "--set", "method=nth", "--budget", "200", "-o", str(out), "-q"]
    codes, printed, errors = run(site, compact, ["count", str(out)], ["--help"])
    assert (codes, errors) == ([0, 0, 0], "")
    assert len(read_ply(out).gaussians) == 200
    assert printed.startswith("200\n")
    assert "count" in printed


@pytest.mark.slow
def test_broken_plugin_stops_no_other(site: Path, small_scene: Path) -> None:
    (site / "gsmerge_nth.py").write_text("import no_such_module\n")
    dry = ["compact", str(small_scene), "--set", "method=nth", "--dry-run"]
    codes, printed, errors = run(site, ["--help"], dry)
    assert codes == [0, 2]
    assert "lab" in printed
    assert errors.count("gsmerge-nth") >= 2
