"""Where a budget is spent: equal superpixels for every view against regions of equal distortion, on real scenes.

    python benchmarks/budget.py train                          # predicted quality only
    python benchmarks/budget.py xuzhy,flower --steps 60        # also held-out views after a fit

``D`` is the distortion in image space as dB; ``tree`` is the CPU time of the merge tree over that of the
segmentation that it starts from; ``auto`` is the count that the knee of the scene's curve gives.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from quality import score
from shared_scenes import export, read_held_out, scene_folders

import gsmerge
from gsmerge.facts.prepare import Frame, canonicalise
from gsmerge.fit import FitJob, FitOptions, fit
from gsmerge.pooling import Members, scene_members
from gsmerge.raster.photos import scene_photos
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.stages import DecodeOptions, SegmentOptions
from gsmerge.stages.decode import decode, split_counts
from gsmerge.stages.encode import encode
from gsmerge.stages.segment import auto_count, cut_tree, pixel_depths, region_tree
from gsmerge.stages.superpixels import segment
from gsmerge.types import Gaussians, Groups, Scene

DENSITY = 0.044
SHARES = (0.005, 0.01, 0.022, 0.044, 0.088)


def cut_evenly(scene: Scene, count: int) -> Groups:
    """The same number of superpixels in every view."""
    assert scene.images is not None
    return segment(scene.images, SegmentOptions(), max(1, count // len(scene)))


def spent(scene: Scene, members: Members, groups: Groups, count: int) -> Gaussians:
    """One Gaussian per region, and more where the regions are fewer than ``count``."""
    features = encode(scene, members, groups)
    extra = max(0, count - len(features))
    return decode(features, members, DecodeOptions(), split_counts(features, members, extra))


def fitted(gaussians: Gaussians, scene: Scene, frame: Frame, steps: int) -> Gaussians:
    photos = scene_photos(scene), scene_photos(scene, 2)
    return frame.leave(fit(gaussians, FitJob(photos, FitOptions(fit="full", fit_steps=steps)))[0])


def show(folder: Path, cache: Path, steps: int) -> None:
    world = gsmerge.read_scene(export(folder, cache))
    targets = read_held_out(folder) if steps else None
    scene, frame = canonicalise(world)
    assert scene.images is not None
    members, depths, total = scene_members(scene), pixel_depths(scene), len(scene.gaussians)
    segment(scene.images[:1], SegmentOptions(), 100)  # compiles
    start = time.process_time()
    fine = cut_evenly(scene, round(DENSITY * total))
    seconds = time.process_time() - start
    region_tree(scene.images[:1], depths[:1], Groups(fine.labels[:1], fine.counts[:1]), scene.valid[:1])
    start = time.process_time()
    tree = region_tree(scene.images, depths, fine, scene.valid)
    ratio = (time.process_time() - start) / seconds
    auto = auto_count(tree)
    print(f"{folder.name}: {total} Gaussians, tree {ratio:.2f}, auto {auto} ({100 * auto / total:.2f} %)", flush=True)
    for share in (*SHARES, auto / total):
        count = max(len(scene), round(share * total))
        ways = {"even": cut_evenly(scene, count), "tree": cut_tree(tree, count)}
        for name, groups in ways.items():
            error = region_tree(scene.images, depths, groups, scene.valid).distortions[0]
            gaussians = spent(scene, members, groups, count)
            line = f"  {100 * share:5.2f} % {name} {len(gaussians):7d} D {-10 * np.log10(error + 1e-12):5.2f} dB"
            line += f", views {min(groups.counts)} to {max(groups.counts)}"
            if targets is not None:
                psnr, ssim = score(fitted(gaussians, scene, frame, steps), targets)
                line += f", held out {psnr:.2f} dB {ssim:.3f}"
            print(line, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", help="train, eval, or names with commas between")
    parser.add_argument("--steps", type=int, default=0, help="steps of the fit; 0: no rendering at all")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    args = parser.parse_args()
    with use_threads(args.threads):
        for folder in scene_folders(args.scenes):
            show(folder, args.cache, args.steps)


if __name__ == "__main__":
    main()
