"""What is public is documented with an example that runs, typed, and where the documentation says."""

from __future__ import annotations

import doctest
import functools
import inspect
import shutil
from collections.abc import Callable
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

import pytest
from splat_transform_programs import put_stand_in, run_here

import gsmerge

PUBLIC = sorted(set(gsmerge.__all__) - {"__version__"})
PROMISED = ("read_scene", "compact", "write_ply", "render", "superpixels", "Gaussians", "Cameras")


def test_promised_names_are_exported() -> None:
    assert set(PROMISED) <= set(PUBLIC)
    assert set(PUBLIC) <= set(dir(gsmerge))


@pytest.mark.parametrize("name", PUBLIC)
def test_public_names_are_documented(name: str) -> None:
    value = getattr(gsmerge, name)
    assert callable(value)
    assert value.__doc__
    assert value.__module__.startswith("gsmerge.")
    first = value.__doc__.splitlines()[0]
    assert first.endswith(".")
    assert not first.startswith(f"{name}(")  # what dataclasses make up when there is no docstring


@pytest.mark.parametrize("name", [name for name in PUBLIC if is_dataclass(getattr(gsmerge, name))])
def test_public_values_are_equal_by_value(name: str) -> None:
    assert getattr(gsmerge, name).__eq__ is not object.__eq__


@pytest.mark.parametrize("name", [name for name in PUBLIC if name[0].islower()])
def test_public_functions_are_typed(name: str) -> None:
    signature = inspect.signature(getattr(gsmerge, name))
    assert signature.return_annotation is not inspect.Signature.empty
    assert [p.name for p in signature.parameters.values() if p.annotation is inspect.Parameter.empty] == []


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("compact", ["scene", "options", "progress", "settings"]),
        ("superpixels", ["image", "count", "segmentation"]),
        ("render", ["gaussians", "cameras", "background"]),
        ("Gaussians", ["means", "quats", "scales", "opacities", "sh0", "shN"]),
        ("Cameras", ["viewmats", "Ks", "width", "height"]),
        ("write_ply", ["path", "gaussians"]),
        ("read_scene", ["path"]),
    ],
)
def test_signatures_start_as_promised(name: str, parameters: list[str]) -> None:
    assert list(inspect.signature(getattr(gsmerge, name)).parameters)[: len(parameters)] == parameters


def test_unknown_names_are_refused() -> None:
    module: Any = gsmerge
    with pytest.raises(AttributeError, match="no_such_thing"):
        _ = module.no_such_thing


def test_type_checkers_see_what_is_exported(root: Path) -> None:
    text = (root / "gsmerge" / "__init__.py").read_text()
    assert [name for name in PUBLIC if f" {name} as {name}\n" not in text] == []


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
