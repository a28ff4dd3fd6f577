"""Flicker and quality of made sequences: each moment by itself, against each from the result before it.

python benchmarks/sequence.py OUT --seeds 3 5 7 9 11 --moments 6

Flicker is the root mean square of the difference of two results' renders, over pixels of held-out views whose photos
hardly differ from one moment to the next. PSNR is that of all held-out views, from the second moment on.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

import gsmerge
from gsmerge.raster.metrics import psnr
from gsmerge.research.generate.folders import generate
from gsmerge.research.generate.synthetic_scene import GenerateOptions
from gsmerge.types import Gaussians

STILL = 0.06  # largest difference of two photos' colours where nothing moves; their noise has a deviation of .004
NEAR = 5  # pixels around what moves, and least width of what stands still


def make_sequence(out: Path, seed: int, moments: int, size: tuple[int, int] = (320, 240), views: int = 8) -> list[Path]:
    """Generate the moments of one scene, a room or a garden."""
    style = ("room", "garden")[seed // 2 % 2]
    options = GenerateOptions(moments=moments, views=(views, views), width=size[0], height=size[1], style=style)
    return [scene.folder for scene in generate(out / f"sequence-{seed}", moments, options, seed=seed)]


def still_pixels(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return a mask ``[v,h,w]`` of pixels of photos ``[v,h,w,3]`` near which nothing moves."""
    square = np.ones((NEAR, NEAR), np.uint8)
    moving = (np.abs(after - before).max(-1) > STILL).astype(np.uint8)
    return np.stack([cv2.dilate(cv2.morphologyEx(mask, cv2.MORPH_CLOSE, square), square) == 0 for mask in moving])


def measure(folders: list[Path], *, chained: bool) -> tuple[float, float, float]:
    """Compact all moments; return the mean PSNR (dB), the flicker, and processor seconds of a moment."""
    scores, flickers, seconds = [], [], []
    earlier: Gaussians | None = None
    before: tuple[np.ndarray, np.ndarray] | None = None
    for folder in folders:
        scene, targets = gsmerge.read_scene(folder), gsmerge.read_cameras(folder / "targets/transforms.json")
        start = time.process_time()
        result = gsmerge.compact(scene, earlier=earlier if chained else None)
        seconds.append(time.process_time() - start)
        earlier = result.gaussians
        paths = [folder / "targets" / name for name in targets.names]
        photos = np.stack([cv2.imread(str(path))[..., ::-1] for path in paths]).astype(np.float32) / 255
        drawn = gsmerge.render(earlier, gsmerge.to_cameras(targets)).images.clip(0, 1)
        scores.append(float(np.mean([psnr(image, photo) for image, photo in zip(drawn, photos, strict=True)])))
        if before is not None:
            still = still_pixels(before[1], photos)
            flickers.append(float(np.sqrt(np.square(drawn - before[0])[still].mean())))
        before = drawn, photos
    return float(np.mean(scores[1:])), float(np.mean(flickers)), float(np.mean(seconds[1:]))


def main() -> None:
    """Print a row for each sequence, and means with their standard errors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[3, 5, 7, 9, 11])
    parser.add_argument("--moments", type=int, default=6)
    args = parser.parse_args()
    print("| seed | PSNR alone | chained | flicker alone | chained | ratio | CPU s alone | chained |")
    print("|---" * 8 + "|")
    rows = []
    for seed in args.seeds:
        folders = make_sequence(args.out, seed, args.moments)
        alone, chained = (measure(folders, chained=is_chained) for is_chained in (False, True))
        psnrs, flickers, seconds = (
            f"{one:.{digits}f} | {other:.{digits}f}"
            for one, other, digits in zip(alone, chained, (2, 4, 1), strict=True)
        )
        rows.append((chained[0] - alone[0], chained[1] / alone[1]))
        print(f"| {seed} | {psnrs} | {flickers} | {rows[-1][1]:.2f} | {seconds} |", flush=True)
    gain, ratio = np.mean(rows, 0)
    errors = np.std(rows, 0) / len(rows) ** 0.5
    print(f"PSNR {gain:+.2f} +- {errors[0]:.2f} dB, flicker x {ratio:.2f} +- {errors[1]:.2f}")


if __name__ == "__main__":
    main()
