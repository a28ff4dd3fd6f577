"""How near the kernels come to what a machine can do: docs/results/limit.md.

python benchmarks/limit.py                                    # fox and fern, the package that Python finds
python benchmarks/limit.py fern --page docs/results/limit.md  # its tables into the page
python benchmarks/limit.py --tree ../before --tree .          # two checkouts with built kernels, in turns
GSMERGE_TARGET=v3 python benchmarks/limit.py --json           # kernels of another target; numbers for programs

Each step of a real fit is timed, and its pairs of a pixel and a Gaussian are counted in a run of their own. Needed
pairs change the picture. Visited pairs are those on which the kernels work. The limit of a kernel is the time that its
operations take at the peak of the processor, or its bytes at the bandwidth of the memory that holds them, whichever is
longer (``kernel_work.py``). Times are the least of several runs, since other programs disturb them.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from kernel_work import KERNELS, work_of
from page_tables import make_table
from shared_scenes import export, scene_folders

from gsmerge.kernels.build import compiler, find_platform
from gsmerge.kernels.library import load_library

HERE = Path(__file__).parent
SIZES = {"L2": 2**19, "L3": 2**24, "memory": 2**28}  # bytes of a stream that is read and written
THREADS = 1, 2
TRIES = {1: 40, 2: 160}  # of a peak, by threads; the best counts
GOAL = 0.7  # share of the limit that the last table supposes
# Kernels in the phases of a step; those with several parts are divided by separate calls
PHASES = {
    "cull": ("cull",), "project": ("project", "sort"), "count": ("bin",), "count_open": ("bin",), "deal": ("bin",),
    "deal_open": ("bin",), "blend": ("blend",), "loss": ("loss",), "backward": ("backward",),
    "update": ("gather_slots", "project_backward", "adam"),
}  # fmt: skip
OF_COUNTS = ("num_visible", "n", "pixels", "listed", "walked", "shown", "visited", "needed", "vectors", "useful")
# Kernels outside of steps that draw a view
DRAWING = {
    "cull": "cull", "project": "project", "sort_bits": "bin", "count_boxes": "bin", "deal_tiles": "bin",
    "deal_open_tiles": "bin", "blend": "blend",
}  # fmt: skip
READ = """
import json, sys, time
from pathlib import Path
import cv2
from gsmerge.io import read_ply
def least(call):
    seconds = []
    for _ in range(5):
        start = time.process_time()
        result = call()
        seconds.append(time.process_time() - start)
    return min(seconds), result
path, folder = Path(sys.argv[1]), Path(sys.argv[2])
seconds, scene = least(lambda: read_ply(path))
arrays = [value for value in vars(scene.gaussians).values() if hasattr(value, "nbytes")]
photos = [one for one in folder.rglob("*") if one.suffix.lower() in (".png", ".jpg", ".jpeg")]
decoding, _ = least(lambda: [cv2.imread(str(one)) for one in photos])
num_bytes = path.stat().st_size + sum(array.nbytes for array in arrays)
print(json.dumps({"rows": len(scene.gaussians), "bytes": num_bytes, "seconds": seconds,
                  "photos": len(photos), "decoding": decoding}))
"""


@dataclass(frozen=True)
class Machine:
    """What a processor does at most, with one and two threads: rates a second."""

    target: str  # Of the kernels
    slots: dict[int, float]  # Multiply-adds, one for each lane
    divisions: dict[int, float]
    bandwidths: dict[str, dict[int, float]]  # Bytes read and written, by the memory that holds them

    @property
    def division(self) -> float:
        """Slots of a division."""
        return self.slots[1] / self.divisions[1]

    def bandwidth(self, num_bytes: float) -> float:
        """Return the bandwidth, for one thread, of memory that holds so many bytes; between streams on a power law."""
        rates = [self.bandwidths[name][1] for name in SIZES]
        return float(np.exp(np.interp(np.log(max(num_bytes, 1)), np.log(list(SIZES.values())), np.log(rates))))

    def limit(self, kernel: str, counts: dict[str, float], *, needed: bool) -> tuple[float, str]:
        """Return the least processor seconds of a kernel at the counts of a step, and what bounds it."""
        work = work_of(kernel, counts, needed=needed, division=self.division)
        slots, moved = work.slots / self.slots[1], work.bytes / self.bandwidth(work.bytes)
        return max((slots, "operations"), (moved, "bytes"))


def compile_counter(tree: Path, target: str, folder: Path) -> Path:
    """Compile limit.c for a target of the kernels, with the headers of a tree."""
    platform, kernels = find_platform(), tree / "gsmerge" / "kernels"
    options = next(one for one in platform.targets if one.name == target)
    command, path = compiler(), folder / f"limit-{target}{platform.suffix}"
    is_zig = Path(command[0]).stem == "zig"
    flags = ["-target", platform.triple, *platform.flags, *options.zig] if is_zig else options.gcc
    call = [
        *command, *flags, "-std=c11", "-O3", "-ffp-contract=on", "-fno-math-errno", "-fPIC", "-shared", "-Wno-psabi",
        f"-I{kernels}", f"-I{kernels / 'raster'}", str(HERE / "limit.c"), "-lm", "-o", str(path),
    ]  # fmt: skip
    caches = {"ZIG_GLOBAL_CACHE_DIR": f"{folder}/global", "ZIG_LOCAL_CACHE_DIR": f"{folder}/local"}
    subprocess.run(call, check=True, env={**os.environ, **caches})
    return path


def best_rate(call: Callable[[int], int], threads: int) -> float:
    """Return the most that calls on so many threads at a time do in a second; each returns what it has done."""
    best = 0.0
    for _ in range(TRIES[threads]):
        done, barrier = [0] * threads, threading.Barrier(threads + 1)

        def work(i: int, done: list[int] = done, barrier: threading.Barrier = barrier) -> None:
            barrier.wait()
            done[i] = call(i)

        workers = [threading.Thread(target=work, args=(i,)) for i in range(threads)]
        for worker in workers:
            worker.start()
        barrier.wait()
        start = time.perf_counter()
        for worker in workers:
            worker.join()
        best = max(best, sum(done) / (time.perf_counter() - start))
    return best


def measure_machine(path: Path, target: str) -> Machine:
    """Measure multiply-adds, divisions and streams by the loops of limit.c; each call takes about 10 ms."""
    library = ctypes.CDLL(str(path))
    for name in ("add_products", "divide", "stream"):
        getattr(library, name).restype = ctypes.c_int64
    outs = np.ones((max(THREADS), 16), np.float32)

    def chains(name: str, rounds: int, threads: int) -> float:
        def call(i: int) -> int:
            return getattr(library, name)(ctypes.c_int64(rounds), ctypes.c_void_p(outs[i].ctypes.data))

        return best_rate(call, threads)

    def stream(size: int, threads: int) -> float:
        count = size // 8
        arrays = np.ones((threads, 2, count), np.float32)
        rounds = max(1, 2**28 // size)

        def call(i: int) -> int:
            addresses = [ctypes.c_void_p(array.ctypes.data) for array in arrays[i]]
            return library.stream(*addresses, ctypes.c_int64(count), ctypes.c_int64(rounds))

        return best_rate(call, threads)

    return Machine(
        target,
        {threads: chains("add_products", 5_000_000, threads) for threads in THREADS},
        {threads: chains("divide", 1_000_000, threads) for threads in THREADS},
        {name: {threads: stream(size, threads) for threads in THREADS} for name, size in SIZES.items()},
    )


def run_tree(tree: Path, words: list[str], threads: int, counter: Path | None = None) -> dict[str, Any]:
    """Run a command with the package of a tree, and return what kernel_times.py writes."""
    environment = {**os.environ, "PYTHONPATH": str(tree), "GSMERGE_THREADS": str(threads)}
    environment |= {"LIMIT_COUNTS": str(counter)} if counter else {}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "record.json"
        call = [sys.executable, str(HERE / "kernel_times.py"), str(out), *words, "--overwrite", "-q"]
        subprocess.run(call, check=True, env=environment)
        return json.loads(out.read_text())


def divide_phases(phases: dict[str, float], parts: dict[str, float]) -> dict[str, float]:
    """Divide the seconds of a step's phases among kernels; sorting by depth belongs to the lists."""
    seconds: dict[str, float] = defaultdict(float)
    for phase, value in phases.items():
        names = PHASES[phase]
        total = sum(parts[name] for name in names) if len(names) > 1 else 1.0
        for name in names:
            share = parts[name] / total if len(names) > 1 else 1.0
            seconds["bin" if name == "sort" else name] += share * value
    return seconds


def join_steps(counted: dict[str, Any], runs: dict[int, list[dict[str, Any]]]) -> dict[str, Any]:
    """Return the mean counts and the mean least processor seconds of the steps of each size, by threads and kernel."""
    groups: dict[tuple[int, int], list[int]] = defaultdict(list)
    for i, step in enumerate(counted["steps"]):
        groups[step["height"], step["width"]].append(i)
    joined = {}
    for (height, width), rows in sorted(groups.items(), reverse=True):
        steps = [counted["steps"][i] for i in rows]
        counts = {key: float(np.mean([step[key] for step in steps])) for key in OF_COUNTS}
        seconds: dict[int, dict[str, float]] = {}
        for threads, records in runs.items():
            sums = dict.fromkeys(KERNELS, 0.0)
            for i, step in zip(rows, steps, strict=True):
                times = [record["steps"][i]["cpu"] for record in records]
                least = {phase: min(one[phase] for one in times) for phase in times[0]}
                for kernel, value in divide_phases(least, step["parts"]).items():
                    sums[kernel] += value / len(rows)
            seconds[threads] = sums
        joined[f"{height} x {width}"] = {"steps": len(rows), "counts": counts, "seconds": seconds}
    return joined


def draw_result(tree: Path, result: Path, pictures: Path, counter: Path, repeats: int) -> dict[str, Any]:
    """Return mean counts and the least seconds of the kernels for a view of a result, one thread."""
    words = ["render", str(result), "-o", str(pictures)]
    counted = run_tree(tree, words, 1, counter)
    runs, views = [run_tree(tree, words, 1)["kernels"] for _ in range(repeats)], counted["kernels"]["sort_bits"][1]
    seconds: dict[str, float] = defaultdict(float)
    for name, kernel in DRAWING.items():
        seconds[kernel] += min(run.get(name, [0.0])[0] for run in runs) / views
    return {"counts": {key: count / views for key, count in counted["drawn"].items()}, "seconds": seconds}


def read_scene(tree: Path, path: Path, folder: Path) -> dict[str, Any]:
    """Return bytes and seconds of reading the rows of a scene, and the seconds of decoding its photos."""
    environment = {**os.environ, "PYTHONPATH": str(tree), "GSMERGE_THREADS": "1"}
    run = subprocess.run(
        [sys.executable, "-c", READ, str(path), str(folder)], check=True, env=environment, stdout=subprocess.PIPE
    )
    return json.loads(run.stdout)


def measure_scene(trees: list[Path], folder: Path, counters: list[Path], repeats: int, out: Path) -> list[Any]:
    """Compact a scene with each tree, in turns; return a record of each tree."""
    results = [out / f"{folder.name}-{i}.ply" for i in range(len(trees))]
    words = [["compact", str(folder), "-o", str(result)] for result in results]
    counted = [run_tree(tree, *rest) for tree, *rest in zip(trees, words, [1] * len(trees), counters, strict=True)]
    runs: list[dict[int, list[Any]]] = [{threads: [] for threads in THREADS} for _ in trees]
    for _ in range(repeats):
        for threads in THREADS:
            for i, tree in enumerate(trees):
                runs[i][threads].append(run_tree(tree, words[i], threads))
    rows = sorted(folder.rglob("*.ply"))[0]
    records = []
    for i, tree in enumerate(trees):
        alone = runs[i][1]
        least = min(alone, key=lambda run: run["seconds"])
        other = sum(seconds for seconds, _ in least["kernels"].values())
        record = {"scene": folder.name.removesuffix("-plain"), "tree": i, "seconds": least["seconds"]}
        record |= {"other_kernels": other, "sizes": join_steps(counted[i], runs[i])}
        record |= {"drawing": draw_result(tree, results[i], out / "pictures", counters[i], repeats)}
        records.append(record | {"reading": read_scene(tree, rows, folder)})
    return records


def machine_table(machine: Machine) -> str:
    rows = [
        (f"multiply-adds, {machine.target}, a second", *(f"{machine.slots[t] / 1e9:.0f} G" for t in THREADS)),
        ("divisions a second", *(f"{machine.divisions[t] / 1e9:.1f} G" for t in THREADS)),
        *(
            (f"read and written, {SIZES[name] // 2**10:,} KB, {name}", *(f"{rates[t] / 1e9:.0f} GB/s" for t in THREADS))
            for name, rates in machine.bandwidths.items()
        ),
    ]
    return make_table(("", "one thread", "two threads"), rows)


def pairs_table(records: list[dict[str, Any]]) -> str:
    rows = []
    for record in records:
        for size, group in record["sizes"].items():
            counts = group["counts"]
            tiles, visited, needed = 256e-6 * counts["listed"], 1e-6 * counts["visited"], 1e-6 * counts["needed"]
            cells = f"{counts['num_visible']:,.0f}", f"{counts['listed']:,.0f}", f"{tiles:.2f}", f"{visited:.2f}"
            shares = f"{needed / visited:.2f}", f"{counts['useful'] / counts['vectors']:.2f}"
            rows.append((f"{record['scene']}, {size}", str(group["steps"]), *cells, f"{needed:.2f}", *shares))
    head = "", "steps", "Gaussians", "listed", "by tiles, M", "visited, M", "needed, M", "needed/visited", "vectors"
    return make_table(head, rows)


def kernel_rows(machine: Machine, counts: dict[str, float], seconds: dict[int, dict[str, float]]) -> list[list[str]]:
    """Return a row for each kernel: milliseconds, what bounds it, and the shares of the limits."""
    rows = []
    for kernel in KERNELS:
        own = seconds[1].get(kernel, 0.0)
        if own == 0:
            continue
        visited, bound = machine.limit(kernel, counts, needed=False)
        needed, _ = machine.limit(kernel, counts, needed=True)
        work = work_of(kernel, counts, needed=False, division=machine.division)
        plain = work.operations / (2 * machine.slots[1]) / own
        row = [kernel, f"{1e3 * own:.3f}", bound, f"{visited / own:.2f}", f"{needed / own:.2f}", f"{plain:.2f}"]
        if 2 in seconds:
            row += [f"{1e3 * seconds[2][kernel]:.3f}", f"{visited / seconds[2][kernel]:.2f}"]
        rows.append(row)
    return rows


HEAD = ("", "ms", "bound by", "of the algorithm's limit", "of the task's", "in FLOPs")


def steps_table(machine: Machine, records: list[dict[str, Any]]) -> str:
    """The kernels of the two kinds of steps in which most of the time goes, for each scene."""
    rows = []
    for record in records:
        groups = sorted(
            record["sizes"].items(), key=lambda item: -item[1]["steps"] * sum(item[1]["seconds"][1].values())
        )
        for size, group in groups[:2]:
            rows.append([f"**{record['scene']}, {size}**", *[""] * 7])
            rows += kernel_rows(machine, group["counts"], group["seconds"])
    return make_table((*HEAD, "of two threads, ms", "of the algorithm's limit"), rows)


def drawing_table(machine: Machine, records: list[dict[str, Any]]) -> str:
    rows = []
    for record in records:
        drawing, reading, scene = record["drawing"], record["reading"], record["scene"]
        for row in kernel_rows(machine, drawing["counts"], {1: drawing["seconds"]}):
            rows.append([f"{scene}, {row[0]}", *row[1:]])
        share = f"{reading['bytes'] / machine.bandwidth(reading['bytes']) / reading['seconds']:.2f}"
        rows.append([f"{scene}, rows read", f"{1e3 * reading['seconds']:.1f}", "bytes", share, share, ""])
        if reading["photos"]:
            name = f"{scene}, {reading['photos']} photos decoded"
            rows.append([name, f"{1e3 * reading['decoding']:.1f}", *[""] * 4])
    return make_table(HEAD, rows)


def kernel_seconds(machine: Machine, record: dict[str, Any], *, needed: bool) -> dict[str, tuple[float, float]]:
    """Return the seconds of each kernel in all steps of a command, and their limit, one thread."""
    totals = {}
    for kernel in KERNELS:
        groups = record["sizes"].values()
        spent = sum(group["steps"] * group["seconds"][1][kernel] for group in groups)
        limit = sum(group["steps"] * machine.limit(kernel, group["counts"], needed=needed)[0] for group in groups)
        totals[kernel] = spent, limit
    return totals


def goal_table(machine: Machine, records: list[dict[str, Any]]) -> str:
    """What a command would take if the kernels of its steps reached GOAL of their limits, and nothing else changed.

    Lists of tiles are left out: their limit counts bytes alone, which scalar code never reaches.
    """
    rows = []
    for record in records:
        totals = kernel_seconds(machine, record, needed=False)
        steps = sum(spent for spent, _ in totals.values())
        rest = record["seconds"] - steps - record["other_kernels"]
        cells = [record["seconds"], steps, record["other_kernels"], rest]
        for needed in (False, True):
            pairs = [pair for key, pair in kernel_seconds(machine, record, needed=needed).items() if key != "bin"]
            cells.append(record["seconds"] - sum(max(0.0, spent - limit / GOAL) for spent, limit in pairs))
        rows.append((record["scene"], *(f"{cell:.2f}" for cell in cells)))
    goals = f"at {GOAL:.0%} of the algorithm's limits", f"at {GOAL:.0%} of the task's"
    head = "seconds, one thread", "command", "its steps", "other kernels", "the rest", *goals
    return make_table(head, rows)


def trees_table(machine: Machine, records: list[dict[str, Any]]) -> str:
    """Seconds of each kernel in all steps of a command, by tree, and their share of the algorithm's limit."""
    rows, names = [], ("before", "now")
    for scene in dict.fromkeys(record["scene"] for record in records):
        some = [record for record in records if record["scene"] == scene]
        totals = [kernel_seconds(machine, record, needed=False) for record in some]
        for kernel in KERNELS:
            cells = [f"{one[kernel][0]:.3f} ({one[kernel][1] / one[kernel][0]:.2f})" for one in totals]
            rows.append((f"{scene}, {kernel}", *cells, f"{totals[-1][kernel][0] / totals[0][kernel][0]:.2f}"))
        ratio = some[-1]["seconds"] / some[0]["seconds"]
        rows.append((f"{scene}, command", *(f"{record['seconds']:.2f}" for record in some), f"{ratio:.2f}"))
    return make_table(
        ("seconds (share)", *(names if len(totals) == 2 else map(str, range(len(totals)))), "ratio"), rows
    )


def make_tables(machine: Machine, records: list[dict[str, Any]]) -> dict[str, str]:
    """Return the tables of the last tree by name and target, and one that compares trees if there are several."""
    last = [record for record in records if record["tree"] == records[-1]["tree"]]
    tables = {
        "machine": machine_table(machine),
        "pairs": pairs_table(last),
        "steps": steps_table(machine, last),
        "drawing": drawing_table(machine, last),
        "goal": goal_table(machine, last),
    }
    tables |= {"trees": trees_table(machine, records)} if len(last) < len(records) else {}
    return {f"{name} {machine.target}": table for name, table in tables.items()}


def write_page(path: Path, tables: dict[str, str]) -> None:
    """Replace the tables of a page; each begins after a comment with its name."""
    text = path.read_text(encoding="utf-8")
    for name, table in tables.items():
        text = re.sub(rf"(<!-- {name} -->\n)(\|.*\n)*", lambda found, table=table: f"{found[1]}{table}\n", text)
    path.write_text(text, encoding="utf-8")


def find_scenes(text: str, cache: Path) -> list[Path]:
    """Return the folders of scenes: a folder itself, or exports of captures by name."""
    if Path(text).is_dir():
        return [Path(text)]
    paths = [export(folder, cache) for folder in scene_folders(text)]
    return [next(parent for parent in path.parents if parent.parent == cache) for path in paths]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", nargs="*", default=["fox,fern"], help="train, eval, names with commas, folders")
    parser.add_argument("--tree", type=Path, action="append", help="checkout with built kernels; may be repeated")
    parser.add_argument("--repeats", type=int, default=5, help="runs of each command")
    parser.add_argument("--json", action="store_true", help="print all numbers instead of tables")
    parser.add_argument("--page", type=Path, help="page whose tables of this target are replaced")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    trees = [tree.resolve() for tree in args.tree or [HERE.parent]]
    target = Path(load_library()._name).stem.split("-")[-1]
    with tempfile.TemporaryDirectory() as name:
        counters = []
        for i, tree in enumerate(trees):
            (Path(name) / str(i)).mkdir()
            counters.append(compile_counter(tree, target, Path(name) / str(i)))
        machine, records = measure_machine(counters[-1], target), []
        for folder in (folder for text in args.scenes for folder in find_scenes(text, args.cache)):
            records += measure_scene(trees, folder, counters, args.repeats, Path(name))
    tables = make_tables(machine, records)
    if args.page:
        write_page(args.page, tables)
    if args.json:
        print(json.dumps({"machine": asdict(machine), "records": records}))
    else:
        print("\n\n".join(f"{key}\n\n{table}" for key, table in tables.items()))


if __name__ == "__main__":
    main()
