"""Compare views in batches with all views at once: held-out PSNR and SSIM, and the time and memory of each batch.

python benchmarks/states.py fern,lightfield,fox,desk,redkitchen --size 1 2 4      # batches of 1, 2 and 4 views
python benchmarks/states.py fern --size 2 --without photos                        # or: cameras

Both results have the same number of Gaussians. All batches run in one process, and seconds are processor seconds.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from captures import export_capture, make_parser, parse_setting, read_held_out, scene_folders, score

import gsmerge
from gsmerge.runtime.memory import peak_memory


def make_batches(folder: Path, size: int, cache: Path) -> list[Path]:
    """Export a capture's views in batches of ``size``, in the order of the trajectory; return the ``.ply`` of each.

    Exports that are in the cache are not made again.
    """
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
        plys.append(export_capture(batch, batch.parent))
    return plys


def read_batch(ply: Path, without: str | None) -> gsmerge.Scene:
    """Read an export, without photos if ``without`` is "photos", and without photos and cameras if it is "cameras"."""
    scene = gsmerge.read_scene(ply)
    if without == "photos":
        return replace(scene, images=None, large_photos=None)
    no_cameras = scene.cameras[[]]
    return scene if without is None else gsmerge.Scene(scene.gaussians, no_cameras, None, None, ())


def measure(folder: Path, plys: Sequence[Path], args: Any) -> dict[str, Any]:
    """Extend a state by each batch, and compact it and the whole scene to the same number of Gaussians.

    Returns this number, the scores of both results, the processor seconds of the state's result and of each batch, and
    the peak memory (GB) after each batch.
    """
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
    at_once = gsmerge.compact(read_batch(export_capture(folder, args.cache), args.without), budget=count)
    targets, results = read_held_out(folder), {"state": result, "at once": at_once}
    scores = {name: [round(x, 3) for x in score(made.gaussians, targets)] for name, made in results.items()}
    return {"count": count, **scores, "result": spent, "batches": seconds, "GB": memory}


def main() -> None:
    """Print a line of JSON for each capture and size of batches."""
    parser = make_parser(__doc__)
    parser.add_argument("--size", type=int, nargs="+", default=[2], help="views of a batch")
    parser.add_argument("--share", type=float, default=0.03, help="share of the input's Gaussians that results keep")
    parser.add_argument("--without", choices=("photos", "cameras"))
    parser.add_argument("--set", nargs="*", default=[], type=parse_setting, help="settings of extend, as name=value")
    args = parser.parse_args()
    for folder in scene_folders(args.scenes):
        for size in args.size:
            plys = make_batches(folder.resolve(), size, args.cache)
            row = measure(folder, plys, args)
            print(json.dumps({"scene": folder.name, "num_batches": len(plys), **row}), flush=True)


if __name__ == "__main__":
    main()
