"""Make docs/images/preview.jpg, which shows the README's room before and after, from a held-out camera.

python tools/make_preview.py
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from readme_block import find_block

import gsmerge
from gsmerge.drawing.preview import to_picture
from gsmerge.scoring.sizes import zoom_cameras

ROOT = Path(__file__).parents[1]
VIEW = 2  # index of the held-out camera
ZOOM = 1.5  # factor by which the view is enlarged
GAP, BAND, LETTERS = 8, 44, 24  # gap between the halves, height of the line below them, and size of letters, pixels
QUALITY = 88  # quality of the JPEG, percent


def draw_half(scene: gsmerge.Gaussians, cameras: gsmerge.Cameras, path: Path, word: str) -> np.ndarray:
    """Draw the Gaussians of a file, with a line below that has their number and the file's size; ``[h,w,3]`` uint8."""
    picture = to_picture(gsmerge.render(scene, cameras).images[0])
    half = Image.fromarray(np.pad(picture, ((0, BAND), (0, 0), (0, 0)), constant_values=255))
    text = f"{word}: {len(scene):,} Gaussians, {path.stat().st_size / 1e6:.1f} MB"
    font = ImageFont.load_default(LETTERS)
    ImageDraw.Draw(half).text((half.width / 2, half.height - BAND / 2), text, "black", font, anchor="mm")
    return np.asarray(half)


def main() -> None:
    """Make the scene and compact it by the README's command, draw both, and write the picture."""
    (size,) = re.findall(r"01_make_scene.py demo (.+?) &&", find_block("examples/01_make_scene.py"))
    with TemporaryDirectory() as folder:
        demo = Path(folder) / "demo"
        for call in ((ROOT / "examples" / "01_make_scene.py", demo, *size.split()), ("-m", "gsmerge", "compact", demo)):
            subprocess.run([sys.executable, *map(str, call)], cwd=ROOT, check=True)
        cameras = gsmerge.to_cameras(gsmerge.read_cameras(demo / "targets"))
        files = (demo / "scene.ply", "before"), (demo / "scene.compact.ply", "after")
        halves = [
            draw_half(gsmerge.read_ply(path).gaussians, zoom_cameras(cameras[[VIEW]], ZOOM), path, word)
            for path, word in files
        ]
    gap = np.full((len(halves[0]), GAP, 3), 255, np.uint8)
    picture = ROOT / "docs" / "images" / "preview.jpg"
    cv2.imwrite(str(picture), np.hstack([halves[0], gap, halves[1]])[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    print(picture)


if __name__ == "__main__":
    main()
