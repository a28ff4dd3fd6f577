"""Test how often views get the right photo when photos are turned, renamed, exchanged, missing, or among others.

python benchmarks/pairing.py                      # 200 draws over all captures
python benchmarks/pairing.py fern,fox --draws 20 --first 100 --show

Each draw takes three to eight context views of a capture and writes them as a model would:

- Rows have a Gaussian for each pixel or for each voxel, opacities times .3 to 1, and some rows are left out.
- Cameras name their photos or do not, or there are no cameras.
- Photos are turned, with or without a tag that says so. They have their own names, each other's, or numbers in any
  order. Some are missing, empty or cut. Up to twenty other photos lie beside them, some of another capture.

The script counts the views with the right photo, with a wrong one, and without one although it is there. If the camera
did not move between two photos, either of them is right.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from captures import (
    Rows,
    concat_rows,
    make_frame,
    make_parser,
    merge_voxels,
    read_context,
    scene_folders,
    take_rows,
    view_gaussians,
    write_ply,
)
from PIL import Image

import gsmerge
from gsmerge.io.bounds import read_json
from gsmerge.method.kernels.pictures import turn_back
from gsmerge.reading.read_scene import load_scene

TAGS = {0: 1, 2: 3, 3: 6, 1: 8}  # orientation tag of EXIF for each number of quarter turns
SAME = 0.02  # mean difference of colours up to which two pictures show the same photo, with the losses of JPEG
STILL = 0.06  # mean difference of colours up to which the camera hardly moved between two photos
View = dict[str, Any]  # see captures.read_context


def read_others(folder: Path, names: set[str]) -> list[tuple[str, np.ndarray]]:
    """Read the name and the picture of each photo of a capture that has none of these names."""
    frames = read_json(folder / "transforms.json")["frames"]
    paths = [folder / frame["file_path"] for frame in frames if Path(frame["file_path"]).name not in names]
    return [(path.name, cv2.imread(str(path))[..., ::-1] / 255) for path in paths]


def make_rows(views: list[View], rng: np.random.Generator, kind: str) -> Rows:
    """Make the rows of some views: all pixels for the kind "grid", otherwise a random part of voxels of random size."""
    rows = concat_rows([view_gaussians(view, rng) for view in views])
    if kind == "grid":
        return rows
    cell = np.median([np.median(view["depth"]) / view["K"][0, 0] for view in views])
    rows = merge_voxels(rows, cell * rng.choice([1, 2, 4, 6]))
    rows = {**rows, "opacities": rows["opacities"] * rng.choice([0.3, 0.6, 1.0])}
    return take_rows(rows, np.flatnonzero(rng.random(len(rows["means"])) < rng.choice([0.5, 0.8, 1.0])))


def save_photo(path: Path, image: np.ndarray, turn: int, *, tag: bool) -> None:
    """Write a photo that is upright after ``turn`` quarter turns; ``tag`` adds an orientation tag that says so."""
    stored = np.ascontiguousarray(turn_back(np.round(image * 255).astype(np.uint8), turn))
    exif = Image.Exif()
    if tag:
        exif[0x112] = TAGS[turn]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(stored).save(path, exif=exif.tobytes(), quality=95)


def write_cameras(folder: Path, views: list[View], names: list[str] | None) -> None:
    """Write cameras that name their photos, or poses and intrinsics alone if there are no names."""
    if names is not None:
        pairs = zip(names, views, strict=True)
        frames = [make_frame(f"images/{name}", v["K"], v["c2w"], v["depth"].shape) for name, v in pairs]
        (folder / "transforms.json").write_text(json.dumps({"camera_model": "PINHOLE", "frames": frames}))
        return
    poses = np.stack([np.linalg.inv(view["c2w"])[:3] for view in views])
    Ks, depth = (np.stack([view[name] for view in views]) for name in ("K", "depth"))
    np.savez(folder / "predictions.npz", extrinsic=poses, intrinsic=Ks, depth=depth.astype(np.float32))


def make_draw(folder: Path, scenes: list[Path], seed: int) -> tuple[list[View], set[int], str]:
    """Write the files of a random draw; return its views, the numbers of views with a photo, and a description."""
    rng = np.random.default_rng(seed)
    scene, other = scenes[seed % len(scenes)], scenes[(seed + 1) % len(scenes)]
    views = read_context(scene)
    first, count = 0, min(int(rng.integers(3, 9)), len(views))
    if rng.random() < 0.5:
        views = [views[i] for i in np.linspace(0, len(views) - 1, count).round().astype(int)]
    else:
        first = int(rng.integers(0, len(views) - count + 1))
        views = views[first : first + count]
    kind = str(rng.choice(["grid", "voxels", "voxels"]))
    cameras = str(rng.choice(["named", "named", "nameless", *["none"] * (kind == "grid")]))
    write_ply(folder / "scene.ply", make_rows(views, rng, kind))
    own_names = [view["name"] for view in views]
    naming = str(rng.choice(["own", "own", "numbers", "exchanged"] if cameras == "named" else ["own", "numbers"]))
    files = list(own_names)
    if naming == "exchanged":
        files = [own_names[i] for i in rng.permutation(len(own_names))]
    elif naming == "numbers":
        files = [f"IMG_{number:04d}.jpg" for number in rng.choice(500, len(own_names), replace=False)]
    mode = str(rng.choice(["upright", "upright", "all tagged", "some tagged", "turned"]))
    turns = np.zeros(len(views), int)
    if mode != "upright":
        turns[:] = rng.choice([1, 2, 3]) if mode != "some tagged" else rng.choice([0, 1, 2, 3], len(views))
    missing = set(rng.choice(len(views), int(rng.integers(0, len(views) // 3 + 1)), replace=False).tolist())
    for i, (view, name, turn) in enumerate(zip(views, files, turns.tolist(), strict=True)):
        path = folder / "images" / name
        if i not in missing:
            save_photo(path, view["image"], turn, tag=mode.endswith("tagged"))
        elif rng.random() < 0.3:
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(b"" if rng.random() < 0.5 else b"\xff\xd8\xff\xe0" + bytes(40))
    extra = [*read_others(scene, set(own_names)), *read_others(other, set())[:6]]
    for i in rng.permutation(len(extra))[: int(rng.choice([0, 0, 5, 20]))]:
        name, image = extra[i]
        path = folder / "images" / (name if naming != "numbers" else f"IMG_{500 + int(i):04d}.jpg")
        if not path.exists():
            save_photo(path, image, int(rng.choice(turns)), tag=mode.endswith("tagged"))
    if cameras != "none":
        write_cameras(folder, views, own_names if cameras == "named" else None)
    description = f"{scene.name}, {count} views, {kind}, cameras {cameras}, names {naming}, photos {mode}"
    return views, set(range(len(views))) - missing, f"{description}, {len(missing)} missing"


def is_photo(image: np.ndarray, photo: np.ndarray, most: float) -> bool:
    """Return whether a scene's photo shows a photo of the capture; colours may differ by less than ``most``."""
    size = image.shape[1::-1]
    return float(np.abs(cv2.resize(photo, size, interpolation=cv2.INTER_AREA) - image).mean()) < most


def judge(folder: Path, views: list[View], present: set[int]) -> Counter[str]:
    """Read a draw, and count its right, wrong and left out photos; ``present`` are the views with a photo."""
    try:
        scene = load_scene(folder).scene
    except gsmerge.GsmergeError as error:
        print(f"    {error}")
        return Counter({"left out": len(present), "refused": 1})
    counts: Counter[str] = Counter()
    poses = np.stack([np.linalg.inv(view["c2w"]) for view in views])
    for view in range(len(views)):
        nearest = np.abs(scene.cameras.viewmats - poses[view]).max((1, 2)) if len(scene) else np.array([np.inf])
        place = int(nearest.argmin())
        if scene.images is None or place not in scene.photo_views:
            counts["left out" if view in present else "rightly without"] += 1
        elif is_photo(scene.images[place], views[view]["image"], STILL if view not in present else SAME):
            counts["right"] += 1
        elif is_photo(scene.images[place], views[view]["image"], STILL):
            counts["as good"] += 1
        else:
            counts["wrong"] += 1
    return counts


def main() -> None:
    """Try all draws; print those with faults, and the totals."""
    parser = make_parser(__doc__, "train,eval")
    parser.add_argument("--draws", type=int, default=200, help="number of draws")
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    parser.add_argument("--show", action="store_true", help="print every draw, not only those with faults")
    parser.add_argument("--keep", type=Path, help="folder in which draws with faults are kept")
    args = parser.parse_args()
    folders = scene_folders(args.scenes)
    total, seconds = Counter[str](), 0.0
    for seed in range(args.first, args.first + args.draws):
        with tempfile.TemporaryDirectory() as place:
            views, present, description = make_draw(Path(place), folders, seed)
            start = time.process_time()
            counts = judge(Path(place), views, present)
            seconds += time.process_time() - start
            total += counts
            bad = counts["wrong"] or counts["left out"]
            if bad or args.show:
                print(f"{seed:4} {description}: {dict(counts)}", flush=True)
            if bad and args.keep:
                shutil.copytree(place, args.keep / str(seed), dirs_exist_ok=True)
    num_photos = sum(total[name] for name in ("right", "as good", "left out", "wrong"))
    print(f"{dict(total)}; wrong {total['wrong']}, left out {100 * total['left out'] / max(1, num_photos):.1f} %")
    print(f"{seconds / args.draws:.2f} CPU s a draw", file=sys.stderr)


if __name__ == "__main__":
    main()
