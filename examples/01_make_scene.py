"""Make a small synthetic scene, the way a feed-forward backbone exports one.

    python examples/01_make_scene.py made

A furnished room is photographed from an arc of views, and every pixel becomes one Gaussian with the errors of a
predicted depth (docs/internals/networks.md). `gsmerge lab generate` makes many such scenes. The folder contains:

    scene.ply          one Gaussian per pixel, 17 columns, view-major and row-major
    transforms.json    the cameras (nerfstudio: camera to world, OpenGL axes)
    images/            the photos
    targets/           photos and cameras half-way between the views, to measure on
    generated.json     the settings with which the scene was made
"""

from __future__ import annotations

import argparse
from pathlib import Path

from gsmerge import GsmergeError
from gsmerge.research.generate import GenerateOptions, NoiseOptions, generate_scene

# The scene is like a usual export: colours do not depend on the view, opacities vary, and lengths are in metres.
EXPORT = NoiseOptions(sh_degrees=(0,), constant_opacity=0.0, unit=(1.0, 1.0))


def make_scene(out: str | Path, *, num_views: int = 6, width: int = 240, height: int = 160, seed: int = 2) -> Path:
    """Write the scene folder and return it.

    Args:
        out: Folder of the scene, new or empty. A folder that has the same scene is not changed.
        num_views: Number of views with Gaussians, at least 2. There is one target fewer.
        width: Image width, pixels.
        height: Image height, pixels.
        seed: Seed of the room and of all errors. The same seed gives the same bytes.
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
    try:
        out = make_scene(args.out, num_views=args.views, width=args.width, height=args.height, seed=args.seed)
    except GsmergeError as error:  # for example a folder with other contents
        parser.exit(error.exit_code, f"{error}\n")
    print(f"{out / 'scene.ply'}: {args.views * args.width * args.height} Gaussians, {args.views} views")


if __name__ == "__main__":
    main()
