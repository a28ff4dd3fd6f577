"""The numbered examples run, in their order, as their docstrings say."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from scripts import load_script


def run_example(root: Path, name: str, *arguments: object) -> str:
    script = root / "examples" / name
    done = subprocess.run(
        [sys.executable, str(script), *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(root)},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_examples_are_numbered_without_gaps(root: Path) -> None:
    names = sorted(path.name for path in (root / "examples").glob("*.py"))
    assert [int(name[:2]) for name in names] == list(range(1, len(names) + 1))
    for name in names:
        first_lines = (root / "examples" / name).read_text()[:600]
        assert f"python examples/{name} " in first_lines


def test_examples_run_one_after_the_other(root: Path, tmp_path: Path) -> None:
    scene, small = tmp_path / "scene", tmp_path / "scene" / "small.ply"
    made = run_example(root, "01_make_scene.py", scene, "--views", 3, "--width", 64, "--height", 48)
    assert "9216 Gaussians, 3 views" in made
    compacted = run_example(root, "02_compact.py", scene, small, "--k", 2)
    count = int(re.search(r"9216 -> (\d+) Gaussians", compacted).group(1))  # type: ignore[union-attr]
    assert 0 < count < 9216 / 5
    measured = run_example(root, "03_measure_targets.py", scene / "targets", scene / "scene.ply", small)
    values = [float(value) for value in re.findall(r": (\S+) dB", measured)]
    assert len(values) == 2
    assert all(10 < value < 60 for value in values)
    arrived = run_example(root, "05_views_in_batches.py", scene / "scene.ply", scene / "so_far.ply")
    assert 0 < int(re.search(r"9216 -> (\d+) Gaussians", arrived).group(1)) < 9216 / 5  # type: ignore[union-attr]


def show(value: Any) -> str:
    """What a notebook shows of a cell's last value."""
    picture = getattr(value, "_repr_png_", lambda: None)()
    return "png" if picture else getattr(value, "_repr_html_", value.__repr__)()


def test_the_notebook_runs(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its cells, one after the other in one namespace, as Jupyter runs them; it is stored without outputs."""
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((root / "examples" / "notebook.ipynb").read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [(cell["outputs"], cell["execution_count"]) for cell in cells] == [([], None)] * len(cells)
    namespace: dict[str, Any] = {}
    shown = []
    for cell in cells:
        *body, last = ast.parse("".join(cell["source"])).body
        assert isinstance(last, ast.Expr)
        exec(compile(ast.Module(body, []), "notebook.ipynb", "exec"), namespace)
        shown.append(show(eval(compile(ast.Expression(last.value), "notebook.ipynb", "eval"), namespace)))
    texts = ("Scene(24,576", "data:image/png;base64,", "<iframe", "fit", "3 target views", "<iframe", "GaussianFile(")
    assert len(shown) == len(texts)
    assert all(text in value for text, value in zip(texts, shown, strict=True)), shown


def test_the_same_seed_makes_the_same_scene(root: Path, tmp_path: Path) -> None:
    make_scene = load_script(root / "examples" / "01_make_scene.py").make_scene
    sizes = {"num_views": 2, "width": 24, "height": 16}
    first, again, other = (
        (make_scene(tmp_path / name, seed=seed, **sizes) / "scene.ply").read_bytes()
        for name, seed in (("a", 0), ("b", 0), ("c", 1))
    )
    assert first == again
    assert first != other
