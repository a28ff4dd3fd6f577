"""Makes docs/images/preview.jpg: the picture of the README's first commands, of one view and from outside, as a JPEG.

python tools/make_preview.py
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2

ROOT = Path(__file__).parents[1]
QUALITY = 90  # of the JPEG, in percent


def main() -> None:
    """Make the scene, compact it, draw it, and write the picture."""
    with TemporaryDirectory() as folder:
        scene, gsmerge = Path(folder) / "demo", ("-m", "gsmerge")
        plys, png = (scene / "scene.ply", scene / "scene.compact.ply"), scene / "preview.png"
        for call in (
            (ROOT / "examples" / "01_make_scene.py", scene),
            (*gsmerge, "compact", scene, "--k", 2),
            (*gsmerge, "render", *plys, "--views", 1, "-o", png),
        ):
            subprocess.run([sys.executable, *map(str, call)], cwd=ROOT, check=True)
        picture = ROOT / "docs" / "images" / "preview.jpg"
        cv2.imwrite(str(picture), cv2.imread(str(png)), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    print(picture)


if __name__ == "__main__":
    main()
