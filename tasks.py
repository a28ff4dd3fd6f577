"""The checks of this project, one command each: python tasks.py TASK... (CONTRIBUTING.md says when).

The tools run from the environment of this Python; the first failure stops. Options, and what follows them, are passed
to the last task: python tasks.py fuzz --minutes 30.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT, TOOLS = Path(__file__).parent, Path(sys.executable).parent
TASKS = {
    "native": (("python", "gsmerge/kernels/build.py"),),
    "tests": (("python", "-m", "pytest"),),
    "sweeps": (("python", "-m", "pytest", "-m", "slow"),),
    "processors": (("python", "tools/processors.py"),),
    "lint": (("ruff", "check", "."), ("ruff", "format", "--check", ".")),
    "types": (("mypy", "-p", "gsmerge"),),
    "imports": (("lint-imports",),),
    "docs": (("python", "docs/generate_reference.py", "--check"), ("python", "docs/one_run.py", "--check")),
    "reference": (("python", "docs/generate_reference.py"), ("python", "docs/one_run.py")),
    "fuzz": (("python", "tools/fuzz.py"),),
    "sanitize": (("python", "tools/sanitize.py"),),
    "kills": (("python", "benchmarks/kills.py"),),
    "preview": (("python", "tools/make_preview.py"),),
    "small": (("python", "tools/small_modules.py"),),
}
CHECKS = ("lint", "types", "imports", "docs", "tests", "sweeps")


def main(names: list[str]) -> int:
    """Run tasks one after the other; ``check`` stands for all checks."""
    options = next((names[i:] for i, name in enumerate(names) if name.startswith("-")), [])
    names = names[: len(names) - len(options)]
    names = [task for name in names for task in (CHECKS if name == "check" else (name,))]
    unknown = [name for name in names if name not in TASKS]
    if unknown or not names:
        print(f"usage: python tasks.py TASK...\ntasks: check (all of {' '.join(CHECKS)}), {', '.join(TASKS)}")
        return 2
    calls = [call for name in names for call in TASKS[name]]
    for tool, *arguments in (*calls[:-1], (*calls[-1], *options)):
        print("+", tool, *arguments, flush=True)
        program = sys.executable if tool == "python" else str(TOOLS / tool)
        code = subprocess.run([program, *arguments], cwd=ROOT, check=False).returncode
        if code:
            return code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
