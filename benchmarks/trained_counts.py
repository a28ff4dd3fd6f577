"""How like the input a trained scene stays at several counts: ours beside splat-transform, mean and worst view.

python benchmarks/trained_counts.py fox,fern --folder made      # made/fox.ply and .cameras.json, by trained_scenes.py

Input and results are rendered at the held-out cameras and at cameras at random between the input's. Results of
splat-transform (on the PATH, or named by GSMERGE_SPLAT_TRANSFORM) are kept in the folder. A line has the
mean of all views and the worst by PSNR; `least` is what ours has more than theirs in the view where that is least.
"""

from __future__ import annotations

import argparse
import subprocess
import time
from pathlib import Path

import numpy as np
from shared_scenes import read_held_out, scene_folders

import gsmerge
from gsmerge.geometry import quat_to_rotmat, rotmat_to_quat
from gsmerge.io import read_ply
from gsmerge.io.formats.splat_transform import find_program
from gsmerge.measure.lpips import lpips
from gsmerge.raster.metrics import psnr, ssim
from gsmerge.types import Cameras, Gaussians, Scene

BETWEEN = 12  # cameras at random


def cameras_between(cameras: Cameras, count: int, seed: int = 0) -> Cameras:
    """Draw cameras at random on the lines between two of the input's, turned as the share of each says."""
    rng = np.random.default_rng(seed)
    quats, centres = rotmat_to_quat(cameras.viewmats[:, :3, :3].astype(np.float64)), cameras.centres
    viewmats, rows = np.tile(np.eye(4), (count, 1, 1)), rng.integers(0, len(cameras), (count, 2))
    for view, (a, b) in enumerate(rows):
        share, sign = rng.uniform(), 1 if quats[a] @ quats[b] >= 0 else -1
        quat = (1 - share) * quats[a] + share * sign * quats[b]
        viewmats[view, :3, :3] = quat_to_rotmat(quat[None] / np.linalg.norm(quat))[0]
        viewmats[view, :3, 3] = -viewmats[view, :3, :3] @ ((1 - share) * centres[a] + share * centres[b])
    return Cameras(viewmats, cameras.Ks[rows[:, 0]], cameras.width, cameras.height)


def draw(gaussians: Gaussians, sets: list[Cameras]) -> list[np.ndarray]:
    """Render all views of all sets of cameras."""
    return [image for cameras in sets for image in gsmerge.render(gaussians, cameras).images.clip(0, 1)]


def compare(images: list[np.ndarray], expected: list[np.ndarray], perceptual: bool) -> np.ndarray:
    """PSNR, SSIM and, if asked for, LPIPS of each view, ``[views,measures]``."""
    pairs = zip(images, expected, strict=True)
    return np.array([[psnr(a, b), ssim(a, b), *([lpips(a, b, "vgg")] if perceptual else [])] for a, b in pairs])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scenes", help="train, eval, or names with commas between")
    parser.add_argument("--folder", type=Path, default=Path(), help="has the scenes of trained_scenes.py")
    parser.add_argument("--shares", nargs="*", default=["1", "2", "4.4", "10", "20"], help="percent")
    parser.add_argument("--cameras", action="store_true", help="give ours the cameras")
    parser.add_argument("--ours-only", action="store_true")
    parser.add_argument("--lpips", action="store_true")
    args = parser.parse_args()
    for folder in scene_folders(args.scenes):
        path = args.folder / f"{folder.name}.ply"
        source, seen = read_ply(path, opacity="logit").gaussians, gsmerge.read_scene(path)
        sets = [read_held_out(folder).cameras, cameras_between(seen.cameras, BETWEEN)]
        expected, bare = draw(source, sets), Scene(source, seen.cameras[:0], None, None, ())
        for share in args.shares:
            start, count = time.process_time(), round(len(source) * float(share) / 100)
            made = gsmerge.compact(seen if args.cameras else bare, budget=count).gaussians
            seconds = time.process_time() - start
            results = {"ours": compare(draw(made, sets), expected, args.lpips)}
            target = args.folder / "theirs" / f"{folder.name}-{share}.ply"
            if not args.ours_only:
                target.parent.mkdir(exist_ok=True)
                if not target.exists():
                    call = [find_program(), "-q", "-g", "cpu", str(path), "-d", str(count), str(target)]
                    subprocess.run(call, check=True)
                theirs = draw(read_ply(target, opacity="logit").gaussians, sets)
                results["theirs"] = compare(theirs, expected, args.lpips)
            for name, values in results.items():
                worst = values[values[:, 0].argmin()]
                print(folder.name, share, name, *np.round(values.mean(0), 3), "worst", *np.round(worst, 3))
            if "theirs" in results:
                gains = results["ours"] - results["theirs"]
                print(folder.name, share, "least", *np.round(gains[gains[:, 0].argmin()], 3))
            print(folder.name, share, f"{seconds:.1f} s of ours", flush=True)


if __name__ == "__main__":
    main()
