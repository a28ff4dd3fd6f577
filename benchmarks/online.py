"""The superpixel merging paper's online experiment: views that arrive in batches, merged, and the naive way.

python benchmarks/online.py fern,apples,lightfield            # as in the paper: 84 views, in steps of 12
python benchmarks/online.py fern,apples,lightfield --size 84  # the same views at once
python benchmarks/online.py desk --views 0 --size 3           # its own views alone

The naive way keeps all Gaussians of all batches. Captures have fewer views than the paper's: they are repeated from
jittered poses (benchmarks/many_views.py). Two tables are printed, means over the scenes: growth, and what is there in
the end, on held-out photos, visible pixels. The picture shows growth. Each way has a process of its own, whose memory
is the most that it has taken so far. Frames are drawn by the native rasterizer at the photos' size.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from many_views import many_views
from page_tables import make_table
from quality import score, setting
from shared_scenes import Targets, export, read_held_out, scene_folders

from gsmerge import Compactor, Gaussians, read_scene
from gsmerge.measure.lpips import INSTALL, lpips_available
from gsmerge.measure.speed import time_render

KS = (1, 2, 4)  # Gaussians of each group
NAIVE = "naive"
WAYS = {NAIVE: "#D62728", **dict(zip((f"K = {k}" for k in KS), ("#1F77B4", "#2CA02C", "#9467BD"), strict=True))}
QUALITY = ("PSNR", "SSIM", "LPIPS")
NEAR = 0.01  # world units, that of gsmerge.render
Figures = dict[str, float]  # by name
Growth = dict[int, Figures]  # by number of views so far


def make_batches(folder: Path, views: int, size: int, cache: Path) -> list[Path]:
    """The exports of a scene's views, ``size`` at a time in the order of the trajectory; made once."""
    source = many_views(folder, cache / f"{folder.name}-{views}", views) if views else folder
    document = json.loads((source / "transforms.json").read_text())
    frames = [frame for frame in document["frames"] if frame["role"] == "context"]
    plys = []
    for first in range(0, len(frames), size):
        batch = cache / f"{folder.name}-{views}-{size}" / f"{first:03d}"
        batch.mkdir(parents=True, exist_ok=True)
        for part in ("images", "depth"):
            if not (batch / part).exists():
                (batch / part).symlink_to((source / part).resolve())
        (batch / "transforms.json").write_text(json.dumps(document | {"frames": frames[first : first + size]}))
        plys.append(export(batch, batch.parent))
    return plys


def peak_memory() -> float:
    """The most memory of this process so far, GB; unlike ``ru_maxrss`` without that of the process that began it."""
    found = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return 1024 * int(found[1]) / 1e9 if found else float("nan")


def keep_all(plys: Sequence[Path]) -> list[Figures]:
    """The naive way: all Gaussians so far stay in memory."""
    kept, steps = list[Gaussians](), []
    for ply in plys:
        kept.append(read_scene(ply).gaussians)
        steps.append({NAIVE: sum(map(len, kept)), "naive GB": peak_memory()})
    return steps


def merge_all(plys: Sequence[Path], settings: dict[str, Any], states: Path) -> list[Figures]:
    """One batch after the other; the state after each is written into the folder ``states``."""
    compactor, steps, num_views = Compactor(**settings), [], 0
    for number, ply in enumerate(plys):
        scene = read_scene(ply)
        start = time.process_time()
        report = compactor.extend(scene)
        spent, num_views = time.process_time() - start, num_views + report.num_views
        path = states / f"{number:03d}.gsm"
        steps.append({"views": num_views, "groups": report.num_gaussians, "GB": peak_memory(), "processor": spent})
        compactor.save(path)
        steps[-1]["MB"] = path.stat().st_size / 1e6
    return steps


def in_own_process(run: Callable[..., Any], *given: Any) -> Any:
    """What a function returns that runs in a new process, whose memory is its own."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(run, *given).result()


def measure(plys: Sequence[Path], targets: Targets, settings: dict[str, Any]) -> tuple[Growth, dict[str, Figures]]:
    """Growth by views so far, and what each way ends with."""
    ways = dict[str, Gaussians]()
    with tempfile.TemporaryDirectory() as place:
        naive = in_own_process(keep_all, plys)
        merged = in_own_process(merge_all, plys, settings, Path(place))
        growth = {int(step["views"]): step | other for step, other in zip(merged, naive, strict=True)}
        for step, path in zip(growth.values(), sorted(Path(place).iterdir()), strict=True):
            compactor = Compactor.load(path)
            ways = {f"K = {k}": compactor.decode(k=k) for k in KS}
            step |= {way: len(gaussians) for way, gaussians in ways.items()}
    ways = {NAIVE: Gaussians.concat([read_scene(ply).gaussians for ply in plys]), **ways}
    ends = {}
    for way, gaussians in ways.items():
        scores = (*score(gaussians, targets, lpips_available("vgg")), float("nan"))[:3]
        shares = {"count": len(gaussians), "share": 100 * len(gaussians) / len(ways[NAIVE])}
        seconds = [time_render(gaussians, targets.cameras[[view]], NEAR) for view in range(len(targets.cameras))]
        ends[way] = shares | dict(zip(QUALITY, scores, strict=True)) | {"frames": 1 / float(np.median(seconds))}
    return growth, ends


def mean_of(rows: Sequence[Figures]) -> Figures:
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def growth_table(growth: Growth) -> str:
    head = ["views", NAIVE, "groups", *(f"K = {k}" for k in KS), "naive, memory", "memory", "state", "processor"]
    rows = []
    for views, step in growth.items():
        counts = [f"{step[name]:,.0f}" for name in (NAIVE, "groups", *(f"K = {k}" for k in KS))]
        memory = [f"{step['naive GB']:.2f} GB", f"{step['GB']:.2f} GB", f"{step['MB']:.1f} MB"]
        rows.append([str(views), *counts, *memory, f"{step['processor']:.1f} s"])
    return make_table(head, rows)


def end_table(ends: dict[str, dict[str, Figures]]) -> str:
    rows = []
    for scene, ways in ends.items():
        for way, end in ways.items():
            quality = [f"{end[name]:.{digits}f}" for name, digits in zip(QUALITY, (2, 3, 3), strict=True)]
            counts = [f"{end['count']:,.0f}", f"{end['share']:.1f}%"]
            rows.append([scene, way, *counts, *quality, f"{end['frames']:.3g}"])
    return make_table(["scene", "way", "Gaussians", "share", *QUALITY, "frames a second"], rows)


def draw(growth: Growth, path: Path) -> None:
    """Gaussians and memory over the views so far, in the paper's colours."""
    from matplotlib.figure import Figure  # here, so that it is in no way's memory

    figure = Figure((9, 3.2), layout="constrained")
    counts, memory = figure.subplots(1, 2)
    for way, color in WAYS.items():
        counts.plot(list(growth), [step[way] / 1e6 for step in growth.values()], "o-", color=color, label=way)
    for name, color, label in (("naive GB", WAYS[NAIVE], NAIVE), ("GB", WAYS["K = 1"], "merged")):
        memory.plot(list(growth), [step[name] for step in growth.values()], "o-", color=color, label=label)
    for axes, words in ((counts, "Gaussians (M)"), (memory, "memory (GB)")):
        axes.set(xlabel="views so far", ylabel=words, ylim=(0, None), xticks=list(growth))
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(path)


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", help="train, eval, or names with commas between")
    parser.add_argument("--views", type=int, default=84, help="of each scene; 0: its own")
    parser.add_argument("--size", type=int, default=12, help="views of a batch")
    parser.add_argument("--set", nargs="*", type=setting, default=[("recipe", "paper")], help="settings, as name=value")
    parser.add_argument("--out", type=Path, default=Path("online.svg"), help="the picture")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-online")
    args = parser.parse_args(words)
    if not lpips_available("vgg"):
        print(f"LPIPS is left out: {INSTALL}", flush=True)
    settings = dict(args.set)
    runs = {}
    for folder in scene_folders(args.scenes):
        plys = make_batches(folder, args.views, args.size, args.cache)
        runs[folder.name] = measure(plys, read_held_out(folder), settings)
        print(json.dumps({folder.name: runs[folder.name]}), flush=True)
    report(runs, args.out)


def report(runs: dict[str, tuple[Growth, dict[str, Figures]]], out: Path) -> None:
    """Print both tables and draw; growth is the mean where all scenes have so many views."""
    growths = [growth for growth, _ in runs.values()]
    growth = {v: mean_of([g[v] for g in growths]) for v in growths[0] if all(v in g for g in growths)}
    ends = {scene: ends for scene, (_, ends) in runs.items()}
    if len(runs) > 1:
        ends["mean"] = {way: mean_of([ways[way] for ways in ends.values()]) for way in WAYS}
    print(growth_table(growth), end_table(ends), sep="\n\n")
    draw(growth, out)


if __name__ == "__main__":
    main()
