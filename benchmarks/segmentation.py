"""Superpixels of six photos: quality and CPU time of every method, as ratios within one run.

    python benchmarks/segmentation.py [--density 5000] [--repeats 3] [--method rdseg] [--scenes desk,beercan]

With ``--scenes`` four photos of each of these captures stand in for the six.

``ms`` is process CPU time for 476 x 476 pixels, best of the repeats, kernels warm. ``/bass-st`` is that time over
the one of ``bass-st``. With the folder of reference material next to the repository (``GSMERGE_SHARED`` or
``../shared``), ``/sketch`` is the time over that of the sketch of the same method kept there.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "helpers")]

import torch  # noqa: E402
from segmentation_scores import DENSITIES, SIDE, count_at, photos, proxy_psnr, shrink, splat_psnr  # noqa: E402
from shared_scenes import scene_folders  # noqa: E402

from gsmerge.stages.superpixels import superpixels  # noqa: E402

RUNS = [
    ("bass-st", "default"),
    ("bass", "default"),
    ("slic", "default"),
    ("rdseg", "fast"),
    ("rdseg", "default"),
    ("rdseg", "best"),
]
PHOTOS_EACH = 4  # of a capture, evenly spread

Method = Callable[[np.ndarray, int], np.ndarray]


def sketches() -> dict[tuple[str, str], Method]:
    """The sketch's methods under our names; empty where the folder or numba is not there."""
    folder = Path(os.environ.get("GSMERGE_SHARED", ROOT.parent / "shared")) / "prototypes"
    if not (folder / "superpixels.py").is_file() or find_spec("numba") is None:
        return {}
    sys.path.append(str(folder))
    import numba
    import superpixels as sketch

    numba.set_num_threads(1)

    def bass_st(image: np.ndarray, count: int) -> np.ndarray:
        density = sketch.density(sketch.saliency(image), count)
        seeds = sketch.seeds_dither(density, 1, count)
        start = sketch.bfs_voronoi(seeds, *image.shape[:2])
        return sketch.bass(image, start, iters=max(1, round((image.shape[0] * image.shape[1] / count) ** 0.5)))

    return {
        ("rdseg", "fast"): lambda image, count: sketch.rdseg(image, count, mult=1.0),
        ("rdseg", "default"): sketch.rdseg,
        ("rdseg", "best"): lambda image, count: sketch.rdseg(image, count, mult=3.0, pre=1),
        ("bass-st", "default"): bass_st,
    }


def cpu_ms(methods: list[Method], image: np.ndarray, count: int, repeats: int) -> list[float]:
    """Best CPU time of each method, milliseconds for 476 x 476 pixels; the methods take turns."""
    best = [np.inf] * len(methods)
    for repeat in range(repeats + 1):
        for i, method in enumerate(methods):
            start = time.process_time()
            method(image, count)
            if repeat > 0:  # the first one compiles and warms up
                best[i] = min(best[i], time.process_time() - start)
    return [1e3 * t * SIDE**2 / (image.shape[0] * image.shape[1]) for t in best]


def captures(names: str) -> dict[str, np.ndarray]:
    """Some photos of each capture, ``[h,w,3]`` uint8, the longer side 476 pixels."""
    found = {}
    for folder in scene_folders(names):
        files = sorted((folder / "images").iterdir())
        for i in range(PHOTOS_EACH):
            path = files[i * (len(files) - 1) // (PHOTOS_EACH - 1)]
            found[f"{folder.name}/{path.name}"] = shrink(cv2.imread(str(path))[..., ::-1])
    return found


def ours(name: str, effort: str) -> Method:
    return lambda image, count: superpixels(image, count, name, effort=effort)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--density", type=int, action="append", help="superpixels per 476 x 476 pixels; repeatable")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--method", action="append", help="of the first column; repeatable, all where left out")
    parser.add_argument("--scenes", help="captures next to the repository, comma-separated")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    pictures, others = captures(options.scenes) if options.scenes else photos(), sketches()
    print(
        f"{'density':>7} {'method':8} {'effort':8} {'proxy':>6} {'splat':>6} {'ms':>7} {'/bass-st':>8} {'/sketch':>8}"
    )
    for density in options.density or DENSITIES:
        reference = None
        for name, effort in RUNS:
            if options.method and name not in options.method:
                continue
            methods = [ours(name, effort), *([others[name, effort]] if (name, effort) in others else [])]
            rows = []
            for image in pictures.values():
                count = count_at(image, density)
                labels = ours(name, effort)(image, count)
                times = cpu_ms(methods, image, count, options.repeats)
                rows.append((proxy_psnr(image, labels), splat_psnr(image, labels), *times))
            proxy, splat, ms, *sketch_ms = np.mean(rows, 0)
            reference = ms if reference is None else reference
            ratio = f"{ms / sketch_ms[0]:8.2f}" if sketch_ms else f"{'-':>8}"
            print(
                f"{density:7d} {name:8} {effort:8} {proxy:6.2f} {splat:6.2f} {ms:7.1f} {ms / reference:8.2f} {ratio}",
                flush=True,
            )


if __name__ == "__main__":
    main()
