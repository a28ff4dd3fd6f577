"""The numbered examples run, in their order, as their docstrings say."""

from __future__ import annotations

import ast
import json
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from batches import InlinePool
from scripts import load_script

from gsmerge.cli import main


def test_examples_run_one_after_the_other(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two fits, which take a second. What an example calls runs in this process, which is twice as fast."""
    monkeypatch.setattr("gsmerge.jobs.batch.run.ProcessPool", InlinePool)
    monkeypatch.setattr("time.sleep", lambda _: None)

    def run_here(call: list[str], *, check: bool) -> subprocess.CompletedProcess[str]:
        assert call[:3] == [sys.executable, "-m", "gsmerge"]
        assert not check
        return subprocess.CompletedProcess(call, main(call[3:]))

    monkeypatch.setattr(subprocess, "run", run_here)

    def run_example(name: str, *arguments: object) -> str:
        script = str(root / "examples" / name)
        monkeypatch.setattr(sys, "argv", [script, *map(str, arguments)])
        runpy.run_path(script, run_name="__main__")
        return capsys.readouterr().out

    scene, small = tmp_path / "scene", tmp_path / "scene" / "small.ply"
    made = run_example("01_make_scene.py", scene, "--views", 2, "--width", 24, "--height", 16)
    assert "768 Gaussians, 2 views" in made
    compacted = run_example("02_compact.py", scene, small, "--k", 2)
    count = int(re.search(r"768 -> (\d+) Gaussians", compacted).group(1))  # type: ignore[union-attr]
    assert 0 < count < 768 / 5
    measured = run_example("03_measure_targets.py", scene / "targets", scene / "scene.ply", small)
    values = [float(value) for value in re.findall(r": (\S+) dB", measured)]
    assert len(values) == 2
    assert all(10 < value < 60 for value in values)
    (tmp_path / "unfinished").mkdir()
    with pytest.raises(SystemExit) as ended:
        run_example("05_watch_folder.py", tmp_path, tmp_path.with_name("results"), "--still", 0, "--once")
    assert ended.value.code == 0
    assert sorted(path.name for path in tmp_path.with_name("results").glob("*.ply")) == ["scene.ply"]


def show(value: Any) -> str:
    """Return what a notebook shows of a cell's last value."""
    picture = getattr(value, "_repr_png_", lambda: None)()
    return "png" if picture else getattr(value, "_repr_html_", value.__repr__)()


@pytest.mark.slow
def test_the_notebook_runs(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its cells, one after the other in one namespace, as Jupyter runs them, on pictures of a sixteenth of the pixels.

    It is stored without outputs. Two runs, two measurements and two pages take more than a second.
    """
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((root / "examples" / "notebook.ipynb").read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [(cell["outputs"], cell["execution_count"]) for cell in cells] == [([], None)] * len(cells)
    namespace: dict[str, Any] = {}
    shown = []
    for cell in cells:
        *body, last = ast.parse("".join(cell["source"]).replace("width=96, height=64", "width=24, height=16")).body
        assert isinstance(last, ast.Expr)
        exec(compile(ast.Module(body, []), "notebook.ipynb", "exec"), namespace)
        shown.append(show(eval(compile(ast.Expression(last.value), "notebook.ipynb", "eval"), namespace)))
    texts = ("Scene(1,536", "CompactResult(", "<iframe", "fit", "Evaluation(", "<iframe", "GaussianFile(")
    assert len(shown) == len(texts)
    assert all(text in value for text, value in zip(texts, shown, strict=True)), shown


def test_the_same_seed_makes_the_same_scene(root: Path, tmp_path: Path) -> None:
    make_scene = load_script(root / "examples" / "01_make_scene.py").make_scene
    sizes = {"num_views": 2, "width": 24, "height": 16}
    scene = tmp_path / "scene"
    first, again = ((make_scene(scene, seed=0, **sizes) / "scene.ply").read_bytes() for _ in range(2))
    assert first == again


def test_a_scene_is_not_made_in_a_folder_with_other_contents(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scene.ply").touch()
    monkeypatch.setattr(sys, "argv", ["01_make_scene.py", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(root / "examples" / "01_make_scene.py"), run_name="__main__")
    assert (ended.value.code, capsys.readouterr().err.count("\n")) == (2, 1)
