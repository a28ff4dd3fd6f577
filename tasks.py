"""Run tasks of this project by their names: python3 tasks.py TASK... (CONTRIBUTING.md says when each is needed).

``demo`` and ``setup`` install the package into ``.venv``, and the tasks after them use the tools there. Without them
the tools of this Python's own environment are used. The first task that fails ends the run. Options, and all words
after them, are passed to the last task: python tasks.py fuzz --minutes 30.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT, TOOLS = Path(__file__).resolve().parent, Path(sys.executable).parent
INSTALLED = ROOT / ".venv" / ("Scripts" if os.name == "nt" else "bin")  # tools that ``demo`` and ``setup`` install
MAKE_VENV = ("python", "-m", "venv", ".venv")
# constraints.txt pins versions for Python 3.11, of which some are not there for others
PINS = ("-c", "constraints.txt") if sys.version_info[:2] == (3, 11) else ()
INSTALL = ("pip", "install", "-q", *PINS, "-e")
ROOM = ("demo", "--width", "480", "--height", "320", "--seed", "20")  # folder and options of the demo's scene
MAIN_JOB = (
    ("python", "examples/01_make_scene.py", *ROOM),
    ("gsmerge", "compact", "demo", "--overwrite"),
    ("gsmerge", "render", "demo/scene.ply", "demo/scene.compact.ply", "-o", "demo/preview.png", "--overwrite"),
)
# What makes pages and pictures of the code
GENERATORS = ("docs/generate_reference.py", "docs/one_run.py", "docs/packages.py")
TASKS: dict[str, tuple[tuple[str, ...], ...]] = {  # the calls of each task
    "demo": (MAKE_VENV, (*INSTALL, "."), *MAIN_JOB),
    "main-job": MAIN_JOB,  # the demo with a package that is installed already
    "setup": (MAKE_VENV, (*INSTALL, ".[test,site]")),
    "native": (("python", "gsmerge/method/kernels/build.py"),),
    "tests": (("python", "-m", "pytest"),),
    "sweeps": (("python", "-m", "pytest", "-m", "slow"),),
    "release-tests": (("python", "-m", "pytest", "-m", "release"),),
    "processors": (("python", "tools/processors.py"),),
    "lint": (("ruff", "check", "."), ("ruff", "format", "--check", ".")),
    "types": (("mypy", "-p", "gsmerge"),),
    "imports": (("lint-imports",),),
    "docs": tuple(("python", program, "--check") for program in GENERATORS),
    "site": (("python", "docs/build_site.py"),),
    "reference": tuple(("python", program) for program in GENERATORS),
    "fuzz": (("python", "tools/fuzz.py"),),
    "sanitize": (("python", "tools/sanitize.py"),),
    "kills": (("python", "tools/kills.py"),),
    "pictures": (("python", "docs/pictures.py"),),
}
CHECKS = ("lint", "types", "imports", "docs", "site", "tests", "sweeps")  # tasks that ``check`` stands for


def main(names: list[str]) -> int:
    """Run tasks one after the other; return the exit code of the first that fails, otherwise 0; 2 for a wrong name."""
    options = next((names[i:] for i, name in enumerate(names) if name.startswith("-")), [])
    names = names[: len(names) - len(options)]
    names = [task for name in names for task in (CHECKS if name == "check" else (name,))]
    unknown = [name for name in names if name not in TASKS]
    if unknown or not names:
        print(f"usage: python tasks.py TASK...\ntasks: check (all of {' '.join(CHECKS)}), {', '.join(TASKS)}")
        return 2
    calls = [call for name in names for call in TASKS[name]]
    programs = TOOLS
    for call in (*calls[:-1], (*calls[-1], *options)):
        print("+", *call, flush=True)
        tool, *arguments = call
        program = sys.executable if tool == "python" and programs == TOOLS else str(programs / tool)
        code = subprocess.run([program, *arguments], cwd=ROOT, check=False).returncode
        if code:
            return code
        programs = INSTALLED if call == MAKE_VENV else programs
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
