"""What the splits and merges of bass-adaptive are worth: photos in the mean colours of their superpixels.

    python benchmarks/adaptive_superpixels.py [FOLDER ...] [--share 0.044] [--photos 2] [--side 480]

``ratio`` is how many superpixels bass-adaptive ends with over those it starts with: mean, least and most. All methods
are then compared at the number that it ends with in each photo (``at its own number``), and at the number that it
starts with, to which its moves go on (``at the start's``). ``proxy`` is the PSNR of mean colours, ``splat`` that of one
Gaussian for each superpixel, dB, means over the photos; in brackets, the least gain over bass-st in any photo. ``ms``
is processor time for a photo.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "helpers")]

from segmentation_scores import proxy_psnr, splat_psnr  # noqa: E402
from shared_scenes import scene_folders  # noqa: E402

from gsmerge.stages.superpixels import superpixels  # noqa: E402

METHODS = ("bass-adaptive", "bass-st", "rdseg")
ENDINGS = {".jpg", ".jpeg", ".png"}


def read_photos(folder: Path, count: int, side: int) -> list[np.ndarray]:
    """``count`` photos of a folder, evenly spread, ``[h,w,3]`` uint8, the longer side at most ``side`` pixels."""
    paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in ENDINGS)
    chosen = np.unique(np.linspace(0, len(paths) - 1, count + 2)[1:-1].round().astype(int))
    photos = []
    for i in chosen:
        photo = cv2.cvtColor(cv2.imread(str(paths[i])), cv2.COLOR_BGR2RGB)
        scale = min(1.0, side / max(photo.shape[:2]))
        photos.append(cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    return photos


def scores(photo: np.ndarray, labels: np.ndarray, seconds: float) -> list[float]:
    return [proxy_psnr(photo, labels), splat_psnr(photo, labels), 1e3 * seconds]


def measure(photo: np.ndarray, start: int, adapt: float | None) -> tuple[int, list[list[float]]]:
    """The number of superpixels, and PSNR, PSNR of Gaussians and milliseconds of every method."""
    rows, count = [], start
    for method in METHODS:
        begin = time.process_time()
        labels = superpixels(photo, count, method, adapt=adapt)
        rows.append(scores(photo, labels, time.process_time() - begin))
        count = int(labels.max()) + 1
    return count, rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="*", help="folders of photos; none: the captures'")
    parser.add_argument("--share", type=float, action="append", help="superpixels per pixel; repeatable")
    parser.add_argument("--photos", type=int, default=2, help="of each folder")
    parser.add_argument("--side", type=int, default=480, help="longer side that photos are reduced to, pixels")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    folders = options.folders or [scene / "images" for split in ("train", "eval") for scene in scene_folders(split)]
    photos = [photo for folder in folders for photo in read_photos(folder, options.photos, options.side)]
    for method in METHODS:
        superpixels(photos[0], 100, method)  # compiles
    print(f"{len(photos)} photos")
    for share in options.share or (0.02, 0.044, 0.087):
        for adapt in (1.0, None):
            starts = [round(share * photo.shape[0] * photo.shape[1]) for photo in photos]
            counts, rows = zip(*[measure(p, n, adapt) for p, n in zip(photos, starts, strict=True)], strict=True)
            ratio, values = np.divide(counts, starts), np.array(rows)
            where = "at its own number" if adapt else "at the start's"
            print(f"{100 * share:g}% {where}: ratio {ratio.mean():.2f} ({ratio.min():.2f} to {ratio.max():.2f})")
            for i, method in enumerate(METHODS):
                proxy, splat, ms = values[:, i].mean(0)
                least = (values[:, i] - values[:, METHODS.index("bass-st")]).min(0)
                print(
                    f"    {method:13} proxy {proxy:6.2f} ({least[0]:+.2f})  splat {splat:6.2f} ({least[1]:+.2f})"
                    f"  {ms:6.0f} ms",
                    flush=True,
                )


if __name__ == "__main__":
    main()
