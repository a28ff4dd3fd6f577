"""The README's demo and its installation run as printed, each in a fresh environment."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from scripts import load_script

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt" or not shutil.which("bash"), reason="needs bash")]


@pytest.fixture(scope="module")
def project(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the project as it is cloned, in a path with a space."""
    ignored = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "kernels-*", "demo")
    return Path(shutil.copytree(root, tmp_path_factory.mktemp("a b") / "gsmerge", ignore=ignored))


def run(block: str, folder: Path, **variables: str) -> None:
    dropped = ("PYTHONPATH", "VIRTUAL_ENV", "GSMERGE_NATIVE")
    env = {key: value for key, value in os.environ.items() if key not in dropped} | variables
    command = ["bash", "-euo", "pipefail", "-c", block]
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{block}\n{done.stdout[-500:]}\n{done.stderr[-2000:]}"


def find_block(root: Path, words: str) -> str:
    block: str = load_script(root / "tools" / "readme_block.py").find_block(words, page=root / "README.md")
    return block


def test_demo_of_the_readme_makes_its_picture(root: Path, project: Path) -> None:
    run(find_block(root, "tasks.py demo"), project)
    assert (project / "demo" / "preview.png").exists()


def test_install_of_the_readme_gives_the_command(root: Path, project: Path, tmp_path: Path) -> None:
    """In the folder that the project is cloned into, where ``gsmerge`` is not the package."""
    run(f'"{sys.executable}" -m venv venv', tmp_path)
    path = f"{tmp_path / 'venv' / 'bin'}:{os.environ['PATH']}"
    shutil.copytree(project, tmp_path / "gsmerge", ignore=shutil.ignore_patterns(".venv", "demo"))
    install = [
        line for line in find_block(root, "pip install ./gsmerge").splitlines() if not line.startswith("git clone")
    ]
    assert install[0].startswith("pip install ./gsmerge")
    run(install[0], tmp_path, PATH=path)
    run("python gsmerge/examples/01_make_scene.py made --width 64 --height 48 && cp -r made/. .", tmp_path, PATH=path)
    run("\n".join(install[1:]), tmp_path, PATH=path, BROWSER="true")
    assert (tmp_path / "scene.compact.ply").exists()
