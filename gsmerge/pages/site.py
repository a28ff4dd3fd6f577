"""Write a web site: a page with a viewer, whose camera stays where photos stood, and the ``.sog`` that it shows."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from gsmerge.facts.place_cameras import place_cameras
from gsmerge.facts.views import even_views
from gsmerge.geometry import middle_depth
from gsmerge.io.atomic import AddOutput
from gsmerge.io.formats.arrays import read_new_views
from gsmerge.io.formats.sog import sog_bytes
from gsmerge.io.formats.table import SITE, SITE_SCENE
from gsmerge.measure.camera_path import median_camera
from gsmerge.measure.preview import to_picture
from gsmerge.pages.data import encode_still
from gsmerge.pages.page import ENGINE, camera_numbers, render_template
from gsmerge.raster import render
from gsmerge.types import Cameras, Gaussians

# Its own files and scripts alone; Spark has data: addresses and a worker in its text
POLICY = (
    "default-src 'none'; img-src 'self' data:; style-src {style}; script-src {script} blob: 'wasm-unsafe-eval';"
    " worker-src data: blob:; connect-src 'self' data: blob:"
)
NAMES = {"scene": SITE_SCENE, "engine": "spark-three.bin", "poster": "poster.webp", "licences": "LICENSES.txt"}
MAX_VIEWS = 64  # of which the page knows where they stood
LICENSED = ("spark", "three", "fflate")


def add_site(
    add: AddOutput, path: Path, page: Path, gaussians: Gaussians, cameras: Cameras, title: str, comments: Sequence[str]
) -> list[Path]:
    """Write a web site as part of :func:`gsmerge.io.atomic.atomic_outputs`; ``page`` is the temporary file of ``path``.

    Without cameras some are placed, and one may look from any side. Returns the present paths of all its files.
    """
    contents = site_contents(gaussians, cameras, title, comments)
    written = [page, *(add(path.with_name(name)) for name in NAMES.values())]
    for file, name in zip(written, (SITE.ending, *NAMES.values()), strict=True):
        file.write_bytes(contents[name])
    return written


def site_contents(gaussians: Gaussians, cameras: Cameras, title: str, comments: Sequence[str]) -> dict[str, bytes]:
    """Make the files of a web site, by name."""
    scene, expected = sog_bytes(gaussians, comments), read_new_views(comments)
    is_free = len(cameras) == 0
    shown = place_cameras(gaussians.numpy()) if is_free else cameras.numpy()
    middle = 0 if is_free else median_camera(shown)  # of placed ones the first shows the most
    picture = render(gaussians.numpy(), shown[[middle]]).images[0]
    views = sorted({*even_views(len(shown), min(len(shown), MAX_VIEWS)), middle})
    page = render_template(
        "site.html", policy=POLICY, title=title, count=len(gaussians), size=len(scene), names=NAMES,
        gain=None if expected is None else expected[1] - expected[0],
        download=f"{title}.sog",
        json_data={
            "names": NAMES, "free": is_free, "start": views.index(middle),
            "views": [
                camera_numbers(shown[[view]], middle_depth(gaussians.means, shown[[view]])) for view in views
            ],
        },
    )  # fmt: skip
    vendor = files("gsmerge.pages").joinpath("vendor")
    licences = [f"{name}\n\n{vendor.joinpath(f'LICENSE.{name}').read_text('utf-8')}" for name in LICENSED]
    return {
        SITE.ending: page.encode(),
        NAMES["scene"]: scene,
        NAMES["engine"]: files("gsmerge.pages").joinpath(ENGINE).read_bytes(),
        NAMES["poster"]: encode_still(to_picture(picture)),
        NAMES["licences"]: "\n\n".join(licences).encode(),
    }
