"""Read changed files of every kind, and keep those that fail: ``python tasks.py fuzz --minutes 30 KIND...``.

atheris (pip install atheris) guides the changes by the lines of code that they reach. Files that reach new lines are
kept in build/fuzz. A reader must return, or raise an error of the package, within its budget. A file for which it does
anything else goes to tests/damage/findings, which the tests read. Without atheris,
``GSMERGE_FUZZ_EXAMPLES=2000 python -m pytest tests/property/test_readers_fuzz.py`` changes files without guidance.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from random import Random
from typing import Any

import atheris

ROOT = Path(__file__).resolve().parent.parent
TESTS = ROOT / "tests"
sys.path[:0] = [str(ROOT), str(TESTS), str(TESTS / "helpers")]
os.environ["OPENCV_LOG_LEVEL"] = "SILENT"
with atheris.instrument_imports(include=["gsmerge"]):
    from damage import SOUNDS
    from damage.random_changes import FINDINGS, mutate, splice

CORPORA = ROOT / "build" / "fuzz"  # a folder of files that reach new lines, for each kind
SECONDS, BYTES = 15, 512 << 20  # limits of processor time and memory, several times the budget of such small files
SHARED_MEMORY = "/dev/shm" if os.path.isdir("/dev/shm") else None


class TooLong(BaseException):
    """A reader has taken too long. This is no Exception, so that no reader can handle it."""


def stop(*_: object) -> None:
    """End a reader that takes too long; called at the signal of the timer."""
    raise TooLong


def describe_failure(sound: Any, data: bytes) -> tuple[str, str]:
    """Read bytes as a file; return the error with its place, and the traceback. Both are empty if reading succeeds."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    with tempfile.TemporaryDirectory(dir=SHARED_MEMORY) as folder:
        try:
            sound.attempt(data, Path(folder))
        except (Exception, TooLong) as error:
            signal.setitimer(signal.ITIMER_PROF, 0)
            frames = [f for f in traceback.extract_tb(error.__traceback__) if "gsmerge/" in f.filename]
            place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "check"
            return f"{type(error).__name__} at {place}", traceback.format_exc()
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
    return "", ""


def keep(kind: str, data: bytes) -> Path:
    """Write a finding to the folder of findings, and return its path."""
    FINDINGS.mkdir(exist_ok=True)
    path = FINDINGS / f"{kind}.{hashlib.sha256(data).hexdigest()[:8]}"
    path.write_bytes(data)
    return path


def try_kind(kind: str, seconds: int) -> None:
    """Try files of one kind for some seconds, and print each finding; libFuzzer ends the process afterwards."""
    signal.signal(signal.SIGPROF, stop)
    sound, corpus = SOUNDS[kind], CORPORA / kind
    seeds = [sound.content(), *(path.read_bytes() for path in FINDINGS.glob(f"{kind}.*"))]
    describe_failure(sound, seeds[0])  # imports all modules before the memory is limited
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + BYTES, resource.getrlimit(resource.RLIMIT_AS)[1]))
    corpus.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        (corpus / hashlib.sha256(seed).hexdigest()).write_bytes(seed)
    causes: set[str] = set()

    def attempt(data: bytes) -> None:
        """Read bytes, and keep them if they fail for a new cause."""
        cause, trace = describe_failure(sound, data)
        if cause and cause not in causes:
            causes.add(cause)
            print(f"FINDING {cause}: {keep(kind, data)}\n{trace}", flush=True)

    def change_part(data: bytes, random: Random) -> bytes:
        """Change a part of a file that has no inner structure."""
        return splice(data, random) if random.random() < 0.5 else atheris.Mutate(data, len(data) + 64)

    def change(data: bytes, most: int, seed: int) -> bytes:
        """Change a file, to at most ``most`` bytes."""
        try:
            return mutate(data, Random(seed), change_part)[:most]
        except MemoryError:  # the limit on the reader holds for the whole process
            return splice(data, Random(seed))[:most]

    options = {"max_total_time": seconds, "max_len": max(8192, 3 * max(map(len, seeds))), "timeout": 4 * SECONDS,
               "artifact_prefix": f"{CORPORA}/{kind}.input-", "print_final_stats": 1, "rss_limit_mb": 0}  # fmt: skip
    flags = [f"-{name}={value}" for name, value in options.items()]
    atheris.Setup(["fuzz", *flags, str(corpus)], attempt, custom_mutator=change)
    atheris.Fuzz()


def run_kind(kind: str, seconds: int) -> bool:
    """Try files of one kind in a process of its own, and print the findings; return True if there are none."""
    for left in CORPORA.glob(f"{kind}.input-*"):
        left.unlink()
    call = [sys.executable, __file__, kind, "--minutes", str(seconds / 60)]
    done = subprocess.run(
        call, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace", check=False
    )
    counted = re.findall(r"number_of_executed_units: +(\d+)", done.stdout)
    findings = re.findall(r"^FINDING (.*)", done.stdout, re.MULTILINE)
    findings += [f"ended the process: {keep(kind, one.read_bytes())}" for one in CORPORA.glob(f"{kind}.input-*")]
    if done.returncode and not findings:
        findings.append(f"ended with exit code {done.returncode}: {done.stdout[-2000:]}")
    print(f"{kind:18}{int(counted[0]) if counted else 0:10,} inputs", *findings, sep="\n  ", flush=True)
    return not findings


def main() -> int:
    """Try the named kinds, or all, for some minutes in total; return 1 if there are findings, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("kinds", nargs="*")
    args = parser.parse_args()
    if len(args.kinds) == 1:
        try_kind(args.kinds[0], round(60 * args.minutes))
    kinds = args.kinds or [kind for kind, sound in SOUNDS.items() if sound.fuzzed]
    processes = os.cpu_count() or 1
    seconds = max(1, round(60 * args.minutes * processes / len(kinds)))
    with ThreadPoolExecutor(processes) as pool:
        return 0 if all(list(pool.map(lambda kind: run_kind(kind, seconds), kinds))) else 1


if __name__ == "__main__":
    sys.exit(main())
