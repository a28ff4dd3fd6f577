"""Two settings against each other on real scenes, seed by seed: differences of held-out PSNR, SSIM and LPIPS, and time.

python benchmarks/paired.py train --other fit_steps=240 half_res_share=0.8 --seeds 5 --lpips
python benchmarks/paired.py eval --base effort=fast --other effort=fast fit_steps=40

One rounding moves a scene's PSNR by a tenth of a dB, so one run of each decides nothing below two. Plain exports,
held-out views, visible pixels. Intervals are 95 % t intervals over the scenes of the mean of each scene's seeds.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from quality import score, setting
from shared_scenes import LEFT_OUT, Targets, export, read_held_out, scene_folders

import gsmerge
from gsmerge.research.charts.lines import mean_interval
from gsmerge.types import Scene

NAMES = ("PSNR", "SSIM", "LPIPS")


def run(scene: Scene, targets: Targets, settings: dict[str, Any], seed: int, lpips: bool) -> tuple[float, ...]:
    """Processor seconds, and the scores."""
    start = time.process_time()
    result = gsmerge.compact(scene, **settings, seed=seed)
    return time.process_time() - start, *score(result.gaussians, targets, lpips)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", help="train, eval, or names with commas between")
    parser.add_argument("--base", nargs="*", default=[], help="settings, as name=value")
    parser.add_argument("--other", nargs="*", required=True, help="settings, as name=value")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--lpips", action="store_true", help="also LPIPS-VGG")
    parser.add_argument("--leave-out", default=",".join(LEFT_OUT), help="scenes, with commas between")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    args = parser.parse_args()
    both = [{k: setting(v) for k, v in (s.split("=") for s in some)} for some in (args.base, args.other)]
    rows = []
    for folder in scene_folders(args.scenes):
        if folder.name in args.leave_out.split(","):
            continue
        scene, targets = gsmerge.read_scene(export(folder, args.cache)), read_held_out(folder)
        runs = [[run(scene, targets, one, seed, args.lpips) for one in both] for seed in range(args.seeds)]
        rows.append(np.mean(runs, 0))
        spread = np.std([base[1] for base, _ in runs], ddof=1) if args.seeds > 1 else 0.0
        columns = np.round(rows[-1], 4).T.tolist()
        values = dict(zip(("CPU s", *NAMES), columns, strict=False))  # LPIPS where it was asked for
        print(json.dumps({"scene": folder.name, **values, "deviation of a seed": round(float(spread), 3)}), flush=True)
    means = np.stack(rows)
    print(f"CPU seconds: {means[:, 1, 0].sum() / means[:, 0, 0].sum():.3f} of the base's")
    for i, name in enumerate(NAMES[: means.shape[2] - 1], 1):
        gain = mean_interval((means[:, 1, i] - means[:, 0, i]).tolist())
        before, after = means[:, :, i].mean(0)
        print(f"{name}: {before:.4f} -> {after:.4f}, {gain.mean:+.4f} ({gain.low:+.4f} to {gain.high:+.4f})")


if __name__ == "__main__":
    main()
