"""A published benchmark on this machine: view lists, folders that people have, and the exports of a model.

python benchmarks/protocol.py DL3DV EXPORTS ctx_6v.json --published dl3dv-6 --size 252x252 --lpips
python benchmarks/protocol.py 360_v2 EXPORTS ctx_32v.json --published mipnerf360-32 --set budget=auto

DATA has a folder for each scene with its cameras and photos (DL3DV: transforms.json, also below nerfstudio/; Mip-NeRF
360: sparse/0 and images/ or images_4/), or is one of pixelSplat's, with index.json and .torch chunks (RE10K). EXPORTS
has a folder of that name with what the model wrote from the context views. The list is that of pixelSplat and ZipSplat:
for each scene "context" and "target", positions of the views in the order of their names, in chunks in their own order.
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
from gsmerge.io.cameras.camera_file import CameraFile, as_pinholes, select_views, to_cameras
from gsmerge.io.cameras.read import read_cameras
from gsmerge.io.photo_files import as_floats, photo_size
from gsmerge.measure.evaluate import Quality
from gsmerge.scene.files import IMAGE_PLACES, SceneFiles
from gsmerge.scene.held_out import fit_similarity
from gsmerge.scene.read import Loaded, load_scene
from gsmerge.scene.views import stored_photos
from gsmerge.types import Cameras, Views

Entry = dict[str, list[int]]  # "context" and "target" of a scene
CAMERAS = ("transforms.json", "nerfstudio/transforms.json", "sparse/0", "colmap/sparse/0", "cameras.json")
PHOTOS = ("images_4", "images_8", "images_2", *IMAGE_PLACES)  # smaller ones first: models look at less
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


@dataclass(frozen=True)
class Source:
    """Cameras of a scene of the data, in the order of the list, and where its photos are."""

    cameras: CameraFile
    path: Path
    photos: Path | None


def find_source(data: Path, scene: str) -> Source:
    """Find the cameras and photos of a scene; SystemExit says where they were expected."""
    index = data / "index.json"
    if index.is_file():
        chunk = data / json.loads(index.read_text())[scene]
        return Source(read_cameras(chunk, scene=scene), chunk, chunk)
    folder = data / scene
    path = next((folder / name for name in CAMERAS if (folder / name).exists()), None)
    if path is None:
        raise SystemExit(f"{folder}: expected {', '.join(CAMERAS)}, or {index.name} and chunks in {data}")
    cameras = read_cameras(path)
    order = np.argsort(np.array(cameras.names), kind="stable").tolist()
    photos = next((root / name for root in (folder, path.parent) for name in PHOTOS if (root / name).is_dir()), None)
    return Source(select_views(cameras, order), path, photos)


def read_targets(load: Loaded, source: Source, entry: Entry, size: tuple[int, int] | None) -> Views:
    """Read the target views of a list's entry in the world of a scene's Gaussians, cropped to ``size`` (w, h) if given.

    The scene has one view for each of the entry's context, in the order of their names.
    """
    context, views = sorted(entry["context"]), np.argsort(np.array(load.scene.names), kind="stable")
    if len(views) != len(context):
        raise SystemExit(f"{load.files.ply}: expected {len(context)} views, as the list has, found {len(views)}")
    ours = load.scene.cameras.viewmats[views].astype(np.float64)
    world = fit_similarity(source.cameras.viewmats[context].astype(np.float64), ours)
    chosen = select_views(source.cameras, entry["target"])
    chosen = replace(chosen, viewmats=world.move_viewmats(chosen.viewmats))
    photos = stored_photos(SceneFiles(load.files.ply, source.path, source.photos), chosen)
    pinholes, photos, _ = as_pinholes(chosen, photos)
    if not len(photos):
        raise SystemExit(f"{source.path}: no photo found for {chosen.names[0]}")
    read = Views(to_cameras(pinholes, photo_size(photos)), as_floats(photos), chosen.names)
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


def measure_scene(
    folder: Path, source: Source, entry: dict[str, list[int]], args: argparse.Namespace
) -> dict[str, Row]:
    """Compact a model's export and measure it, and the export itself, on the held-out views of a list's entry."""
    load = load_scene(folder)
    targets = read_targets(load, source, entry, args.size)
    start = time.perf_counter()
    result = gsmerge.compact(load.scene, **dict(args.set))
    seconds = time.perf_counter() - start
    options = gsmerge.EvaluateOptions(lpips=("vgg",) if args.lpips else (), context=False, fog=False)
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
    parser.add_argument("exports", type=Path)
    parser.add_argument("views", type=Path, help="list of context and target views")
    parser.add_argument(
        "--published", choices=[*PUBLISHED, *ECOSPLAT], help="print published figures of this benchmark as well"
    )
    parser.add_argument("--size", type=parse_size, help="crop and resize held-out photos, as 252x252")
    parser.add_argument("--scenes", nargs="*", help="these of the list alone")
    parser.add_argument(
        "--set", nargs="*", default=[], type=lambda pair: (pair.split("=")[0], setting(pair.split("=")[1]))
    )
    parser.add_argument("--lpips", action="store_true", help="also LPIPS-VGG, as the published figures have it")
    args = parser.parse_args(arguments)
    entries = {name: entry for name, entry in json.loads(args.views.read_text()).items() if entry}
    if unknown := set(args.scenes or ()) - entries.keys():
        parser.error(f"--scenes: {args.views} has no {', '.join(sorted(unknown))}")
    measured: dict[str, list[Row]] = {}
    for name in args.scenes or entries:
        if not (args.exports / name).exists():
            print(f"{name}: no export, left out", flush=True)
            continue
        rows = measure_scene(args.exports / name, find_source(args.data, name), entries[name], args)
        for method, row in rows.items():
            measured.setdefault(method, []).append(row)
        print(f"{name}: " + ", ".join(f"{method} {row.full.psnr:.2f} dB" for method, row in rows.items()), flush=True)
    if not measured:
        raise SystemExit(f"{args.exports}: expected exports named as the scenes of {args.views}, found none")
    means = {method: mean_row(rows) for method, rows in measured.items()}
    print(f"\n{len(measured['gsmerge'])} of {len(entries)} scenes\n")
    print("\n".join(table(means, args.published)))


if __name__ == "__main__":
    main()
