"""The automatic checks do what the front page and the templates of issues say of them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer.main
from scripts import load_script

from gsmerge import __version__
from gsmerge.cli.app import app
from gsmerge.kernels.build import find_platform

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
COMMANDS: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]
SHELL = ("/bin/bash", "-euo", "pipefail", "-c")

pytestmark = pytest.mark.skipif(not Path(SHELL[0]).exists(), reason="needs bash")


def find_block(words: str, **page: Path) -> str:
    block: str = load_script(ROOT / "tools" / "readme_block.py").find_block(words, **page)
    return block


def write_program(path: Path, lines: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/bash\n{lines}\n", encoding="utf-8")
    path.chmod(0o755)


def run_block(block: str, folder: Path, failing: str = "none") -> list[str]:
    """Run a block with programs that only write down how they were called; one of them fails."""
    note = f'echo "{{}} $*" >> "{folder}/calls"; [ {{}} != {failing} ]'
    write_program(folder / "bin" / "python3", note.replace("{}", "python3"))
    for name in ("pip", "python", "gsmerge"):
        write_program(folder / ".venv" / "bin" / name, note.replace("{}", name))
    env = {"PATH": f"{folder}/bin:{os.environ['PATH']}"}
    code = subprocess.run([*SHELL, block], cwd=folder, env=env, check=False).returncode
    assert (code == 0) == (failing == "none")
    return (folder / "calls").read_text(encoding="utf-8").splitlines()


def test_block_of_the_tests_runs_as_a_whole(tmp_path: Path) -> None:
    made, installed, tested = run_block(find_block("-m pytest"), tmp_path)
    assert made == "python3 -m venv .venv"
    assert installed == "pip install -q -c constraints.txt -e .[test]"
    assert tested == "python -m pytest"


def calls_of(*tasks: str) -> list[str]:
    """Return the commands of tasks, as :func:`run_block` notes them."""
    calls = [call for task in tasks for call in load_script(ROOT / "tasks.py").TASKS[task]]
    return [" ".join(call).replace("python -m venv", "python3 -m venv") for call in calls]


@pytest.mark.parametrize(
    ("line", "steps", "tasks"),
    [
        ("python3 tasks.py setup tests\n", "-m pytest", ("setup", "tests")),
        ("python3 tasks.py demo\n", "examples/01_make_scene.py", ("demo",)),
    ],
)
def test_short_line_of_a_block_runs_the_commands_that_are_written_out_below(
    line: str, steps: str, tasks: tuple[str, ...], tmp_path: Path
) -> None:
    assert find_block(line.strip()) == line
    assert run_block(find_block(steps), tmp_path) == calls_of(*tasks)


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


def test_commands_of_the_tests_stop_where_one_fails(tmp_path: Path) -> None:
    assert run_block(find_block("-m pytest"), tmp_path, failing="pip")[-1].startswith("pip install")


def test_block_of_the_main_job_runs_as_a_whole(tmp_path: Path) -> None:
    calls = [call.split()[:2] for call in run_block(find_block("examples/01_make_scene.py"), tmp_path)]
    install, make = ["pip", "install"], ["python", "examples/01_make_scene.py"]
    assert calls == [["python3", "-m"], install, make, ["gsmerge", "compact"], ["gsmerge", "render"]]


def test_ci_script_runs_the_block_of_the_tests() -> None:
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert 'commands=$(python3 tools/readme_block.py "tasks.py setup tests")' in script
    assert 'bash -euo pipefail -c "$commands"' in script
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


@pytest.mark.parametrize(("tag", "code"), [(f"v{__version__}", 0), (__version__, 1), (f"v{__version__}.1", 1)])
def test_a_tag_that_is_not_the_version_stops_the_wheels(tag: str, code: int) -> None:
    text = (ROOT / ".github" / "workflows" / "wheels.yml").read_text(encoding="utf-8")
    (step,) = re.findall(r"^ {10}version=\$.+?(?=^ {6}- )", text, re.DOTALL | re.MULTILINE)
    env = {**os.environ, "GITHUB_REF_NAME": tag}
    done = subprocess.run([*SHELL, step], cwd=ROOT, env=env, capture_output=True, check=False)
    assert done.returncode == code
