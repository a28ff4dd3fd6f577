"""Write a scene as training for minutes leaves it: many Gaussians of degree 3 that belong to no pixels.

python benchmarks/trained_scenes.py SCENE OUT.ply --count 1000000

At most half of the Gaussians of a SCENE with photos are fitted to the photos, split along their longest axis until
there are enough, stretched, and given harmonics of degree 3; faint copies and floaters are added, as trained scenes
have them. The cameras are written beside OUT.ply, the photos are not. A seed gives the same bytes every time.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import gsmerge
from gsmerge.geometry import quat_to_rotmat
from gsmerge.io import write_gaussians
from gsmerge.io.cameras.viewer_cameras import viewer_cameras
from gsmerge.types import Cameras, Gaussians

FITTED = 0.5  # share of the input's Gaussians that is fitted at most; the others come by splitting
FAINT, FLOATERS = 0.2, 0.002  # shares of faint copies beside the others, and of faint ones in front of the cameras
GLOSS, NOISE = 0.12, 0.015  # harmonics of a highlight, and of single Gaussians at degree 1
STRETCH = 0.25  # standard deviation of the logarithm of a side


def train_like(scene: gsmerge.Scene, count: int, seed: int, effort: str) -> Gaussians:
    """Make ``count`` Gaussians of degree 3 that show the scene's photos about as training would."""
    rng = np.random.default_rng(seed)
    num_faint, num_floaters = int(FAINT * count), int(FLOATERS * count)
    solid = count - num_faint - num_floaters
    wanted = min(solid, int(FITTED * scene.num_gaussians))
    made = gsmerge.compact(scene, budget=wanted, effort=effort, seed=seed, threads=2).gaussians.numpy()
    while len(made) < solid:
        made = split_longest(made, min(solid - len(made), len(made)))
    sides = np.exp(rng.normal(0, STRETCH, made.scales.shape))
    sides /= np.cbrt(sides.prod(1, keepdims=True))
    made = replace(made, scales=(made.scales * sides).astype(np.float32), shN=harmonics(made, rng))
    faint = made[rng.integers(0, len(made), num_faint)]
    faint = replace(
        faint,
        means=(faint.means + faint.scales * rng.normal(0, 1, faint.means.shape)).astype(np.float32),
        opacities=rng.uniform(0.005, 0.1, num_faint).astype(np.float32),
    )
    return Gaussians.concat([made, faint, floaters(made, scene.cameras, num_floaters, rng)])


def split_longest(gaussians: Gaussians, extra: int) -> Gaussians:
    """Split the ``extra`` Gaussians with the longest axis into two halves along it."""
    order = np.argsort(-gaussians.scales.max(1), kind="stable")
    parents, others = gaussians[order[:extra]], gaussians[order[extra:]]
    axis = parents.scales.argmax(1)
    rows = np.arange(extra)
    length = parents.scales[rows, axis]
    along = quat_to_rotmat(parents.quats.astype(np.float64))[rows, :, axis] * (0.6 * length)[:, None]
    scales = parents.scales.copy()
    scales[rows, axis] = 0.65 * length
    halves = [
        replace(parents, means=(parents.means + sign * along).astype(np.float32), scales=scales) for sign in (-1, 1)
    ]
    return Gaussians.concat([others, *halves])


def harmonics(gaussians: Gaussians, rng: np.random.Generator) -> np.ndarray:
    """Return ``shN [n,15,3]``: a highlight that is strong in some places, and noise that falls with the degree."""
    count = len(gaussians)
    centred = (gaussians.means - np.median(gaussians.means, 0)) / gaussians.means.std(0)
    gloss = GLOSS * np.clip(np.sin(2.1 * centred @ [1.0, 0.7, -0.4]), 0, 1) ** 2
    normals = quat_to_rotmat(gaussians.quats.astype(np.float64))[np.arange(count), :, gaussians.scales.argmin(1)]
    first = normals[:, [1, 2, 0]] * [-1, 1, -1]  # of degree 1, in the order of harmonics
    degree = np.repeat([1, 2, 3], [3, 5, 7])
    shN = rng.normal(0, NOISE, (count, 15, 3)) / degree[:, None]
    shN[:, :3] += (gloss[:, None] * first)[..., None]
    shN[:, 3:] += (gloss[:, None] * rng.normal(0, 0.3, 12) / degree[3:])[..., None]
    return shN.astype(np.float32)


def floaters(gaussians: Gaussians, cameras: Cameras, count: int, rng: np.random.Generator) -> Gaussians:
    """Make large, faint Gaussians between the cameras and what they see."""
    rows = rng.integers(0, len(gaussians), count)
    eyes = cameras.centres[rng.integers(0, len(cameras), count)]
    chosen, share = gaussians[rows], rng.uniform(0.15, 0.9, (count, 1))
    return replace(
        chosen,
        means=(eyes + share * (chosen.means - eyes)).astype(np.float32),
        scales=(chosen.scales * share * rng.uniform(1, 4, (count, 1))).astype(np.float32),
        opacities=rng.uniform(0.01, 0.05, count).astype(np.float32),
    )


def main() -> None:
    """Write the scene that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--effort", default="default")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    scene = gsmerge.read_scene(args.scene)
    made = train_like(scene, args.count, args.seed, args.effort)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_gaussians(args.out, made, overwrite=True)
    written = args.out.read_bytes()
    args.out.write_bytes(written.replace(b"comment opacity: logit\n", b"", 1))  # which gsmerge alone writes
    names = list(scene.names)
    args.out.with_suffix(".cameras.json").write_text(viewer_cameras(scene.cameras, names))
    print(f"{args.out}: {len(made):,} Gaussians of degree {made.sh_degree}, {len(scene)} views")


if __name__ == "__main__":
    import one_line_errors  # noqa: F401

    main()
