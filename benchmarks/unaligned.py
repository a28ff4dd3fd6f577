"""Scenes in no order of pixels against the plain export: visible PSNR of held-out views, and the contribution pass.

    python benchmarks/unaligned.py eval                    # defaults
    python benchmarks/unaligned.py carton,flower --set fit=none
    python benchmarks/unaligned.py fox --pass-only         # seconds of processor time, and over those of one rendering

``unaligned`` are the plain export's Gaussians without their order (goal: at most 0.2 dB below it), ``anysplat`` voxels
(goal: at most 0.5 dB below it, and at most 4.4 % of their own number).
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from quality import score, setting
from shared_scenes import export, read_held_out, scene_folders

import gsmerge
from gsmerge import read_scene
from gsmerge.runtime.threads import use_threads
from gsmerge.settings.stages import SegmentOptions
from gsmerge.stages.assign import find_owners
from gsmerge.stages.superpixels import segment


def without_order(scene: gsmerge.Scene) -> gsmerge.Scene:
    """The Gaussians without their order."""
    return gsmerge.Scene(scene.gaussians[scene.valid.reshape(-1)], scene.cameras, scene.images, None, scene.names)


def time_pass(folder: Path, cache: Path, threads: int) -> None:
    """The contribution pass, with its kernels compiled, compared with rendering the same views."""
    scene = gsmerge.read_scene(export(folder, cache))
    assert scene.images is not None
    groups, unaligned = segment(scene.images, SegmentOptions()), without_order(scene)
    times = []
    with use_threads(threads):
        for work in (lambda: find_owners(unaligned, groups), lambda: gsmerge.render(scene.gaussians, scene.cameras)):
            work()
            wall, start = time.perf_counter(), time.process_time()
            work()
            times.append((time.process_time() - start, time.perf_counter() - wall))
    size = f"{len(scene.gaussians)} Gaussians x {len(scene)} views of {scene.cameras.width} x {scene.cameras.height}"
    (own, wall), (drawn, _) = times
    print(
        f"{folder.name}: {size}: {own:.2f} s of processor time, {wall:.2f} s; {own / drawn:.2f} x rendering", flush=True
    )


def compare(folder: Path, cache: Path, settings: dict[str, object]) -> dict[str, float]:
    """PSNR (dB) of the three ways."""
    plain = gsmerge.read_scene(export(folder, cache))
    ways = {
        "plain": plain,
        "unaligned": without_order(plain),
        "anysplat": read_scene(export(folder, cache, "anysplat"), order="none"),
    }
    targets, results = read_held_out(folder), {}
    for name, scene in ways.items():
        result = gsmerge.compact(scene, **settings)
        results[name], similarity = score(result.gaussians, targets)
        share = 100 * len(result.gaussians) / len(scene.gaussians)
        print(
            f"{folder.name:10s} {name:8s} {len(scene.gaussians):8d} -> {len(result.gaussians):6d} ({share:.2f} %)"
            f"  {results[name]:.2f} dB {similarity:.3f}  {results[name] - results['plain']:+.2f} dB"
            f"  pass {result.report.seconds['members']:.1f} s",
            flush=True,
        )
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", help="train, eval, or names with commas between")
    parser.add_argument("--set", nargs="*", default=[], help="settings, as name=value")
    parser.add_argument("--pass-only", action="store_true", help="only the time of the contribution pass")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "gsmerge-benchmarks")
    args = parser.parse_args()
    settings = {k: setting(v) for k, v in (s.split("=") for s in args.set)}
    rows = []
    for folder in scene_folders(args.scenes):
        if args.pass_only:
            time_pass(folder, args.cache, args.threads)
        else:
            rows.append(compare(folder, args.cache, settings))
    for name in ("plain", "unaligned", "anysplat") if rows else ():
        print(f"mean {name:8s} {np.mean([row[name] for row in rows]):.2f} dB")


if __name__ == "__main__":
    main()
