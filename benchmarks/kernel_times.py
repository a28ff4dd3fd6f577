"""Run one command of gsmerge in this process, and write the time of each call of its kernels.

python benchmarks/kernel_times.py OUT.json compact scene -o out.ply --overwrite -q

A part of limit.py that runs with the package of any tree (PYTHONPATH). With LIMIT_COUNTS, the library of limit.c, it
also counts the pairs of pixels and Gaussians in each step of a fit and in each drawn view. That and the separate calls
of the parts of a phase take time, so seconds of a whole command come from a run without it.
"""

from __future__ import annotations

import atexit
import ctypes
import inspect
import json
import os
import runpy
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from gsmerge.kernels import signature
from gsmerge.kernels.gaussians.optimise import adam
from gsmerge.kernels.raster.binning import sort_bits
from gsmerge.kernels.raster.blend import gather_slots
from gsmerge.kernels.raster.project import project, project_backward
from gsmerge.kernels.raster.step import PHASES, STEP

COUNTS = ("pixels", "listed", "walked", "shown", "visited", "needed", "vectors", "useful")  # of limit.c
WRITTEN = ("x", "m", "v", "means", "quats", "scales", "opacities", "colors")  # by adam
PLACES = getattr(STEP, "fields", None) or STEP.places  # of the table's values; 0.5 has the second name
SIZES = ("n", "height", "width", "num_visible", "num_intersections")  # of a step


class Recorder:
    """Times of kernels: of the phases of each step of a fit, and sums over all other calls by name."""

    def __init__(self, counter: ctypes.CDLL | None) -> None:
        self.counter, self.lock = counter, threading.Lock()
        self.steps: list[dict[str, Any]] = []
        self.phases: dict[str, list[float]] = {}  # Of the step that runs: start, end, processor seconds, calls
        self.kernels: dict[str, list[float]] = {}  # Processor seconds and calls of each kernel outside of steps
        self.drawn: dict[str, int] = dict.fromkeys((*COUNTS, "n", "num_visible"), 0)  # Counts of views outside of steps

    def wrap(self, name: str, entry: Callable[..., Any]) -> Callable[..., Any]:
        """Return the native function with a clock around it."""
        if name == "fit_phase":
            return lambda *values: self._time_phase(entry, *values)

        def call(*values: Any) -> Any:
            start = time.thread_time()
            result = entry(*values)
            seconds = time.thread_time() - start
            with self.lock:
                one = self.kernels.setdefault(name, [0.0, 0])
                one[0] += seconds
                one[1] += 1
                self._count_drawn(name, values)
            return result

        return call

    def _time_phase(self, entry: Callable[..., Any], address: int, phase: int, fields: int) -> Any:
        """Time one call of a phase; each thread of a step makes one."""
        table, name = Fields(address), PHASES[phase]
        if name == "update" and self.counter is not None:
            self.separate = {**time_parts(table), **count_step(self.counter, table)}
        start, cpu = time.perf_counter(), time.thread_time()
        result = entry(address, phase, fields)
        seconds, end = time.thread_time() - cpu, time.perf_counter()
        with self.lock:
            one = self.phases.setdefault(name, [start, end, 0.0, 0])
            if one[3] == table["threads"]:  # the phase begins anew, with more room
                one[:] = [start, end, 0.0, 0]
            one[:] = [min(one[0], start), max(one[1], end), one[2] + seconds, one[3] + 1]
            if name == "update" and one[3] == table["threads"]:
                self._end_step(table)
        return result

    def _end_step(self, table: Fields) -> None:
        step: dict[str, Any] = {key: table[key] for key in SIZES}
        step["wall"] = {name: end - start for name, (start, end, *_) in self.phases.items()}
        step["cpu"] = {name: one[2] for name, one in self.phases.items()}
        if self.counter is not None:
            step |= self.separate
        self.steps.append(step)
        self.phases = {}

    def _count_drawn(self, name: str, values: tuple[Any, ...]) -> None:
        if self.counter is None:
            return
        if name == "cull":
            self.drawn["n"] += values[8]
        if name == "project":
            self.drawn["num_visible"] += values[-1]
        if name == "blend":
            conics, ids, offsets, tile_width, _, first, last, top = values[:8]
            m, n, ends, h, w = values[11:]
            sizes = tile_width, first, last, top + h, w, m, n, ends
            for key, count in count_lists(self.counter, (conics, ids, offsets), sizes).items():
                self.drawn[key] += count


class Fields:
    """Numbers and arrays of a step's table, by name, at its address."""

    def __init__(self, address: int) -> None:
        self.values = (ctypes.c_int64 * len(PLACES)).from_address(address)

    def __getitem__(self, key: str) -> int:
        return self.values[PLACES[key]]

    def array(self, key: str) -> np.ndarray:
        """Return an array of the table without a copy."""
        argument = STEP.arrays[key]
        shape = [size if isinstance(size, int) else self[size] for size in argument.shape]
        count = int(np.prod(shape)) * argument.dtype.itemsize
        if count == 0:
            return np.empty(shape, argument.dtype)
        return np.frombuffer((ctypes.c_char * count).from_address(self[key]), argument.dtype).reshape(shape)


def count_lists(counter: ctypes.CDLL, addresses: tuple[int, ...], sizes: tuple[int, ...]) -> dict[str, int]:
    """Count pairs in lists of tiles: addresses of conics, ids and offsets; numbers in the order of limit.c."""
    counts = np.zeros(len(COUNTS), np.int64)
    pointers = [ctypes.c_void_p(address) for address in (*addresses, counts.ctypes.data)]
    numbers = [ctypes.c_int64(size) for size in sizes]
    if counter.count_pairs(*pointers[:3], *numbers, pointers[3]):
        raise ValueError("expected lists within their arrays, found an index outside")
    return dict(zip(COUNTS, counts.tolist(), strict=True))


def count_step(counter: ctypes.CDLL, table: Fields) -> dict[str, Any]:
    """Count the pairs of a step, before its last phase."""
    columns, addresses = -(-table["width"] // 16), tuple(table[key] for key in ("conics", "flatten_ids", "offsets"))
    sizes = table["tiles"], table["height"], table["width"], table["num_visible"], table["num_intersections"]
    return count_lists(counter, addresses, (columns, 0, *sizes, table["ends"]))


def time_parts(table: Fields) -> dict[str, float]:
    """Time what the phases "project" and "update" consist of by separate calls; adam works on copies."""
    m, count = table["num_visible"], table["num_intersections"]
    arrays = {key: table.array(key) for key in STEP.arrays}
    of_view = (
        "sums", "ids", "g_means", "g_quats", "g_scales", "g_opacities", "g_colors", "conics", "depths", "boxes",
        "order", "keys", "spare",
    )  # fmt: skip
    arrays |= {key: arrays[key][:m] for key in of_view} | {
        "flatten_ids": arrays["flatten_ids"][:count], "slots": arrays["slots"][:count], "first": 0, "last": m,
        "step": table["step"], "grad_poses": None, "bits": arrays["depths"][:m].view(np.uint32),
    }  # fmt: skip
    arrays |= {f"grad_{key[2:]}": arrays[key] for key in of_view if key.startswith("g_")}
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
    return {"parts": seconds}


def main() -> None:
    out, words = sys.argv[1], sys.argv[2:]
    library = os.environ.get("LIMIT_COUNTS")
    recorder = Recorder(ctypes.CDLL(library) if library else None)
    find_entry = signature._entry
    signature._entry = lambda library, name, *rest: recorder.wrap(name, find_entry(library, name, *rest))
    sys.argv = ["gsmerge", *words]

    def write_record() -> None:
        record = {"steps": recorder.steps, "kernels": recorder.kernels, "drawn": recorder.drawn}
        with open(out, "w", encoding="utf-8") as file:
            json.dump(record | {"seconds": time.process_time()}, file)

    atexit.register(write_record)  # the program ends its process itself
    runpy.run_module("gsmerge", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
