"""What more Gaussians bring: photos that were not used, over shares of the input; and the picture of how-many.md.

python benchmarks/how_many.py measure eval,train >> shares.jsonl
python benchmarks/how_many.py draw shares.jsonl docs/images/how-many.png

``measure`` prints a line for each capture (docs/internals/captures.md) and share: held-out PSNR and LPIPS, seconds of
CPU, and the share of confirmed depth. ``draw`` shows both scores against the default's, the mean and the worst capture,
of captures whose depth is confirmed and of others.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import matplotlib as mpl
import numpy as np
from quality import score
from shared_scenes import export, read_held_out, scene_folders

import gsmerge
from gsmerge.facts.confirm_depths import FEWEST, MOST, WRONG

SHARES = "1%", "2%", "4.4%", "7%", "10%", "30%"
CACHE = Path(gettempdir()) / "gsmerge-exports"
PANELS = {"psnr": ("PSNR, dB", max), "lpips": ("LPIPS (less is better)", min)}  # by name: label, and the better of two


def measure(folder: Path, share: str) -> dict[str, Any]:
    """Compact a capture to a share, and score it."""
    scene, held_out, start = gsmerge.read_scene(export(folder, CACHE)), read_held_out(folder), time.process_time()
    result = gsmerge.compact(scene, budget=share, fill=True, new_views=False)
    seconds = time.process_time() - start
    psnr, _, lpips = score(result.gaussians, held_out, True)
    confirmed = result.report.choices["agreement"]["confirmed"]
    return {"name": folder.name, "share": share, "psnr": psnr, "lpips": lpips, "cpu": seconds, "confirmed": confirmed}


def draw(rows: list[Mapping[str, Any]], out: Path) -> None:
    """Draw PSNR and LPIPS over shares, against those of the default."""
    mpl.use("agg")
    import matplotlib.pyplot as plt

    by_name: dict[str, dict[str, Mapping[str, Any]]] = {}
    for row in rows:
        by_name.setdefault(row["name"], {})[row["share"]] = row
    kinds = {
        "depth confirmed": ([row for row in by_name.values() if row["4.4%"]["confirmed"] >= WRONG], "#0072b2"),
        "depth wrong": ([row for row in by_name.values() if row["4.4%"]["confirmed"] < WRONG], "#999"),
    }
    figure, axes = plt.subplots(1, len(PANELS), figsize=(8.4, 3.1), layout="constrained")
    x = [float(share[:-1]) for share in SHARES]
    for axis, (name, (label, better)) in zip(axes, PANELS.items(), strict=True):
        axis.axvspan(100 * FEWEST, 100 * MOST, color="#0072b2", alpha=0.15, lw=0)
        axis.axhline(0, color="#ccc", lw=0.8)
        for kind, (captures, color) in kinds.items():
            change = np.array([[row[share][name] - row["4.4%"][name] for share in SHARES] for row in captures])
            axis.plot(x, change.mean(0), "o-", color=color, ms=4, label=f"{len(captures)} captures, {kind}")
            worst = change.min(0) if better is max else change.max(0)
            axis.plot(x, worst, ":", color=color, lw=1, label="the worst of these")
        axis.set(xscale="log", xlabel="Gaussians, % of the input", ylabel=f"{label}, against 4.4 %")
        axis.set_xticks(x, [share[:-1] for share in SHARES])
        axis.minorticks_off()
    axes[0].legend(frameon=False, fontsize=8)
    figure.savefig(out, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=("measure", "draw"))
    parser.add_argument("source", help="captures; a file of what was measured")
    parser.add_argument("out", nargs="?", type=Path)
    options = parser.parse_args()
    if options.task == "draw":
        draw([json.loads(line) for line in Path(options.source).read_text().splitlines()], options.out)
    else:
        for folder in (folder for split in options.source.split(",") for folder in scene_folders(split)):
            for share in SHARES:
                print(json.dumps(measure(folder, share)), flush=True)
