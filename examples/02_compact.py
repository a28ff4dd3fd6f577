"""Compact a scene from Python.

python examples/02_compact.py demo/scene.ply demo/small.ply --k 2
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gsmerge


def compact_scene(scene: Path, output: Path, k: int) -> gsmerge.CompactReport:
    """Read a scene, compact it with K = ``k``, write the result, and return the report of the run."""
    result = gsmerge.compact(gsmerge.read_scene(scene), k=k)
    gsmerge.write_ply(output, result.gaussians, overwrite=True)
    return result.report


def main() -> None:
    """Parse the command line and compact."""
    parser = argparse.ArgumentParser(description="Compact a scene from Python.")
    parser.add_argument("scene", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--k", type=int, default=1)
    args = parser.parse_args()
    report = compact_scene(args.scene, args.output, args.k)
    print(f"{report.num_input} -> {report.num_output} Gaussians in {sum(report.seconds.values()):.1f} s")
    if report.psnr_before is not None and report.psnr_after is not None:
        print(f"input views {report.psnr_before:.2f} -> {report.psnr_after:.2f} dB")


if __name__ == "__main__":
    main()
