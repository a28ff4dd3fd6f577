"""Measure how near the kernels come to the limits of a machine, for a table of docs/results.md.

python benchmarks/limit.py                    # fox and fern
GSMERGE_TARGET=v3 python benchmarks/limit.py  # kernels of another target

Each step of a real fit is timed. Another run counts the step's pairs of a pixel and a Gaussian. Needed pairs change the
picture. Visited pairs are those on which the kernels work. The limit of a kernel is a time: the longer one of the time
that its operations take at the peak of the processor, and the time that its bytes take at the bandwidth of the memory
that holds them. Measured times are the least of several runs, since other programs disturb them.

Operations and bytes (``COSTS``) are counted in the source of each kernel. A slot is one instruction in one lane of a
vector: an add, a multiplication, a comparison, a selection, a minimum, a rounding or a bitwise operation, or a
multiply-add, which is two operations in one slot. A division or a square root takes as many slots as the machine makes
multiply-adds in the same time. Loads, stores, shuffles, addresses and loops are not counted, because an ideal processor
does them at the same time. Bytes are those that each call has to read or write once. The planes of a tile or block are
not counted, because they stay in the first cache.
"""

from __future__ import annotations

import atexit
import ctypes
import inspect
import json
import os
import runpy
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from captures import export_capture, make_parser, make_table, scene_folders

from gsmerge.method.kernels import signature
from gsmerge.method.kernels.build import compiler, find_platform
from gsmerge.method.kernels.gaussians.optimise import adam
from gsmerge.method.kernels.library import load_library
from gsmerge.method.kernels.raster.binning import sort_bits
from gsmerge.method.kernels.raster.blend import gather_slots
from gsmerge.method.kernels.raster.project import project, project_backward
from gsmerge.method.kernels.raster.step import PHASES, STEP

HERE = Path(__file__).parent
# Environment variables of a recorded run: the file of its record, and the library that counts pairs
RECORD, COUNTER = "LIMIT_RECORD", "LIMIT_COUNTER"
REPEATS = 5  # runs of each command
SIZES = {"L2": 2**19, "L3": 2**24, "memory": 2**28}  # bytes that a stream reads and writes, to measure a memory
THREADS = 1, 2  # numbers of threads that are measured
TRIES = {1: 40, 2: 160}  # measurements of a peak by number of threads, of which the best counts
# Kernels of each phase of a step. The time of a phase with several kernels is divided by timing them separately
KERNELS_OF = {
    "cull": ("cull",), "project": ("project", "sort"), "count": ("bin",), "count_open": ("bin",), "deal": ("bin",),
    "deal_open": ("bin",), "blend": ("blend",), "loss": ("loss",), "backward": ("backward",),
    "update": ("gather_slots", "project_backward", "adam"),
}  # fmt: skip
COUNTS = ("pixels", "listed", "walked", "shown", "visited", "needed", "vectors", "useful")  # fields of limit.c's Counts
OF_COUNTS = ("num_visible", "n", *COUNTS)  # counts of a step, which are averaged
OF_STEPS = ("n", "height", "width", "num_visible", "num_intersections")  # numbers of a step that are recorded
WRITTEN = ("x", "m", "v", "means", "quats", "scales", "opacities", "colors")  # arrays that adam changes
FLOAT, ROW = 4, 14 * 4  # bytes of a number, and of a row of the optimiser's state
# Bytes of a Gaussian's mean, quaternion, scales and opacity; of its conic with its colour; and of a row of slots
SPLAT, CONIC, SLOT = 11 * FLOAT, (8 + 3) * FLOAT, 9 * FLOAT


@dataclass(frozen=True)
class Cost:
    """The work of a kernel for each unit of a count."""

    kernel: str
    unit: str  # a count of a step; "pair" is a visited or a needed pair
    plain: float  # number of slots with one operation
    fused: float  # number of multiply-adds
    divisions: float  # number of divisions and square roots
    bytes: float  # bytes read or written
    why: str  # what the work is for

    def slots(self, division: float) -> float:
        """Return the number of slots, if a division takes as long as ``division`` slots."""
        return self.plain + self.fused + division * self.divisions

    def operations(self, division: float) -> float:
        """Return the number of operations, if a division takes as long as ``division`` slots."""
        return self.plain + 2 * self.fused + 2 * division * self.divisions


NARROW = "transpose of the conic, narrow_rows: two axes of the ellipse, their ends, whole numbers"
TRACE = "trace: base and top of sixteen rows, and the columns of a row"
COSTS = (
    Cost("cull", "n", 42, 12, 3, 7 * FLOAT, "depth, two coordinates and their limits, two reaches, seven comparisons"),
    Cost("cull", "num_visible", 0, 0, 0, FLOAT, "its id"),
    Cost("project", "num_visible", 134, 63, 9, FLOAT + SPLAT + 8 * FLOAT + FLOAT + 8 + 6 * FLOAT,
         "position 12, Jacobian 26, rotation 34, two half axes 24, covariance 22, logarithm 20, box 41, conic 18"),
    Cost("bin", "num_visible", 0, 0, 0, 4 + 4 + 8 + 3 * 16 + 12 + 20 + 12,
         "sort: keys, three passes that read and write them, order; boxes in that order; dealt. Scalar: bytes alone"),
    Cost("bin", "listed", 0, 0, 0, FLOAT, "its place in a tile's list"),
    Cost("blend", "pair", 13, 9, 0, 0,
         "exponent 2, exp: polynomial 5, squares 3, cut and clamp 3; share of the light 6, three colours"),
    Cost("blend", "walked", 70, 10, 8, 0, NARROW),
    Cost("blend", "shown", 64, 32, 0, 0, TRACE),
    Cost("blend", "listed", 0, 0, 0, FLOAT, "its row"),
    Cost("blend", "num_visible", 0, 0, 0, CONIC, "conic and colour"),
    Cost("blend", "pixels", 1, 3, 0, 4 * FLOAT, "background; image and transmittance"),
    Cost("loss", "pixels", 375, 37.5, 3, 10 * FLOAT,
         "three values: means over windows 21, SSIM's derivatives 56, their means 10, gradient 32, edges 19"),
    Cost("backward", "pair", 25, 12, 1, 0,
         "alpha and share of the light as in blend, 20; g.c 3, what is left behind 5, six sums 9"),
    Cost("backward", "walked", 70, 10, 8, 0, NARROW),
    Cost("backward", "shown", 264, 32, 0, 0, TRACE + "; add_columns: moments with x, sums of nine vectors"),
    Cost("backward", "listed", 0, 0, 0, FLOAT + SLOT, "its row; its slot"),
    Cost("backward", "num_visible", 0, 0, 0, CONIC, "conic and colour"),
    Cost("backward", "pixels", 1, 3, 0, 6 * FLOAT, "g.C; image and gradient"),
    Cost("gather_slots", "listed", 9, 0, 0, FLOAT + SLOT, "its row, its slot"),
    Cost("gather_slots", "num_visible", 0, 0, 0, 2 * SLOT, "sums, zeroed and written"),
    Cost("project_backward", "num_visible", 213, 134, 6, FLOAT + SPLAT + SLOT + SPLAT,
         "position and Jacobian 34, rotation and half axes 62, conic 55, scales 33, quaternion 58, mean 70, pose 30"),
    Cost("adam", "num_visible", 809, 96, 37, 4 * ROW + 3 * ROW + 5 * FLOAT + 4 * FLOAT + ROW + ROW,
         "a row is sixteen lanes: moments and step 27 each with root and division, box 24; four exponentials 80"),
)  # fmt: skip
KERNELS = tuple(dict.fromkeys(cost.kernel for cost in COSTS))
OF_LISTS = "walked", "shown", "listed"  # units of work on tile lists, which another algorithm might not need


@dataclass(frozen=True)
class Machine:
    """The highest rates of a processor per second, each by number of threads."""

    target: str  # target of the kernels
    slots: dict[int, float]  # multiply-adds, one for each lane
    divisions: dict[int, float]
    bandwidths: dict[str, dict[int, float]]  # bytes read and written, by the memory that holds them

    def work(self, kernel: str, counts: dict[str, float], *, needed: bool) -> np.ndarray:
        """Return the slots, operations and bytes of a kernel ``[3]``.

        If ``needed``, only the work that the task itself needs is counted, otherwise all work of our algorithm.
        """
        division, total = self.slots[1] / self.divisions[1], np.zeros(3)
        for cost in COSTS:
            if cost.kernel == kernel and not (needed and cost.unit in OF_LISTS):
                count = counts[("needed" if needed else "visited") if cost.unit == "pair" else cost.unit]
                total += count * np.array([cost.slots(division), cost.operations(division), cost.bytes])
        return total

    def bandwidth(self, num_bytes: float) -> float:
        """Return the bandwidth for one thread of the memory that holds so many bytes, interpolated by a power law."""
        rates = [self.bandwidths[name][1] for name in SIZES]
        return float(np.exp(np.interp(np.log(max(num_bytes, 1)), np.log(list(SIZES.values())), np.log(rates))))

    def limit(self, kernel: str, counts: dict[str, float], *, needed: bool) -> tuple[float, str]:
        """Return the least processor seconds of a kernel at the counts of a step, and what bounds it."""
        slots, _, num_bytes = self.work(kernel, counts, needed=needed)
        slots, moved = slots / self.slots[1], num_bytes / self.bandwidth(num_bytes)
        return max((slots, "operations"), (moved, "bytes"))


def compile_counter(target: str, folder: Path) -> Path:
    """Compile limit.c for a target of the kernels."""
    platform, kernels = find_platform(), HERE.parent / "gsmerge" / "method" / "kernels"
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
    """Return the highest rate per second of calls on several threads at the same time.

    ``call`` gets the number of its thread, and returns the amount of work that it has done.
    """
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
    """Measure the rates of multiply-adds, divisions and streams with the loops of limit.c, in calls of about 10 ms."""
    library = ctypes.CDLL(str(path))
    for name in ("add_products", "divide", "stream"):
        getattr(library, name).restype = ctypes.c_int64
    outs = np.ones((max(THREADS), 16), np.float32)

    def measure_chains(name: str, rounds: int, threads: int) -> float:
        """Measure the operations per second of a loop of limit.c on all threads."""

        def call(i: int) -> int:
            return getattr(library, name)(ctypes.c_int64(rounds), ctypes.c_void_p(outs[i].ctypes.data))

        return best_rate(call, threads)

    def measure_stream(size: int, threads: int) -> float:
        """Measure the bytes per second of streams over memory of ``size`` bytes."""
        count = size // 8
        arrays = np.ones((threads, 2, count), np.float32)
        rounds = max(1, 2**28 // size)

        def call(i: int) -> int:
            addresses = [ctypes.c_void_p(array.ctypes.data) for array in arrays[i]]
            return library.stream(*addresses, ctypes.c_int64(count), ctypes.c_int64(rounds))

        return best_rate(call, threads)

    return Machine(
        target,
        {threads: measure_chains("add_products", 5_000_000, threads) for threads in THREADS},
        {threads: measure_chains("divide", 1_000_000, threads) for threads in THREADS},
        {name: {threads: measure_stream(size, threads) for threads in THREADS} for name, size in SIZES.items()},
    )


class Recorder:
    """Recorder of the times of all phases of each step of a fit, and of pairs if there is a counter."""

    def __init__(self, counter: ctypes.CDLL | None) -> None:
        self.counter, self.lock = counter, threading.Lock()
        self.steps: list[dict[str, Any]] = []  # records of finished steps
        self.phases: dict[
            str, list[float]
        ] = {}  # processor seconds and number of calls of each phase of the current step
        self.separate: dict[str, Any] = {}  # times of separate kernels and counts of pairs of the current step

    def time_phase(self, entry: Callable[..., Any], address: int, phase: int, fields: int) -> Any:
        """Time one call of a phase, and return its result; each thread of a step makes one call."""
        table, name = Fields(address), PHASES[phase]
        if name == "update" and self.counter is not None:
            self.separate = {"parts": time_parts(table), **count_pairs(self.counter, table)}
        start = time.thread_time()
        result = entry(address, phase, fields)
        seconds = time.thread_time() - start
        with self.lock:
            entries = self.phases.setdefault(name, [0.0, 0])
            if entries[1] == table["threads"]:  # the phase is repeated, with more memory
                entries[:] = [0.0, 0]
            entries[:] = [entries[0] + seconds, entries[1] + 1]
            if name == "update" and entries[1] == table["threads"]:
                cpu = {phase: spent for phase, (spent, _) in self.phases.items()}
                self.steps.append({**{key: table[key] for key in OF_STEPS}, "cpu": cpu, **self.separate})
                self.phases = {}
        return result


class Fields:
    """The numbers and arrays of the table of a step, which lies at an address, by name."""

    def __init__(self, address: int) -> None:
        self.values = (ctypes.c_int64 * len(STEP.fields)).from_address(address)

    def __getitem__(self, key: str) -> int:
        """Return a number of the table."""
        return self.values[STEP.fields[key]]

    def array(self, key: str) -> np.ndarray:
        """Return an array of the table without a copy."""
        argument = STEP.arrays[key]
        shape = [size if isinstance(size, int) else self[size] for size in argument.shape]
        count = int(np.prod(shape)) * argument.dtype.itemsize
        if count == 0:
            return np.empty(shape, argument.dtype)
        return np.frombuffer((ctypes.c_char * count).from_address(self[key]), argument.dtype).reshape(shape)


def count_pairs(counter: ctypes.CDLL, table: Fields) -> dict[str, int]:
    """Count the pairs of pixels and Gaussians in a step's lists of tiles, before its last phase."""
    counts = np.zeros(len(COUNTS), np.int64)
    pointers = [ctypes.c_void_p(table[key]) for key in ("conics", "flatten_ids", "offsets")]
    sizes = ("tiles", "height", "width", "num_visible", "num_intersections", "ends")
    numbers = [ctypes.c_int64(size) for size in (-(-table["width"] // 16), 0, *(table[key] for key in sizes))]
    if counter.count_pairs(*pointers, *numbers, ctypes.c_void_p(counts.ctypes.data)):
        raise ValueError("expected lists within their arrays, found an index outside")
    return dict(zip(COUNTS, counts.tolist(), strict=True))


def time_parts(table: Fields) -> dict[str, float]:
    """Time each kernel of the phases "project" and "update" by a separate call; return processor seconds by kernel.

    adam works on copies, so that the fit goes on unchanged.
    """
    m, count = table["num_visible"], table["num_intersections"]
    arrays = {key: table.array(key) for key in STEP.arrays}
    view_arrays = (
        "sums", "ids", "g_means", "g_quats", "g_scales", "g_opacities", "g_colors", "conics", "depths", "boxes",
        "order", "keys", "spare",
    )  # fmt: skip
    arrays |= {key: arrays[key][:m] for key in view_arrays} | {
        "flatten_ids": arrays["flatten_ids"][:count], "slots": arrays["slots"][:count], "first": 0, "last": m,
        "step": table["step"], "grad_poses": None, "bits": arrays["depths"][:m].view(np.uint32),
    }  # fmt: skip
    arrays |= {f"grad_{key[2:]}": arrays[key] for key in view_arrays if key.startswith("g_")}
    copies = {key: arrays[key].copy() for key in WRITTEN}
    seconds = {}
    for name, function, own in (
        ("project", project, {"opacities": arrays["drawn"]}),
        ("sort", sort_bits, {}),
        ("gather_slots", gather_slots, {}),
        ("project_backward", project_backward, {"opacities": arrays["drawn"]}),
        ("adam", adam, copies),
    ):
        if name == "gather_slots":
            arrays["sums"][:] = 0
        if name == "adam":
            arrays["g_colors"][:] = arrays["sums"][:, :3]
        values = [(arrays | own)[key] for key in inspect.signature(function).parameters]
        start = time.thread_time()
        function(*values)
        seconds[name] = time.thread_time() - start
    return seconds


def record_run(out: str) -> None:
    """Run gsmerge with this process's arguments, time its kernels, and write the records of all steps to a file."""
    library = os.environ.get(COUNTER)
    recorder = Recorder(ctypes.CDLL(library) if library else None)
    find_entry = signature._entry

    def find_timed(library: Any, name: str, *rest: Any) -> Callable[..., Any]:
        """Return the entry of a function of the library; the entry of the fit's phases also records times."""
        entry = find_entry(library, name, *rest)
        return (lambda *values: recorder.time_phase(entry, *values)) if name == "fit_phase" else entry

    signature._entry = find_timed
    atexit.register(lambda: Path(out).write_text(json.dumps(recorder.steps)))  # the program ends its process itself
    runpy.run_module("gsmerge", run_name="__main__", alter_sys=True)


def run_command(folder: Path, threads: int, counter: Path | None = None) -> list[dict[str, Any]]:
    """Compact a scene in a process of its own, and return the records of its steps; ``counter`` also counts pairs."""
    with tempfile.TemporaryDirectory() as place:
        environment = {**os.environ, "GSMERGE_THREADS": str(threads), RECORD: f"{place}/record.json"}
        environment |= {COUNTER: str(counter)} if counter else {}
        words = ["compact", str(folder), "-o", f"{place}/out.ply", "-q"]
        subprocess.run([sys.executable, __file__, *words], check=True, env=environment)
        return json.loads(Path(environment[RECORD]).read_text())


def divide_phases(phases: dict[str, float], parts: dict[str, float]) -> dict[str, float]:
    """Divide the seconds of a step's phases among kernels, by their separate times ``parts``.

    Sorting by depth counts as part of "bin", which makes the lists.
    """
    seconds: dict[str, float] = defaultdict(float)
    for phase, value in phases.items():
        names = KERNELS_OF[phase]
        total = sum(parts[name] for name in names) if len(names) > 1 else 1.0
        for name in names:
            share = parts[name] / total if len(names) > 1 else 1.0
            seconds["bin" if name == "sort" else name] += share * value
    return seconds


def join_steps(counted: list[dict[str, Any]], runs: dict[int, list[list[dict[str, Any]]]]) -> dict[str, Any]:
    """Average the steps of each image size: their counts, and their least processor seconds over all runs.

    ``counted`` are the steps of the run that counts pairs, and ``runs`` the timed runs by number of threads. Returns
    the number of steps, the mean counts, and the mean seconds by threads and kernel, for each size.
    """
    groups: dict[tuple[int, int], list[int]] = defaultdict(list)
    for i, step in enumerate(counted):
        groups[step["height"], step["width"]].append(i)
    joined = {}
    for (height, width), rows in sorted(groups.items(), reverse=True):
        steps = [counted[i] for i in rows]
        counts = {key: float(np.mean([step[key] for step in steps])) for key in OF_COUNTS}
        seconds: dict[int, dict[str, float]] = {}
        for threads, records in runs.items():
            sums = dict.fromkeys(KERNELS, 0.0)
            for i, step in zip(rows, steps, strict=True):
                times = [record[i]["cpu"] for record in records]
                least = {phase: min(seconds_of[phase] for seconds_of in times) for phase in times[0]}
                for kernel, value in divide_phases(least, step["parts"]).items():
                    sums[kernel] += value / len(rows)
            seconds[threads] = sums
        joined[f"{height} x {width}"] = {"steps": len(rows), "counts": counts, "seconds": seconds}
    return joined


def measure_scene(folder: Path, counter: Path) -> dict[str, Any]:
    """Measure the steps of a scene's default run; see :func:`join_steps`."""
    counted = run_command(folder, 1, counter)
    runs: dict[int, list[list[dict[str, Any]]]] = {threads: [] for threads in THREADS}
    for _ in range(REPEATS):
        for threads in THREADS:
            runs[threads].append(run_command(folder, threads))
    return {"scene": folder.name.removesuffix("-plain"), "sizes": join_steps(counted, runs)}


def machine_table(machine: Machine) -> str:
    """Make the table of the processor's rates."""
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
    """Make the table of the pairs of each scene and size."""
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
    """Make a row for each kernel: milliseconds, what bounds it, and the shares of the limits that it reaches."""
    rows = []
    for kernel in KERNELS:
        own = seconds[1][kernel]
        visited, bound = machine.limit(kernel, counts, needed=False)
        needed, _ = machine.limit(kernel, counts, needed=True)
        plain = machine.work(kernel, counts, needed=False)[1] / (2 * machine.slots[1]) / own
        row = [kernel, f"{1e3 * own:.3f}", bound, f"{visited / own:.2f}", f"{needed / own:.2f}", f"{plain:.2f}"]
        row += [f"{1e3 * seconds[2][kernel]:.3f}", f"{visited / seconds[2][kernel]:.2f}"]
        rows.append(row)
    return rows


def steps_table(machine: Machine, records: list[dict[str, Any]]) -> str:
    """Make the table of the kernels, for the two image sizes of each scene that take most of the time."""
    rows = []
    for record in records:
        groups = sorted(
            record["sizes"].items(), key=lambda item: -item[1]["steps"] * sum(item[1]["seconds"][1].values())
        )
        for size, group in groups[:2]:
            rows.append([f"**{record['scene']}, {size}**", *[""] * 7])
            rows += kernel_rows(machine, group["counts"], group["seconds"])
    head = "", "ms", "bound by", "of the algorithm's limit", "of the task's", "in FLOPs"
    return make_table((*head, "of two threads, ms", "of the algorithm's limit"), rows)


def main() -> None:
    """Measure the machine and all scenes, and print the tables."""
    parser = make_parser(__doc__, "fox,fern")
    args = parser.parse_args()
    target, folders = Path(load_library()._name).stem.split("-")[-1], scene_folders(args.scenes)
    with tempfile.TemporaryDirectory() as name:
        counter = compile_counter(target, Path(name))
        machine = measure_machine(counter, target)
        records = [measure_scene(export_capture(folder, args.cache).parent, counter) for folder in folders]
    tables = {
        f"machine {target}": machine_table(machine),
        f"pairs {target}": pairs_table(records),
        f"steps {target}": steps_table(machine, records),
    }
    print("\n\n".join(f"{key}\n\n{table}" for key, table in tables.items()))


if __name__ == "__main__":
    if RECORD in os.environ:
        record_run(os.environ[RECORD])
    else:
        main()
