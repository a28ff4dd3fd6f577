"""Views that arrive in batches against all of them at once: growth, seconds per step, memory, quality.

python benchmarks/online.py desk,carton                          # 84 views of each, in steps of 12
python benchmarks/online.py eval --order cycle --whole none full  # every batch sees the whole scene; and in one go
python benchmarks/online.py apples,fern,fox --views 0 --size 3 1 --whole none --fits none --set recipe=paper

Scenes have fewer views: they are repeated from jittered poses (benchmarks/many_views.py); with --views 0 they have
their own alone. Every run is a process of its own. Quality is that of held-out views, visible pixels. The table at the
end has one row for each scene and way, decoded without a fit.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from exports import export as write_export
from many_views import many_views
from quality import score, setting
from shared_scenes import Targets, export, read_held_out, scene_folders

import gsmerge
from gsmerge import Compactor
from gsmerge.scene.files import find_scene_files

KS = (1, 2, 4)  # Gaussians of each group


def batches(name: str, views: int, size: int, order: str, cache: Path) -> list[Path]:
    """A scene's views in batches, each exported as its own scene; created once."""
    source = views_of(name, views, cache)
    document = json.loads((source / "transforms.json").read_text())
    context = [f for f in document["frames"] if f["role"] == "context"]
    ids = np.arange(len(context))
    if order == "cycle":  # every batch goes once through the scene
        ids = np.concatenate([ids[i :: -(-views // size)] for i in range(-(-views // size))])
    results = []
    for number, first in enumerate(range(0, len(ids), size)):
        folder = cache / f"{name}-{views}-{order}-{size}" / f"{number:03d}"
        ply = folder / "plain" / "scene.ply"
        if not (folder / "done").exists():
            folder.mkdir(parents=True, exist_ok=True)
            for part in ("images", "depth"):
                if not (folder / part).exists():
                    (folder / part).symlink_to((source / part).resolve())
            frames = [context[i] for i in ids[first : first + size]]
            (folder / "transforms.json").write_text(json.dumps(document | {"frames": frames}))
            write_export(folder, folder / "plain")
            (folder / "done").touch()
        results.append(ply)
    return results


def views_of(name: str, views: int, cache: Path) -> Path:
    """The folder of a scene with so many views; 0: its own."""
    folder = scene_folders(name)[0]
    return many_views(folder, cache / f"{name}-{views}", views) if views else folder


def online(args: argparse.Namespace) -> dict:
    """One batch after the other, and what is decoded in the end."""
    targets = read_held_out(scene_folders(args.scenes)[0])
    compactor, steps = Compactor(**{"replay": args.replay} | settings_of(args)), []
    for ply in batches(args.scenes, args.views, args.size[0], args.order, args.cache):
        scene = gsmerge.read_scene(find_scene_files(ply).ply)
        start = time.perf_counter(), time.process_time()
        report = compactor.extend(scene)
        seconds = time.perf_counter() - start[0], time.process_time() - start[1]
        names = ("num_input", "num_new", "num_covered", "num_joined", "num_hidden", "num_groups")
        step = {name: getattr(report, name) for name in names}
        steps.append(step | {"seconds": round(seconds[0], 2), "processor": round(seconds[1], 2)})
        print(steps[-1], {k: round(v, 2) for k, v in report.seconds.items()}, file=sys.stderr, flush=True)
        del scene
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    with tempfile.TemporaryDirectory() as folder:
        compactor.save(Path(folder) / "state.gsm")
        size = (Path(folder) / "state.gsm").stat().st_size
    spent = sum(step["processor"] for step in steps)
    results = {
        "steps": steps,
        "peak_GB": round(peak, 2),
        "state_MB": round(size / 1e6, 1),
        "processor": round(spent, 1),
    }
    for fit in args.fits:
        for k in KS:
            start = time.process_time()
            gaussians = compactor.decode(k=k, fit=fit)
            results[f"{fit} k{k}"] = _scored(gaussians, targets, time.process_time() - start, args.lpips)
    return results


def whole(args: argparse.Namespace, fit: str) -> dict:
    """All views at once; ``input``: as they are."""
    source = views_of(args.scenes, args.views, args.cache)
    scene, targets = gsmerge.read_scene(export(source, args.cache)), read_held_out(scene_folders(args.scenes)[0])
    if fit == "input":
        return _scored(scene.gaussians, targets, 0.0, args.lpips)
    results: dict = {}
    for k in KS:
        start = time.process_time()
        result = gsmerge.compact(scene, **{"fit": fit, "k": k} | settings_of(args))
        seconds = time.process_time() - start
        if k == 1:
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
            results = {"peak_GB": round(peak, 2), "processor": round(seconds, 1)}
        results[f"{fit} k{k}"] = _scored(result.gaussians, targets, seconds, args.lpips)
    return results


def settings_of(args: argparse.Namespace) -> dict:
    """Settings from the command line."""
    return {name: setting(value) for name, value in (text.split("=") for text in args.set)}


def _scored(gaussians: gsmerge.Gaussians, targets: Targets, seconds: float, perceptual: bool) -> dict:
    values = score(gaussians, targets, perceptual)
    results = {name: round(value, 3) for name, value in zip(("psnr", "ssim", "lpips"), values, strict=False)}
    return {"count": len(gaussians), **results, "processor": round(seconds, 1)}


def print_table(rows: list[tuple[str, str, dict]]) -> None:
    """Print a row for each scene and way: what is decoded without a fit, and what it takes."""
    print("| scene | views at a time | K = 1 | K = 2 | K = 4 | Gaussians | state MB | peak GB | processor seconds |")
    print("|---|---|---|---|---|---|---|---|---|")
    for scene, way, results in rows:
        if "none k1" not in results:
            continue
        cells = [f"{results[f'none k{k}']['psnr']:.2f}" for k in KS]
        cells += [f"{results['none k1']['count']:,}", str(results.get("state_MB", "")), str(results["peak_GB"])]
        print("|", " | ".join([scene, way, *cells, str(results["processor"])]), "|")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", help="train, eval, or names with commas between")
    parser.add_argument("--views", type=int, default=84)
    parser.add_argument("--size", type=int, nargs="+", default=[12], help="views of a batch")
    parser.add_argument("--order", choices=("trajectory", "cycle"), default="trajectory")
    parser.add_argument("--replay", type=int, default=96)
    parser.add_argument("--whole", nargs="*", default=[], choices=("input", "none", "full"), help="also in one go")
    parser.add_argument("--fits", nargs="*", default=["none", "full"], choices=("none", "full"), help="at decoding")
    parser.add_argument("--set", nargs="*", default=[], help="settings, as name=value")
    parser.add_argument("--lpips", action="store_true", help="also LPIPS-VGG, see benchmarks/quality.py")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-online")
    parser.add_argument("--run", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.run:
        print(json.dumps(online(args) if args.run == "online" else whole(args, args.run)))
        return
    rows = []
    for folder in scene_folders(args.scenes):
        runs = [*((run, args.size[0]) for run in args.whole), *(("online", size) for size in args.size)]
        for size in args.size:  # exported here, so that no run's memory has it
            batches(folder.name, args.views, size, args.order, args.cache)
        if args.whole:
            export(views_of(folder.name, args.views, args.cache), args.cache)
        for run, size in runs:
            options = [f"--{name}={getattr(args, name)}" for name in ("views", "order", "replay", "cache")]
            options += [f"--size={size}", "--fits", *args.fits, "--set", *args.set, *["--lpips"] * args.lpips]
            command = [sys.executable, __file__, folder.name, *options, "--run", run]
            text = subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True).stdout.strip()
            way = f"{size}" if run == "online" else "all"
            print(folder.name, run, way, text, flush=True)
            rows.append((folder.name, way, json.loads(text)))
    print_table(rows)


if __name__ == "__main__":
    main()
