"""Times and results of one scene on the CPU and on a GPU, as Markdown.

    python benchmarks/gpu.py SCENE [--runs 3] [--device cuda]

SCENE is what ``gsmerge compact`` reads. Both ways run once to warm up, then in turns; of each the run with
the median time is shown. With ``--device cpu`` torch does on the CPU what a GPU would do: its times say
nothing, its counts and PSNR do.
"""

from __future__ import annotations

import argparse
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import torch

from gsmerge import compact, plan, read_scene
from gsmerge.compaction.result import CompactResult
from gsmerge.fit.gpu import cuda_problem
from gsmerge.fit.gpu.engine import make_backend
from gsmerge.measure.evaluate import near_plane
from gsmerge.measure.speed import measure_costs
from gsmerge.runtime.threads import available_threads
from gsmerge.types import Scene


@dataclass(frozen=True)
class Run:
    """One run: seconds from the scene in memory to the scored result, and the result."""

    seconds: float
    result: CompactResult


@contextmanager
def torch_on_the_cpu() -> Iterator[None]:
    """Let ``compact`` take the functions of the GPU on torch's CPU device."""
    backend = make_backend(torch.device("cpu"))
    with mock.patch.object(plan, "choose_backend", return_value=(backend, None)):
        yield


def run_once(scene: Scene, settings: dict[str, Any], device: str, *, by_torch: bool) -> Run:
    """Compact the scene on a device; ``by_torch`` with the functions of the GPU on torch's CPU device."""
    with torch_on_the_cpu() if by_torch else nullcontext():
        started = time.perf_counter()
        result = compact(scene, device=device, **settings)
        return Run(time.perf_counter() - started, result)


def compare_runs(scene: Scene, settings: dict[str, Any], device: str, count: int) -> tuple[Run, Run]:
    """Run both ways in turns, and return the median run of each."""
    ways = {"device": "cpu", "by_torch": False}, {"device": device, "by_torch": device == "cpu"}
    for way in ways:
        run_once(scene, settings, **way)
    turns = [[run_once(scene, settings, **way) for way in ways] for _ in range(count)]
    first, second = (sorted(runs, key=lambda run: run.seconds) for runs in zip(*turns, strict=True))
    return first[(count - 1) // 2], second[(count - 1) // 2]


def table(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Markdown."""
    lines = [heads, ("---",) * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def stage_rows(runs: tuple[Run, Run]) -> list[tuple[str, ...]]:
    """Milliseconds of every stage and of the whole run."""
    seconds = [run.result.report.seconds for run in runs]
    names = list(dict.fromkeys(name for stages in seconds for name in stages))
    rows = [(name, *(f"{1e3 * stages.get(name, 0):.1f}" for stages in seconds)) for name in names]
    return [*rows, ("all", *(f"{1e3 * run.seconds:.1f}" for run in runs))]


def result_rows(runs: tuple[Run, Run]) -> list[tuple[str, ...]]:
    """Counts and PSNR of both results, and what their reports note."""
    reports = [run.result.report for run in runs]
    fits = [report.choices.get("fit", {}) for report in reports]

    def decibels(values: list[float | None]) -> list[str]:
        return ["-" if value is None else f"{value:.2f}" for value in values]

    return [
        ("Gaussians", *(f"{report.num_output:,}" for report in reports)),
        ("fitted on", *(fit.get("device", "-") for fit in fits)),
        ("steps", *(str(fit.get("steps", "-")) for fit in fits)),
        ("input PSNR, dB", *decibels([report.psnr_before for report in reports])),
        ("result PSNR, dB", *decibels([report.psnr_after for report in reports])),
        ("held-out blocks, dB", *decibels([fit.get("holdout_after") for fit in fits])),
    ]


def speed_rows(scene: Scene, result: CompactResult) -> list[tuple[str, ...]]:
    """Milliseconds to render a view of the input and of the result, on the CPU and on a GPU where there is one."""
    scenes, cameras = {"input": scene.file_gaussians, "result": result.gaussians}, scene.cameras
    costs = measure_costs(scenes, cameras, (1,), near_plane(scene))
    return [
        (f"render the {name}, {speed['width']} x {speed['height']}", speed["device"], f"{1e3 * speed['seconds']:.2f}")
        for name, cost in costs.items()
        for speed in cost["speeds"]
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="what gsmerge compact reads")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--fit-steps", type=int, help="steps of the fit; the default's where left out")
    arguments = parser.parse_args()
    problem = cuda_problem() if arguments.device == "cuda" else None
    if problem is not None:
        raise SystemExit(f"expected a CUDA device that can be used, but {problem}; --device cpu needs none")
    name = torch.cuda.get_device_name() if arguments.device == "cuda" else "torch on the CPU"
    scene = read_scene(arguments.scene)
    settings = {"photo_scale": 1, "fit_steps": arguments.fit_steps}  # larger photos are the CPU's alone
    runs = compare_runs(scene, settings, arguments.device, arguments.runs)
    size = f"{scene.cameras.width} x {scene.cameras.height}"
    print(f"{arguments.scene.name}: {scene.num_gaussians:,} Gaussians, {len(scene)} views of {size}; ", end="")
    print(f"{available_threads()} processors ({platform.machine()}), {name}\n")
    print(table(("stage, ms", "CPU", name), stage_rows(runs)), end="\n\n")
    print(table(("", "CPU", name), result_rows(runs)), end="\n\n")
    print(table(("", "device", "ms a view"), speed_rows(scene, runs[1].result)))


if __name__ == "__main__":
    main()
