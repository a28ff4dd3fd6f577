"""Commands run in processes and limits of their own, forked from one that has imported what they need."""

from __future__ import annotations

import gc
import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from messages import ERROR

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
FAILED = 99  # exit code of what raised an error
WALL_SECONDS = 300  # after which a process that waits is ended


@dataclass(frozen=True)
class Limits:
    """Most of what a process may take: address space beyond that in use, bytes, and processor time."""

    memory: int
    seconds: float


@dataclass(frozen=True)
class Outcome:
    """What a process did."""

    code: int  # exit code, or minus the signal that ended it
    out: str
    err: str
    peak: int  # resident bytes beyond those at its start
    seconds: float  # of processor time

    @property
    def error(self) -> str:
        """Return the lines on stderr, without those that decoders of pictures print themselves."""
        lines = self.err.splitlines(keepends=True)
        ours = "gsmerge: ", "note: ", "Traceback"
        return "".join(line for line in lines if line.startswith(ours) or "Warning: " in line)


def refused_by_inspect(refusal: Outcome, outcome: Outcome) -> None:
    """Check that ``gsmerge inspect`` ended with the cause by which another command refused."""
    cause = refusal.error.removeprefix(ERROR).strip()
    assert outcome.code == 3, f"{cause}: {outcome.out}"
    place, _, problem = cause.partition(": ")
    assert place in outcome.err
    assert problem in outcome.err


def _memory() -> list[int]:
    """Return address space and resident memory of this process, bytes."""
    return [int(pages) * resource.getpagesize() for pages in Path("/proc/self/statm").read_text().split()[:2]]


def run_forked(call: Callable[[], int], limits: Limits) -> Outcome:
    """Return what ``call``, which returns an exit code, does in a child of this process."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err, tempfile.TemporaryFile() as start:
        pid = os.fork()
        if pid == 0:
            code = FAILED
            try:
                os.dup2(out.fileno(), 1)
                os.dup2(err.fileno(), 2)
                address_space, resident = _memory()
                start.write(str(resident).encode())
                start.flush()
                resource.setrlimit(resource.RLIMIT_AS, (address_space + limits.memory,) * 2)
                for timer, number, seconds in (
                    (signal.ITIMER_PROF, signal.SIGPROF, limits.seconds),
                    (signal.ITIMER_REAL, signal.SIGALRM, WALL_SECONDS),
                ):
                    signal.signal(number, signal.SIG_DFL)  # which ends what never returns to the interpreter, too
                    signal.setitimer(timer, seconds)
                code = call()
            except BaseException:
                traceback.print_exc()
            finally:
                with suppress(OSError):
                    sys.stdout.flush()
                    sys.stderr.flush()
                os._exit(code)
        _, status, usage = os.wait4(pid, 0)
        texts = []
        for file in (out, err, start):
            file.seek(0)
            texts.append(file.read().decode("utf-8", "backslashreplace"))
    peak = (usage.ru_maxrss << 10) - int(texts.pop())
    return Outcome(os.waitstatus_to_exitcode(status), *texts, peak, usage.ru_utime + usage.ru_stime)


class CommandServer:
    """A process that has run sound commands once, and runs others in children of its own."""

    def __init__(self, sound: Sequence[Sequence[object]]) -> None:
        environment = os.environ | dict.fromkeys(THREADS, "1")
        self._process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        for words in sound:
            self._ask({"warm": [str(word) for word in words]})

    def run(self, words: Sequence[object], limits: Limits) -> Outcome:
        """Return the outcome of a command."""
        return Outcome(**self._ask({"words": [str(word) for word in words], "limits": asdict(limits)}))

    def __enter__(self) -> CommandServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def _ask(self, question: dict[str, object]) -> dict[str, object]:
        self._process.stdin.write(json.dumps(question) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


def _modules_of(words: list[str]) -> int:
    """Print the modules that a command imports; its exit code."""
    from gsmerge.cli import main

    code = main(words)
    print("\n" + json.dumps(list(sys.modules)))
    return code


def _serve() -> None:
    from gsmerge.cli import main

    for line in sys.stdin:
        question = json.loads(line)
        if "warm" in question:  # here no thread is started, which a fork would lose
            outcome = run_forked(partial(_modules_of, question["warm"]), Limits(1 << 34, WALL_SECONDS))
            assert outcome.code == 0, outcome.err
            for name in json.loads(outcome.out.splitlines()[-1]):
                with suppress(ImportError):
                    importlib.import_module(name)
            gc.freeze()  # so that children do not copy what they look through
            answer = {}
        else:
            answer = asdict(run_forked(partial(main, question["words"]), Limits(**question["limits"])))
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    _serve()
