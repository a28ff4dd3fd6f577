"""Views in batches against all views at once: held-out PSNR and SSIM, and the time and memory of each batch.

python benchmarks/states.py fern,lightfield,fox,desk,redkitchen --size 1 2 4      # so many views at a time
python benchmarks/states.py fern --size 2 --without photos                        # or: cameras

Both results have as many Gaussians. One batch after the other in one process; seconds are of the processor.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from captures import export, make_parser, read_held_out, scene_folders, score, setting

import gsmerge
from gsmerge.runtime.memory import peak_memory


def make_batches(folder: Path, size: int, cache: Path) -> list[Path]:
    """The exports of a capture's views, ``size`` at a time in the order of the trajectory; made once."""
    document = json.loads((folder / "transforms.json").read_text())
    frames = [frame for frame in document["frames"] if frame["role"] == "context"]
    plys = []
    for first in range(0, len(frames), size):
        batch = cache / f"{folder.name}-by-{size}" / f"{first:03d}"
        batch.mkdir(parents=True, exist_ok=True)
        for part in ("images", "depth"):
            if not (batch / part).exists():
                (batch / part).symlink_to(folder / part)
        (batch / "transforms.json").write_text(json.dumps(document | {"frames": frames[first : first + size]}))
        plys.append(export(batch, batch.parent))
    return plys


def read_batch(ply: Path, without: str | None) -> gsmerge.Scene:
    """An export, as it is or without its photos, or without cameras either."""
    scene = gsmerge.read_scene(ply)
    if without == "photos":
        return replace(scene, images=None, large_photos=None)
    none = scene.cameras[[]]
    return scene if without is None else gsmerge.Scene(scene.gaussians, none, None, None, ())


def measure(folder: Path, plys: Sequence[Path], args: Any) -> dict[str, Any]:
    """Extend a state by each batch, and compact it and the whole scene to as many Gaussians."""
    compactor, seconds, memory = gsmerge.Compactor(**dict(args.set)), [], []
    for ply in plys:
        scene = read_batch(ply, args.without)
        start = time.process_time()
        compactor.extend(scene)
        seconds.append(round(time.process_time() - start, 2))
        memory.append(round(peak_memory() / 1e9, 2))
    count = round(args.share * sum(batch["num_input"] for batch in compactor.batches))
    start = time.process_time()
    result = compactor.compact(budget=count)
    spent = round(time.process_time() - start, 1)
    at_once = gsmerge.compact(read_batch(export(folder, args.cache), args.without), budget=count)
    targets, ways = read_held_out(folder), {"state": result, "at once": at_once}
    scores = {name: [round(x, 3) for x in score(one.gaussians, targets)] for name, one in ways.items()}
    return {"count": count, **scores, "result": spent, "batches": seconds, "GB": memory}


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--size", type=int, nargs="+", default=[2], help="views of a batch")
    parser.add_argument("--share", type=float, default=0.03, help="Gaussians of the results, of the input's")
    parser.add_argument("--without", choices=("photos", "cameras"))
    parser.add_argument("--set", nargs="*", default=[], type=setting, help="settings of extend, as name=value")
    args = parser.parse_args()
    for folder in scene_folders(args.scenes):
        for size in args.size:
            plys = make_batches(folder.resolve(), size, args.cache)
            row = measure(folder, plys, args)
            print(json.dumps({"scene": folder.name, "num_batches": len(plys), **row}), flush=True)


if __name__ == "__main__":
    main()
