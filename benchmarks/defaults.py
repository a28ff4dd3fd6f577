"""The defaults seed by seed, of held-out views and from outside: two tables of docs/results.md.

python benchmarks/defaults.py                  # the evaluation captures, five seeds; what is done is not repeated
python benchmarks/defaults.py all --seeds 2    # all fifteen

Plain exports, visible pixels, LPIPS of two views; intervals are 95 % t intervals over the seeds, which decide the order
of the views, the backgrounds and the held-out patches.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from page_tables import make_table
from shared_scenes import export, scene_folders

import gsmerge
from gsmerge.measure.evaluate import EvaluateOptions, evaluate
from gsmerge.measure.fog import ALL
from gsmerge.measure.scores import OUTSIDE
from gsmerge.research.charts.lines import mean_interval
from gsmerge.scene.held_out import read_held_out
from gsmerge.scene.read import load_scene
from gsmerge.types import Views

LPIPS_VIEWS = 2
QUALITY = {"psnr": ("PSNR", 2), "ssim": ("SSIM", 4), "lpips": ("LPIPS", 3)}  # heading and digits
SIDES = {name: (heading, 3) for name, heading in OUTSIDE.items()}
Columns = Mapping[str, tuple[str, int]]


def measure(folder: Path, seed: int, cache: Path) -> dict[str, Any]:
    """Scores of the default result on the held-out views of a capture, and from outside."""
    load = load_scene(export(folder, cache))
    held_out = read_held_out(load, folder / "transforms.json")
    views = Views(held_out.cameras, held_out.images, held_out.names)
    results = {"gsmerge": gsmerge.compact(load.scene, seed=seed).gaussians}
    record: dict[str, Any] = {"scene": folder.name, "seed": seed}
    options = EvaluateOptions(lpips=("vgg",), lpips_views=LPIPS_VIEWS, context=False, own=False)
    (result,) = evaluate(load.scene, results, views, options).results
    mean = result.mean("target")[1]
    record |= {"psnr": mean.psnr, "ssim": mean.ssim, "lpips": mean.lpips_vgg}
    return record | (asdict(result.fog[ALL]) if result.fog else {})


def make_rows(records: Sequence[Mapping[str, Any]], columns: Columns) -> list[tuple[str, ...]]:
    """Capture, and the interval of each score over the seeds."""
    rows = []
    for scene in sorted({record["scene"] for record in records}):
        some = [record for record in records if record["scene"] == scene]
        cells = [interval([record.get(name) for record in some], d) for name, (_, d) in columns.items()]
        rows.append((scene, *cells))
    return rows


def interval(values: Sequence[float | None], digits: int) -> str:
    """Mean and half of the interval; the mean alone of one value."""
    known = [value for value in values if value is not None]
    if len(known) < 2:
        return f"{np.mean(known):.{digits}f}" if known else "-"
    both = mean_interval(known)
    return f"{both.mean:.{digits}f} ±{both.high - both.mean:.{digits}f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", nargs="?", default="eval", help="all, train, eval, or names with commas between")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    path = args.cache / f"defaults-{gsmerge.__version__}.jsonl"
    records = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {(record["scene"], record["seed"]) for record in records}
    splits = ("eval", "train") if args.scenes == "all" else (args.scenes,)
    folders = [folder for split in splits for folder in scene_folders(split)]
    for folder in folders:
        for seed in range(args.seeds):
            if (folder.name, seed) not in done:
                records.append(measure(folder, seed, args.cache))
                with path.open("a") as file:
                    file.write(json.dumps(records[-1]) + "\n")
                print(json.dumps(records[-1]), flush=True)
    chosen = [r for r in records if r["scene"] in {folder.name for folder in folders} and r["seed"] < args.seeds]
    for columns in (QUALITY, SIDES):
        head = ("capture", *(heading for heading, _ in columns.values()))
        print(f"\n{make_table(head, make_rows(chosen, columns))}")


if __name__ == "__main__":
    main()
