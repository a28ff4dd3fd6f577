"""Read changed files of every kind, and keep those that fail: ``python tasks.py fuzz --minutes 30 KIND...``.

With atheris (pip install atheris) changes follow the lines of code that they reach, and files that reached new ones are
kept in build/fuzz; without it files are changed blindly. A reader returns, or raises an error of the package, within
its budget; the smallest file that makes it do anything else goes to tests/damage/findings, which the tests read.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from random import Random
from typing import Any

try:
    import atheris
except ImportError:
    atheris = None

ROOT = Path(__file__).resolve().parent.parent
TESTS = ROOT / "tests"
sys.path[:0] = [str(ROOT), str(TESTS), str(TESTS / "helpers")]
LEARNT = ROOT / "build" / "fuzz"
SECONDS, BYTES = 15, 512 << 20  # of processor time and memory, several times the budget of such small files
TRIES = 300  # to make a finding smaller
SHARED_MEMORY = "/dev/shm" if os.path.isdir("/dev/shm") else None


class TooLong(BaseException):
    """The time is over; no reader can take this for an error of its own."""


def stop(*_: object) -> None:
    """End the block that takes too long."""
    raise TooLong


def failure(sound: Any, data: bytes) -> tuple[str, str]:
    """Read bytes -> where and how it fails, and the traceback; two empty texts if it does not."""
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


def shrink(sound: Any, data: bytes, cause: str) -> bytes:
    """Leave out pieces of a file as long as it fails in the same way."""
    size, tries = len(data) // 2, 0
    while size and tries < TRIES:
        for start in range(0, len(data), size):
            shorter = data[:start] + data[start + size :]
            tries += 1
            if tries < TRIES and failure(sound, shorter)[0] == cause:
                data = shorter
                break
        else:
            size //= 2
    return data


def keep(kind: str, data: bytes) -> Path:
    """Write a finding to the folder of findings."""
    from damage.random_changes import FINDINGS

    FINDINGS.mkdir(exist_ok=True)
    path = FINDINGS / f"{kind}.{hashlib.sha256(data).hexdigest()[:8]}"
    path.write_bytes(data)
    return path


def work(kind: str, seconds: int) -> None:
    """Try files of one kind for some seconds; print each finding, and the number of inputs as libFuzzer does."""
    from damage import SOUNDS
    from damage.random_changes import FINDINGS, mutate, splice

    signal.signal(signal.SIGPROF, stop)
    sound = SOUNDS[kind]
    seeds = [sound.content()]
    failure(sound, seeds[0])  # which imports all that it takes
    seeds += [path.read_bytes() for path in FINDINGS.glob(f"{kind}.*")]
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + BYTES, resource.getrlimit(resource.RLIMIT_AS)[1]))
    causes: set[str] = set()

    def attempt(data: bytes) -> None:
        cause, trace = failure(sound, data)
        if cause and cause not in causes:
            causes.add(cause)
            path = keep(kind, data if cause.startswith("TooLong") else shrink(sound, data, cause))
            print(f"FINDING {cause}: {path}\n{trace}", flush=True)

    if atheris:
        learn(kind, seconds, seeds, attempt, mutate, splice)
    random, count, end = Random(time.time_ns()), 0, time.monotonic() + seconds
    while time.monotonic() < end:
        attempt(mutate(random.choice(seeds), random))
        count += 1
    print(f"stat::number_of_executed_units: {count}", flush=True)


def learn(
    kind: str, seconds: int, seeds: list[bytes], attempt: Callable[[bytes], None], mutate: Any, splice: Any
) -> None:
    """Run libFuzzer, which keeps the files that reach new lines; it ends the process."""
    corpus = LEARNT / kind
    corpus.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        (corpus / hashlib.sha256(seed).hexdigest()).write_bytes(seed)

    def leaf(data: bytes, random: Random) -> bytes:
        return splice(data, random) if random.random() < 0.5 else atheris.Mutate(data, len(data) + 64)

    def change(data: bytes, most: int, seed: int) -> bytes:
        try:
            return mutate(data, Random(seed), leaf)[:most]
        except MemoryError:  # of the limit on the reader, in this process
            return splice(data, Random(seed))[:most]

    options = {"max_total_time": seconds, "max_len": max(8192, 3 * max(map(len, seeds))), "timeout": 4 * SECONDS,
               "artifact_prefix": f"{LEARNT}/{kind}.input-", "print_final_stats": 1, "rss_limit_mb": 0}  # fmt: skip
    flags = [f"-{name}={value}" for name, value in options.items()]
    atheris.Setup(["fuzz", *flags, str(corpus)], attempt, custom_mutator=change)
    atheris.Fuzz()


def start(kind: str, seconds: int) -> int:
    """Try files of one kind in a process of its own, which writes a log -> its id."""
    for left in LEARNT.glob(f"{kind}.input-*"):
        left.unlink()
    process = os.fork()
    if process == 0:
        log = os.open(LEARNT / f"{kind}.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(log, 1)
        os.dup2(log, 2)
        try:
            work(kind, seconds)
            os._exit(0)
        except Exception:
            traceback.print_exc()
            os._exit(1)
    return process


def report(kind: str, code: int, seconds: float) -> bool:
    """Print what came of a kind -> whether its kind is sound."""
    log = LEARNT / f"{kind}.log"
    text = log.read_text(errors="replace")
    counted = re.findall(r"number_of_executed_units: +(\d+)", text)
    findings = re.findall(r"^FINDING (.*)", text, re.MULTILINE)
    for crash in LEARNT.glob(f"{kind}.input-*"):
        findings.append(f"ended the process: {keep(kind, crash.read_bytes())}")
    if code and not findings:
        findings.append(f"ended with exit code {code}: {log}")
    print(f"{kind:18}{int(counted[0]) if counted else 0:10,} inputs{seconds:7.0f} s", flush=True)
    for finding in findings:
        print(f"  {finding}", flush=True)
    return not findings


def main() -> int:
    """Try the named kinds, or all, for some minutes together; exit code 1 if there are findings."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("kinds", nargs="*")
    arguments = parser.parse_args()
    LEARNT.mkdir(parents=True, exist_ok=True)
    os.environ["OPENCV_LOG_LEVEL"] = "SILENT"
    with atheris.instrument_imports(include=["gsmerge"]) if atheris else nullcontext():
        from damage import SOUNDS

        waiting = arguments.kinds or [kind for kind, sound in SOUNDS.items() if sound.fuzzed]
        processes = min(os.cpu_count() or 1, len(waiting))
        seconds = max(1, round(60 * arguments.minutes * processes / len(waiting)))
        running: dict[int, tuple[str, float]] = {}
        sound = True
        while waiting or running:
            while waiting and len(running) < processes:
                kind, waiting = waiting[0], waiting[1:]
                running[start(kind, seconds)] = kind, time.monotonic()
            process, status = os.wait()
            kind, begin = running.pop(process)
            sound &= report(kind, os.waitstatus_to_exitcode(status), time.monotonic() - begin)
    return 0 if sound else 1


if __name__ == "__main__":
    sys.exit(main())
