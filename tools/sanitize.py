"""Run the native library under the sanitizers of gcc, as Debian has them: ``python tools/sanitize.py``.

Three runs, each on a library of its own in a temporary folder:

- The kernels' tests under the address and undefined-behaviour sanitizers, with the plugin ``mutated_calls``: every
  function is also called with changed arguments.
- All commands, damaged files, and compacting in three ways, under the same.
- The three ways under the thread sanitizer, on four threads. Its library is loaded before Python's, and only the
  kernels are made for it: it sees their reads and writes, and the locks of all others. So that silence means something,
  two threads first write one array, which it has to report.

Arguments are passed to pytest in place of the tests below, under the first two sanitizers.
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

KERNELS = ("-p", "mutated_calls", "tests/kernels", "--ignore=tests/kernels/test_build.py")
COMMANDS = ("tests/e2e/test_every_command.py", "tests/e2e/test_damaged_files.py")
FLAGS = ("-fno-omit-frame-pointer", "-g", "-O1", "-w")
MEMORY = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", *FLAGS)
THREADS = ("-fsanitize=thread", *FLAGS)
PYTHON = ("setarch", "-R", sys.executable)  # the thread sanitizer's memory has a fixed place
WAYS = ((), ("--effort", "draft"), ("--fit", "none"))
RACE = 66  # exit code of a process with a report of the thread sanitizer

WRITE_ONE_ARRAY = """
import threading
import numpy as np
from gsmerge.kernels.raster.project import add_rows
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


def runtime(name: str) -> str:
    """Return the path of a library that gcc brings."""
    return subprocess.run(
        ["gcc", f"-print-file-name={name}"], capture_output=True, text=True, check=True
    ).stdout.strip()


def environment(folder: Path, flags: tuple[str, ...], *preloaded: str) -> dict[str, str]:
    """Build the library with a sanitizer -> the variables with which a process takes it."""
    usual = dict(os.environ)
    os.environ["GSMERGE_CC"] = "gcc"
    build.build_libraries(folder, flags, link=("-shared",))
    del os.environ["GSMERGE_CC"]  # or the tests would take it, too
    path = os.pathsep.join((str(ROOT), str(ROOT / "tools")))
    return usual | {"GSMERGE_NATIVE": str(folder), "LD_PRELOAD": " ".join(map(runtime, preloaded)), "PYTHONPATH": path}


def check_memory(folder: Path, runs: tuple[tuple[str, ...], ...]) -> bool:
    """Run tests under the address and undefined-behaviour sanitizers, side by side -> whether all is well."""
    env = environment(folder, MEMORY, "libasan.so", "libubsan.so", "libstdc++.so")
    env |= {
        "ASAN_OPTIONS": "detect_leaks=0:allocator_may_return_null=1:quarantine_size_mb=16",
        "UBSAN_OPTIONS": "print_stacktrace=1",
    }
    env["PYTHONMALLOC"] = "malloc"
    pytest = (sys.executable, "-m", "pytest", "-q", "-n0", "--capture=sys")  # reports are seen, not captured
    calls = [subprocess.Popen([*pytest, *run], cwd=ROOT, env=env) for run in runs]
    codes = [call.wait() for call in calls]
    codes += compact(folder, env)
    print(f"memory: exit codes {codes}", flush=True)
    return not any(codes)


def compact(folder: Path, env: dict[str, str]) -> list[int]:
    """Make a scene and compact it on four threads in all ways -> exit codes."""
    sizes = ("--views", "3", "--width", "96", "--height", "64")
    subprocess.run([sys.executable, "examples/01_make_scene.py", folder / "scene", *sizes], cwd=ROOT, check=True)
    call = (*PYTHON, "-m", "gsmerge", "compact", folder / "scene", "-o", folder / "small.ply", "--overwrite", "--quiet")
    return [subprocess.run([*call, "--threads", "4", *way], env=env, check=False).returncode for way in WAYS]


def check_threads(folder: Path) -> bool:
    """Compact on several threads under the thread sanitizer -> whether all is well."""
    env = environment(folder, THREADS, "libtsan.so")
    env["TSAN_OPTIONS"] = f"ignore_noninstrumented_modules=1:exitcode={RACE}"
    race = subprocess.run([*PYTHON, "-c", WRITE_ONE_ARRAY], env=env, capture_output=True, check=False).returncode
    codes = compact(folder, env)
    print(f"threads: exit codes {codes}; {race} of two threads that write one array, expected {RACE}", flush=True)
    return race == RACE and not any(codes)


def main(arguments: list[str]) -> int:
    """Run everything, or the tests that are named -> 0 where no sanitizer has a report and no test fails."""
    with tempfile.TemporaryDirectory() as name:
        memory, threads = Path(name) / "memory", Path(name) / "threads"
        if arguments:
            return not check_memory(memory, (tuple(arguments),))
        return not all([check_memory(memory, (KERNELS, COMMANDS)), check_threads(threads)])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
