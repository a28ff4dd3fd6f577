"""Views in files of their own, joined: how far poses are off, and held-out views against those of true poses.

python benchmarks/joined.py lund_door,flower,sceaux,desk
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from quality import score
from shared_scenes import Targets, export, read_held_out, scene_folders

import gsmerge
from gsmerge.alignment.registration.join import join_scenes
from gsmerge.facts.views import subset
from gsmerge.geometry import camera_centres, multiply_quats, rotmat_to_quat
from gsmerge.types import Cameras

LOW, HIGH = 0.8, 1.25  # by which the unit of each file is multiplied


def split_views(scene: gsmerge.Scene) -> list[gsmerge.Scene]:
    """Every view as a scene of its own, in its camera's frame and a unit of its own."""
    rng = np.random.default_rng(3)
    parts = []
    for view, viewmat in enumerate(scene.cameras.viewmats):
        one = subset(scene, [view])
        scale = np.exp(rng.uniform(np.log(LOW), np.log(HIGH)))
        turn = viewmat[:3, :3]
        g = one.gaussians
        own = replace(
            g,
            means=(scale * (g.means @ turn.T + viewmat[:3, 3])).astype(np.float32),
            quats=multiply_quats(rotmat_to_quat(turn[None])[0], g.quats).astype(np.float32),
            scales=(scale * g.scales).astype(np.float32),
        )
        cameras = replace(one.cameras, viewmats=np.eye(4)[None])
        parts.append(replace(one, gaussians=own, cameras=cameras))
    return parts


def fit_frame(true: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """The rotation, scale and shift from the world of true poses ``[c,4,4]`` to that of the found."""
    u, _, v = np.linalg.svd((found[:, :3, :3].swapaxes(1, 2) @ true[:, :3, :3]).sum(0))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    centres = camera_centres(true) @ rotation.T
    a = centres - centres.mean(0)
    b = camera_centres(found) - camera_centres(found).mean(0)
    scale = float((a * b).sum() / (a * a).sum())
    return rotation, scale, camera_centres(found).mean(0) - scale * centres.mean(0)


def move_cameras(cameras: Cameras, frame: tuple[np.ndarray, float, np.ndarray]) -> Cameras:
    """The cameras in the world of the found poses."""
    rotation, scale, shift = frame
    viewmats = cameras.viewmats.copy()
    viewmats[:, :3, :3] = viewmats[:, :3, :3] @ rotation.T
    viewmats[:, :3, 3] = scale * viewmats[:, :3, 3] - viewmats[:, :3, :3] @ shift
    return replace(cameras, viewmats=viewmats)


def largest_errors(true: np.ndarray, found: np.ndarray) -> tuple[float, float]:
    """The most degrees that a pose is off, and the largest error of a centre, share of the path's radius."""
    frame = fit_frame(true, found)
    moved = move_cameras(Cameras(true, np.tile(np.eye(3), (len(true), 1, 1)), 1, 1), frame).viewmats
    chords = np.linalg.norm(moved[:, :3, :3] - found[:, :3, :3], axis=(1, 2)) / np.sqrt(8)
    centres = camera_centres(found)
    off = np.linalg.norm(camera_centres(moved) - centres, axis=1)
    radius = np.linalg.norm(centres - centres.mean(0), axis=1).max()
    return float(np.degrees(2 * np.arcsin(chords)).max()), float(off.max() / radius)


def measure(folder: Path, cache: Path, threads: int) -> str:
    """One row of the table."""
    scene = gsmerge.read_scene(export(folder, cache))
    joined = join_scenes(split_views(scene), [Path(f"{name}.ply") for name in scene.names])
    true = scene.cameras.viewmats[list(joined.used)]
    targets: Targets = read_held_out(folder)
    frame = fit_frame(true, joined.scene.cameras.viewmats)
    there = replace(targets, cameras=move_cameras(targets.cameras, frame))
    degrees, shift = largest_errors(true, joined.scene.cameras.viewmats)
    found = gsmerge.compact(joined.scene, threads=threads).gaussians
    best = gsmerge.compact(scene, threads=threads).gaussians
    return (
        f"| {folder.name} | {len(joined.used)} of {len(scene)} | {degrees:.2f} | {100 * shift:.1f} %"
        f" | {score(scene.gaussians, targets)[0]:.1f} | {score(found, there)[0]:.1f} | {score(best, targets)[0]:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="?", default="lund_door,flower,sceaux,desk")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    folders = scene_folders(args.scenes)
    print("| scene | files joined | degrees off | centre off | input | joined | true poses |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as cache:
        for folder in folders:
            print(measure(folder, Path(cache), args.threads), flush=True)


if __name__ == "__main__":
    main()
