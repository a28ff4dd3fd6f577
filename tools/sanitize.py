"""Run tests of the native library under the address and undefined-behaviour sanitizers: ``python tools/sanitize.py``.

It takes gcc with its sanitizers, as Debian has them, and builds a library of its own in a temporary folder. Arguments
are passed to pytest in place of the tests below.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from gsmerge.kernels import build  # noqa: E402

TESTS = ("tests/kernels", "tests/property")
FLAGS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer", "-g", "-O1", "-w")


def runtime(name: str) -> str:
    """Return the path of a library that gcc brings."""
    return subprocess.run(
        ["gcc", f"-print-file-name={name}"], capture_output=True, text=True, check=True
    ).stdout.strip()


def main(arguments: list[str]) -> int:
    """Build the library with the sanitizers and run tests on it -> exit code of pytest."""
    os.environ["GSMERGE_CC"] = "gcc"
    with tempfile.TemporaryDirectory() as folder:
        build.build(Path(folder), FLAGS, link=("-shared",))
        preload = f"{runtime('libasan.so')} {runtime('libubsan.so')} {runtime('libstdc++.so')}"
        env = {**os.environ, "GSMERGE_NATIVE": folder, "LD_PRELOAD": preload, "PYTHONMALLOC": "malloc"}
        env |= {"ASAN_OPTIONS": "detect_leaks=0:allocator_may_return_null=1", "UBSAN_OPTIONS": "print_stacktrace=1"}
        command = [sys.executable, "-m", "pytest", "-q", *(arguments or TESTS)]
        return subprocess.run(command, cwd=ROOT, env=env, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
