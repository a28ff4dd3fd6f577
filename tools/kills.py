"""Kill commands before each call that changes their folder, and check what they leave, also after a loss of power.

python tools/kills.py                                       # every call of the commands; needs Linux and gcc
python tools/kills.py --calls 6 --commands compact extend   # six calls of each, at equal distances
python tools/kills.py --plant copies --commands extend      # with a fault, which must be reported

A preloaded library (kills.c) counts the calls (opens for writing, writes, syncs, renames, removals, new folders) and
ends the process by SIGKILL before one of them. Then every file must have its old content or the content that the
command makes, and no index may name a missing chunk. The next run must make all files and leave no other.

The same must hold for the disks that a loss of power may leave. There, files are as long as at their last sync. Names
that changed since the last sync of their folder may be lost: all of them, none, any single one, or all but one.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
FAST = "--effort draft --set fit=none --threads 1"
COMPACT = f"compact {{scene}} -o {{out}}/a.ply --levels 2 --overwrite {FAST}"
LOD = f"compact {{scene}} -o {{out}}/lod/lod-meta.json --levels 2 --overwrite {FAST}"
# Each command that is killed, and the command that is run before it, so that there are earlier files
COMMANDS = {
    "compact": (COMPACT.format(scene="{a}", out="{out}"), COMPACT.format(scene="{b}", out="{out}")),
    "extend": ("extend {out}/a.gsm {b} --set effort=draft", "extend {out}/a.gsm {a} --set effort=draft"),
    "batch": (f"batch {{scenes}} -o {{out}} --jobs 1 {FAST}", None),
    "lod": (LOD.format(scene="{a}", out="{out}"), LOD.format(scene="{b}", out="{out}")),
    "video": tuple(f"render {{{x}}} -o {{out}}/a.mp4 --path orbit --frames 3 --overwrite" for x in "ab"),
}
# Modules that are imported once, before the commands are run in child processes
MODULES = ("gsmerge.cli.app", "gsmerge.reading.input", "gsmerge.method.networks.apply", "gsmerge.jobs.states.files")
OF_THE_RUN = ("seconds", "total_seconds", "peak_memory_bytes")  # keys of reports that differ from run to run
RECORDS, LOCK = "batch.jsonl", ".gsmerge-lock"  # records of a batch, and the file that exists while a folder is in use
# Faults on purpose, to show that they are reported: functions that replace those of ``os``
PLANTS: dict[str, dict[str, Callable[..., object]]] = {
    "none": {},
    "copies": {"replace": shutil.copyfile},
    "no syncs": {"fsync": lambda descriptor: None},
}

Contents = dict[str, str]  # SHA-256 by name in a folder


@dataclass(frozen=True)
class Ended:
    """The end of a run."""

    code: int  # exit code; -9 after SIGKILL
    text: str  # printed text
    calls: list[list[str]]  # each call's kind, inode of the file, its size, path, and new path


@dataclass(frozen=True)
class Place:
    """The folders of one command's runs."""

    scenes: Path  # the inputs
    out: Path  # the output folder
    keep: Path  # links to files that were replaced or removed
    notes: Path  # counter, list of calls, and printed text
    plant: str = "none"  # fault on purpose, a key of ``PLANTS``

    def run(self, words: str, at: int = 0) -> Ended:
        """Run a command in a child process, which is killed before its call number ``at``; 0: it runs to its end."""
        shutil.rmtree(self.keep, ignore_errors=True)
        shutil.rmtree(self.notes, ignore_errors=True)
        self.keep.mkdir()
        self.notes.mkdir()
        (self.notes / "count").write_bytes(bytes(8))
        files = {"out": self.out, "scenes": self.scenes, "a": self.scenes / "a", "b": self.scenes / "b"}
        call = [word.format(**files) for word in words.split()]
        log, printed = self.notes / "calls", self.notes / "printed"
        log.touch()
        printed.touch()
        env = {"FOLDER": self.out, "KEEP": self.keep, "COUNT": self.notes / "count", "LOG": log, "AT": at}
        if (child := os.fork()) == 0:
            os.environ.update({f"KILLS_{key}": str(value) for key, value in env.items()})
            os._exit(_main(call, printed, self.plant))
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        return Ended(code, printed.read_text(), [line.split("\t") for line in log.read_text().splitlines()])

    def set_up(self, earlier: Path) -> None:
        """Replace the output folder by a copy of ``earlier``, the folder before a run."""
        shutil.rmtree(self.out, ignore_errors=True)
        shutil.copytree(earlier, self.out)


def _main(call: list[str], printed: Path, plant: str) -> int:
    """Run a command with its output in a file, and with a fault; return the exit code."""
    from gsmerge.cli import main

    for name, function in PLANTS[plant].items():
        setattr(os, name, function)
    with printed.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        code = main(call)
        sys.stdout.flush()
        sys.stderr.flush()
    return code


def read_files(folder: Path) -> dict[str, bytes]:
    """Read the bytes of every file below a folder except the lock, by name."""
    files = (x for x in sorted(folder.rglob("*")) if x.is_file() and x.name != LOCK)
    return {str(x.relative_to(folder)): x.read_bytes() for x in files}


def contents(files: dict[str, bytes]) -> Contents:
    """Hash files, but not the records of batches; what differs from run to run is left out of reports."""
    return {name: hashlib.sha256(_without_run(name, x)).hexdigest() for name, x in files.items() if name != RECORDS}


def _without_run(name: str, data: bytes) -> bytes:
    """Return a file's bytes; a report loses the keys that differ from run to run."""
    if not name.endswith(".json"):
        return data
    try:
        return json.dumps(json.loads(data, object_hook=_without_times)).encode()
    except ValueError:
        return data


def _without_times(document: dict[str, Any]) -> dict[str, Any]:
    """Return an object of a report without the keys that differ from run to run."""
    return {key: value for key, value in document.items() if key not in OF_THE_RUN}


def faults_of(files: dict[str, bytes], old: Contents, new: Contents) -> Iterator[str]:
    """Yield the faults of the files that a command has left.

    ``old`` are the contents before the command, and ``new`` those that it makes.
    """
    actual = contents(files)
    for name in sorted({*old, *new}):
        if actual.get(name) not in (old.get(name), new.get(name)):
            yield f"{name} is {'half-written' if name in actual else 'gone'}"
    for name in sorted(actual.keys() - {*old, *new}):
        if not Path(name).name.startswith((".gsmerge-", ".batch-")):
            yield f"{name} is neither an output nor temporary"
    for name in files.keys() & {"lod/lod-meta.json"}:
        missing = [x for x in json.loads(files[name] or b"{}").get("filenames", []) if f"lod/{x}" not in files]
        yield from [f"the index names {missing}"] if missing else []
    for line in files.get(RECORDS, b"").split(b"\n")[:-1]:
        for file in json.loads(line)["files"]:
            if hashlib.sha256(files.get(file["path"], b"")).hexdigest() != file["sha256"]:
                yield f"the record of {file['path']} is of another file"


def disks(place: Place, calls: list[list[str]], before: dict[str, os.stat_result]) -> Iterator[dict[str, bytes]]:
    """Yield the files of each disk that a loss of power may leave, by name.

    ``calls`` are those of the run, and ``before`` has the status of all files and folders before the run, by path.
    """
    written = {x.stat().st_ino: x for folder in (place.keep, place.out) for x in folder.rglob("*") if x.is_file()}
    synced = {status.st_ino: status.st_size for status in before.values()}
    lasting = {path: status.st_ino for path, status in before.items()}
    pending: list[dict[str, int]] = []
    for kind, number, size, path, target in calls:
        if kind == "create":
            pending.append({path: int(number)})
        elif kind == "rename":
            pending.append({path: 0, target: int(number)})
        elif kind == "unlink":
            pending.append({path: 0})
        elif kind == "truncate":
            synced[int(number)] = 0
        elif kind == "fsync":
            synced[int(number)] = int(size)
            for change in [x for x in pending if str(Path(next(iter(x))).parent) == path]:
                lasting |= change
                pending.remove(change)
    everything = range(len(pending))
    choices = {(), tuple(everything), *((i,) for i in everything)}
    choices |= {tuple(i for i in everything if i != lost) for lost in everything}
    for choice in sorted(choices):
        tree = dict(lasting)
        for i in choice:
            tree |= pending[i]
        yield {
            path.removeprefix(f"{place.out}/"): written[number].read_bytes()[: synced.get(number, 0)]
            for path, number in tree.items()
            if number in written and all(tree.get(str(x)) for x in Path(path).parents if x.is_relative_to(place.out))
        }


def try_command(name: str, place: Place, most: int | None) -> tuple[Counter[str], int, list[str]]:
    """Kill a command before each of its calls, or before ``most`` of them, and check what it leaves.

    Returns the number of kills by kind of call, the number of disks that were checked, and the faults.
    """
    words, first = COMMANDS[name]
    place.out.mkdir(parents=True)
    if first and (done := place.run(first)).code:
        raise SystemExit(f"an undisturbed run failed: {first}: {done.text}")
    earlier = place.out.with_name("earlier")
    shutil.copytree(place.out, earlier)
    old, inputs = contents(read_files(place.out)), contents(read_files(place.scenes))
    if (done := place.run(words)).code:
        raise SystemExit(f"an undisturbed run failed: {words}: {done.text}")
    new, last = contents(read_files(place.out)), int.from_bytes((place.notes / "count").read_bytes(), "little")
    chosen = np.unique(np.linspace(1, last, min(last, most or last)).round().astype(int))
    kinds: Counter[str] = Counter()
    num_disks, faults = 0, []
    for at in [*chosen, last + 1]:
        place.set_up(earlier)
        before = {str(x): x.stat() for x in (place.out, *place.out.rglob("*"))}
        ended = place.run(words, at)
        kind = next((call[3] for call in ended.calls if call[0] == "end"), "the end")
        kinds[kind] += kind != "the end"
        # A batch ends with 5 if the killed process is that of one of its scenes
        codes = (0,) if kind == "the end" else (-9, 5) if name == "batch" else (-9,)
        wrong = [] if ended.code in codes else [f"exit code {ended.code}: {ended.text}"]
        wrong += faults_of(left := read_files(place.out), old, new)
        lasting = old if ended.code else old | new  # after a whole run, chunks of the old index may come back
        for files in disks(place, ended.calls, before):
            num_disks += 1
            wrong += [f"after a loss of power, {x}" for x in faults_of(files, lasting, new)]
        if name != "extend" or contents(left) != new:  # a finished extend would add the views once more
            again = place.run(words)
            wrong += [f"the next run ends with {again.code}: {again.text}"] if again.code else []
        if (after := contents(read_files(place.out))) != new:
            wrong.append(f"after the next run: {sorted(after.items() ^ new.items())}")
        wrong += ["an input has changed"] if contents(read_files(place.scenes)) != inputs else []
        faults += [f"{name}, before call {at} of {last} ({kind}): {x}" for x in dict.fromkeys(wrong)]
    return kinds, num_disks, faults


def make_scenes(folder: Path) -> Path:
    """Make two small scenes of one world in a folder."""
    sys.path.insert(0, str(ROOT / "examples"))
    make = importlib.import_module("01_make_scene").make_scene
    for num_views, name in ((3, "a"), (4, "b")):
        make(folder / name, num_views=num_views, width=48, height=32, seed=0)
        shutil.rmtree(folder / name / "targets")
    return folder


def main() -> int:
    """Try the commands; return 1 if there are faults, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--calls", type=int, help="calls of each command, at equal distances; default: all")
    parser.add_argument("--commands", nargs="*", choices=list(COMMANDS), default=list(COMMANDS))
    parser.add_argument(
        "--plant", choices=list(PLANTS), default="none", help="a fault on purpose, which must be reported"
    )
    args = parser.parse_args()
    if "KILLS_LIBRARY" not in os.environ:
        with tempfile.TemporaryDirectory() as folder:
            library = f"{folder}/kills.so"
            subprocess.run(["gcc", "-shared", "-fPIC", "-o", library, str(ROOT / "tools" / "kills.c")], check=True)
            env = {**os.environ, "LD_PRELOAD": library, "KILLS_LIBRARY": library}
            return subprocess.run([sys.executable, *sys.argv], env=env, check=False).returncode
    num_faults = 0
    for module in MODULES:
        importlib.import_module(module)
    with tempfile.TemporaryDirectory() as folder:
        scenes = make_scenes(Path(folder) / "scenes")
        for name in args.commands:
            place = Place(scenes, *(Path(folder) / name / part for part in ("out", "keep", "notes")), args.plant)
            kinds, num_disks, faults = try_command(name, place, args.calls)
            counts = ", ".join(f"{kind} {count}" for kind, count in sorted(kinds.items()) if count)
            print(
                f"{name}: kills before {kinds.total()} calls ({counts}), {num_disks} disks, {len(faults)} faults",
                flush=True,
            )
            print("".join(f"  {fault}\n" for fault in faults), end="", flush=True)
            num_faults += len(faults)
    return 1 if num_faults else 0


if __name__ == "__main__":
    sys.exit(main())
