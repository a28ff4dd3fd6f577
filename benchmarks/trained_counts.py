"""Compare trained files, which have no photos and cameras, with their results at several counts.

python benchmarks/trained_counts.py biker.ply guitar.ply
python benchmarks/trained_counts.py garden.ply --walk           # a scene that is also seen from inside
python benchmarks/trained_counts.py biker.ply --ours-only

Each cell has the mean PSNR of 16 views from two orbits (and of 8 views inside), with the input as the reference. The
first number is gsmerge's, and the others are those of both modes of splat-transform (on the PATH, or named by
GSMERGE_SPLAT_TRANSFORM). The last column has their processor seconds at 4.4 %.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
from captures import CAPTURES, make_table, run_command

import gsmerge
from gsmerge.io import read_ply
from gsmerge.io.formats.splat_transform import find_program
from gsmerge.method.raster.metrics import psnr
from gsmerge.types import Cameras, Gaussians

# Radii of the orbits in halves of the extent's diagonal, cameras on each orbit, and side of their pictures in pixels
ORBITS, AROUND, SIDE = (1.2, 2.2), 8, 512
WALK = 0.525  # length of the line of cameras inside, in longest sides of the extent
MODES = ("-d", "--decimate-adaptive")  # of splat-transform
SHARES = ("1", "4.4", "10", "20")  # percent


def look(eye: np.ndarray, direction: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the world-to-camera matrix of a camera at ``eye`` that looks in a direction."""
    right = np.cross(direction, up) / np.linalg.norm(np.cross(direction, up))
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(direction, right), direction])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return viewmat


def place_cameras(gaussians: Gaussians, walk: bool) -> Cameras:
    """Place cameras on two circles around the middle and the shortest axis, and on a line inside for a ``walk``."""
    low, high = np.quantile(gaussians.means.astype(np.float64), [0.05, 0.95], axis=0)
    sides, turns = high - low, 2 * np.pi * np.arange(AROUND) / AROUND
    up = np.eye(3)[sides.argmin()]
    level = [np.cos(turn) * np.roll(up, 1) + np.sin(turn) * np.cross(up, np.roll(up, 1)) for turn in turns]
    away = [(side + 0.25 * up) / np.linalg.norm(side + 0.25 * up) for side in level]
    reach = np.linalg.norm(sides) / 2
    viewmats = [look((low + high) / 2 + radii * reach * d, -d, up) for radii in ORBITS for d in away]
    if walk:
        steps = np.outer(np.linspace(-0.5, 0.5, AROUND) * WALK, np.eye(3)[sides.argmax()] * sides.max())
        viewmats += [look(np.median(gaussians.means, 0) + s, d, up) for s, d in zip(steps, level, strict=True)]
    K = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
    return Cameras(np.stack(viewmats), np.repeat(K[None], len(viewmats), 0), SIDE, SIDE)


def measure(path: Path, share: str, *, walk: bool, ours_only: bool) -> tuple[list[float], list[float]]:
    """Make the results at a share; return the PSNR of each against the input, and the processor seconds of each.

    The results are gsmerge's, and those of both modes of splat-transform unless ``ours_only``.
    """
    if not path.is_file():
        raise SystemExit(f"{path}: expected a trained file, found none; {CAPTURES}")
    source = read_ply(path, opacity="logit").gaussians
    cameras, count = place_cameras(source, walk), str(round(len(source) * float(share) / 100))
    start, scene = time.process_time(), gsmerge.Scene(source, cameras[:0], None, None, ())
    results, seconds = [gsmerge.compact(scene, budget=int(count)).gaussians], [time.process_time() - start]
    for mode in () if ours_only else MODES:
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "out.ply"
            spent, _ = run_command([find_program(), "-q", "-g", "cpu", str(path.resolve()), mode, count, str(out)])
            results.append(read_ply(out, opacity="logit").gaussians)
            seconds.append(spent)
    expected, *renders = (gsmerge.render(some, cameras).images.clip(0, 1) for some in (source, *results))
    return [float(np.mean([psnr(a, b) for a, b in zip(images, expected, strict=True)])) for images in renders], seconds


def main() -> None:
    """Print the table of all files and shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--walk", action="store_true", help="also from cameras on a line inside")
    parser.add_argument("--ours-only", action="store_true")
    args = parser.parse_args()
    rows = []
    for path in args.files:
        runs = {share: measure(path, share, walk=args.walk, ours_only=args.ours_only) for share in SHARES}
        cells = [" ".join(f"{value:.1f}" for value in values) for values, _ in runs.values()]
        rows.append((path.stem, *cells, " ".join(f"{value:.2g}" for value in runs["4.4"][1])))
    print(make_table(("file", *(f"{share} %" for share in SHARES), "seconds"), rows))


if __name__ == "__main__":
    main()
