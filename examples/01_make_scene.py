"""Make a small synthetic scene, the way a feed-forward backbone exports one.

    python examples/01_make_scene.py made

A furnished room is photographed from an arc of views, and every pixel becomes one Gaussian with the errors of a
predicted depth (docs: "generator"). `gsmerge lab generate` makes many such scenes. The folder gets

    scene.ply          one Gaussian per pixel, 17 columns, view-major and row-major
    transforms.json    the cameras (nerfstudio: camera to world, OpenGL axes)
    images/            the photos
    targets/           photos and cameras half-way between the views, for measuring
    generated.json     what the scene was made with
"""

from __future__ import annotations

import argparse
from pathlib import Path

from gsmerge.research.generate import GenerateOptions, NoiseOptions, generate_scene

# A usual export: colours without view dependence, opacities that vary, metres.
EXPORT = NoiseOptions(sh_degrees=(0,), constant_opacity=0.0, unit=(1.0, 1.0))


def make_scene(out: str | Path, *, num_views: int = 6, width: int = 240, height: int = 160, seed: int = 2) -> Path:
    """Write the scene folder and return it.

    Args:
        out: Folder of the scene, new or empty; one with the same scene stays.
        num_views: Views with Gaussians, at least 2; the targets are one fewer.
        width: Image width, pixels.
        height: Image height, pixels.
        seed: Seeds the room and every error; the same seed writes the same bytes.
    """
    options = GenerateOptions(views=num_views, width=width, height=height, ranges=EXPORT)
    return generate_scene(Path(out), options, seed=seed)


def main() -> None:
    """Parse the command line and make the scene."""
    parser = argparse.ArgumentParser(description="Make a small synthetic scene with one Gaussian per pixel.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--views", type=int, default=6)
    parser.add_argument("--width", type=int, default=240)
    parser.add_argument("--height", type=int, default=160)
    parser.add_argument("--seed", type=int, default=2)
    args = parser.parse_args()
    out = make_scene(args.out, num_views=args.views, width=args.width, height=args.height, seed=args.seed)
    print(f"{out / 'scene.ply'}: {args.views * args.width * args.height} Gaussians, {args.views} views")


if __name__ == "__main__":
    main()
