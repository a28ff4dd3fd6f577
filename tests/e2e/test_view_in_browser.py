"""The page of ``gsmerge view`` in a real browser: stills, 3D as our own renderer draws it, jumps, the swipe."""

from __future__ import annotations

import base64
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

import gsmerge
from gsmerge.geometry import middle_depth, rotmat_to_quat
from gsmerge.measure.camera_path import outside_camera
from gsmerge.measure.evaluate import near_plane
from gsmerge.raster.metrics import psnr

from .browser import CHROMIUM, Browser, browser

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium installed")
SIZE = WIDTH, HEIGHT = 192, 128
PATIENCE = 120.0  # seconds: 3D on a processor that other tests use as well
SETTLED = "state.solid === '1' && stage.getAttribute('aria-busy') === 'false'"
# The picture alone, one pixel of the photo for one of the screen
BARE = (
    "for (const one of document.querySelectorAll('.handle, .tag, .back')) one.style.display = 'none';"
    f"stage.style.borderRadius = 0; stage.style.width = '{WIDTH}px'; stage.style.margin = 0; scrollTo(0, 0);"
)


@pytest.fixture(scope="module")
def opened(make_scene: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Browser, Any]]:
    from gsmerge.cli import main

    folder = tmp_path_factory.mktemp("view")
    scene = make_scene(folder / "room", num_views=3, width=WIDTH, height=HEIGHT)
    small, page = scene / "small<b>.ply", folder / "page.html"
    assert main(["compact", str(scene), "-o", str(small), "--effort", "draft", "-q"]) == 0
    results = [gsmerge.read_ply(small).gaussians]
    results += [with_one_from_outside(results[0], gsmerge.read_scene(scene).cameras[[0]])]
    gsmerge.write_ply(wide := scene / "wide.ply", results[1])
    targets = ["--targets", str(scene / "targets")]
    assert main(["view", str(scene), str(small), str(wide), *targets, "-o", str(page), "--no-open", "-q"]) == 0
    with browser(CHROMIUM, folder / "profile", "--enable-unsafe-swiftshader") as tab:
        tab.open(page)
        wait(tab, "solid !== null")
        tab.run("clearInterval(blinking); set('solid', '1')")
        wait(tab, SETTLED)
        yield tab, (gsmerge.read_scene(scene), *results)


def with_one_from_outside(gaussians: gsmerge.Gaussians, camera: gsmerge.Cameras) -> gsmerge.Gaussians:
    """With a long Gaussian that reaches into the camera's picture from three half pictures to its right."""
    rotation, shift = camera.viewmats[0, :3, :3], camera.viewmats[0, :3, 3]
    depth = 0.5 * middle_depth(gaussians.means, camera)
    side = depth * WIDTH / 2 / camera.Ks[0, 0, 0]  # of half a picture
    place = rotation.T @ ((3 * side, 0, depth) - shift)
    new = {"means": place, "scales": (2 * side, side / 2, side / 2), "quats": rotmat_to_quat(rotation.T[None])[0]}
    new |= {"opacities": 0.7, "sh0": [(1.5, -1.0, -1.0)], "shN": 0 * gaussians.shN[0]}
    columns = {name: np.asarray(value, np.float32)[None] for name, value in new.items()}
    return replace(gaussians, **{name: np.concatenate([getattr(gaussians, name), c]) for name, c in columns.items()})


def wait(tab: Browser, condition: str) -> None:
    end = time.monotonic() + PATIENCE
    while not tab.run(condition):
        assert time.monotonic() < end, tab.run("id('status').textContent")
        time.sleep(0.05)


def picture(tab: Browser) -> np.ndarray:
    """``[h,w,3]`` what the stage shows, in [0, 1], once it is the same twice: a busy browser is late."""
    wait(tab, f"({SETTLED}) || state.solid === '' && [...document.images].every(image => image.complete)")
    data = None
    for _ in range(100):
        tab.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        before, box = data, tab.run("JSON.parse(JSON.stringify(stage.getBoundingClientRect()))")
        clip = {"x": box["x"], "y": box["y"], "width": WIDTH, "height": HEIGHT, "scale": 1}
        data = tab.call("Page.captureScreenshot", format="png", clip=clip)["data"]
        if data == before:
            break
    assert data == before, "the picture changes all the time"
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    return np.asarray(image[..., ::-1], np.float32) / 255


def test_3d_is_what_we_render_at_every_input_view(opened: tuple[Browser, Any]) -> None:
    tab, (scene, small, _) = opened
    tab.run(f"{BARE} set('mode', 'blink'); set('pixels', 'photo')")
    inputs = tab.run(
        "data.views.map((view, i) => [view.held_out || view.outside, view.name, i]).filter(one => !one[0])"
    )
    assert len(inputs) == 3
    for _, name, index in inputs:
        view = next(i for i, path in enumerate(scene.names) if path.endswith(f"{name}.png"))
        tab.run(f"jump({index})")
        for other, gaussians in (("false", scene.gaussians), ("true", small)):
            drawn = gsmerge.render(gaussians, scene.cameras[[view]], near=near_plane(scene)).images[0].clip(0, 1)
            for solid, least in (("'1'", 30), ("''", 35)):  # as the browser draws it, and the still
                tab.run(f"set('solid', {solid}); set('other', {other})")
                assert psnr(picture(tab), drawn) > least
    assert tab.run("state.atCamera") is True


def test_a_gaussian_reaches_in_from_outside(opened: tuple[Browser, Any]) -> None:
    tab, (scene, small, wide) = opened
    tab.run(f"{BARE} set('mode', 'blink'); set('pixels', 'photo'); set('solid', '1'); set('other', false)")
    name = scene.names[0].rpartition("/")[2].removesuffix(".png")
    tab.run(f"jump(data.views.findIndex(view => view.name === '{name}' && !view.held_out))")
    drawn = [
        gsmerge.render(one, scene.cameras[[0]], near=near_plane(scene)).images[0].clip(0, 1) for one in (small, wide)
    ]
    assert psnr(*drawn) < 25
    tab.run("set('left', state.right + 1)")
    wait(tab, "solid.has(state.left)")
    assert psnr(picture(tab), drawn[1]) > 30
    tab.run("set('left', state.right - 1)")


def test_leaving_a_camera_and_coming_back(opened: tuple[Browser, Any]) -> None:
    tab, _ = opened
    tab.run(f"{BARE} set('mode', 'blink'); set('solid', '1'); jump(0)")
    there = picture(tab)
    tab.run("solid.orbit(0.3, 0.1); solid.dolly(1.2)")
    wait(tab, "state.atCamera === false && id('back').hidden === false")
    assert psnr(picture(tab), there) < 30
    tab.run("id('back').click()")
    assert psnr(picture(tab), there) > 45


def test_step_back_shows_the_side_without_photos(opened: tuple[Browser, Any]) -> None:
    tab, (scene, small, _) = opened
    tab.run(f"{BARE} set('mode', 'blink'); set('pixels', 'photo'); jump(0); id('outside').click()")
    there = tab.run("[view().name, view().held_out, state.atCamera, id('scores').rows.length]")
    assert there == ["step back", False, True, 0]
    camera, _ = outside_camera(scene.cameras, scene.gaussians.means)
    for other, gaussians in (("false", scene.gaussians), ("true", small)):
        drawn = gsmerge.render(gaussians, camera, near=near_plane(scene)).images[0].clip(0, 1)
        for solid, least in (("'1'", 28), ("''", 33)):
            tab.run(f"set('solid', {solid}); set('other', {other})")
            assert psnr(picture(tab), drawn) > least
    for solid in ("''", "'1'"):
        tab.run(f"set('solid', {solid}); set('other', false); set('left', 0)")
        assert tab.run("[id('left').hidden, id('message').textContent]") == [True, "photo: at the photos' cameras only"]
        assert tab.run("id('overlay-share').title") == "No photo is outside"
    tab.run("set('left', 1)")
    tab.press("ArrowUp", 38)
    assert tab.run("view().outside") is False
    tab.press("b", 66)
    assert tab.run("view().outside") is True


def test_swipe_shows_each_on_its_side(opened: tuple[Browser, Any]) -> None:
    tab, _ = opened
    tab.run(f"{BARE} jump(0); set('solid', ''); set('other', false); set('mode', 'blink')")
    left = picture(tab)
    tab.run("set('other', true)")
    right = picture(tab)
    for solid in ("''", "'1'"):
        tab.run(f"set('solid', {solid}); set('mode', 'swipe'); swipeTo(0.25)")
        both, cut = picture(tab), WIDTH // 4
        assert psnr(both[:, : cut - 2], left[:, : cut - 2]) > 30
        assert psnr(both[:, cut + 2 :], right[:, cut + 2 :]) > 30
        assert psnr(both[:, cut + 2 :], left[:, cut + 2 :]) < 30


def test_a_difference_of_a_scene_with_itself_is_black(opened: tuple[Browser, Any]) -> None:
    tab, _ = opened
    tab.run(f"{BARE} jump(0); set('mode', 'difference'); set('pixels', 'photo')")
    for solid in ("''", "'1'"):
        tab.run(f"set('solid', {solid})")
        assert picture(tab).mean() > 0.02
        tab.run("set('left', state.right)")
        assert picture(tab).mean() < 0.005
        tab.run("set('left', state.right - 1)")


def test_keys(opened: tuple[Browser, Any]) -> None:
    tab, _ = opened
    tab.run("jump(0); set('solid', ''); set('mode', 'swipe'); swipeTo(0.5)")
    for key, code in (("ArrowLeft", 37), ("ArrowDown", 40), ("2", 50), ("s", 83)):
        tab.press(key, code)
    assert tab.run("[state.at, state.view, state.mode, state.solid]") == [0.48, 1, "side", "1"]
    assert tab.run("[...id('strip').children].filter(one => one.ariaCurrent === 'true').length") == 1


def test_outlines_of_superpixels(opened: tuple[Browser, Any]) -> None:
    """Lines that are a little off the photo's colours, on stills and in 3D, from the cameras of input photos."""
    tab, _ = opened
    tab.run(f"{BARE} set('mode', 'blink'); set('other', false); jump(data.views.findIndex(view => !view.held_out))")
    for solid in ("''", "'1'"):
        tab.run(f"set('solid', {solid})")
        plain = picture(tab)
        tab.press("o", 79)
        lines = np.abs(picture(tab) - plain)
        assert 0.01 < lines.mean() < 0.15
        assert tab.run("document.querySelector('[data-set=outlines][data-value=\"1\"]').ariaPressed") == "true"
        tab.run("jump(data.views.findIndex(view => view.held_out))")
        assert tab.run("id('outlines').hidden") is True
        tab.press("o", 79)
        tab.run("jump(data.views.findIndex(view => !view.held_out))")
        assert psnr(picture(tab), plain) > 45


def test_it_opens_on_the_middle_view(opened: tuple[Browser, Any]) -> None:
    tab, _ = opened
    views, start = tab.run("data.views.slice(0, -1).map(view => view.scores[1][0])"), tab.run("data.start")
    assert views == sorted(views)
    assert start == (len(views) - 1) // 2


def test_grey_controls_say_why(opened: tuple[Browser, Any]) -> None:
    tab, _ = opened
    tab.run("jump(data.views.findIndex(view => view.held_out)); set('solid', '')")
    grey = "[...document.querySelectorAll('button:disabled')].filter(one => one.checkVisibility())"
    assert tab.run(f"{grey}.length") >= 11
    assert tab.run(f"{grey}.every(one => one.title.length > 5)")
    assert tab.run("document.querySelector('[data-set=outlines]').title") == "Held-out photos have no superpixels"
    assert tab.run("document.querySelector('[data-set=shape]').title") == "In 3D only"
    tab.run("set('solid', '1')")
    assert tab.run("[...document.querySelectorAll('button:enabled')].every(one => one.title === '')")


def test_full_screen(opened: tuple[Browser, Any]) -> None:
    tab, _ = opened
    for words in ("Leave full screen", "Full screen"):
        tab.press("f", 70)
        wait(tab, f"id('full').textContent === '{words}'")
        assert tab.run("document.fullscreenElement !== null") == (words != "Full screen")
        wait(tab, "stage.getBoundingClientRect().bottom <= innerHeight + scrollY")


def test_an_upright_photo_takes_the_height_of_the_window(opened: tuple[Browser, Any]) -> None:
    tab, _ = opened
    tab.call("Emulation.setDeviceMetricsOverride", width=1440, height=900, deviceScaleFactor=1, mobile=False)
    tab.run("set('mode', 'swipe'); stage.style.width = ''; [view().width, view().height] = [128, 192]; show()")
    wait(tab, "stage.getBoundingClientRect().height > 0.7 * 900")
    tab.run("[view().width, view().height] = [192, 128]; show()")
    wait(tab, "stage.getBoundingClientRect().height < 0.63 * 900")
    tab.call("Emulation.clearDeviceMetricsOverride")


def test_it_fits_a_phone(opened: tuple[Browser, Any]) -> None:
    tab, _ = opened
    tab.call("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True)
    for mode in ("swipe", "side"):
        tab.run(f"set('mode', '{mode}')")
        assert tab.run("document.documentElement.scrollWidth") == 390
    assert tab.run("id('strip').scrollWidth > id('strip').clientWidth")
    tab.call("Emulation.clearDeviceMetricsOverride")


def test_nothing_is_fetched_and_nothing_complains(opened: tuple[Browser, Any]) -> None:
    """After all that the others did."""
    tab, _ = opened
    assert [url[:60] for url in tab.requests() if not url.startswith(("file:", "data:", "blob:"))] == []
    assert [url for url in tab.requests() if url.startswith("file:")][1:] == []
    assert [one for one in tab.complaints() if '"level": "warning"' not in one] == []  # of the driver, about its speed
    assert [event for event in tab.events if event.get("method") == "Runtime.consoleAPICalled"] == []
    assert tab.run("document.querySelectorAll('b b, select b').length") == 0
    assert tab.run("id('right-tag').textContent").endswith(".ply")
