"""The package and the command line load nothing before they are asked for something."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from messages import ERROR
from sweeps import sweep

HEAVY = ("torch", "cv2", "numpy", "plyfile", "skimage", "matplotlib", "jinja2")
COMMANDS = (
    "compact", "batch", "convert", "extend", "inspect", "view", "render", "evaluate", "lab", "lab stress",
    "lab chart", "lab generate", "lab train",
)  # fmt: skip


def run_python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout


def loaded_after(code: str) -> set[str]:
    listing = run_python(f"{code}\nimport sys\nprint('modules:', *(m for m in sys.modules if '.' not in m))")
    return set(listing.splitlines()[-1].split()) & set(HEAVY)


def test_neither_import_nor_help_nor_mistyped_options_load_anything_heavy() -> None:
    """One after the other in one process."""
    told = (
        ["--help"],
        ["--version"],
        [],
        ["compact", "--set", "help"],
        *([*name.split(), "--help"] for name in COMMANDS),
    )
    code = f"import gsmerge\nfrom gsmerge.cli import main\nfor words in {told!r}:\n    assert main(words) == 0\n"
    assert loaded_after(f"{code}assert main(['compact', 'room', '--magic']) == 2") == set()


def test_a_command_loads_no_other() -> None:
    code = "from gsmerge.cli import main\nassert main(['compact', '--help']) == 0\nimport sys\n"
    modules = run_python(f"{code}print(*(m for m in sys.modules if m.startswith('gsmerge.cli.')))").splitlines()[-1]
    assert set(modules.split()) == {
        f"gsmerge.cli.{name}" for name in ("app", "compact_command", "console", "parameters", "paths")
    }


@sweep("settings", [[], ["--fit", "none"], ["--effort", "draft"], ["--set", "recipe=paper"]], ids=" ".join)
def test_compacting_loads_and_needs_neither_torch_nor_scipy_nor_matplotlib(
    settings: list[str], small_scene: Path, tmp_path: Path
) -> None:
    """Which take longer to load than a small scene takes to merge; without them the result is the same bytes."""
    outputs, loaded = [tmp_path / "with.ply", tmp_path / "without.ply"], []
    for output, missing in zip(outputs, ((), ("torch", "scipy", "skimage", "matplotlib")), strict=True):
        hide = f"import sys\nsys.modules.update(dict.fromkeys({missing!r}))\n"
        arguments = ["compact", str(small_scene), "-o", str(output), *settings]
        code = f"{hide}from gsmerge.cli import main\nassert main({arguments!r}) == 0\n"
        loaded.append(set(run_python(f"{code}print(*sys.modules)").splitlines()[-1].split()))
    heavy = ("linalg", "ndimage", "optimize", "spatial", "sparse")
    assert loaded[0].isdisjoint({"torch", "skimage", "matplotlib", *(f"scipy.{name}" for name in heavy)})
    assert outputs[0].read_bytes() == outputs[1].read_bytes()


def test_submodule_imports_do_not_hide_functions() -> None:
    """Modules may share their names with public functions, but not at the top."""
    print_kinds = "print(type(gsmerge.render).__name__, type(gsmerge.inspect).__name__)\n"
    code = f"import gsmerge.raster, gsmerge.compaction.inspect\n{print_kinds}import gsmerge.pipeline\n{print_kinds}"
    assert run_python(code).split() == ["function"] * 4


def test_a_damaged_opencv_names_the_remedy(tmp_path: Path, made_scene: Path) -> None:
    """Uninstalling one of several opencv packages leaves a module cv2 without its parts."""
    (tmp_path / "cv2").mkdir()
    (tmp_path / "cv2" / "__init__.py").touch()
    done = subprocess.run(
        [sys.executable, "-m", "gsmerge", "inspect", str(made_scene)],
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
