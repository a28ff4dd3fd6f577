"""Cost of a batch compared with single runs, and what it loses when it is killed again and again.

    python benchmarks/batch.py                                 # 200 scenes of 50 k Gaussians, 20 kills
    python benchmarks/batch.py --scenes 20 --kills 4 -- --effort fast
    python benchmarks/batch.py --only memory --scenes 10000    # many scenes that fail at once: does memory grow?

Everything after ``--`` goes to ``gsmerge batch``. A single run is ``gsmerge compact --threads 1`` of one scene, kernels
compiled, the mean of a few; throughput per core is scenes per processor second of the batch over that of single
runs, and the same by wall time and processors. Both are near one another on an idle machine only.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from gsmerge.research.generate import GenerateOptions, generate
from gsmerge.runtime.threads import available_threads

COMMAND = [sys.executable, "-m", "gsmerge"]
SINGLES = 5


@dataclass(frozen=True)
class Cost:
    """Seconds by the clock and of processors."""

    wall: float
    cpu: float


def timed(*arguments: object) -> Cost:
    """A command that must succeed."""
    wall, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([*COMMAND, *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Cost(time.perf_counter() - wall, cpu)


def hashes(folder: Path) -> dict[str, str]:
    """Every file but the records."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.suffix != ".jsonl"]
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def records(folder: Path) -> Counter[tuple[str, str]]:
    """How often each result was recorded, by its status."""
    path = folder / "batch.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    return Counter((line["output"], line["status"]) for line in map(json.loads, filter(_whole, lines)))


def _whole(line: str) -> bool:
    return line.endswith("}")


def throughput(scenes: list[Path], out: Path, options: list[str]) -> Cost:
    """Single runs, then the batch in one go; returns what the batch cost."""
    timed("compact", scenes[0], "-o", out / "single.ply", "--overwrite", "-q", *options)  # compiles
    single = [
        timed("compact", scene, "-o", out / "single.ply", "--overwrite", "--threads", 1, "-q", *options)
        for scene in scenes[:SINGLES]
    ]
    wall, cpu = (sum(getattr(cost, name) for cost in single) / len(single) for name in ("wall", "cpu"))
    print(f"single run      {wall:6.2f} s, {cpu:6.2f} s of processors (mean of {len(single)}, imports included)")
    whole = out / "undisturbed"
    shutil.rmtree(whole, ignore_errors=True)
    cost = timed("batch", scenes[0].parent, "--output", whole, "-q", *options)
    count = len(scenes)
    each = Cost(cost.wall * available_threads() / count, cost.cpu / count)
    print(f"batch           {cost.wall:6.1f} s for {count} scenes: {each.wall:.2f} s of a core, {each.cpu:.2f} s used")
    print(f"per core        {wall / each.wall:.2f} by the clock, {cpu / each.cpu:.2f} by processor time")
    steady = [line["report"]["total_seconds"] for line in map(json.loads, (whole / "batch.jsonl").open())]
    print(f"in the batch    {sum(steady) / count:6.2f} s per scene without imports and hashes")
    return cost


def at_work(folder: Path, since: float) -> bool:
    """Whether a scene has been taken up since a moment."""
    try:
        return any(path.stat().st_mtime > since for path in folder.glob(".batch-*.lock"))
    except FileNotFoundError:
        return False


def killed(scenes: list[Path], out: Path, options: list[str], cost: Cost, kills: int, seed: int) -> bool:
    """Kill a batch at random moments, finish it, and compare with the one that nothing happened to."""
    folder, chance, done = out / "killed", random.Random(seed), []
    shutil.rmtree(folder, ignore_errors=True)
    for _ in range(kills):
        process = subprocess.Popen([*COMMAND, "batch", str(scenes[0].parent), "--output", str(folder), "-q", *options])
        start = time.time()
        while process.poll() is None and not at_work(folder, start):
            time.sleep(0.01)
        time.sleep(chance.uniform(0, 1.6) * cost.wall / (kills + 1))  # from the first scene on, the whole run over
        process.kill()
        process.wait()
        done.append(sum(records(folder).values()))
    timed("batch", scenes[0].parent, "--output", folder, "-q", *options)
    results, expected, counts = hashes(folder), hashes(out / "undisturbed"), records(folder)
    twice = [name for (name, _), count in counts.items() if count > 1]
    lost, other = sorted(expected.keys() - results.keys()), sorted(results.keys() - expected.keys())
    differ = sorted(name for name in results.keys() & expected.keys() if results[name] != expected[name])
    print(f"killed {kills} times, with {', '.join(map(str, done))} scenes recorded")
    print(f"                {len(results)} of {len(expected)} results; lost {lost}, differ {differ}")
    print(f"                recorded twice {twice}, left over {other}")
    return not (lost or differ or twice or other)


def memory(out: Path, count: int) -> None:
    """The memory of a batch's processes while scenes that fail at once fly by."""
    folder = out / "broken"
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        (folder / f"{number:06d}.ply").write_bytes(b"ply\n")
    target = out / "broken-out"
    shutil.rmtree(target, ignore_errors=True)
    command = [*COMMAND, "batch", str(folder), "--output", str(target), "--jobs", "1", "-q"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    seen: list[tuple[int, int]] = []

    def watch() -> None:
        while process.poll() is None:
            lines = (target / "batch.jsonl").read_bytes().count(b"\n") if (target / "batch.jsonl").exists() else 0
            if lines and lines >= len(seen) * count / 10:
                seen.append((lines, resident(process.pid)))
            time.sleep(0.2)

    start = time.perf_counter()
    watcher = threading.Thread(target=watch)
    watcher.start()
    process.wait()
    watcher.join()
    print(f"{count} scenes that fail: {time.perf_counter() - start:.0f} s; memory of the run itself:")
    print("  " + ", ".join(f"{lines}: {size / 1e6:.0f} MB" for lines, size in seen))


def resident(pid: int) -> int:
    """Bytes that a process has in memory."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--size", default="128x98", help="of the views: 4 x 128 x 98 are 50 k Gaussians")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "out" / "batch")
    parser.add_argument("--only", choices=["batch", "memory"], default="batch")
    parser.add_argument("options", nargs="*", help="of gsmerge batch, after --")
    args = parser.parse_args()
    if args.only == "memory":
        memory(args.output, args.scenes)
        return
    width, height = map(int, args.size.split("x"))
    made = GenerateOptions(views=(args.views, args.views), width=width, height=height)
    folder = args.output / f"scenes-{args.views}x{args.size}-{args.scenes}"
    scenes = [scene.folder for scene in generate(folder, args.scenes, made, seed=args.seed)]
    cost = throughput(scenes, args.output, args.options)
    if args.kills and not killed(scenes, args.output, args.options, cost, args.kills, args.seed):
        sys.exit(1)


if __name__ == "__main__":
    main()
