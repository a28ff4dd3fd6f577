"""Fixtures around the tiny scene, and copies of made ones."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from tiny_scene import Tiny, make_tiny


@pytest.fixture
def tiny() -> Tiny:
    return make_tiny()


@pytest.fixture
def tiny_folder(tmp_path: Path, tiny: Tiny) -> Path:
    """The tiny scene with transforms.json and images/."""
    return tiny.save(tmp_path / "scene")


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    """A copy of the module's scene ``made`` that a test may change."""
    return Path(shutil.copytree(made, tmp_path / "scene"))
