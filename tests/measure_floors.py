"""Measure the floors of the tests anew: ``python tests/measure_floors.py [pytest's choice of tests]``.

Takes half an hour on two cores. Rows of ``floors.csv`` whose tests are not chosen stay; all are measured, and those
of tests that are gone dropped, without a choice. Look at the differences before you commit them: a mean that falls
by more than its deviation is a change for the worse.
"""

from __future__ import annotations

import csv
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import floors  # noqa: E402

# The libraries' own ways to use older vectors than the processor has: numba, torch, numpy and its BLAS, OpenCV.
PROCESSORS = {
    "128 bits": {
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": "",
        "ATEN_CPU_CAPABILITY": "default",
        "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4",
        "OPENBLAS_CORETYPE": "Nehalem",
        "OPENCV_CPU_DISABLE": "AVX2,FP16,AVX512-SKX",
    },
    "this machine's": {},
}
NUDGES = 5


def run(chosen: list[str], nudge: int, processor: str, record: Path) -> dict[str, float]:
    """Values of the tests with a floor, by name."""
    cache = Path(tempfile.gettempdir()) / f"gsmerge-floors-{processor.split()[0]}"
    env = {**os.environ, **PROCESSORS[processor], "GSMERGE_CACHE_DIR": str(cache)}
    env |= {floors.NUDGE: str(nudge), floors.RECORD: str(record)}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-n",
        str(os.cpu_count()),
        "-m",
        "floor",
        "-p",
        "no:cacheprovider",
        *chosen,
    ]
    if subprocess.run(command, cwd=ROOT, env=env, check=False).returncode:
        print("some of these tests fail for another reason than a floor", flush=True)
    rows = [line.rsplit("\t", 1) for line in record.read_text(encoding="utf-8").splitlines()]
    return {test: float(value) for test, value in rows}


def main() -> None:
    """Run the tests with a floor ten times, and write the table, after each run what is known so far."""
    chosen, values = sys.argv[1:], {}
    rows = {}
    if chosen and floors.TABLE.exists():
        with floors.TABLE.open(encoding="utf-8", newline="") as file:
            rows = {row["test"]: row for row in csv.DictReader(file)}
    with tempfile.TemporaryDirectory() as folder:
        for nudge in range(NUDGES):
            for processor in PROCESSORS:
                print(f"vectors of {processor}, run {nudge + 1} of {NUDGES}", flush=True)
                for test, value in run(chosen, nudge, processor, Path(folder) / f"{processor}{nudge}").items():
                    values.setdefault(test, []).append(value)
                write(rows | {test: row(test, found) for test, found in values.items()})


def row(test: str, values: list[float]) -> dict[str, object]:
    """A line of the table."""
    mean, sd = statistics.mean(values), statistics.stdev(values) if len(values) > 1 else 0.0
    floor = mean - 3 * max(sd, floors.LEAST_SD)
    figures = (test, len(values), f"{mean:.2f}", f"{sd:.2f}", f"{floor:.2f}")
    return dict(zip(floors.COLUMNS, figures, strict=True))


def write(rows: dict[str, dict[str, object]]) -> None:
    """The table, sorted by test."""
    with floors.TABLE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, floors.COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows[test] for test in sorted(rows))


if __name__ == "__main__":
    main()
