"""Write a page that contains a viewer and a ``.sog``; the viewer's camera stays near the viewpoints of the photos."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from gsmerge.drawing.camera_path import median_camera
from gsmerge.drawing.pages.data import encode_still
from gsmerge.drawing.pages.page import VIEWER, base64_text, data_uri, page_camera, render_template
from gsmerge.drawing.preview import to_picture
from gsmerge.drawing.render_views import near_plane
from gsmerge.io.atomic import AddOutput
from gsmerge.io.formats.rows import describe_gain, read_expected_scores
from gsmerge.io.formats.sog import sog_bytes
from gsmerge.io.formats.table import Contents
from gsmerge.method.geometry.transforms import middle_depth
from gsmerge.method.geometry.views import even_views
from gsmerge.method.raster import render
from gsmerge.method.viewpoints.place_cameras import place_viewpoints
from gsmerge.types import Cameras, Gaussians

# Content security policy: only the page's own scripts run. The script of the 3D viewer Spark starts a worker, and loads
# data: addresses that it holds itself
SITE_POLICY = (
    "default-src 'none'; img-src data:; style-src {style}; script-src {script} blob: 'wasm-unsafe-eval';"
    " worker-src data: blob:; connect-src data: blob:"
)
NAMES = {"scene": "scene.sog", "engine": "spark-three.bin", "licences": "LICENSES.txt"}  # of files in the page
MAX_VIEWPOINTS = 64  # largest number of viewpoints in the page
LICENSED = ("spark", "three", "fflate")  # parts of the viewer that have a licence


def write_output(add: AddOutput, path: Path, page: Path, contents: Contents) -> dict[Path, list[Path]]:
    """Write the page of a result.

    The table of formats calls this function as :data:`gsmerge.io.formats.table.WriteOutput`.
    """
    page.write_bytes(make_page(contents.levels[0], contents.cameras, contents.title, contents.comments).encode())
    return {path: [page]}


def least_bytes() -> int:
    """Return the number of bytes that every page has at least, besides its Gaussians."""
    page_bytes = 43_000  # least bytes of scripts, licences, and the picture and textures of one Gaussian
    return int(4 / 3 * VIEWER.stat().st_size) + page_bytes


def measure(gaussians: Gaussians, cameras: Cameras, comments: Sequence[str]) -> int:
    """Return the number of bytes of a page of these Gaussians with the longest possible title."""
    longest_title = 255  # bytes; a title is a file name
    return len(make_page(gaussians, cameras, "x" * longest_title, comments).encode())


def make_page(gaussians: Gaussians, cameras: Cameras, title: str, comments: Sequence[str]) -> str:
    """Make the HTML of a page. Without cameras, gsmerge places viewpoints, and the user may look from any side."""
    expected = read_expected_scores(comments)
    is_free = len(cameras) == 0
    viewpoints = place_viewpoints(gaussians.numpy()) if is_free else cameras.numpy()
    start = 0 if is_free else median_camera(viewpoints)  # the first of the placed viewpoints is outside the scene
    near = near_plane(gaussians, viewpoints)
    poster = encode_still(to_picture(render(gaussians.numpy(), viewpoints[[start]], near=near).images[0]))
    views = sorted({*even_views(len(viewpoints), min(len(viewpoints), MAX_VIEWPOINTS)), start})
    vendor = resources.files("gsmerge.drawing.pages").joinpath("vendor")
    texts = [f"{name}\n\n{vendor.joinpath(f'LICENSE.{name}').read_text('utf-8')}" for name in LICENSED]
    licences = "\n\n".join(texts).encode()
    files = {"engine": VIEWER.read_bytes(), "scene": sog_bytes(gaussians, Contents([gaussians], comments))}
    return render_template(
        "site.html", policy=SITE_POLICY, title=title, count=len(gaussians), names=NAMES,
        poster=data_uri(poster, "image/webp"), licences=data_uri(licences, "text/plain"),
        inside={NAMES[name]: base64_text(content) for name, content in files.items()},
        gain=None if expected is None else describe_gain(expected.low, expected.high),
        download=f"{title}.sog",
        json_data={
            "names": NAMES, "free": is_free, "start": views.index(start),
            "views": [
                page_camera(viewpoints[[view]], middle_depth(gaussians.means, viewpoints[[view]])) for view in views
            ],
        },
    )  # fmt: skip
