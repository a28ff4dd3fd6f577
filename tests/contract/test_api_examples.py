"""Every public name has an example in its docstring, which runs beside a scene in the folder ``demo``."""

from __future__ import annotations

import doctest
import shutil
from pathlib import Path

import pytest

import gsmerge

NAMES = sorted(set(gsmerge.__all__) - {"__version__"})


@pytest.mark.parametrize("name", NAMES)
def test_example_runs(name: str, small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(small_scene, tmp_path / "demo")
    monkeypatch.chdir(tmp_path)
    text = getattr(gsmerge, name).__doc__
    example = doctest.DocTestParser().get_doctest(text, {"gsmerge": gsmerge}, name, None, 0)
    assert example.examples
    assert doctest.DocTestRunner().run(example).failed == 0
