"""Fixtures for the whole suite: a scene that the project makes itself."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent


def load_script(path: Path) -> ModuleType:
    """A script as a module; its name may start with a digit."""
    name = f"script_{path.stem}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def root() -> Path:
    """The repository's root."""
    return ROOT


@pytest.fixture(scope="session")
def make_scene() -> Callable[..., Path]:
    """``make_scene(out, num_views=, width=, height=, seed=)`` of the first example."""
    return load_script(ROOT / "examples" / "01_make_scene.py").make_scene


@pytest.fixture(scope="session")
def target_psnr() -> Callable[[Path, Path], float]:
    """``target_psnr(targets, ply)`` of the measuring example, dB."""
    return load_script(ROOT / "examples" / "03_measure_targets.py").target_psnr


@pytest.fixture(scope="session")
def made_scene(make_scene: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scene.ply, transforms.json, images/ and targets/: 5 views of 96 x 64. Read only."""
    return make_scene(tmp_path_factory.mktemp("made") / "scene", num_views=5, width=96, height=64)


@pytest.fixture
def scene_copy(made_scene: Path, tmp_path: Path) -> Path:
    """A copy of the made scene that a test may spoil."""
    return Path(shutil.copytree(made_scene, tmp_path / "scene"))
