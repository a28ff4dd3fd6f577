"""Views that arrive in batches: a state, and a compact scene of what has come so far.

python examples/05_views_in_batches.py demo/scene.ply demo/so_far.ply --size 2
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gsmerge
from gsmerge.facts.views import subset


def main() -> None:
    """Parse the command line, hand the scene's views over in batches, write what they give."""
    parser = argparse.ArgumentParser(description="Compact the views of a scene batch by batch.")
    parser.add_argument("scene", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--size", type=int, default=2, help="views of a batch")
    args = parser.parse_args()
    scene = gsmerge.read_scene(args.scene)
    compactor = gsmerge.Compactor()
    for first in range(0, len(scene), args.size):
        report = compactor.extend(subset(scene, range(first, min(first + args.size, len(scene)))))
        print(f"{report.num_input} -> {report.num_new} Gaussians: {report.num_gaussians} in all")
    result = compactor.compact(effort="fast")
    gsmerge.write_ply(args.output, result.gaussians, overwrite=True)
    print(f"{scene.num_gaussians} -> {len(result.gaussians)} Gaussians")


if __name__ == "__main__":
    main()
