"""``-o small.html`` writes one file that opens from disk, and from any web server."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, Browser, browser, needs_browser
from shared import make_once, write_small

import gsmerge
from gsmerge.method.raster.metrics import psnr
from gsmerge.scoring.evaluate import near_plane

from .conftest import Run, assert_refused

SETTLED = "typeof site !== 'undefined' && site !== null && stage.getAttribute('aria-busy') === 'false'"
PLACE = "column(site.camera.matrix, 3).toArray()"


QUICK = ("--effort", "draft", "--fit", "none")


def test_compact_writes_one_file_to_send(run: Run, smallest_copy: Path) -> None:
    page = smallest_copy / "made" / "small.html"
    assert_refused(run("compact", smallest_copy, "-o", page, "--levels", "2"), 2, page)
    assert not page.parent.exists()  # levels have none
    document = json.loads(run("compact", smallest_copy, "-o", page, *QUICK, "--json", code=0).out)
    assert [path.name for path in page.parent.iterdir()] == ["small.html"]
    assert document["output"]["bytes"] == page.stat().st_size < 1_100_000


def test_budget_in_bytes_counts_the_viewer_of_a_page(run: Run, smallest_copy: Path) -> None:
    page = smallest_copy / "a.html"
    words = ("compact", smallest_copy, "-o", page, *QUICK, "--set", "fill=true", "--budget")
    run(*words, "930KB", code=0)
    assert 915_000 < page.stat().st_size <= 930_000
    assert_refused(run(*words, "800KB", "--overwrite"), 2, "", "0.89 MB for the viewer", "800.0 kB")
    assert_refused(run(*words, "892KB", "--overwrite"), 2, "", ".html with one Gaussian", "892.0 kB")


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


def make_site(folder: Path) -> None:
    """Write ``one.html`` of the small scene, and the Gaussians that it shows."""
    from gsmerge.cli import main

    folder.mkdir()
    small = make_once("small", write_small)
    assert main(["compact", str(small), "-o", str(folder / "scene.sog"), "--effort", "draft", "-q"]) == 0
    assert main(["convert", str(folder / "scene.sog"), str(folder / "one.html"), "-q"]) == 0


@pytest.fixture(scope="module")
def served() -> Iterator[str]:
    handler = partial(Quiet, directory=str(make_once("site", make_site)))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/one.html"
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Yield a browser with a small window: a processor draws its 3D."""
    flags = "--enable-unsafe-swiftshader", "--window-size=400,300"
    with browser(CHROMIUM, tmp_path_factory.mktemp("profile"), *flags) as opened:
        yield opened


@needs_browser()
def test_page_from_a_server_draws_the_scene_as_render_does(tab: Browser, served: str, small_scene: Path) -> None:
    tab.open(served)
    tab.wait(SETTLED)
    host = served.removesuffix("one.html")
    assert [url for url in tab.requests() if not url.startswith((host, "data:", f"blob:{host}"))] == []
    width, height = tab.run("[data.views[0].width, data.views[0].height]")
    tab.run(f"stage.style.right = stage.style.bottom = 'auto'; stage.style.width = '{width}px'")
    tab.run("document.querySelectorAll('header, footer').forEach((one) => one.remove())")
    tab.run(f"stage.style.height = '{height}px'; const usual = frame; frame = () => ({{...usual(), exact: true}}); 0")
    tab.run("site.frame = frame; site.look(data.start); 0")
    scene = gsmerge.read_scene(small_scene)
    middle = tab.run("data.views[data.start].viewmat")
    view = int(np.abs(scene.cameras.viewmats.reshape(-1, 16) - middle).sum(1).argmin())
    gaussians = gsmerge.read_gaussians(make_once("site", make_site) / "scene.sog").gaussians
    drawn = gsmerge.render(gaussians, scene.cameras[[view]], near=near_plane(scene)).images[0].clip(0, 1)
    tab.wait(SETTLED)
    box = tab.box("stage")
    assert psnr(tab.screenshot(*(box[name] for name in ("x", "y", "width", "height"))), drawn) > 30


@needs_browser()
def test_the_camera_stays_where_photos_stood(tab: Browser, served: str) -> None:
    tab.open(served)
    tab.wait(SETTLED)
    start = tab.run(PLACE)
    beyond = "([along, most]) => column(site.camera.matrix, 3).dot(along) > most + 1e-3 * Math.abs(most)"
    for motion in ("site.orbit(0.3, 0.05)", "site.fly(0, 0, 1)", "site.fly(1, 1, -1)", "site.pan(0.4, 0.4)"):
        tab.run(f"for (let i = 0; i < 15; i++) {motion}; 0")
        assert tab.run(f"site.places.some({beyond})") is False
        assert tab.run(PLACE) != pytest.approx(start)
    tab.run("site.nearer(1e6); 0")
    assert tab.run("[site.lens, MOST_LENS]") == pytest.approx([5, 5])
    tab.run("id('reset').click()")
    assert tab.run(PLACE) == pytest.approx(start)
    assert tab.run("site.lens") == 1


@pytest.mark.slow
@needs_browser()
def test_fingers_turn_and_enlarge_the_scene_on_a_phone(tab: Browser, served: str) -> None:
    tab.open(served)
    tab.call("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True)
    tab.call("Emulation.setTouchEmulationEnabled", enabled=True)
    tab.wait(SETTLED)
    assert tab.run("document.documentElement.scrollWidth") == 390
    heights = tab.run("[...document.querySelectorAll('.plain')].map((one) => one.offsetHeight).filter(Boolean)")
    assert min(heights) >= 44
    start = tab.run(PLACE)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        marks = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
        tab.call("Input.dispatchTouchEvent", type=kind, touchPoints=marks)

    touch("touchStart", (200, 300))
    touch("touchMove", (120, 300))
    touch("touchEnd")
    turned = tab.run(PLACE)
    assert np.linalg.norm(np.subtract(turned, start)) > 1e-3
    before = tab.run("[site.lens / column(site.camera.matrix, 3).distanceTo(site.target)]")[0]
    touch("touchStart", (180, 300), (220, 300))
    touch("touchMove", (120, 300), (280, 300))
    touch("touchEnd")
    assert tab.run("[site.lens / column(site.camera.matrix, 3).distanceTo(site.target)]")[0] > 1.5 * before


@needs_browser()
def test_page_opens_from_disk(tab: Browser) -> None:
    site = make_once("site", make_site)
    before = len(tab.requests())
    tab.open(site / "one.html")
    assert tab.run("[id('canvas').hidden, id('poster').naturalWidth > 0]") == [True, True]
    tab.wait(SETTLED)
    assert tab.run("[id('canvas').hidden, id('poster').hidden, id('save').hidden]") == [False, True, False]
    assert [url for url in tab.requests()[before:] if not url.startswith(("file:", "data:", "blob:"))] == []
    saved = tab.run("fetch(id('save').href).then((answer) => answer.arrayBuffer()).then((bytes) => bytes.byteLength)")
    assert 5_000 < saved < 100_000


@pytest.mark.slow
@needs_browser()
@pytest.mark.parametrize("supported", [True, False])
def test_vr_is_offered_where_the_browser_has_it(supported: bool, tab: Browser) -> None:
    target = tab.call("Target.createTarget", url="about:blank")["targetId"]
    tab.session = tab.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
    session = "requestSession: async () => { throw Error('off'); }"
    xr = f"isSessionSupported: async () => {json.dumps(supported)}, {session}"
    script = f"Object.defineProperty(navigator, 'xr', {{ value: {{ {xr} }} }});"
    tab.call("Page.enable")
    tab.call("Page.addScriptToEvaluateOnNewDocument", source=script)
    tab.call("Page.navigate", url=(make_once("site", make_site) / "one.html").as_uri())
    tab.wait("location.protocol === 'file:' && document.readyState === 'complete'")
    tab.wait(SETTLED)
    assert tab.run("new Promise((end) => setTimeout(() => end(id('headset').hidden)))") is not supported
    if supported:
        tab.run("id('headset').click()")
        tab.wait("id('status').textContent === 'No VR: off'")
