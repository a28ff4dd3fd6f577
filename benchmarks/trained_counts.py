"""How like the input a trained scene stays at several counts: ours beside splat-transform, mean and worst view.

python benchmarks/trained_counts.py fox,fern --folder made      # made/fox.ply and .cameras.json, by trained_scenes.py
python benchmarks/trained_counts.py biker --folder made --orbits    # made/biker.ply, which has neither; --walk: a room
python benchmarks/trained_counts.py biker --folder made --views transforms.json    # cameras of a file

Input and results are rendered at the held-out cameras and at cameras at random between the input's; or on two orbits,
on a walk inside, and at the cameras of a file.
Results of both modes of splat-transform (on the PATH, or named by GSMERGE_SPLAT_TRANSFORM) are kept in the folder. A
line has the mean of all views, the worst by PSNR, and processor seconds of what was made anew; `least` is what ours has
more than theirs in the view where that is least.
"""

from __future__ import annotations

import argparse
import resource
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
ORBITS, AROUND, SIDE = (1.2, 2.2), 8, 512  # radii of half the extent's diagonal; cameras on each; pixels
WALK = 0.525  # of the longest side
MODES = {"uniform": "-d", "adaptive": "--decimate-adaptive"}


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


def look(eye: np.ndarray, direction: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The world-to-camera matrix of a camera."""
    right = np.cross(direction, up) / np.linalg.norm(np.cross(direction, up))
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(direction, right), direction])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return viewmat


def placed(gaussians: Gaussians, walk: bool) -> list[Cameras]:
    """Place cameras on two circles about the middle, around the shortest axis, and if asked for on a line inside."""
    low, high = np.quantile(gaussians.means.astype(np.float64), [0.05, 0.95], axis=0)
    sides, turns = high - low, 2 * np.pi * np.arange(AROUND) / AROUND
    up = np.eye(3)[sides.argmin()]
    level = [np.cos(turn) * np.roll(up, 1) + np.sin(turn) * np.cross(up, np.roll(up, 1)) for turn in turns]
    away = [(side + 0.25 * up) / np.linalg.norm(side + 0.25 * up) for side in level]
    reach = np.linalg.norm(sides) / 2
    groups = [[look((low + high) / 2 + radii * reach * d, -d, up) for d in away] for radii in ORBITS]
    if walk:
        steps = np.outer(np.linspace(-0.5, 0.5, AROUND) * WALK, np.eye(3)[sides.argmax()] * sides.max())
        groups.append([look(np.median(gaussians.means, 0) + s, d, up) for s, d in zip(steps, level, strict=True)])
    K = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
    return [Cameras(np.stack(group), np.repeat(K[None], AROUND, 0), SIDE, SIDE) for group in groups]


def cameras_of(path: Path) -> list[Cameras]:
    """Read the cameras of a file, each for itself: their sizes differ."""
    file = gsmerge.read_cameras(path)
    sizes = zip(file.widths.tolist(), file.heights.tolist(), strict=True)
    return [Cameras(file.viewmats[[v]], file.Ks[[v]], *size) for v, size in enumerate(sizes)]


def seconds_of(call: list[str]) -> float:
    """Run a command; return its processor seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(call, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


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
    parser.add_argument("--orbits", action="store_true", help="judge from two orbits")
    parser.add_argument("--walk", action="store_true", help="judge from a walk inside, too")
    parser.add_argument("--views", type=Path, help="judge from the cameras of a file, too")
    parser.add_argument("--effort", default="default")
    parser.add_argument("--ours-only", action="store_true")
    parser.add_argument("--lpips", action="store_true")
    args = parser.parse_args()
    bare_files = args.orbits or args.walk or args.views is not None
    for name in args.scenes.split(",") if bare_files else [folder.name for folder in scene_folders(args.scenes)]:
        path = args.folder / f"{name}.ply"
        source, seen = read_ply(path, opacity="logit").gaussians, gsmerge.read_scene(path)
        if bare_files:
            sets = placed(source, args.walk) if args.orbits or args.walk else []
            sets += cameras_of(args.views) if args.views else []
        else:
            sets = [read_held_out(scene_folders(name)[0]).cameras, cameras_between(seen.cameras, BETWEEN)]
        expected, bare = draw(source, sets), Scene(source, seen.cameras[:0], None, None, ())
        for share in args.shares:
            start, count = time.process_time(), round(len(source) * float(share) / 100)
            made = gsmerge.compact(seen if args.cameras else bare, budget=count, effort=args.effort).gaussians
            seconds = {"ours": time.process_time() - start}
            results = {"ours": compare(draw(made, sets), expected, args.lpips)}
            for mode, option in {} if args.ours_only else MODES.items():
                target = args.folder / "theirs" / f"{name}-{share}-{mode}.ply"
                target.parent.mkdir(exist_ok=True)
                if not target.exists():
                    call = [find_program(), "-q", "-g", "cpu", str(path), option, str(count), str(target)]
                    seconds[mode] = seconds_of(call)
                theirs = draw(read_ply(target, opacity="logit").gaussians, sets)
                results[mode] = compare(theirs, expected, args.lpips)
            for way, values in results.items():
                worst, least = (each[each[:, 0].argmin()] for each in (values, results["ours"] - values))
                line = [name, share, way, *np.round(values.mean(0), 3), "worst", *np.round(worst, 3)]
                line += [] if way == "ours" else ["least", *np.round(least, 3)]
                print(*line, f"{seconds[way]:.1f} s" if way in seconds else "", flush=True)


if __name__ == "__main__":
    main()
