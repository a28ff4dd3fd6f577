"""Every public name has an example in its docstring, which runs beside a scene in the folder ``demo``."""

from __future__ import annotations

import doctest
import functools
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from splat_transform_programs import put_stand_in, run_here

import gsmerge

NAMES = sorted(set(gsmerge.__all__) - {"__version__"})


@pytest.fixture(scope="module")
def compact() -> Callable[..., gsmerge.CompactResult]:
    """Return the function that takes the folder ``demo`` once for the same options, with its cameras as they are."""
    once, plain = functools.cache(gsmerge.compact), gsmerge.compact
    return lambda scene, **options: (once if isinstance(scene, str) else plain)(scene, poses="fixed", **options)


@pytest.mark.parametrize("name", NAMES)
def test_example_runs(
    name: str, compact: object, small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(small_scene, tmp_path / "demo")
    monkeypatch.chdir(tmp_path)
    if name == "write_levels":
        run_here(monkeypatch, put_stand_in(tmp_path / "program", monkeypatch))
    text = getattr(gsmerge, name).__doc__
    monkeypatch.setattr(gsmerge, "compact", compact)
    example = doctest.DocTestParser().get_doctest(text, {"gsmerge": gsmerge}, name, None, 0)
    assert example.examples
    assert doctest.DocTestRunner().run(example).failed == 0
