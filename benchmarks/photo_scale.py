"""Photos larger than the grid: exports at half the size of the photos, held-out views at both sizes.

python benchmarks/photo_scale.py eval
python benchmarks/photo_scale.py train --scales 1,2,1.5
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from shared_scenes import LEFT_OUT, Targets, exporter, read_held_out, scene_folders

import gsmerge
from gsmerge.measure.sizes import resize_mask, resize_photo, zoom_cameras
from gsmerge.raster.metrics import psnr, ssim
from gsmerge.types import Cameras, LargePhotos, grid_ids

HALF = 2


def half_export(folder: Path) -> gsmerge.Scene:
    """What the exporter would write of the scene at half its size, with the photos as they are."""
    tool, rng, parts = exporter(), np.random.default_rng(0), []
    views = tool.read_scene(folder)
    height, width = views[0]["depth"].shape
    size = width // HALF, height // HALF
    K = np.stack([view["K"] for view in views])
    Ks = K * np.array([[size[0] / width], [size[1] / height], [1.0]])
    images = np.stack([cv2.resize(v["image"], size, interpolation=cv2.INTER_AREA) for v in views]).astype(np.float32)
    for view, image, own in zip(views, images, Ks, strict=True):
        depth = cv2.resize(view["depth"], size, interpolation=cv2.INTER_NEAREST)
        conf = cv2.resize(view["conf"], size, interpolation=cv2.INTER_AREA)
        parts.append(tool.view_gaussians({**view, "image": image, "depth": depth, "conf": conf, "K": own}, rng))
    made = {name: values.astype(np.float32) for name, values in tool.concat(parts).items()}
    gaussians = gsmerge.Gaussians(
        made["means"].astype(np.float64), made["quats"], made["scales"], made["opacities"], made["sh0"][:, None],
        np.zeros((len(made["means"]), 0, 3), np.float32),
    )  # fmt: skip
    photos = [np.rint(view["image"] * 255).astype(np.uint8) for view in views]
    large = LargePhotos(K, width, height, tuple(range(len(views))), photos.__getitem__)
    cameras = Cameras(np.stack([np.linalg.inv(view["c2w"]) for view in views]), Ks, *size)
    names, valid = tuple(view["name"] for view in views), np.ones((len(views), size[1], size[0]), bool)
    return gsmerge.Scene(gaussians, cameras, images, grid_ids(valid), names, None, large)


def score(gaussians: gsmerge.Gaussians, targets: Targets, zoom: float) -> tuple[float, float]:
    """Mean PSNR (dB) and SSIM of the visible pixels of the targets at ``zoom`` times their size."""
    cameras = zoom_cameras(targets.cameras, zoom)
    size, values = (cameras.width, cameras.height), []
    for image, photo, mask in zip(
        gsmerge.render(gaussians, cameras).images.clip(0, 1), targets.images, targets.masks, strict=True
    ):
        seen, resized = resize_mask(mask, *size), resize_photo(photo, *size)
        values.append((psnr(image, resized, seen), ssim(image, resized, seen)))
    return float(np.mean([v[0] for v in values])), float(np.mean([v[1] for v in values]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", help="train, eval, or names with commas between")
    parser.add_argument("--scales", default="1,2")
    args = parser.parse_args()
    rows: dict[float, list[tuple[float, ...]]] = {}
    for folder in scene_folders(args.scenes):
        if folder.name in LEFT_OUT:
            continue
        scene, targets = half_export(folder), read_held_out(folder)
        for scale in map(float, args.scales.split(",")):
            start = time.process_time()
            result = gsmerge.compact(scene, photo_scale=scale)
            seconds = time.process_time() - start
            row = (*score(result.gaussians, targets, 1 / HALF), *score(result.gaussians, targets, 1), seconds)
            rows.setdefault(scale, []).append(row)
            print(folder.name, scale, np.round(row, 3), flush=True)
    for scale, each in rows.items():
        print("mean", scale, "PSNR, SSIM at the views' size, at the photos', seconds", np.mean(each, 0).round(3))


if __name__ == "__main__":
    main()
