"""Make the pictures of the README and the guides from the room of the README's demo, which it makes itself.

python tasks.py pictures             # all of docs/images that no benchmark makes, which takes some minutes
python docs/pictures.py view clip    # only these

Each function makes one picture, mostly by the commands that its guide shows. The picture of the page of ``view`` needs
a Chromium on the PATH, as tests of pages do.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import gsmerge
from gsmerge.drawing.preview import to_picture
from gsmerge.method.geometry.views import resize_cameras

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "helpers")]
from browser import CHROMIUM, browser  # noqa: E402 - of the tests

from tasks import ROOM  # noqa: E402 - the demo's folder and options

IMAGES = ROOT / "docs" / "images"
WIDTH, GAP, WHITE = 1200, 6, 255  # width of pictures and gap between their parts, pixels
VIEW = 2  # index of the held-out view that is drawn
CROP = (0.36, 0.76, 0.28, 0.86)  # its detail: first and last column, first and last row, shares of the view
BAND, LETTERS = 40, {2: 22, 4: 15}  # height of a line below a part, and size of its letters by the number of parts
RESULTS = {"1.ply": "1%", "10.ply": "10%"}  # results beside that of the defaults, and their budgets
COUNTS = "budget=0.5%,1%,2%,4.4%,10%,20%"  # of the chart
FRAMES, SHOWN = 12, (1, 6, 8)  # frames of the clip, and those that are shown
WINDOW, SEEN = (1240, 970), 842  # size of the browser's window, and height of what is shown of it, its pixels
SCALE = 0.97  # pixels of the picture for each pixel of the window
QUALITY = {"preview": 88, "how-many": 86, "view": 85}  # of the JPEG, percent; of others 90


def run(folder: Path, *words: str) -> None:
    """Run a command of gsmerge in a folder."""
    subprocess.run([sys.executable, "-m", "gsmerge", *words, "--quiet"], cwd=folder, check=True)


def join(parts: list[np.ndarray]) -> np.ndarray:
    """Put parts side by side, with a white gap between them."""
    return np.hstack([np.pad(part, ((0, 0), (0, GAP), (0, 0)), constant_values=WHITE) for part in parts])[:, :-GAP]


def resize(picture: np.ndarray) -> np.ndarray:
    """Bring a picture to the width of all pictures."""
    size = WIDTH, round(len(picture) * WIDTH / picture.shape[1])
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS))


def draw_scenes(demo: Path, names: dict[str, str], crop: tuple[float, ...] = (0, 1, 0, 1)) -> np.ndarray:
    """Draw a part of a held-out view of several files, with their words, sizes and bytes below; ``[h,w,3]`` uint8."""
    views = gsmerge.to_cameras(gsmerge.read_cameras(demo / "targets"))[[VIEW]]
    left, right, top, bottom = crop
    zoom = (WIDTH - GAP * (len(names) - 1)) / len(names) / (right - left) / views.width
    width, height = round(zoom * views.width), round(zoom * views.height)
    shown = slice(round(top * height), round(bottom * height)), slice(round(left * width), round(right * width))
    parts = []
    for name, words in names.items():
        scene = gsmerge.read_ply(demo / name).gaussians
        picture = to_picture(gsmerge.render(scene, resize_cameras(views, width, height)).images[0])[shown]
        part = Image.fromarray(np.pad(picture, ((0, BAND), (0, 0), (0, 0)), constant_values=WHITE))
        text = f"{words}: {len(scene):,} Gaussians, {(demo / name).stat().st_size / 1e6:.1f} MB"
        place, font = (part.width / 2, part.height - BAND / 2), ImageFont.load_default(LETTERS[len(names)])
        ImageDraw.Draw(part).text(place, text, "black", font, anchor="mm")
        parts.append(np.asarray(part))
    return join(parts)


def draw_counts(demo: Path) -> np.ndarray:
    """Draw a detail of the input and of three results above the chart of quality over the number of Gaussians."""
    names = {"scene.ply": "input", "1.ply": "1 %", "scene.compact.ply": "default", "10.ply": "10 %"}
    run(demo.parent, "lab", "chart", "demo", "-o", "chart", "--targets", "demo/targets", "--grid", COUNTS)
    chart = Image.open(demo.parent / "chart" / "charts" / "quality-ratio.png").convert("RGB")
    return np.vstack([resize(draw_scenes(demo, names, CROP)), resize(np.asarray(chart))])


def draw_panel(demo: Path) -> np.ndarray:
    """Draw the first row of the panel of ``render``: the photo, the scene and the result."""
    run(demo.parent, "render", "demo", "demo/scene.compact.ply", "-o", "panel.png", "--views", "1")
    panel = np.asarray(Image.open(demo.parent / "panel.png").convert("RGB"))
    return resize(panel[: len(panel) // 2])


def draw_clip(demo: Path) -> np.ndarray:
    """Draw three frames of the clip of ``render``, as they follow each other."""
    run(demo.parent, "render", "demo", "demo/scene.compact.ply", "-o", "clip.mp4", "--frames", str(FRAMES))
    film = cv2.VideoCapture(str(demo.parent / "clip.mp4"))
    frames = [film.read()[1][..., ::-1] for _ in range(FRAMES)]
    return resize(join([frames[place] for place in SHOWN]))


def draw_page(demo: Path) -> np.ndarray:
    """Draw the page of ``view`` once 3D is loaded, with its stills."""
    files = [f"demo/{name}" for name in ("scene.compact.ply", *RESULTS)]
    run(demo.parent, "view", "demo", *files, "--targets", "demo/targets", "-o", "page.html", "--no-open")
    flags = "--enable-unsafe-swiftshader", f"--window-size={WINDOW[0]},{WINDOW[1]}"
    with browser(CHROMIUM, demo.parent / "profile", *flags, f"--force-device-scale-factor={SCALE}") as page:
        page.open(demo.parent / "page.html")
        page.wait("solid !== null")
        page.run("set('solid', ''); say(''); swipeTo(0.5)")  # as with a GPU, which nothing is said of
        page.wait("[...document.images].every(image => image.complete)")
        return to_picture(page.screenshot(0, 0, WINDOW[0], SEEN))


PICTURES: dict[str, Callable[[Path], np.ndarray]] = {
    "preview": partial(draw_scenes, names={"scene.ply": "before", "scene.compact.ply": "after"}),
    "how-many": draw_counts,
    "panel": draw_panel,
    "clip": draw_clip,
    "view": draw_page,
}


def main() -> None:
    """Make the room and its results, and write the pictures."""
    with TemporaryDirectory() as folder:
        subprocess.run([sys.executable, str(ROOT / "examples" / "01_make_scene.py"), *ROOM], cwd=folder, check=True)
        run(Path(folder), "compact", "demo")
        for name, budget in RESULTS.items():
            words = "--budget", budget, "--set", "fill=true", "-o", f"demo/{name}"
            run(Path(folder), "compact", "demo", *words)
        for name in sys.argv[1:] or PICTURES:
            picture, path = PICTURES[name](Path(folder) / "demo"), IMAGES / f"{name}.jpg"
            Image.fromarray(picture).save(path, quality=QUALITY.get(name, 90), optimize=True)
            print(f"{path.relative_to(ROOT)}: {picture.shape[1]} x {picture.shape[0]}, {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
