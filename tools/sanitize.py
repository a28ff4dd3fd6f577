"""Run the native library under the sanitizers of gcc, as Debian has them: ``python tools/sanitize.py``.

There are three runs, on libraries that are built into a temporary folder:

- The kernels' tests run under the address and undefined-behaviour sanitizers. The plugin ``mutated_calls`` also calls
  every function with changed arguments.
- All commands, damaged files, and three variants of compacting run under the same sanitizers.
- The variants of compacting run under the thread sanitizer, on four threads. Its library is loaded before Python's, and
  only the kernels are built for it. So it sees the reads and writes of the kernels alone, but the locks of all code. To
  show that it would report a race, two threads first write one array at the same time.

Arguments are passed to pytest instead of these tests, under the first two sanitizers.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from gsmerge.method.kernels import build  # noqa: E402

KERNELS = ("-p", "mutated_calls", "tests/kernels", "--ignore=tests/kernels/test_build.py")
COMMANDS = ("tests/e2e/test_every_command.py", "tests/e2e/test_damaged_files.py")
FLAGS = ("-fno-omit-frame-pointer", "-g", "-O1", "-w")
MEMORY = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", *FLAGS)
THREADS = ("-fsanitize=thread", *FLAGS)
PYTHON = (
    "setarch",
    "-R",
    sys.executable,
)  # without random addresses, since the thread sanitizer's memory has a fixed place
VARIANTS = ((), ("--effort", "draft"), ("--fit", "none"))  # options of compacting
RACE = 66  # exit code of a process in which the thread sanitizer reports a race

WRITE_ONE_ARRAY = """
import threading
import numpy as np
from gsmerge.method.kernels.raster.project import add_rows
ids, rows, totals = np.zeros(200_000, np.int32), np.ones((200_000, 3), np.float32), np.zeros((1, 3), np.float32)
barrier = threading.Barrier(2)
def work():
    barrier.wait()
    for _ in range(5):
        add_rows(ids, rows, totals)
threads = [threading.Thread(target=work) for _ in range(2)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
"""


def find_library(name: str) -> str:
    """Return the path of a library that comes with gcc."""
    return subprocess.run(
        ["gcc", f"-print-file-name={name}"], capture_output=True, text=True, check=True
    ).stdout.strip()


def build_library(folder: Path, flags: tuple[str, ...], *preloaded: str) -> dict[str, str]:
    """Build the native library with a sanitizer; return the environment of processes that load it."""
    usual = dict(os.environ)
    os.environ["GSMERGE_CC"] = "gcc"
    build.build_libraries(folder, flags, link=("-shared",))
    del os.environ["GSMERGE_CC"]  # the tests must not use it
    path = os.pathsep.join((str(ROOT), str(ROOT / "tools")))
    return usual | {
        "GSMERGE_NATIVE": str(folder),
        "LD_PRELOAD": " ".join(map(find_library, preloaded)),
        "PYTHONPATH": path,
    }


def check_memory(folder: Path, runs: tuple[tuple[str, ...], ...]) -> bool:
    """Run tests side by side under the address and undefined-behaviour sanitizers; return True if all is well."""
    env = build_library(folder, MEMORY, "libasan.so", "libubsan.so", "libstdc++.so")
    env |= {
        "ASAN_OPTIONS": "detect_leaks=0:allocator_may_return_null=1:quarantine_size_mb=16",
        "UBSAN_OPTIONS": "print_stacktrace=1",
    }
    env["PYTHONMALLOC"] = "malloc"
    pytest = (
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-n0",
        "--capture=sys",
    )  # pytest must not capture the sanitizers' reports
    calls = [subprocess.Popen([*pytest, *run], cwd=ROOT, env=env) for run in runs]
    codes = [call.wait() for call in calls]
    codes += compact(folder, env)
    print(f"memory: exit codes {codes}", flush=True)
    return not any(codes)


def compact(folder: Path, env: dict[str, str]) -> list[int]:
    """Make a scene and compact it on four threads in all variants; return the exit codes."""
    sizes = ("--views", "3", "--width", "96", "--height", "64")
    subprocess.run([sys.executable, "examples/01_make_scene.py", folder / "scene", *sizes], cwd=ROOT, check=True)
    call = (*PYTHON, "-m", "gsmerge", "compact", folder / "scene", "-o", folder / "small.ply", "--overwrite", "--quiet")
    return [subprocess.run([*call, "--threads", "4", *words], env=env, check=False).returncode for words in VARIANTS]


def check_threads(folder: Path) -> bool:
    """Compact under the thread sanitizer; return True if it reports the race that is made for it, and no other."""
    env = build_library(folder, THREADS, "libtsan.so")
    env["TSAN_OPTIONS"] = f"ignore_noninstrumented_modules=1:exitcode={RACE}"
    race = subprocess.run([*PYTHON, "-c", WRITE_ONE_ARRAY], env=env, capture_output=True, check=False).returncode
    codes = compact(folder, env)
    print(f"threads: exit codes {codes}; a race on purpose ended with {race}, expected {RACE}", flush=True)
    return race == RACE and not any(codes)


def main(arguments: list[str]) -> int:
    """Run everything, or the named tests; return 0 if no sanitizer reports anything and no test fails, otherwise 1."""
    with tempfile.TemporaryDirectory() as name:
        memory, threads = Path(name) / "memory", Path(name) / "threads"
        if arguments:
            return not check_memory(memory, (tuple(arguments),))
        return not all([check_memory(memory, (KERNELS, COMMANDS)), check_threads(threads)])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
