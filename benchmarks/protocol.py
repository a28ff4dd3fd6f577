"""A published benchmark on this machine: view lists, folders that people have, and the exports of a model.

python benchmarks/protocol.py DL3DV EXPORTS ctx_6v_tgt_8v.json --published dl3dv-6 --size 252x252 --lpips
python benchmarks/protocol.py RE10K/test EXPORTS ctx_6v_tgt_8v.json --published re10k-6 --size 252x252 --lpips
python benchmarks/protocol.py 360_v2 EXPORTS ctx_32v.json --published mipnerf360-32 --set budget=auto
python benchmarks/protocol.py DL3DV --views 6 > views.json
python benchmarks/protocol.py DL3DV EXPORTS --views 6

DATA is what gsmerge.research.captures reads: a folder for each scene with its cameras and photos (DL3DV, Mip-NeRF 360),
or index.json and .torch chunks (RE10K, ACID). EXPORTS has a folder for each scene, of its name, with what the model
wrote from the context views. The list is that of pixelSplat and ZipSplat: for each scene "context" and "target",
positions of the views in the order of their names, in chunks in their own order. --views N is the list of the paper:
N views at equal intervals, targets midway between them; without EXPORTS it is printed, for the model to be run on.
Exports may be in a world of their own: the context cameras say how it lies to the data's.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from quality import setting

import gsmerge
from gsmerge.facts.views import even_views, midpoint_views
from gsmerge.geometry import fit_similarity
from gsmerge.io.cameras.camera_file import select_views
from gsmerge.measure.evaluate import Quality
from gsmerge.research.captures import Capture, find_capture, list_captures
from gsmerge.scene.read import Loaded, load_scene
from gsmerge.types import Cameras, Views

Entry = dict[str, list[int]]  # "context" and "target" of a scene
# PSNR / SSIM / LPIPS of methods without poses, as ZipSplat measured them; the PSNR of EcoSplat is its own
METHODS = "ZipSplat", "DA3", "YoNoSplat"
PUBLISHED: dict[str, tuple[str, ...]] = {
    "dl3dv-6": ("25.24 / 0.804 / 0.172", "23.77 / 0.795 / 0.165", "24.10 / 0.783 / 0.160"),
    "dl3dv-12": ("24.27 / 0.767 / 0.197", "22.38 / 0.736 / 0.208", "22.73 / 0.736 / 0.200"),
    "dl3dv-24": ("24.14 / 0.768 / 0.198", "21.69 / 0.711 / 0.229", "22.01 / 0.710 / 0.223"),
    "re10k-6": ("26.20 / 0.842 / 0.158", "20.90 / 0.724 / 0.234", "24.99 / 0.835 / 0.151"),
    "mipnerf360-32": ("21.72 / 0.594 / 0.325", "20.94 / 0.577 / 0.295", "17.62 / 0.409 / 0.465"),
    "mipnerf360-64": ("22.18 / 0.615 / 0.298", "20.30 / 0.554 / 0.311", "17.77 / 0.413 / 0.466"),
    "mipnerf360-128": ("22.29 / 0.624 / 0.290", "20.19 / 0.568 / 0.306", "17.16 / 0.409 / 0.509"),
}
ECOSPLAT = {"re10k-24": "24.7"}  # at 5 % of the pixels


def read_lists(path: Path) -> dict[str, Entry]:
    """The entries of a published list; scenes that it leaves out are null there."""
    return {name: entry for name, entry in json.loads(path.read_text()).items() if entry}


def make_lists(captures: Sequence[Capture], count: int) -> dict[str, Entry]:
    """The entries of captures by the paper's rule, where they leave views for targets."""
    sizes = {capture.name: len(capture.read_cameras()) for capture in captures}
    contexts = {name: even_views(size, count) for name, size in sizes.items() if size > count > 1}
    return {
        name: {"context": context, "target": midpoint_views(context, range(sizes[name]))}
        for name, context in contexts.items()
    }


def read_targets(load: Loaded, capture: Capture, entry: Entry, size: tuple[int, int] | None) -> Views:
    """Read the target views of a list's entry in the world of a scene's Gaussians, cropped to ``size`` (w, h) if given.

    The scene has one view for each of the entry's context, in the order of their names.
    """
    context, views = sorted(entry["context"]), np.argsort(np.array(load.scene.names), kind="stable")
    if len(views) != len(context):
        raise SystemExit(f"{load.files.ply}: expected {len(context)} views, as the list has, found {len(views)}")
    ours, cameras = load.scene.cameras.viewmats[views].astype(np.float64), capture.read_cameras()
    world = fit_similarity(cameras.viewmats[context].astype(np.float64), ours)
    chosen = select_views(cameras, entry["target"])
    read = capture.read_views(replace(chosen, viewmats=world.move_viewmats(chosen.viewmats)))
    return read if size is None else crop_views(read, size)


def crop_views(views: Views, size: tuple[int, int]) -> Views:
    """Cut photos to the middle part of a shape (w, h) and resize them to it, as for models that see squares."""
    (width, height), cameras = size, views.cameras
    scale = max(width / cameras.width, height / cameras.height)
    middle = [(round(side / scale), total) for side, total in ((height, cameras.height), (width, cameras.width))]
    top, left = ((total - side) // 2 for side, total in middle)
    rows, columns = slice(top, top + middle[0][0]), slice(left, left + middle[1][0])
    images = [cv2.resize(image[rows, columns], size, interpolation=cv2.INTER_AREA) for image in views.images]
    Ks = cameras.Ks.astype(np.float64)
    Ks[:, :2, 2] -= (left, top)
    Ks[:, 0] *= width / middle[1][0]
    Ks[:, 1] *= height / middle[0][0]
    return Views(Cameras(cameras.viewmats, Ks, width, height), np.stack(images), views.names)


@dataclass(frozen=True)
class Row:
    """Means of a method over the views of one scene, or over scenes: all pixels, and those that the context sees."""

    share: float
    seconds: float
    full: Quality
    seen: Quality


def measure_scene(folder: Path, capture: Capture, entry: Entry, args: argparse.Namespace) -> dict[str, Row]:
    """Compact a model's export and measure it, and the export itself, on the held-out views of a list's entry."""
    load = load_scene(folder)
    targets = read_targets(load, capture, entry, args.size)
    start = time.perf_counter()
    result = gsmerge.compact(load.scene, **dict(args.set))
    seconds = time.perf_counter() - start
    options = gsmerge.EvaluateOptions(lpips=("vgg",) if args.lpips else (), lpips_views=None, context=False, fog=False)
    results = {"gsmerge": result.gaussians}
    evaluation = gsmerge.evaluate(load.scene, results, targets, options, cameras={"gsmerge": result.cameras})
    return {
        scores.name: Row(scores.ratio, seconds if scores.name in results else 0.0, *scores.mean("target"))
        for scores in evaluation.results
    }


def mean_row(rows: Sequence[Row]) -> Row:
    """Average over scenes."""

    def mean(qualities: Sequence[Quality]) -> Quality:
        values = {name: [getattr(quality, name) for quality in qualities] for name in vars(qualities[0])}
        return Quality(**{name: None if None in all_ else float(np.mean(all_)) for name, all_ in values.items()})

    shares, seconds = (float(np.mean([getattr(row, name) for row in rows])) for name in ("share", "seconds"))
    return Row(shares, seconds, mean([row.full for row in rows]), mean([row.seen for row in rows]))


def table(rows: dict[str, Row], published: str | None) -> list[str]:
    """Write the table: measured rows, then those published of a benchmark."""

    def cell(quality: Quality) -> str:
        values = (quality.psnr, 2), (quality.ssim, 3), (quality.lpips_vgg, 3)
        return " / ".join("-" if value is None else f"{value:.{digits}f}" for value, digits in values)

    lines = ["| | share | PSNR / SSIM / LPIPS | the same, seen pixels | seconds |", "|---|---|---|---|---|"]
    lines += [
        f"| {name} | {100 * row.share:.1f} % | {cell(row.full)} | {cell(row.seen)} | {row.seconds:.1f} |"
        for name, row in rows.items()
    ]
    others = dict(zip(METHODS, PUBLISHED.get(published or "", ()), strict=False))
    if published in ECOSPLAT:
        others["EcoSplat, 5 %"] = ECOSPLAT[published]
    return lines + [f"| {name}, published | | {figures} | | |" for name, figures in others.items()]


def parse_size(text: str) -> tuple[int, int]:
    """Parse a size as 252x252."""
    match = re.fullmatch(r"(\d+)x(\d+)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"expected a size as 252x252, got {text!r}")
    return int(match[1]), int(match[2])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("exports", type=Path, nargs="?", help="without it, the list of --views is printed")
    parser.add_argument("list", type=Path, nargs="?", help="published list of context and target views")
    parser.add_argument("--views", type=int, metavar="N", help="in place of a list: N views at equal intervals")
    parser.add_argument(
        "--published", choices=[*PUBLISHED, *ECOSPLAT], help="print published figures of this benchmark as well"
    )
    parser.add_argument("--size", type=parse_size, help="crop and resize held-out photos, as 252x252")
    parser.add_argument("--scenes", nargs="*", help="these of the list alone")
    parser.add_argument("--set", nargs="*", default=[], type=setting)
    parser.add_argument("--lpips", action="store_true", help="also LPIPS-VGG, as the published figures have it")
    args = parser.parse_args(arguments)
    if (args.list is None) == (args.views is None):
        parser.error("expected either a list or --views")
    if args.exports is None:
        print(json.dumps(make_lists(list_captures(args.data), args.views)))
        return
    source = args.list or args.data
    known = [] if args.list else [one for one in list_captures(args.data) if (args.exports / one.name).exists()]
    entries = read_lists(args.list) if args.list else make_lists(known, args.views)
    if unknown := set(args.scenes or ()) - entries.keys():
        parser.error(f"--scenes: {source} has no {', '.join(sorted(unknown))}")
    measured: dict[str, list[Row]] = {}
    for name in args.scenes or entries:
        if not (args.exports / name).exists():
            print(f"{name}: no export, left out", flush=True)
            continue
        rows = measure_scene(args.exports / name, find_capture(args.data, name), entries[name], args)
        for method, row in rows.items():
            measured.setdefault(method, []).append(row)
        print(f"{name}: " + ", ".join(f"{method} {row.full.psnr:.2f} dB" for method, row in rows.items()), flush=True)
    if not measured:
        raise SystemExit(f"{args.exports}: expected exports named as the scenes of {source}, found none")
    means = {method: mean_row(rows) for method, rows in measured.items()}
    print(f"\n{len(measured['gsmerge'])} of {len(entries)} scenes\n")
    print("\n".join(table(means, args.published)))


if __name__ == "__main__":
    import one_line_errors  # noqa: F401

    main()
