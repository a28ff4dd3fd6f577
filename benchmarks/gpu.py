"""Stage times of one scene on the CPU and on a GPU, as the Markdown tables of the documents.

    python benchmarks/gpu.py SCENE [--device cuda] [--runs 3]

SCENE is what ``gsmerge compact`` reads. With ``--device cpu`` torch does on the CPU what a GPU would do: no time of
that says anything, but counts and PSNR do. Every way runs once to warm up; of the runs after that, the one with the
middle total is shown, with all transfers between the computer's memory and the device's in it. The device is waited
for at the end of every stage.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import torch
from gsmerge.gpu.build import DeviceScene
from gsmerge.runtime.run_log import RunLog

from gsmerge import CompactOptions, read_scene
from gsmerge.pipeline import begin, build, input_psnr, score, score_input
from gsmerge.report import CompactReport
from gsmerge.runtime.threads import available_threads, use_threads
from gsmerge.stages.prepare import prepare
from gsmerge.types import PixelScene, UnalignedScene

MERGING = {"fit": "none", "checkpoint": "none"}  # superpixels to Gaussians, with no photo looked at
ALONE = ("prepare", "segment", "encode", "match", "decode")  # the stages of that
MILLIONS = 2.0  # Gaussians that merging alone is said for, as in the literature


@dataclass(frozen=True)
class Run:
    """One run: seconds from the scene in memory to the scored result, and its report."""

    seconds: float
    report: CompactReport


def run_once(scene: PixelScene | UnalignedScene, options: CompactOptions, device: str | None) -> Run:
    """One run on a device, or with None the stages of the CPU."""
    log, started = RunLog(), time.perf_counter()
    with use_threads():
        prepared = prepare(scene, options, log)
        make, psnr = build, input_psnr
        if device is not None:
            on_device = DeviceScene(prepared, device, begin)
            make, psnr = on_device.build, on_device.input_psnr
        result = score(make(prepared, prepared.limits.count, log), prepared, log, psnr)
        report = score_input(result, prepared, RunLog(), psnr).report
    return Run(time.perf_counter() - started, report)


def middle_run(scene: PixelScene | UnalignedScene, options: CompactOptions, device: str | None, runs: int) -> Run:
    """The run with the middle time of several, after one to warm up."""
    run_once(scene, options, device)
    done = sorted((run_once(scene, options, device) for _ in range(runs)), key=lambda run: run.seconds)
    return done[(runs - 1) // 2]


def stage_table(first: Run, second: Run, name: str) -> str:
    """Markdown: milliseconds and share of every stage in both ways."""
    rows = [f"| stage | CPU, ms | share | {name}, ms | share |", "|---|---|---|---|---|"]
    parts = [(run.report.seconds, run.seconds) for run in (first, second)]
    for stage in {**parts[0][0], **parts[1][0]}:
        cells = (f"{1e3 * s.get(stage, 0):.1f} | {100 * s.get(stage, 0) / total:.0f} %" for s, total in parts)
        rows.append(f"| {stage} | {' | '.join(cells)} |")
    others = (total - sum(seconds.values()) for seconds, total in parts)
    rest = (f"{1e3 * other:.1f} | {100 * other / parts[i][1]:.0f} %" for i, other in enumerate(others))
    rows += [f"| rest | {' | '.join(rest)} |"]
    rows += [f"| all | {' | '.join(f'{1e3 * total:.1f} | 100 %' for _, total in parts)} |"]
    return "\n".join(rows)


def result_table(first: Run, second: Run, name: str) -> str:
    """Markdown: counts and PSNR of both ways."""
    rows = [f"| | CPU | {name} |", "|---|---|---|"]
    reports = first.report, second.report

    def line(label: str, cells: list[str]) -> None:
        rows.append(f"| {label} | {' | '.join(cells)} |")

    for key in ("groups", "clusters", "begun_with"):
        line(key.replace("_", " "), [f"{r.choices.get(key, 0):,}" for r in reports])
    line("Gaussians", [f"{r.num_output:,}" for r in reports])
    for label, key in (("input PSNR, dB", "psnr_before"), ("result PSNR, dB", "psnr_after")):
        values = [getattr(r, key) for r in reports]
        line(label, ["-" if value is None else f"{value:.2f}" for value in values])
    fits = [r.choices.get("fit", {}) for r in reports]
    line("held-out blocks, dB", [f"{fit['holdout_after']:.2f}" if fit else "-" for fit in fits])
    line("on the CPU", ["all", ", ".join(f"{k}: {v}" for k, v in reports[1].choices.get("on_cpu", {}).items()) or "-"])
    return "\n".join(rows)


def merging_line(
    scene: PixelScene | UnalignedScene, base: dict[str, object], devices: list[str | None], runs: int
) -> str:
    """Markdown: seconds of merging alone, for every two million Gaussians."""
    rows = ["| merging alone | s | s for 2.0 M | PSNR, dB |", "|---|---|---|---|"]
    options = CompactOptions().with_settings({**base, **MERGING})
    for device in devices:
        run_once(scene, options, device)
        done = [run_once(scene, options, device).report for _ in range(runs)]
        seconds = statistics.median(sum(report.seconds.get(stage, 0) for stage in ALONE) for report in done)
        scaled = seconds * MILLIONS * 1e6 / scene.num_gaussians
        psnr = "-" if done[0].psnr_after is None else f"{done[0].psnr_after:.2f}"
        rows.append(f"| {device or 'CPU'} | {seconds:.3f} | {scaled:.3f} | {psnr} |")
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="what gsmerge compact reads")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--fit-steps", type=int, help="steps of the fit; the default's where left out")
    arguments = parser.parse_args()
    if arguments.device == "cuda":
        from gsmerge.render.cuda import cuda_problem

        if problem := cuda_problem():
            raise SystemExit(f"expected a CUDA device that can be used, but {problem}; --device cpu needs none")
    scene = read_scene(arguments.scene)
    name = torch.cuda.get_device_name() if arguments.device == "cuda" else "torch on the CPU"
    print(f"{arguments.scene.name}: {scene.num_gaussians:,} Gaussians, {len(scene)} views of", end=" ")
    print(f"{scene.cameras.width} x {scene.cameras.height}; {available_threads()} processors ({platform.machine()})\n")
    base = {} if arguments.fit_steps is None else {"fit_steps": arguments.fit_steps}
    options = CompactOptions().with_settings(base)
    first, second = (middle_run(scene, options, device, arguments.runs) for device in (None, arguments.device))
    print(stage_table(first, second, name), result_table(first, second, name), sep="\n\n", end="\n\n")
    print(merging_line(scene, base, [None, arguments.device], arguments.runs))


if __name__ == "__main__":
    main()
