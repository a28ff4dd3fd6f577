"""The page of ``gsmerge view`` shows stills, 3D as our own renderer draws it, jumps and the swipe in a browser."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import CHROMIUM, Browser, browser, needs_browser
from shared import make_once, write_scene

import gsmerge
from gsmerge.cli import main
from gsmerge.drawing.camera_path import outside_camera
from gsmerge.method.geometry.transforms import middle_depth, rotmat_to_quat
from gsmerge.method.raster.metrics import psnr
from gsmerge.scoring.evaluate import near_plane

pytestmark = needs_browser()
SIZE = WIDTH, HEIGHT = 72, 48
SETTLED = "state.solid === '1' && stage.getAttribute('aria-busy') === 'false'"
# The picture alone, one pixel of the photo for one of the screen, and 3D draws it
BARE = (
    "delete solid.request;"
    "for (const one of document.querySelectorAll('.handle, .tag, .back')) one.style.display = 'none';"
    f"stage.style.borderRadius = 0; stage.style.width = '{WIDTH}px'; stage.style.margin = 0; scrollTo(0, 0);"
)


# The page as it opened, whatever the test before did; 3D draws nothing, which takes a processor most of a test's time
FRESH = (
    "solid.request = () => {};"
    "for (const one of document.querySelectorAll('.handle, .tag, .back')) one.style.display = '';"
    "for (const name of ['borderRadius', 'width', 'margin']) stage.style[name] = '';"
    "set('scheme', ''); set('order', 'worst');"
    "set('pixels', 'screen'); set('shape', 'splats');"
    "set('solid', ''); set('mode', 'swipe'); set('other', false); pick('left', 1); choose(2); zoomTo(1); swipeTo(0.5);"
    "jump(data.start); document.fullscreenElement && document.exitFullscreen(); scrollTo(0, 0)"
)


def refreshed(page: tuple[Browser, Any]) -> tuple[Browser, Any]:
    """Return the page without what the test before did: tests may run alone, and in any order."""
    tab, _ = page
    tab.call("Emulation.clearDeviceMetricsOverride")
    tab.run(FRESH)
    tab.wait("document.fullscreenElement === null")
    return page


def write_page(folder: Path) -> None:
    """Write ``page.html`` of the scene ``room``, beside it, which takes seconds."""
    scene = write_scene(folder / "room", num_views=3, width=WIDTH, height=HEIGHT)
    small, page = scene / "small<b>.ply", folder / "page.html"
    assert main(["compact", str(scene), "-o", str(small), "--effort", "draft", "-q"]) == 0
    longer = with_one_from_outside(gsmerge.read_ply(small).gaussians, gsmerge.read_scene(scene).cameras[[0]])
    gsmerge.write_ply(wide := scene / "wide.ply", longer)
    targets = ["--targets", str(scene / "targets")]
    assert main(["view", str(scene), str(small), str(wide), *targets, "-o", str(page), "--no-open", "-q"]) == 0


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Browser, Any]]:
    written = make_once("view-page", write_page)
    scene = written / "room"
    results = [gsmerge.read_ply(scene / name).gaussians for name in ("small<b>.ply", "wide.ply")]
    with browser(CHROMIUM, tmp_path_factory.mktemp("view"), "--enable-unsafe-swiftshader") as tab:
        tab.open(written / "page.html")
        tab.wait("solid !== null")
        tab.run("clearInterval(blinking)")
        yield tab, (gsmerge.read_scene(scene), *results)


def with_one_from_outside(gaussians: gsmerge.Gaussians, camera: gsmerge.Cameras) -> gsmerge.Gaussians:
    """Add a long Gaussian that reaches into the camera's picture from three half pictures to its right.

    Another one is far behind the camera, where no view sees it.
    """
    rotation, shift = camera.viewmats[0, :3, :3], camera.viewmats[0, :3, 3]
    depth = 0.5 * middle_depth(gaussians.means, camera)
    side = depth * WIDTH / 2 / camera.Ks[0, 0, 0]  # of half a picture
    place = rotation.T @ ((3 * side, 0, depth) - shift)
    new = {"means": place, "scales": (2 * side, side / 2, side / 2), "quats": rotmat_to_quat(rotation.T[None])[0]}
    new |= {"opacities": 0.7, "sh0": [(1.5, -1.0, -1.0)], "shN": 0 * gaussians.shN[0]}
    behind = new | {"means": rotation.T @ ((0, 0, -20 * depth) - shift), "scales": (side, side, side)}
    columns = {name: np.asarray([new[name], behind[name]], np.float32) for name in new}
    return replace(gaussians, **{name: np.concatenate([getattr(gaussians, name), c]) for name, c in columns.items()})


def picture(tab: Browser) -> np.ndarray:
    """Return what the stage shows ``[h,w,3]``, in [0, 1], once it is the same twice: a busy browser is late."""
    tab.wait(f"({SETTLED}) || state.solid === '' && [...document.images].every(image => image.complete)")
    shown = np.empty(0)
    for _ in range(100):
        tab.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
        before, box = shown, tab.box("stage")
        shown = tab.screenshot(box["x"], box["y"], WIDTH, HEIGHT)
        if np.array_equal(shown, before):
            return shown
    raise AssertionError("the picture changes all the time")


@pytest.mark.parametrize(
    "views", [slice(1), pytest.param(slice(1, None), marks=pytest.mark.slow)], ids=["the first view", "all other views"]
)
def test_3d_shows_every_input_view_as_render_does(views: slice, page: tuple[Browser, Any]) -> None:
    """The browser draws without a GPU."""
    tab, (scene, small, _) = refreshed(page)
    tab.run(f"{BARE} set('mode', 'blink'); set('pixels', 'photo')")
    inputs = tab.run(
        "data.views.map((view, i) => [view.held_out || view.outside, view.name, i]).filter(one => !one[0])"
    )
    assert len(inputs) == 3
    for _, name, index in inputs[views]:
        view = next(i for i, path in enumerate(scene.names) if path.endswith(f"{name}.png"))
        tab.run(f"jump({index})")
        for other, gaussians in (("false", scene.gaussians), ("true", small)):
            drawn = gsmerge.render(gaussians, scene.cameras[[view]], near=near_plane(scene)).images[0].clip(0, 1)
            for solid, least in (("'1'", 30), ("''", 35)):  # as the browser draws it, and the still
                tab.run(f"set('solid', {solid}); set('other', {other})")
                assert psnr(picture(tab), drawn) > least
    assert tab.run("state.atCamera") is True


@pytest.mark.slow
def test_gaussian_reaches_into_the_picture_from_outside(page: tuple[Browser, Any]) -> None:
    tab, (scene, small, wide) = refreshed(page)
    tab.run(f"{BARE} set('mode', 'blink'); set('pixels', 'photo'); set('solid', '1'); set('other', false)")
    name = scene.names[0].rpartition("/")[2].removesuffix(".png")
    tab.run(f"jump(data.views.findIndex(view => view.name === '{name}' && !view.held_out))")
    drawn = [
        gsmerge.render(one, scene.cameras[[0]], near=near_plane(scene)).images[0].clip(0, 1) for one in (small, wide)
    ]
    assert psnr(*drawn) < 25
    tab.run("set('left', state.right + 1)")
    tab.wait("solid.has(state.left)")
    assert psnr(picture(tab), drawn[1]) > 30


@pytest.mark.slow
def test_step_back_shows_the_side_without_photos(page: tuple[Browser, Any]) -> None:
    tab, (scene, small, _) = refreshed(page)
    tab.run(f"{BARE} set('mode', 'blink'); set('pixels', 'photo'); jump(0); zoomTo(6)")
    tab.press("b")
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
        shown = tab.run("[id('left-tag').textContent, id('message').textContent]")
        assert shown == [tab.run("data.sources[2].name"), "photo: at the photos' cameras only"]
        tab.run("id('message').style.opacity = 0")
        assert psnr(picture(tab), drawn) > (33 if solid == "''" else 28)  # the result, which is on the other side
        tab.run("id('message').style.opacity = ''")
        assert tab.run("id('overlay-share').title") == "From a photo's camera only"
    tab.run("set('left', 1)")
    tab.press("ArrowUp")
    assert tab.run("view().outside") is False


def test_side_in_stills_alone_gives_way_once_the_camera_moves(page: tuple[Browser, Any]) -> None:
    """Without a GPU a large scene is in stills alone: once the camera has moved, both sides show the result."""
    tab, _ = refreshed(page)
    tab.run("set('mode', 'swipe'); set('solid', '1'); jump(0)")
    tab.run("kept = solid.results.get(1); solid.results.delete(1); show()")
    tags = "[id('left-tag').textContent, id('message').hidden]"
    assert tab.run(tags) == ["input", True]
    tab.run("solid.orbit(0.2, 0.1)")
    tab.wait("state.atCamera === false")
    assert tab.run(tags) == [tab.run("data.sources[2].name"), False]
    assert tab.run("panes().map(pane => pane.source)") == [2, 2]
    assert tab.run("id('message').textContent") == "input: at the photos' cameras only"
    tab.run("solid.results.set(1, kept)")
    assert tab.run("[id('back').hidden, solid.camera.matrix.equals(solid.poses[0])]") == [False, False]
    tab.run("id('back').click()")
    assert tab.run("[state.atCamera, id('back').hidden, solid.camera.matrix.equals(solid.poses[0])]") == [True] * 3


def test_choosing_a_result_changes_picture_and_figures(page: tuple[Browser, Any]) -> None:
    """By the slider, from the smallest, or the table: picture, figures and 3D."""
    tab, _ = refreshed(page)
    assert tab.run("data.sizes") == [2, 3]  # one Gaussian more
    said = "[data.results.map(one => one.headline), data.results.map(one => one.figures[0][0])]"
    headlines, counts = tab.run(said)
    assert counts[0] != counts[1]
    shown = "[id('headline').textContent, id('right-tag').textContent, id('size-words').textContent, state.right]"
    score = "document.querySelector('.card[aria-current=true] .score b').textContent"
    slide = "id('size').value = {}; id('size').dispatchEvent(new Event('input'))"
    click = "id('results').rows[{} + 1].querySelector('button').click()"
    for action, row in ((slide, 1), (slide, 0), (click, 1), (click, 0)):
        tab.run(action.format(row))
        name, words = tab.run(f"[data.sources[{row + 2}].name, data.results[{row}].words]")
        assert tab.run(shown) == [headlines[row], name, words, row + 2]
        assert "B · " in words
        assert f"→ {counts[row]}" in tab.run("id('figures').textContent")
        assert tab.run(score) == f"{tab.run(f'view().scores[{row + 1}][0]'):.1f} dB"
        assert tab.run("[...id('results').rows].map(one => one.ariaCurrent)").index("true") == row + 1
        assert tab.run("[Number(id('size').value), id('right').src === stillOf(state.right)]") == [row, True]
        tab.wait(f"solid.has({row + 2})")
    tab.run("pick('left', 3)")
    assert counts[0] in tab.run("id('figures').textContent")  # of the one on the right


def test_headline_has_the_speed_of_this_device(page: tuple[Browser, Any]) -> None:
    tab, _ = refreshed(page)
    tab.run("[solid.frameTime, solid.software] = [source => source === 1 ? 18 : 2, false]; measureSpeed()")
    assert tab.run("id('speed').textContent").replace("\u00a0", " ") == ", about 9 \u00d7 faster to draw"
    assert tab.run("id('speed').title") == "Medians of frames on this device: 18.0 and 2.0 ms"
    tab.run("times.clear(); solid.frameTime = source => 2; measureSpeed()")
    assert tab.run("[id('speed').textContent, id('speed').title]") == ["", ""]
    tab.run(f"{BARE} delete solid.frameTime; set('solid', '1')")
    tab.wait(SETTLED)
    assert tab.run("solid.frameTime(2)") > 0
    tab.run("solid.software = true")


def test_swipe_shows_each_scene_on_its_side(page: tuple[Browser, Any]) -> None:
    tab, _ = refreshed(page)
    tab.run(f"{BARE} jump(0); set('solid', ''); set('other', false); set('mode', 'blink'); set('pixels', 'photo')")
    left = picture(tab)
    tab.run("set('other', true)")
    right = picture(tab)
    for solid in ("''", "'1'"):
        tab.run(f"set('solid', {solid}); set('mode', 'swipe'); swipeTo(0.25)")
        both, cut = picture(tab), WIDTH // 4
        assert psnr(both[:, : cut - 2], left[:, : cut - 2]) > 30
        assert psnr(both[:, cut + 2 :], right[:, cut + 2 :]) > 30
        assert psnr(both[:, cut + 2 :], left[:, cut + 2 :]) < 30


@pytest.mark.slow
def test_a_difference_of_a_scene_with_itself_is_black(page: tuple[Browser, Any]) -> None:
    tab, _ = refreshed(page)
    tab.run(f"{BARE} jump(0); set('mode', 'difference'); set('pixels', 'photo')")
    for solid in ("''", "'1'"):
        tab.run(f"set('solid', {solid})")
        assert picture(tab).mean() > 0.02
        tab.run("set('left', state.right)")
        assert picture(tab).mean() < 0.005
        tab.run("set('left', state.right - 1)")


def test_keys_move_the_swipe_and_choose_view_mode_and_3d(page: tuple[Browser, Any]) -> None:
    tab, _ = refreshed(page)
    tab.run("jump(0); set('solid', ''); set('mode', 'swipe'); swipeTo(0.5)")
    for key in ("ArrowLeft", "ArrowDown", "2", "v"):
        tab.press(key)
    assert tab.run("[state.at, state.view, state.mode, state.solid]") == [0.48, 1, "side", "1"]
    assert tab.run("[...id('strip').children].filter(one => one.ariaCurrent === 'true').length") == 1


def test_disabled_controls_say_why(page: tuple[Browser, Any]) -> None:
    tab, _ = refreshed(page)
    tab.run("jump(data.views.findIndex(view => view.outside)); set('solid', '')")
    grey = "[...document.querySelectorAll('button:disabled, input:disabled')].filter(one => one.checkVisibility())"
    assert tab.run(f"{grey}.length") >= 1
    assert tab.run(f"{grey}.every(one => one.title.length > 5)")
    seen = "[...document.querySelectorAll('[data-set=shape], [data-set=pixels]')].map(one => one.checkVisibility())"
    assert tab.run(seen) == [False] * 4  # in 3D only
    tab.run("set('solid', '1')")
    assert tab.run(seen) == [True] * 4
    assert tab.run("[...document.querySelectorAll('button:enabled')].every(one => one.title === '')")


@pytest.mark.slow
def test_full_screen_shows_the_whole_picture(page: tuple[Browser, Any]) -> None:
    """Where the buttons take two lines as well."""
    tab, _ = refreshed(page)
    for width in (1280, 520):
        resize(tab, width, 600)
        tab.press("F", shift=True)
        tab.wait("id('full').textContent === 'Leave full screen' && document.fullscreenElement !== null")
        tab.wait("stage.getBoundingClientRect().bottom <= innerHeight")
        tab.press("F", shift=True)
        tab.wait("id('full').textContent === 'Full screen' && document.fullscreenElement === null")


def resize(tab: Browser, width: int, height: int) -> None:
    tab.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 640)
    tab.wait(f"innerWidth === {width}")


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1280, 800), (1000, 700), (390, 844)])
def test_the_picture_fits_the_window(size: tuple[int, int], page: tuple[Browser, Any]) -> None:
    """Its lower edge is seen without scrolling, upright or not, and the figures above stay in rows of equal length."""
    tab, _ = refreshed(page)
    resize(tab, *size)
    least = min(0.4 * size[1], 0.5 * size[0])
    for width, height in (SIZE, SIZE[::-1]):
        for mode in ("swipe", "side"):
            tab.run(f"[view().width, view().height] = [{width}, {height}]; set('mode', '{mode}')")
            tab.wait("stage.getBoundingClientRect().bottom <= innerHeight")
            box = tab.box("stage")
            assert max(box["width"], box["height"]) > least
    tab.run(f"[view().width, view().height] = [{WIDTH}, {HEIGHT}]; show()")
    tops = tab.run("[...id('figures').children].map(one => Math.round(one.getBoundingClientRect().top))")
    assert [tops.count(top) for top in sorted(set(tops))] == ([2, 2] if size[0] < 640 else [4])
    assert tab.run("document.documentElement.scrollWidth") == size[0]


def on_phone(page: tuple[Browser, Any]) -> Browser:
    """Return the page as it opens in a window of a phone, held upright."""
    tab, _ = refreshed(page)
    resize(tab, 390, 844)  # CSS pixels of a common phone
    return tab


def test_phone_shows_headline_and_picture_first_with_its_controls_in_sight(page: tuple[Browser, Any]) -> None:
    tab = on_phone(page)
    assert tab.box("headline")["y"] < 40
    assert 60 < tab.box("stage")["y"] < 844 / 3
    alts = tab.run("[id('left').alt, id('right').alt, id('canvas').getAttribute('aria-label')]")
    assert [alt.split(":")[0].split(",")[0] for alt in alts[:2]] == ["before", "after"]
    assert alts[2].endswith(" in 3D")
    for control in ("id('left-source')", "id('right-source')"):  # in sight with the headline and the picture
        assert 0 < tab.box(control)["y"] < 844


def test_phone_stacks_the_scenes_that_are_shown_side_by_side(page: tuple[Browser, Any]) -> None:
    tab = on_phone(page)
    for mode, shown in {"swipe": 2, "side": 2, "blink": 1, "difference": 2}.items():
        side = mode == "side"
        expected = [[0, 0, 1, 0.5], [0, 0.5, 1, 0.5]] if side else [[0, 0, 1, 1]] * shown
        for solid in ("''", "'1'"):
            tab.run(f"set('mode', '{mode}'); set('solid', {solid})")
            boxes = tab.run(
                "['left', 'right'].filter(side => !id(`${side}-pane`).hidden).map(side => { const box ="
                " id(`${side}-pane`).getBoundingClientRect(), whole = stage.getBoundingClientRect(); return"
                " [(box.x - whole.x) / whole.width, (box.y - whole.y) / whole.height, box.width / whole.width,"
                " box.height / whole.height]; })"
            )
            assert np.allclose(boxes, expected, atol=0.01)
            assert np.allclose(tab.run("panes().map(pane => pane.box)"), expected)
            assert tab.run("stage.classList.contains('stacked')") is side


def test_phone_shows_the_score_in_the_table_and_that_there_is_more(page: tuple[Browser, Any]) -> None:
    tab = on_phone(page)
    heads = "[...document.querySelectorAll('.results th')]"
    assert tab.run(f"{heads}.map(one => one.textContent)")[:2] == ["File", "PSNR (dB)"]
    assert tab.run(f"{heads}[1].getBoundingClientRect().right") < 390
    assert tab.run("(one => one.scrollWidth > one.clientWidth)(document.querySelector('.results .scroll'))")
    ground = tab.run("getComputedStyle(document.querySelector('.results .scroll')).backgroundAttachment")
    assert ground == "local, local, scroll, scroll"  # a shadow says that there is more


def test_controls_on_a_phone_are_large_enough_for_fingers(page: tuple[Browser, Any]) -> None:
    tab = on_phone(page)
    tab.run("set('mode', 'difference'); zoomTo(2)")
    small = "[...document.querySelectorAll('button, select, summary, input')].filter(one => one.checkVisibility())"
    small += ".map(one => [one.id || one.textContent, one.getBoundingClientRect()])"
    assert tab.run(f"{small}.length") > 20
    # WCAG 2.5.5 asks for 44 CSS pixels
    assert tab.run(f"{small}.filter(([, box]) => box.height < 44 || box.width < 44).map(([name]) => name)") == []
    assert tab.run("id('strip').scrollWidth > id('strip').clientWidth")


def test_picture_fills_a_phone_that_is_turned(page: tuple[Browser, Any]) -> None:
    tab = on_phone(page)
    tab.call("Emulation.setDeviceMetricsOverride", width=844, height=390, deviceScaleFactor=1, mobile=True)
    tab.wait("innerWidth === 844")
    tab.run("set('mode', 'swipe'); zoomTo(1); scrollTo(0, 0)")
    tab.wait("stage.getBoundingClientRect().bottom <= innerHeight")
    assert tab.run("stage.getBoundingClientRect().height") > 0.85 * 390  # the rest is for the controls
    assert tab.run("document.documentElement.scrollWidth") == 844


@pytest.mark.slow
def test_colours_follow_the_system_unless_the_switch_is_set(page: tuple[Browser, Any]) -> None:
    tab, _ = refreshed(page)
    grounds = []
    for system, scheme in (("dark", ""), ("light", ""), ("light", "dark"), ("dark", "light")):
        tab.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": system}])
        tab.run(f"document.querySelector('[data-set=scheme][data-value=\"{scheme}\"]').click()")
        grounds.append(tab.run("getComputedStyle(document.documentElement).backgroundColor"))
    dark, light = "rgb(20, 21, 23)", "rgb(255, 255, 255)"
    assert grounds == [dark, light, dark, light]
    tab.call("Emulation.setEmulatedMedia", features=[])


def point(tab: Browser, x: float, y: float, kind: str = "mousePressed", **more: Any) -> None:
    """Send an event of the mouse at a place of the stage, in shares of it."""
    box = tab.box("stage")
    place = {"x": box["x"] + x * box["width"], "y": box["y"] + y * box["height"]}
    tab.call("Input.dispatchMouseEvent", type=kind, **place, **more)


def double_click(tab: Browser, x: float, y: float) -> None:
    for count in (1, 2):
        for kind in ("mousePressed", "mouseReleased"):
            point(tab, x, y, kind, button="left", clickCount=count)


LEFT_AND_RIGHT = "['left', 'right'].map(side => getComputedStyle(id(side)).transform)"


@pytest.mark.slow
def test_stills_zoom_in_step(page: tuple[Browser, Any]) -> None:
    """By double click, wheel, drag and keys: what is below the pointer stays, and both sides show the same part."""
    tab, _ = refreshed(page)
    for mode in ("swipe", "side", "blink"):
        tab.run(f"set('mode', '{mode}'); zoomTo(1)")
        double_click(tab, 0.3, 0.6)
        assert tab.run("[state.zoom, state.at]") == [3, 0.5]
        left, right = tab.run(LEFT_AND_RIGHT)
        assert left == (right if mode != "blink" else left)
        assert left.startswith("matrix(3, 0, 0, 3,")
        x = 0.6 if mode == "side" else 0.3  # of the pane
        assert tab.run("state.centre") == pytest.approx([x + (0.5 - x) / 3, 0.6 - 0.1 / 3], abs=0.01)
    before = tab.run("state.centre[0]")
    point(tab, 0.5, 0.5, button="left")
    point(tab, 0.4, 0.5, "mouseMoved", button="left", buttons=1)
    point(tab, 0.4, 0.5, "mouseReleased", button="left")
    assert tab.run("state.centre[0]") == pytest.approx(before + 0.1 / 3, abs=0.005)
    point(tab, 0.5, 0.5, "mouseWheel", deltaX=0, deltaY=-100)
    tab.wait("state.zoom > 3.2")
    tab.press("r")
    assert tab.run("[state.zoom, state.centre, id('back').hidden]") == [1, [0.5, 0.5], True]
    for key, zoom in (("+", 1.25), ("0", 1)):
        tab.press(key)
        assert tab.run("state.zoom") == pytest.approx(zoom)


@pytest.mark.slow
def test_fingers_zoom_stills(page: tuple[Browser, Any]) -> None:
    tab, _ = refreshed(page)
    resize(tab, 390, 844)
    box = tab.box("stage")
    tab.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
    middle = box["x"] + box["width"] / 2
    for kind, off in (("touchStart", 20), ("touchMove", 30), ("touchMove", 40)):
        points = [{"x": middle + side * off, "y": box["y"] + 60, "id": i} for i, side in enumerate((-1, 1))]
        tab.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
    tab.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    tab.call("Emulation.setTouchEmulationEnabled", enabled=False)
    assert tab.run("state.zoom") == pytest.approx(2, abs=0.1)
    assert tab.run("state.at") == 0.5


@pytest.mark.slow
def test_keys_and_clicks_move_frame_and_turn_the_camera(page: tuple[Browser, Any]) -> None:
    tab, _ = refreshed(page)
    tab.run("delete solid.request; set('mode', 'blink'); choose(2); set('left', 2); set('solid', '1')")
    tab.wait(SETTLED)
    place = "solid.camera.matrix.elements.slice(12, 15)"
    ahead = np.array(tab.run("solid.camera.matrix.elements.slice(8, 11).map(value => -value)"))
    start, target = np.array(tab.run(place)), np.array(tab.run("solid.target.toArray()"))
    tab.press("w", release=False)
    tab.wait(f"Math.hypot(...{place}.map((value, i) => value - {start.tolist()}[i])) > 0.02")
    tab.press("w")
    tab.wait(SETTLED)
    moved = np.array(tab.run(place)) - start
    assert moved @ ahead / np.linalg.norm(moved) > 0.999
    np.testing.assert_allclose(np.array(tab.run("solid.target.toArray()")) - target, moved, atol=1e-5)
    assert tab.run("[state.atCamera, flying.size]") == [False, 0]

    double_click(tab, 0.3, 0.6)
    inside = "solid.target.clone().applyMatrix4(solid.camera.matrix.clone().invert())"
    seen = f"{inside}.applyMatrix4(solid.camera.projectionMatrix).toArray()"
    assert tab.run(seen)[:2] == pytest.approx([2 * 0.3 - 1, 1 - 2 * 0.6], abs=0.02)
    assert tab.run("id('pivot').hidden") is False
    before = tab.run(seen)
    tab.run("solid.orbit(0.4, 0.2)")
    assert tab.run(seen) == pytest.approx(before, abs=1e-4)  # it stays where it is while all else turns

    tab.press("f")
    tab.wait(SETTLED)
    tab.run(
        "inPicture = [0, 0]; solid.results.get(2).mesh.forEachSplat((_, centre) => { const [x, y] ="
        " centre.clone().applyMatrix4(solid.camera.matrix.clone().invert()).applyMatrix4(solid.camera.projectionMatrix)"
        ".toArray(); inPicture[0] += 1; inPicture[1] += Math.abs(x) < 1 && Math.abs(y) < 1; })"
    )
    total, within = tab.run("inPicture")
    assert within > 0.8 * total


def test_page_fetches_nothing(page: tuple[Browser, Any]) -> None:
    """After all that the others did, as below."""
    tab, _ = refreshed(page)
    assert [url[:60] for url in tab.requests() if not url.startswith(("file:", "data:", "blob:"))] == []
    assert [url for url in tab.requests() if url.startswith("file:")][1:] == []


def test_page_makes_the_browser_complain_of_nothing(page: tuple[Browser, Any]) -> None:
    tab, _ = refreshed(page)
    assert [one for one in tab.complaints() if '"level": "warning"' not in one] == []  # of the driver, about its speed
    assert [event for event in tab.events if event.get("method") == "Runtime.consoleAPICalled"] == []
    assert tab.run("document.querySelectorAll('b b, select b').length") == 0
    assert tab.run("id('right-tag').textContent").endswith(".ply")
