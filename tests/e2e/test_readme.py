"""The README's blocks run as printed in the folder that it names, from its own installations."""

from __future__ import annotations

import os
import re
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


def find_block(root: Path, words: str, page: str = "README.md") -> str:
    block: str = load_script(root / "tools" / "readme_block.py").find_block(words, page=root / page)
    return block


def test_demo_of_the_readme_makes_the_scene_of_the_python_guide(root: Path, project: Path) -> None:
    run(find_block(root, "tasks.py demo"), project)
    assert (project / "demo" / "preview.png").exists()
    guide = (root / "docs" / "guide" / "python.md").read_text()
    code = re.findall(r"^```python\n(.*?)^```$", guide, re.DOTALL | re.MULTILINE)[0]
    subprocess.run([project / ".venv" / "bin" / "python", "-c", code], cwd=project, check=True)
    assert (project / "demo" / "small.ply").exists()


def test_every_command_of_the_readme_runs_after_its_install(root: Path, project: Path, tmp_path: Path) -> None:
    """In the folder that the project is cloned into, where ``gsmerge`` is not the package."""
    run(f'"{sys.executable}" -m venv venv', tmp_path)
    path = f"{tmp_path / 'venv' / 'bin'}:{os.environ['PATH']}"
    shutil.copytree(project, tmp_path / "gsmerge", ignore=shutil.ignore_patterns(".venv", "demo"))
    make = "python gsmerge/examples/01_make_scene.py"
    install = [
        line for line in find_block(root, "pip install ./gsmerge").splitlines() if not line.startswith("git clone")
    ]
    assert install[0].startswith("pip install ./gsmerge")
    run(install[0], tmp_path, PATH=path)
    for folder in ("scenes/a", "monday", "tuesday"):
        run(f"{make} {folder} --width 64 --height 48", tmp_path, PATH=path)
    run("cp -r monday/. .", tmp_path)
    run("\n".join(install[1:]), tmp_path, PATH=path, BROWSER="true")
    run(find_block(root, "gsmerge batch scenes/", "docs/README.md"), tmp_path, PATH=path)
    for name in ("small.ply", "small.spz", "clip.mp4", "room.gsm", "small"):
        assert (tmp_path / name).exists(), name
