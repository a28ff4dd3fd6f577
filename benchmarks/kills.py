"""Commands that end at random moments: nothing half-written under an output's name, nothing left beside it.

python benchmarks/kills.py                                  # 50 moments of each signal, four commands; about an hour
python benchmarks/kills.py --kills 5 --commands extend batch

Each run is a process of its own on a small scene, ended by SIGTERM, SIGHUP or SIGKILL. Half of the moments are spread
over the whole of an undisturbed run, half over its last third, in which it works and writes. A process that is ended
before it has set up its handlers ends as Python does; shells report the same code.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
SIGNALS = ("SIGTERM", "SIGHUP", "SIGKILL")
FAST = ("--effort", "draft", "--fit", "none", "--threads", "1")
PATIENCE = 120  # seconds, on a machine that is busy with other things
WRITES = 1 / 3  # share of a run, at its end, that gets half of the moments
OF_THE_RUN = ("seconds", "total_seconds", "peak_memory_bytes")  # keys of reports that differ from run to run

Contents = dict[str, str]  # name in the output folder -> SHA-256


@dataclass(frozen=True)
class Command:
    """A command, what is there before, and what it writes."""

    words: Callable[[Path, Path], list[str]]  # of the scenes' folder and of the output folder
    outputs: tuple[str, ...]  # that are there together or not at all
    prepare: Callable[[Path, Path], list[str]] | None = None  # the words that write earlier outputs
    needs_earlier: bool = False  # whether it goes on from them
    resumes: bool = False  # whether a run that was ended leaves files of its own for the next


COMMANDS = {
    "compact": Command(
        lambda scenes, out: [
            *("compact", str(scenes / "a"), "-o", str(out / "a.ply"), "--levels", "2"),
            *("--report", str(out / "a.json"), "--overwrite", *FAST),
        ],
        ("a.ply", "a.level1.ply", "a.cameras.json", "a.json"),
        lambda scenes, out: [
            *("compact", str(scenes / "b"), "-o", str(out / "a.ply"), "--levels", "2"),
            *("--report", str(out / "a.json"), *FAST),
        ],
    ),
    "encode": Command(
        lambda scenes, out: [
            *("encode", str(scenes / "a"), "-o", str(out / "a.gsm"), "--effort", "draft", "--overwrite"),
        ],
        ("a.gsm",),
        lambda scenes, out: ["encode", str(scenes / "b"), "-o", str(out / "a.gsm"), "--effort", "draft"],
    ),
    "extend": Command(
        lambda scenes, out: ["extend", str(out / "a.gsm"), str(scenes / "b"), "--effort", "draft"],
        ("a.gsm",),
        lambda scenes, out: ["extend", str(out / "a.gsm"), str(scenes / "a"), "--effort", "draft"],
        needs_earlier=True,
    ),
    "batch": Command(
        lambda scenes, out: ["batch", str(scenes), "-o", str(out), "--jobs", "2", *FAST],
        ("a.ply", "b.ply"),
        resumes=True,
    ),
}


def gsmerge(words: list[str]) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "gsmerge", *words]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(words: list[str]) -> float:
    """Run a command to its end; its seconds."""
    start = time.perf_counter()
    process = gsmerge(words)
    _, err = process.communicate(timeout=PATIENCE)
    if process.returncode:
        raise SystemExit(f"an undisturbed run failed: {' '.join(words)}: {err}")
    return time.perf_counter() - start


def contents(folder: Path) -> Contents:
    """Every file below a folder; reports without what differs from run to run."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {str(path.relative_to(folder)): hashlib.sha256(_content(path)).hexdigest() for path in files}


def _content(path: Path) -> bytes:
    data = path.read_bytes()
    if path.suffix != ".json":
        return data
    try:
        return json.dumps(json.loads(data, object_hook=_without_times)).encode()
    except ValueError:
        return data


def _without_times(document: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in document.items() if key not in OF_THE_RUN}


def results(folder: Path) -> Contents:
    """What a batch wrote, without its records, whose lines differ from run to run."""
    return {name: digest for name, digest in contents(folder).items() if name not in ("batch.jsonl", "summary.csv")}


@dataclass
class Trial:
    """A command that is ended again and again in one folder."""

    name: str
    scenes: Path
    out: Path
    faults: list[str] = field(default_factory=list)
    codes: Counter[str] = field(default_factory=Counter)
    mixed: int = 0  # SIGKILL between two renames: each file whole, but not all new

    def __post_init__(self) -> None:
        self.command = COMMANDS[self.name]
        self.words = self.command.words(self.scenes, self.out)
        self.given = contents(self.scenes)
        self.earlier: Contents = {}
        self.set_up(earlier=True)
        self.earlier = contents(self.out)
        self.kept = self.out.with_name(f"{self.out.name}-earlier")
        shutil.rmtree(self.kept, ignore_errors=True)
        shutil.copytree(self.out, self.kept)
        self.seconds = min(finish(self.words), self._again())
        self.new = results(self.out) if self.command.resumes else contents(self.out)

    def _again(self) -> float:
        """A second undisturbed run: the first one also loads what the disk has."""
        self.set_up(earlier=True)
        return finish(self.words)

    def set_up(self, *, earlier: bool) -> None:
        """The output folder as it is before a run."""
        shutil.rmtree(self.out, ignore_errors=True)
        if self.earlier and earlier:
            shutil.copytree(self.kept, self.out)
            return
        self.out.mkdir()
        if earlier and self.command.prepare is not None:
            finish(self.command.prepare(self.scenes, self.out))

    def run(self, kills: int, seed: int) -> None:
        """End the command so often with each signal."""
        rng = random.Random(f"{seed} {self.name}")
        for number in range(kills * len(SIGNALS)):
            name, turn = SIGNALS[number % len(SIGNALS)], number // len(SIGNALS)
            share = rng.random() if turn % 2 else 1 - WRITES * rng.random()
            self.set_up(earlier=self.command.needs_earlier or turn % 4 < 2)
            before = contents(self.out)
            code, err, seconds = self.end_at(share * self.seconds, name)
            if code == 0:  # as fast as the machine is now
                self.seconds = (self.seconds + seconds) / 2
            self.codes[f"{name} {code}"] += 1
            for fault in self.check(name, code, err, before, again=turn % 5 == 0):
                self.faults.append(f"{self.name}, {name} after {share * self.seconds:.3f} s: {fault}")
                print(self.faults[-1], flush=True)
            if number % 30 == 29:
                print(f"{self.name}: {number + 1} of {kills * len(SIGNALS)}", file=sys.stderr, flush=True)

    def end_at(self, seconds: float, name: str) -> tuple[int, str, float]:
        """Exit code, error text and seconds of a run that gets a signal."""
        start = time.perf_counter()
        process = gsmerge(self.words)
        time.sleep(max(0.0, start + seconds - time.perf_counter()))
        process.send_signal(signal.Signals[name])
        try:
            _, err = process.communicate(timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            return 1, f"still runs after {PATIENCE} s", PATIENCE
        return process.returncode, err, time.perf_counter() - start

    def check(self, name: str, code: int, err: str, before: Contents, *, again: bool) -> list[str]:
        """What is wrong after a run was ended."""
        number, faults = signal.Signals[name].value, []
        orderly = (f"gsmerge: error: ended by {name}",) if code == 128 + number else ()
        if code not in (0, -number, *([128 + number] if name != "SIGKILL" else [])):
            faults.append(f"exit code {code}: {err.strip()}")
        elif "Traceback" in err or (orderly and err.splitlines()[-1:] != list(orderly)):
            faults.append(f"says {err.strip()!r}")
        if contents(self.scenes) != self.given:
            faults.append("an input has changed")
        after = contents(self.out)
        faults += self.half_written(name, code, before, after)
        left = {path for path in after if path not in before and path not in self.new}
        own = {"batch.jsonl", "summary.csv"} | {path for path in left if path.startswith(".batch-")}  # for the next run
        if orderly and left - own:
            faults.append(f"left {sorted(left)}")
        if left or again or self.command.resumes:
            faults += self.check_next()
        return faults

    def half_written(self, name: str, code: int, before: Contents, after: Contents) -> list[str]:
        """Outputs that are neither what was there before nor what the command makes."""
        faults, states = [], set()
        for output in self.command.outputs:
            if after.get(output) == self.new[output]:
                states.add("new")
            elif after.get(output) == before.get(output):
                states.add("old")
            else:
                faults.append(f"{output} is {'gone' if output not in after else 'half-written'}")
        if len(states) > 1 and not self.command.resumes:
            self.mixed += name == "SIGKILL"
            if name != "SIGKILL":
                faults.append("some outputs are new and some are not")
        if code == 0 and "old" in states and before != self.new:
            faults.append("exit code 0 without its outputs")
        return faults + (_record_faults(self.out) if self.command.resumes else [])

    def check_next(self) -> list[str]:
        """The next run: the whole result, and nothing beside it."""
        if self.command.needs_earlier and contents(self.out)["a.gsm"] == self.new["a.gsm"]:
            return []  # it would add the views once more
        process = gsmerge(self.words)
        _, err = process.communicate(timeout=PATIENCE)
        faults = [f"the next run ends with {process.returncode}: {err.strip()}"] if process.returncode else []
        actual = results(self.out) if self.command.resumes else contents(self.out)
        if actual != self.new:
            faults.append(f"after the next run: {sorted(set(actual.items()) ^ set(self.new.items()))}")
        return faults


def _record_faults(out: Path) -> list[str]:
    """Records that are not whole, or of files that are not what they say."""
    path = out / "batch.jsonl"
    faults = []
    for line in path.read_bytes().split(b"\n")[:-1] if path.exists() else []:
        try:
            record = json.loads(line)
            for file in record["files"]:
                if hashlib.sha256((out / file["path"]).read_bytes()).hexdigest() != file["sha256"]:
                    faults.append(f"the record of {file['path']} is of another file")
        except (ValueError, KeyError, OSError) as error:
            faults.append(f"a record is damaged: {error!r}")
    return faults


def make_scenes(folder: Path) -> Path:
    """Two small scenes of one world in a folder."""
    sys.path.insert(0, str(ROOT / "examples"))
    make = importlib.import_module("01_make_scene").make_scene
    for num_views, name in ((3, "a"), (4, "b")):
        make(folder / name, num_views=num_views, width=48, height=32, seed=0)
        shutil.rmtree(folder / name / "targets")
    return folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--kills", type=int, default=50, help="of each signal and command")
    parser.add_argument("--commands", nargs="*", choices=list(COMMANDS), default=list(COMMANDS))
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup all runs would ignore it
    faults = 0
    with tempfile.TemporaryDirectory() as folder:
        scenes = make_scenes(Path(folder) / "scenes")
        for name in args.commands:
            trial = Trial(name, scenes, Path(folder) / name)
            trial.run(args.kills, args.seed)
            faults += len(trial.faults)
            codes = ", ".join(f"{key}: {count}" for key, count in sorted(trial.codes.items()))
            print(
                f"{name}: {args.kills * len(SIGNALS)} kills in {trial.seconds:.1f} s each, {len(trial.faults)} faults,"
                f" {trial.mixed} between renames; {codes}", flush=True,
            )  # fmt: skip
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
