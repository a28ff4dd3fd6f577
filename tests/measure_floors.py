"""Measure the floors of the tests anew: ``python tests/measure_floors.py [pytest's choice of tests]``.

Takes ten minutes on two idle cores. Rows of ``floors.csv`` whose tests are not chosen stay; without a choice all are
measured, and those of tests that are gone dropped. Look at the differences before you commit them: a mean that falls
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
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "helpers")]

import floors  # noqa: E402

NUDGES = 10


def run(chosen: list[str], nudge: int, record: Path) -> dict[str, float]:
    """Values of the tests with a floor, by name."""
    env = os.environ | {floors.NUDGE: str(nudge), floors.RECORD: str(record)}
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
    with floors.TABLE.open(encoding="utf-8", newline="") as file:
        before = {row["test"]: row for row in csv.DictReader(file)}
    rows = before if chosen else {}
    with tempfile.TemporaryDirectory() as folder:
        for nudge in range(NUDGES):
            print(f"run {nudge + 1} of {NUDGES}", flush=True)
            for test, value in run(chosen, nudge, Path(folder) / str(nudge)).items():
                values.setdefault(test, []).append(value)
            write(rows | table_rows(values, before))


def table_rows(values: dict[str, list[float]], before: dict[str, dict[str, str]]) -> dict[str, dict[str, object]]:
    """Lines of the table, by test. A floor does not fall by measuring: who lowers one does it by hand, and says why.

    Twenty runs know a deviation to a sixth. The cases of one test spread alike, so each counts with at least what they
    have together.
    """
    variances = {test: statistics.variance(runs) if len(runs) > 1 else 0.0 for test, runs in values.items()}
    cases: dict[str, list[float]] = {}
    for test, variance in variances.items():
        cases.setdefault(test.split("[")[0], []).append(variance)
    rows = {}
    for test, runs in values.items():
        mean, variance = statistics.mean(runs), max(variances[test], statistics.mean(cases[test.split("[")[0]]))
        floor = mean - 3 * max(variance**0.5, floors.LEAST_SD)
        floor = max(floor, float(before[test]["floor"])) if test in before else floor
        figures = (test, len(runs), f"{mean:.2f}", f"{variances[test] ** 0.5:.2f}", f"{floor:.2f}")
        rows[test] = dict(zip(floors.COLUMNS, figures, strict=True))
    return rows


def write(rows: dict[str, dict[str, object]]) -> None:
    """The table, sorted by test."""
    with floors.TABLE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, floors.COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows[test] for test in sorted(rows))


if __name__ == "__main__":
    main()
