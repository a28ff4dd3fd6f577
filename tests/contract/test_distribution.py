"""The wheel and the source archive hold what they should, and their metadata say so."""

from __future__ import annotations

import email
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from email.message import Message
from pathlib import Path
from typing import Any

import pytest

import gsmerge
from gsmerge.errors import NO_TORCH
from gsmerge.method.kernels.build import find_platform

pytest.importorskip("setuptools", minversion="77")
tomllib = pytest.importorskip("tomllib", reason="tomllib comes with Python 3.11")
BUILD = "import sys; from setuptools import build_meta as b; to = sys.argv[1]; b.build_wheel(to); b.build_sdist(to)"
# In the place of the compiler, which tests/kernels/test_build.py tries: what it makes is no matter here
COMPILER = "import sys; open(sys.argv[-1], 'wb').close()"
SOURCES = ("gsmerge", "setup.py", "pyproject.toml", "README.md", "LICENSE")


@pytest.fixture(scope="module")
def built(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the wheel and the source archive of a copy of the sources."""
    folder = tmp_path_factory.mktemp("distribution")
    for name in SOURCES:
        if (root / name).is_dir():
            ignored = shutil.ignore_patterns("__pycache__", "kernels-*")
            shutil.copytree(root / name, folder / "source" / name, ignore=ignored)
        else:
            shutil.copy(root / name, folder / "source" / name)
    command = [sys.executable, "-c", BUILD, "../dist"]
    env = {**os.environ, "GSMERGE_CC": shlex.join([sys.executable, "-c", COMPILER])}
    done = subprocess.run(command, cwd=folder / "source", env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def project(root: Path) -> dict[str, Any]:
    content: dict[str, Any] = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    return content


def packed(source: Path) -> set[str]:
    """Return files of the package, without the byte code of what the build runs."""
    files = (path for path in (source / "gsmerge").rglob("*") if path.is_file() and path.suffix != ".pyc")
    return {str(path.relative_to(source)) for path in files}


@pytest.mark.slow
def test_the_wheel_holds_every_file_of_the_package(built: Path) -> None:
    """The build is one of setuptools, in a process of its own."""
    (wheel,) = (built / "dist").glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert packed(built / "source") - names == set()
    for name in (
        "drawing/pages/vendor/spark-three.js.gz",
        "drawing/pages/templates/view.html",
        "method/networks/shipped.safetensors",
        "py.typed",
    ):
        assert f"gsmerge/{name}" in names
    licences = {Path(name).name for name in names if ".dist-info/licenses/" in name}
    assert {"LICENSE", "LICENSE.three", "LICENSE.spark", "LICENSE.fflate"} <= licences
    assert [
        name for name in names if not name.startswith(("gsmerge/", f"gsmerge-{gsmerge.__version__}.dist-info/"))
    ] == []


def test_the_wheel_holds_the_library_of_its_platform(built: Path) -> None:
    """For any version of Python; the source archive holds none."""
    (wheel,) = (built / "dist").glob("*.whl")
    tag = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    assert wheel.name == f"gsmerge-{gsmerge.__version__}-py3-none-{tag}.whl"
    here = find_platform()
    libraries = {name for name in zipfile.ZipFile(wheel).namelist() if "/kernels-" in name}
    assert libraries == {f"gsmerge/method/kernels/{here.library_name(target)}" for target in here.targets}
    (archive,) = (built / "dist").glob("*.tar.gz")
    with tarfile.open(archive) as file:
        assert [name for name in file.getnames() if "/kernels-" in name] == []


def test_the_source_archive_can_be_built_again(built: Path) -> None:
    (archive,) = (built / "dist").glob("*.tar.gz")
    with tarfile.open(archive) as file:
        names = {name.split("/", 1)[1] for name in file.getnames() if "/" in name}
    assert packed(built / "source") - names == set()
    assert {"setup.py", "pyproject.toml", "README.md", "LICENSE"} <= names


def test_metadata_of_the_wheel_name_version_types_and_requirements(
    built: Path, root: Path, project: dict[str, Any]
) -> None:
    (wheel,) = (built / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as file:
        metadata: Message = email.message_from_bytes(
            file.read(next(name for name in file.namelist() if name.endswith(".dist-info/METADATA")))
        )
    assert metadata["Version"] == gsmerge.__version__
    assert "version" not in project  # which stands in gsmerge/version.py alone
    assert "Typing :: Typed" in metadata.get_all("Classifier", [])
    assert [line for line in metadata.get_all("Requires-Dist", []) if "matplotlib" in line] == ["matplotlib<4,>=3.8"]
    assert not re.search(r"file://|/work/|/root/|/tmp/|/home/", metadata.as_string())


def test_messages_install_what_the_extras_ask_for(root: Path, project: dict[str, Any]) -> None:
    extras = project["optional-dependencies"]
    assert f'pip install "{extras["ray"][0]}"' in (root / "gsmerge" / "runtime" / "work.py").read_text()
    assert f'pip install "{extras["torch"][0]}"' in NO_TORCH
    pages = (*root.glob("*.md"), *(root / "docs").rglob("*.md"), *(root / "gsmerge").rglob("*.py"))
    assert [str(page) for page in pages if re.search(r"""install ["']?gsmerge\b""", page.read_text())] == []


def test_the_image_has_the_pinned_versions(root: Path) -> None:
    steps = (root / "Dockerfile").read_text()
    assert steps.count("\nARG BASE=python:3.11-slim") == steps.count("\nFROM $BASE\n") == 1  # or a digest
    assert "pip install --no-cache-dir -c constraints.txt ." in steps
    assert re.findall(r"PIP_(?:BUILD_)?CONSTRAINT=(\S+)", steps) == ["/opt/gsmerge/constraints.txt"] * 2  # of the build
    copied = {word for line in re.findall(r"^COPY (.+) \S+$", steps, re.MULTILINE) for word in line.split()}
    assert copied >= {*SOURCES, "constraints.txt"}
    assert [name for name in copied if not (root / name).exists()] == []
    assert copied & set((root / ".dockerignore").read_text().split()) == set()
