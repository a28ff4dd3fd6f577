"""The default fit seed by seed, enlarged, and with compensation, for docs/results.md.

python benchmarks/defaults.py                  # the evaluation scenes, five seeds; what is done is not repeated
python benchmarks/defaults.py --split train --seeds 2

Held-out views, visible pixels, plain exports, and fog and holes from outside. Every seed is scored at the photos'
size; the first one also at other sizes, and with compensation as some viewers have it.
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
from result_cells import make_table
from shared_scenes import export, scene_folders

import gsmerge
from gsmerge.measure.evaluate import EvaluateOptions, evaluate
from gsmerge.measure.fog import ALL
from gsmerge.measure.scores import OUTSIDE
from gsmerge.research.charts.lines import mean_interval
from gsmerge.scene.held_out import read_held_out as read_views
from gsmerge.scene.read import load_scene
from gsmerge.types import Views

NAME = "defaults.jsonl"
ZOOMS = (0.5, 1.0, 2.0, 4.0)
LPIPS_VIEWS = 2
SCORES = {"psnr": ("PSNR", 2), "ssim": ("SSIM", 4), "lpips": ("LPIPS", 3)}  # heading and digits


def measure(folder: Path, seed: int, cache: Path) -> dict[str, Any]:
    """Scores of the input and of the default result on the held-out views of a scene."""
    load = load_scene(export(folder, cache))
    held_out = read_views(load, folder / "transforms.json")
    views = Views(held_out.cameras, held_out.images, held_out.names)
    results = {"gsmerge": gsmerge.compact(load.scene, seed=seed).gaussians}
    record: dict[str, Any] = {"scene": folder.name, "seed": seed}
    more = {"zoom": ZOOMS} if seed == 0 else {}
    options = EvaluateOptions(lpips=("vgg",), lpips_views=LPIPS_VIEWS, context=False, own=seed == 0, **more)
    for result in evaluate(load.scene, results, views, options).results:
        mean = result.mean("target")[1]
        fog = asdict(result.fog[ALL]) if result.fog else {}
        record[result.name] = {"psnr": mean.psnr, "ssim": mean.ssim, "lpips": mean.lpips_vgg} | fog
        if seed == 0:
            record[result.name]["zooms"] = {z: result.mean("target", zoom=z)[1].psnr for z in ZOOMS}
    if seed == 0:
        other = EvaluateOptions(lpips=(), context=False, antialiased=True, fog=False)
        for result in evaluate(load.scene, results, views, other).results:
            record[result.name]["compensated"] = result.mean("target")[1].psnr
    return record


def read_defaults(path: Path) -> list[dict[str, Any]]:
    """What was measured so far."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def make_section(records: Sequence[Mapping[str, Any]]) -> str:
    """The part of docs/results.md; empty without records."""
    if not records:
        return ""
    columns = seed_columns(records)
    seeds = make_table(("scene", "seeds", *(heading for heading, _ in columns.values())), seed_rows(records))
    outside = "\n[Fog and holes](guide/evaluate.md#fog-and-holes) are seen from outside." if "holes" in columns else ""
    views = make_table(
        ("scene", "result", *(f"{zoom:g} x" for zoom in ZOOMS), "compensated"),
        view_rows(records),
    )
    return f"""## The defaults, seed by seed

Made by `python benchmarks/defaults.py`. Held-out views; intervals are 95 % t intervals over the seeds, which decide the
order of the views, the backgrounds and the held-out patches.{outside}

{seeds}

### As viewers show it

PSNR (dB) of the first seed: the photos resized to so many times their size; and at their size with the opacity of
small Gaussians lowered by what the low-pass adds (`--antialiased`).

{views}"""


def seed_columns(records: Sequence[Mapping[str, Any]]) -> dict[str, tuple[str, int]]:
    """Heading and digits of each score of :func:`seed_rows`, by name; fog and holes where a record has them."""
    measured = any("holes" in record["gsmerge"] for record in records)
    return SCORES | ({name: (heading, 3) for name, heading in OUTSIDE.items()} if measured else {})


def seed_rows(records: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Scene, number of seeds, and the interval of each score over the seeds; the last row is of all scenes."""
    by_scene: dict[str, list[Mapping[str, Any]]] = {}
    for record in records:
        by_scene.setdefault(record["scene"], []).append(record["gsmerge"])
    columns, rows = seed_columns(records), []
    means: dict[str, list[float]] = {name: [] for name in columns}
    for scene, some in sorted(by_scene.items()):
        cells = []
        for name, (_, digits) in columns.items():
            values = [value for one in some if (value := one.get(name)) is not None]
            if not values:
                cells.append("-")
                continue
            interval = mean_interval(values)
            means[name].append(interval.mean)
            cells.append(f"{interval.mean:.{digits}f} ± {interval.high - interval.mean:.{digits}f}")
        rows.append((scene, str(len(some)), *cells))
    last = [f"{np.mean(means[name]):.{digits}f}" if means[name] else "-" for name, (_, digits) in columns.items()]
    return [*rows, ("mean", "", *last)] if rows else []


def view_rows(records: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Scene, result, and PSNR at each size and with compensation; last the means."""
    table: dict[str, list[tuple[str, list[float]]]] = {}
    for record in sorted(records, key=lambda r: r["scene"]):
        for name in ("input", "gsmerge") if record["seed"] == 0 else ():
            one = record[name]
            values = [*one["zooms"].values(), one["compensated"]]
            table.setdefault(name, []).append((record["scene"], values))
    rows = [(scene, name, *(f"{v:.2f}" for v in values)) for name, some in table.items() for scene, values in some]
    for name, some in table.items():
        rows.append(("mean", name, *(f"{v:.2f}" for v in np.mean([values for _, values in some], 0))))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--split", default="eval", help="train, eval, or names with commas between")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    parser.add_argument("--runs", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-results" / "runs")
    args = parser.parse_args()
    args.runs.mkdir(parents=True, exist_ok=True)
    path = args.runs / NAME
    done = {(record["scene"], record["seed"]) for record in read_defaults(path)}
    for folder in scene_folders(args.split):
        for seed in range(args.seeds):
            if (folder.name, seed) not in done:
                record = measure(folder, seed, args.cache)
                with path.open("a") as file:
                    file.write(json.dumps(record) + "\n")
                print(json.dumps(record), flush=True)


if __name__ == "__main__":
    main()
