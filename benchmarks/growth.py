"""How seconds and memory grow with the views of a scene, and with the Gaussians of a file without photos.

python benchmarks/growth.py                                        # 8 to 512 views, .5 to 8 million; what is done stays
python benchmarks/growth.py --views 8 32 --millions .5 2 --chart docs/results/growth.png

Scenes are those of ``examples/01_make_scene.py`` in 240 x 160, files without photos their rows alone. Every run is a
process of its own with one thread; seconds are the processor's. Parts are stages of the report, of which those that
grow faster than the whole are the ones to mend.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from page_tables import make_table

from gsmerge.research.charts.figures import COLORS, RC

WIDTH, HEIGHT = 240, 160
EFFORTS = "draft", "default"
VIEWS, MILLIONS = (8, 32, 128, 512), (0.5, 2.0, 7.99)
SECONDS, GIGABYTES = (2, 5, 10, 20, 50, 100, 200), (0.2, 0.5, 1, 2, 4)  # ticks
MAKE = Path(__file__).parents[1] / "examples" / "01_make_scene.py"


def scene_of(views: int, cache: Path) -> Path:
    """A made scene of some views, written once."""
    out = cache / f"{views}-views"
    if not (out / "done").exists():
        size = "--width", str(WIDTH), "--height", str(HEIGHT), "--views", str(views)
        subprocess.run([sys.executable, str(MAKE), str(out), *size], check=True, stdout=subprocess.DEVNULL)
        (out / "done").touch()
    return out


def bare_file(millions: float, cache: Path) -> Path:
    """The rows of a made scene of so many million pixels, without its photos and cameras."""
    views = max(1, round(millions * 1e6 / (WIDTH * HEIGHT)))
    out = cache / f"{millions:g}-million"
    if not out.exists():
        out.mkdir()
        shutil.copyfile(scene_of(views, cache) / "scene.ply", out / "scene.ply")
    return out / "scene.ply"


def measure(scene: Path, effort: str, cache: Path) -> dict[str, Any]:
    """Processor seconds, by stage as well, peak memory and the size of the input of one run."""
    words = ["compact", str(scene), "-o", str(cache / "out.ply"), "--overwrite", "--json", "-q", "--effort", effort]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    call = [sys.executable, "-m", "gsmerge", *words]
    run = subprocess.run(call, check=True, stdout=subprocess.PIPE, env={**os.environ, "GSMERGE_THREADS": "1"})
    after, report = resource.getrusage(resource.RUSAGE_CHILDREN), json.loads(run.stdout)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    share = seconds / sum(report["seconds"].values())  # stages are measured by the clock
    return {
        "effort": effort,
        "gaussians": report["input"]["num_gaussians"],
        "seconds": seconds,
        "memory": report["peak_memory_bytes"],
        "stages": {stage: share * value for stage, value in report["seconds"].items()},
    }


def worst_stages(records: list[dict[str, Any]]) -> dict[str, str]:
    """The stage of each run, by its name, that grew most in seconds a Gaussian since the run before, and how much."""
    worst = {records[0]["name"]: ""}
    for first, second in pairwise(records):
        times = second["gaussians"] / first["gaussians"]
        grown = {
            stage: value / (times * first["stages"].get(stage, value))
            for stage, value in second["stages"].items()
            if value > 0.05 * second["seconds"]
        }
        stage = max(grown, key=lambda name: grown[name])
        worst[second["name"]] = f"{stage}, {grown[stage]:.2f}"
    return worst


def table_of(records: list[dict[str, Any]]) -> str:
    """The table of one kind of input and one effort after the other."""
    rows = []
    for kind in ("views", "million"):
        for effort in EFFORTS:
            some = [record for record in records if record["effort"] == effort and record["name"].endswith(kind)]
            worst = worst_stages(some) if some else {}
            for record in some:
                millions = record["gaussians"] / 1e6
                cells = record["seconds"], record["seconds"] / millions, record["memory"] / 1e6
                numbers = f"{cells[0]:.1f}", f"{cells[1]:.2f}", f"{cells[2]:.0f}", f"{cells[2] / millions:.0f}"
                rows.append((record["name"], effort, f"{millions:.2f}", *numbers, worst[record["name"]]))
    head = "", "effort", "million", "seconds", "a million", "peak, MB", "a million", "grew most"
    return make_table(head, rows)


def draw_chart(records: list[dict[str, Any]], path: Path) -> None:
    """Draw seconds and memory over millions of Gaussians."""
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(7.2, 2.6), layout="constrained")
        panels = figure.subplots(1, 2)
        for axes, key, label, unit in zip(
            panels, ("seconds", "memory"), ("processor seconds", "peak memory, GB"), (1, 1e9), strict=True
        ):
            for kind, style in (("views", "-"), ("million", "--")):
                for effort, color in zip(EFFORTS, COLORS, strict=False):
                    some = [one for one in records if one["effort"] == effort and one["name"].endswith(kind)]
                    name = f"{effort}, {'with photos' if kind == 'views' else 'rows alone'}"
                    millions, values = [one["gaussians"] / 1e6 for one in some], [one[key] / unit for one in some]
                    axes.plot(millions, values, style, color=color, marker="o", markersize=3, label=name)
            axes.set(xscale="log", yscale="log", xlabel="million Gaussians", ylabel=label)
            for axis, ticks in ((axes.xaxis, (0.5, 1, 2, 4, 8, 16)), (axes.yaxis, SECONDS if unit == 1 else GIGABYTES)):
                axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
                axis.set_minor_locator(NullLocator())
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center", handlelength=3)
        figure.savefig(path, dpi=150, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--views", type=int, nargs="*", default=VIEWS)
    parser.add_argument("--millions", type=float, nargs="*", default=MILLIONS)
    parser.add_argument("--chart", type=Path, help="also write it as .png")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-growth")
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    done = args.cache / "records.json"
    records: list[dict[str, Any]] = json.loads(done.read_text()) if done.exists() else []
    inputs = [(f"{views} views", lambda views=views: scene_of(views, args.cache)) for views in args.views]
    inputs += [(f"{size:g} million", lambda size=size: bare_file(size, args.cache)) for size in args.millions]
    for name, make in inputs:
        for effort in EFFORTS:
            if not any((record["name"], record["effort"]) == (name, effort) for record in records):
                records.append({"name": name, **measure(make(), effort, args.cache)})
                done.write_text(json.dumps(records))
                print(f"{name}, {effort}: {records[-1]['seconds']:.1f} s", flush=True)
    print(table_of(records))
    if args.chart:
        draw_chart(records, args.chart)


if __name__ == "__main__":
    main()
