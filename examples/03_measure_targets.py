"""Measure scenes on photos that they were not made from.

python examples/03_measure_targets.py demo/targets demo/scene.ply demo/small.ply
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

import gsmerge


def target_psnr(targets: Path, ply: Path) -> float:
    """Return the mean PSNR (dB) of a scene over the target views.

    Args:
        targets: Folder with a camera file and the photos that it names.
        ply: The scene to measure.
    """
    camera_file = gsmerge.read_cameras(targets)
    rendering = gsmerge.render(gsmerge.read_ply(ply).gaussians, gsmerge.to_cameras(camera_file))
    values = []
    for name, image in zip(camera_file.names, rendering.images, strict=True):
        photo = cv2.imread(str(targets / name))
        if photo is None:
            raise SystemExit(f"{targets / name}: cannot be read")
        error = image.clip(0, 1) - photo[..., ::-1] / 255.0
        values.append(-10 * np.log10((error**2).mean()))
    return float(np.mean(values))


def main() -> None:
    """Parse the command line and print one line per scene."""
    parser = argparse.ArgumentParser(description="PSNR of scenes on target photos.")
    parser.add_argument("targets", type=Path)
    parser.add_argument("scenes", type=Path, nargs="+")
    args = parser.parse_args()
    for ply in args.scenes:
        print(f"{ply}: {target_psnr(args.targets, ply):.2f} dB")


if __name__ == "__main__":
    main()
