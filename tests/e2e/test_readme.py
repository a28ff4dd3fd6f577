"""The README's demo and its installation run as printed, in a fresh environment."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt" or not shutil.which("bash"), reason="needs bash")]


@pytest.fixture(scope="module")
def project(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the project as it is cloned, in a path with a space."""
    ignored = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "build", "kernels-*", "demo")
    return Path(shutil.copytree(root, tmp_path_factory.mktemp("a b") / "gsmerge", ignore=ignored))


def run(block: str, folder: Path, **variables: str) -> None:
    dropped = ("PYTHONPATH", "VIRTUAL_ENV", "GSMERGE_NATIVE")
    env = {key: value for key, value in os.environ.items() if key not in dropped} | {"PIP_COMPILE": "0"} | variables
    command = ["bash", "-euo", "pipefail", "-c", block]
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{block}\n{done.stdout[-500:]}\n{done.stderr[-2000:]}"


def test_demo_and_installation_of_the_readme(project: Path, tmp_path: Path) -> None:
    """One test, so that what the package needs is installed once: the installation takes the demo's environment.

    It is tried in the folder that the project is cloned into, where ``gsmerge`` is not the package. Its compiler gives
    the libraries that the demo's has just built of the same sources, which takes a minute of processor time. Files are
    compiled as they are imported, a few hundred of the thousands that pip would compile.
    """
    run("python3 tasks.py demo", project)
    assert (project / "demo" / "preview.png").exists()
    path = f"{project / '.venv' / 'bin'}:{os.environ['PATH']}"
    ignored = shutil.ignore_patterns(".venv", "demo", "build", "*.egg-info", "__pycache__", "kernels-*")
    shutil.copytree(project, tmp_path / "gsmerge", ignore=ignored)
    compiler = tmp_path / "compiler"
    kernels = project / "gsmerge" / "method" / "kernels"
    compiler.write_text(f'#!/bin/bash\ncp {shlex.quote(str(kernels))}/"${{@: -1}}" .\n')  # the last word is a file's
    compiler.chmod(0o755)
    run("pip install ./gsmerge", tmp_path, PATH=path, GSMERGE_CC=shlex.quote(str(compiler)))
    run("python gsmerge/examples/01_make_scene.py made --width 64 --height 48 && cp -r made/. .", tmp_path, PATH=path)
    run("gsmerge scene.ply", tmp_path, PATH=path, BROWSER="true")
    assert (tmp_path / "scene.compact.ply").exists()
