"""The package and the command line load nothing before they are asked for something.

Each test is about a process that has loaded nothing, and so takes a second.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from messages import ERROR
from shared import write_scene
from sweeps import sweep

HEAVY = ("torch", "cv2", "numpy", "plyfile", "skimage", "matplotlib", "jinja2")
COMMANDS = (
    "compact", "batch", "convert", "extend", "inspect", "view", "render", "evaluate", "lab", "lab stress",
    "lab chart", "lab generate", "lab train",
)  # fmt: skip


def run_python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout


def test_help_loads_nothing_heavy_and_modules_hide_no_functions() -> None:
    """In one process: help of one command, of all, a mistyped option; then modules named as functions are."""
    told = [[], ["--help"], ["--version"], ["compact", "--set", "help"], *([*c.split(), "--help"] for c in COMMANDS)]
    code = f"""
import sys, gsmerge
from gsmerge.cli import main
assert main(["compact", "--help"]) == 0
one = [m for m in sys.modules if m.startswith("gsmerge.cli.")]
for words in {told!r}:
    assert main(words) == 0
assert main(["compact", "room", "--magic"]) == 2
loaded, kinds = [m for m in sys.modules if "." not in m], []
import gsmerge.method.raster, gsmerge.jobs.inspect
kinds += [type(gsmerge.render).__name__, type(gsmerge.inspect).__name__]
import gsmerge.method.pipelines.pixel_rows
kinds += [type(gsmerge.render).__name__, type(gsmerge.inspect).__name__]
print()
for words in (one, loaded, kinds):
    print(*words)
"""
    one, loaded, kinds = (line.split() for line in run_python(code).splitlines()[-3:])
    parts = ("app", "compact_command", "console", "parameters", "paths", "usage")
    assert set(one) == {f"gsmerge.cli.{name}" for name in parts}  # a command loads no other
    assert set(loaded) & set(HEAVY) == set()
    assert kinds == ["function"] * 4


@sweep("settings", [["--set", "fit_steps=5"], [], ["--fit", "none"], ["--set", "recipe=paper"]], ids=" ".join)
def test_compact_neither_loads_nor_needs_torch_scipy_or_matplotlib(settings: list[str], tmp_path: Path) -> None:
    """Which take longer to load than a small scene takes to merge; without them the result is the same bytes."""
    scene = write_scene(tmp_path / "scene", num_views=2, width=24, height=16)
    outputs = [tmp_path / "with.ply", tmp_path / "without.ply"]
    arguments = [["compact", str(scene), "-o", str(output), *settings] for output in outputs]
    code = f"""
import sys
from gsmerge.cli import main
assert main({arguments[0]!r}) == 0
print(*sys.modules)
sys.modules.update(dict.fromkeys(("torch", "scipy", "skimage", "matplotlib")))
assert main({arguments[1]!r}) == 0
"""
    heavy = ("linalg", "ndimage", "optimize", "spatial", "sparse")
    never = {"torch", "skimage", "matplotlib", "pydantic", *(f"scipy.{name}" for name in heavy)}
    (loaded,) = (line for line in run_python(code).splitlines() if "gsmerge.method.pipelines.pixel_rows" in line)
    assert never.isdisjoint(loaded.split())
    assert outputs[0].read_bytes() == outputs[1].read_bytes()


def test_a_damaged_opencv_names_the_remedy(tmp_path: Path, small_scene: Path) -> None:
    """Uninstalling one of several opencv packages leaves a module cv2 without its parts."""
    (tmp_path / "cv2").mkdir()
    (tmp_path / "cv2" / "__init__.py").touch()
    done = subprocess.run(
        [sys.executable, "-m", "gsmerge", "inspect", str(small_scene)],
        capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{Path(__file__).parents[2]}"},
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "--force-reinstall opencv-contrib-python-headless" in done.stderr


@pytest.mark.usefixtures("foreground")
def test_ctrl_c_while_a_command_is_imported_is_one_line() -> None:
    code = """
import signal, sys
from gsmerge.cli import program

class Finder:
    @staticmethod
    def find_spec(name, *_):
        if name == "typer":
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Finder)
program()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", f"{ERROR}interrupted\n")
