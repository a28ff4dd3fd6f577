"""Views in batches against all views at once: held-out PSNR and SSIM, and the time and memory of each batch.

python benchmarks/states.py fern,lightfield,fox,desk,redkitchen --size 1 2 4      # its own views, so many at a time
python benchmarks/states.py fern --views 80 --size 8 --set max_views=32           # repeated from jittered poses
python benchmarks/states.py fern --size 2 --without photos                        # or: cameras

Both results have as many Gaussians. One batch after the other in one process; seconds are of the processor.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from online import make_batches, peak_memory
from quality import score, setting
from shared_scenes import Targets, read_held_out, scene_folders

import gsmerge


def read_batch(ply: Path, without: str | None) -> gsmerge.Scene:
    """An export, as it is or without its photos, or without cameras either."""
    scene = gsmerge.read_scene(ply)
    if without == "photos":
        return replace(scene, images=None, large_photos=None)
    none = scene.cameras[[]]
    return scene if without is None else gsmerge.Scene(scene.gaussians, none, None, None, ())


def measure(plys: Sequence[Path], whole: Path, targets: Targets, settings: dict[str, Any], args: Any) -> dict[str, Any]:
    """Extend a state by each batch, and compact it and the whole scene to as many Gaussians."""
    compactor, seconds, memory = gsmerge.Compactor(**settings), [], []
    for ply in plys:
        scene = read_batch(ply, args.without)
        start = time.process_time()
        compactor.extend(scene)
        seconds.append(round(time.process_time() - start, 2))
        memory.append(round(peak_memory(), 2))
    count = round(args.share * sum(batch["num_input"] for batch in compactor.batches))
    start = time.process_time()
    result = compactor.compact(budget=count)
    spent = round(time.process_time() - start, 1)
    at_once = gsmerge.compact(read_batch(whole, args.without), budget=count)
    scores = {name: score(one.gaussians, targets)[:2] for name, one in (("state", result), ("at once", at_once))}
    rounded = {name: [round(value, 3) for value in values] for name, values in scores.items()}
    return {"count": count, **rounded, "result": spent, "batches": seconds, "GB": memory}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", help="train, eval, or names with commas between")
    parser.add_argument("--views", type=int, default=0, help="of each scene; 0: its own")
    parser.add_argument("--size", type=int, nargs="+", default=[2], help="views of a batch")
    parser.add_argument("--share", type=float, default=0.03, help="Gaussians of the results, of the input's")
    parser.add_argument("--without", choices=("photos", "cameras"))
    parser.add_argument("--set", nargs="*", default=[], type=setting, help="settings of extend, as name=value")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-online")
    args = parser.parse_args()
    settings = dict(args.set)
    for folder in scene_folders(args.scenes):
        (whole,) = make_batches(folder, args.views, 10_000, args.cache)
        for size in args.size:
            plys = make_batches(folder, args.views, size, args.cache)
            row = measure(plys, whole, read_held_out(folder), settings, args)
            print(json.dumps({"scene": folder.name, "num_batches": len(plys), **row}), flush=True)


if __name__ == "__main__":
    main()
