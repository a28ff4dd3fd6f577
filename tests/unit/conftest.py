"""Fixtures around the tiny scene."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_scene import Tiny, make_tiny


@pytest.fixture
def tiny() -> Tiny:
    return make_tiny()


@pytest.fixture
def tiny_folder(tmp_path: Path) -> Path:
    """The tiny scene with transforms.json and images/."""
    return make_tiny().save(tmp_path / "scene")
