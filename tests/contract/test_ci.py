"""The automatic checks do what the front page and the templates of issues say of them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from scripts import load_script

from gsmerge import __version__
from gsmerge.method.kernels.build import find_platform

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
SHELL = ("/bin/bash", "-euo", "pipefail", "-c")

pytestmark = pytest.mark.skipif(not Path(SHELL[0]).exists(), reason="needs bash")


def test_lines_of_the_readme_are_tasks() -> None:
    """One line installs and does the main job, and one installs and runs the tests."""
    lines = re.findall(r"python3 tasks\.py ([a-z\s]+)\b", README)
    assert [line.split() for line in lines if line] == [["demo"], ["setup", "tests"]]
    assert {"demo", "setup", "tests"} <= load_script(ROOT / "tasks.py").TASKS.keys()


def test_tasks_use_the_python_that_setup_installs(monkeypatch: pytest.MonkeyPatch) -> None:
    tasks, programs = load_script(ROOT / "tasks.py"), []

    def run(call: list[str], **_: object) -> SimpleNamespace:
        programs.append(call[0])
        return SimpleNamespace(returncode=len(programs) == 3)

    monkeypatch.setattr(tasks.subprocess, "run", run)
    assert tasks.main(["setup", "tests", "lint"]) == 1  # the tests fail, and lint is not run
    assert programs == [sys.executable, str(tasks.INSTALLED / "pip"), str(tasks.INSTALLED / "python")]
    programs.clear()
    assert tasks.main(["tests"]) == 0
    assert programs == [sys.executable]


def test_ci_script_runs_the_readmes_line_of_the_tests() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "\npython3 tasks.py setup tests" in script
    assert re.search(r"^\.venv/bin/python tasks\.py lint types imports docs site\b", script, re.MULTILINE)
    assert script.endswith("\n.venv/bin/python tasks.py sweeps\n")
    assert "run: .ci/run" in (ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8")


def test_every_version_of_python_at_the_ends_is_tested() -> None:
    text = (ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8")
    first, end = re.findall(r'^requires-python = ">=3\.(\d+),<3\.(\d+)"$', PROJECT, re.MULTILINE)[0]
    assert {f"3.{first}", f"3.{int(end) - 1}"} <= set(re.findall(r'python: "([\d.]+)"', text))


def test_wheels_are_built_and_tried_on_the_platforms_of_the_guide() -> None:
    text = (ROOT / ".github" / "workflows" / "wheels.yml").read_text(encoding="utf-8")
    platforms = re.findall(r"for platform in (.+); do", text)[0].split()
    assert len({find_platform(tag) for tag in platforms}) == len(platforms) == 5
    assert sorted(re.findall(r'file: "\*-(\w+)\.whl"', text)) == sorted(platforms)
    guide = (ROOT / "docs" / "guide" / "questions.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `(\w+)\.whl`", guide, re.MULTILINE) == platforms


def test_the_published_site_is_built_with_the_tools_of_the_setup() -> None:
    """Without the package, which the docstrings are read from as text."""
    text = (ROOT / ".github" / "workflows" / "site.yml").read_text(encoding="utf-8")
    (extra,) = re.findall(r"^site = \[(.+)\]$", PROJECT, re.MULTILINE)
    (installed,) = re.findall(r"pip install -c constraints\.txt (.+)$", text, re.MULTILINE)
    assert installed.split() == re.findall(r'"([a-z-]+)>=', extra)
    assert "run: python docs/build_site.py" in text


@pytest.mark.parametrize(("tag", "code"), [(f"v{__version__}", 0), (__version__, 1), (f"v{__version__}.1", 1)])
def test_a_tag_that_is_not_the_version_stops_the_wheels(tag: str, code: int) -> None:
    text = (ROOT / ".github" / "workflows" / "wheels.yml").read_text(encoding="utf-8")
    (step,) = re.findall(r"^ {10}version=\$.+?(?=^ {6}- )", text, re.DOTALL | re.MULTILINE)
    env = {**os.environ, "GITHUB_REF_NAME": tag}
    done = subprocess.run([*SHELL, step], cwd=ROOT, env=env, capture_output=True, check=False)
    assert done.returncode == code
