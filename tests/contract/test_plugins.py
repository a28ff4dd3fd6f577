"""The example of docs/internals/plugins.md, laid out as an installer leaves it, adds its method and its command."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from gsmerge import read_ply

PAGE = Path(__file__).parents[2] / "docs" / "internals" / "plugins.md"


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder with the example's module and the metadata of its package."""
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


def run(site: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(site), *sys.path])
    command = [sys.executable, "-m", "gsmerge", *arguments]
    return subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=False)


def test_the_example_works(site: Path, made_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.ply"
    done = run(site, "compact", str(made_scene), "--set", "method=nth", "--budget", "200", "-o", str(out), "-q")
    assert (done.returncode, done.stderr) == (0, "")
    assert len(read_ply(out).gaussians) == 200
    counted = run(site, "count", str(out))
    assert (counted.returncode, counted.stdout) == (0, "200\n")
    assert "count" in run(site, "--help").stdout


def test_a_broken_package_stops_no_other(site: Path, made_scene: Path) -> None:
    (site / "gsmerge_nth.py").write_text("import no_such_module\n")
    done = run(site, "--help")
    assert done.returncode == 0
    assert "lab" in done.stdout
    assert "gsmerge-nth" in done.stderr
    refused = run(site, "compact", str(made_scene), "--set", "method=nth", "--dry-run")
    assert refused.returncode == 2
    assert "gsmerge-nth" in refused.stderr
