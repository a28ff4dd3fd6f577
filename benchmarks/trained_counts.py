"""How like the input trained files stay at several counts, without photos and cameras: ours beside splat-transform.

python benchmarks/trained_counts.py biker.ply guitar.ply
python benchmarks/trained_counts.py garden.ply --walk           # a room: from inside, too
python benchmarks/trained_counts.py biker.ply --ours-only

Each cell has the mean PSNR of 16 views from two orbits (and 8 inside): of ours, and of both modes of splat-transform
(on the PATH, or named by GSMERGE_SPLAT_TRANSFORM). The last column has their processor seconds at 4.4 %.
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
from gsmerge.raster.metrics import psnr
from gsmerge.types import Cameras, Gaussians

ORBITS, AROUND, SIDE = (1.2, 2.2), 8, 512  # radii of half the extent's diagonal; cameras on each; pixels
WALK = 0.525  # of the longest side
MODES = ("-d", "--decimate-adaptive")
SHARES = ("1", "4.4", "10", "20")  # percent


def look(eye: np.ndarray, direction: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The world-to-camera matrix of a camera."""
    right = np.cross(direction, up) / np.linalg.norm(np.cross(direction, up))
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([right, np.cross(direction, right), direction])
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    return viewmat


def place_cameras(gaussians: Gaussians, walk: bool) -> Cameras:
    """Place cameras on two circles about the middle, around the shortest axis, and if asked for on a line inside."""
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
    """PSNR from the input, and processor seconds, of ours and of the other program."""
    if not path.is_file():
        raise SystemExit(f"{path}: expected a trained file, found none; {CAPTURES}")
    source = read_ply(path, opacity="logit").gaussians
    cameras, count = place_cameras(source, walk), str(round(len(source) * float(share) / 100))
    start, bare = time.process_time(), gsmerge.Scene(source, cameras[:0], None, None, ())
    made, seconds = [gsmerge.compact(bare, budget=int(count)).gaussians], [time.process_time() - start]
    for mode in () if ours_only else MODES:
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "out.ply"
            spent, _ = run_command([find_program(), "-q", "-g", "cpu", str(path.resolve()), mode, count, str(out)])
            made.append(read_ply(out, opacity="logit").gaussians)
            seconds.append(spent)
    expected, *images = (gsmerge.render(each, cameras).images.clip(0, 1) for each in (source, *made))
    return [float(np.mean([psnr(a, b) for a, b in zip(each, expected, strict=True)])) for each in images], seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--walk", action="store_true", help="judge from a walk inside, too")
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
