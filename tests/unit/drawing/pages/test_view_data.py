"""A page shows pictures, cameras, numbers and Gaussians of its scenes."""

from __future__ import annotations

import gzip
import json
from dataclasses import replace
from operator import attrgetter
from typing import Any

import cv2
import motions
import numpy as np
import pytest
import scenes
from messages import noted

from gsmerge import Gaussians, Scene, evaluate, render
from gsmerge.drawing.camera_path import outside_camera
from gsmerge.drawing.pages import data, splats
from gsmerge.drawing.pages.data import ViewData, collect_page_data, encode_still, short_names
from gsmerge.drawing.pages.page import headline
from gsmerge.drawing.pages.splats import pack_splats
from gsmerge.drawing.preview import to_picture
from gsmerge.io.formats.rows import ExpectedScores
from gsmerge.io.formats.spz import UNIX, spz_bytes
from gsmerge.method.facts.pictures import ROW_COLORS
from gsmerge.method.geometry.frame import scene_frame
from gsmerge.method.raster.metrics import psnr
from gsmerge.scoring.evaluate import EvaluateOptions, near_plane
from gsmerge.scoring.lpips import lpips_available
from gsmerge.types import Views


def make_scene() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3, 80, 60), noise=0.05)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene()


@pytest.fixture(scope="module")
def half() -> Gaussians:
    return make_scene().gaussians[::2]


@pytest.fixture(scope="module")
def small() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(3), noise=0.05)


def make_held_out() -> Views:
    other = scenes.make_scene(scenes.room(), scenes.arc(2, 90, 54))
    return Views(other.cameras, other.images, ("x/a.png", "x/b.png"))


@pytest.fixture(scope="module")
def held_out() -> Views:
    return make_held_out()


@pytest.fixture(scope="module")
def actual() -> ViewData:
    scene = make_scene()
    results = {"half": scene.gaussians[::2], "all": scene.gaussians}
    return collect_page_data("room", scene, results, (300, 200, 100), make_held_out())


def test_a_result_that_is_worse_has_no_expected_gain(small: Scene) -> None:
    """It may be of another scene; held-out photos say it themselves."""
    gain = ExpectedScores(20.0, 27.8, 6.0, 9.0)
    results = {"other": small.gaussians[:10], "same": small.gaussians}
    made = collect_page_data("room", small, results, (300, 10, 300), new_views=dict.fromkeys(results, gain))
    assert [side.new_views for side in made.sides] == [None, None, gain]
    assert noted(made.notes, "other", "worse than room")
    assert "expected" not in headline(made)


def decoded(still: bytes | None) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(still, np.uint8), cv2.IMREAD_COLOR)
    return np.asarray(image[..., ::-1], np.float32) / 255


def unpacked(packed: bytes | None) -> tuple[dict[str, Any], np.ndarray]:
    """Return the numbers of what the page holds: its head, and ``[n,columns]``."""
    assert packed[9:10] == UNIX
    line, _, rest = gzip.decompress(packed).partition(b"\n")
    head = json.loads(line)
    columns, at = [], 0
    for size in head["sizes"]:
        planes = np.frombuffer(rest, np.uint8, size * head["count"], at).reshape(size, -1).astype(np.int64)
        signed = (planes << (8 * np.arange(size)[:, None])).sum(0)
        columns.append(np.cumsum((signed >> 1) ^ -(signed & 1)))
        at += size * head["count"]
    assert len(rest) == at
    return head, np.stack(columns, 1)


def test_scores_are_those_of_evaluate(actual: ViewData, scene: Scene, half: Gaussians, held_out: Views) -> None:
    nets = (data.LPIPS,) if lpips_available(data.LPIPS) else ()
    expected = evaluate(scene, {"half": half}, held_out, EvaluateOptions(lpips=nets, fog=False))
    by_place = sorted(actual.views, key=lambda view: view.place)
    for side, result in enumerate(expected.results):
        assert [view.scores[side] for view in by_place] == [score.masked for score in result.scores]
        assert actual.sides[side].mean == result.mean("target")[1]
        assert actual.sides[side].seconds > 0
    assert [side.name for side in actual.sides] == ["input", "half", "all"]
    assert [side.file_bytes for side in actual.sides] == [300, 200, 100]
    assert [view.held_out for view in by_place] == [False, False, False, True, True]


def test_a_page_opens_on_the_middle_view(actual: ViewData) -> None:
    """Of those that the figures at the top are of: the held-out ones, otherwise the inputs."""
    inputs = replace(actual, views=tuple(view for view in actual.views if not view.held_out))
    values = [view.scores[1].psnr or 0 for view in inputs.views]
    assert values[inputs.start] == np.median(values)
    assert replace(inputs, views=inputs.views[:1]).start == 0
    assert actual.start == next(place for place, view in enumerate(actual.views) if view.held_out)
    best = max((view for view in actual.views if view.held_out), key=lambda view: view.scores[1].psnr or 0)
    assert replace(actual, views=(*inputs.views, best)).start == 3
    some = [
        replace(view, scores=tuple(replace(score, lpips_alex=lpips) for score in view.scores))
        for view, lpips in zip(inputs.views, (0.1, None, None), strict=True)
    ]
    assert replace(inputs, views=tuple(some)).start == 0  # the one with every figure


def test_scene_alone_is_scored_against_its_photos(small: Scene) -> None:
    alone = collect_page_data("room", small, {}, (300,))
    assert [side.name for side in alone.sides] == ["input"]
    assert alone.notes == ()
    values = [view.scores[0].psnr or 0 for view in alone.views]
    assert values == sorted(values)
    assert alone.scored
    assert not collect_page_data("room", replace(small, images=None, pixels=None), {}, (300,)).scored


def test_the_worst_view_comes_first(actual: ViewData) -> None:
    values = [view.scores[1].psnr for view in actual.views]
    assert len(values) == actual.num_views == 5
    assert values == sorted(values, key=lambda value: value or 0)


def test_stills_are_what_render_draws(actual: ViewData, scene: Scene, half: Gaussians, held_out: Views) -> None:
    for view in actual.views:
        split, i = (held_out, view.place - 3) if view.held_out else (scene, view.place)
        renders = [
            render(some, split.cameras[[i]], near=near_plane(scene)).images[0].clip(0, 1)
            for some in (scene.gaussians, half)
        ]
        for still, picture in zip((view.photo, *view.stills), (split.images[i], *renders), strict=False):
            assert psnr(decoded(still), picture) > 31  # 41 where pictures are not as small and colourful


def test_view_from_outside_is_drawn_without_photo_or_scores(actual: ViewData, scene: Scene, half: Gaussians) -> None:
    camera, distance = outside_camera(scene.cameras, scene.gaussians.means)
    for some, still in zip((scene.gaussians, half), actual.outside.stills, strict=False):
        assert psnr(decoded(still), render(some, camera, near=near_plane(scene)).images[0].clip(0, 1)) > 30
    frame = scene_frame(scene)
    assert actual.outside.distance == pytest.approx(distance / frame.unit)
    np.testing.assert_allclose(actual.outside.camera.viewmats, frame.enter_cameras(camera).viewmats)
    assert (actual.outside.photo, actual.outside.scores) == (None, ())
    assert actual.outside not in actual.views


def test_cameras_and_gaussians_share_one_frame(actual: ViewData, half: Gaussians, scene: Scene) -> None:
    """What a view sees in the world it sees in the page's frame."""
    head, columns = unpacked(actual.sides[1].splats)
    drawn = half.means[half.opacities >= splats.LEAST_OPACITY]
    assert head["count"] == len(drawn)
    means = columns[:, :3] / 2.0 ** head["fraction"]
    view = next(view for view in actual.views if view.place == 1)
    ours = means @ view.camera.viewmats[0, :3, :3].T + view.camera.viewmats[0, :3, 3]
    world = drawn @ scene.cameras.viewmats[1, :3, :3].T + scene.cameras.viewmats[1, :3, 3]
    assert np.allclose(ours[:, :2] / ours[:, 2:], world[:, :2] / world[:, 2:], atol=1e-3)
    assert view.distance == pytest.approx(np.median(ours[:, 2]), rel=0.3)


def test_rows_of_pixels_have_depths(actual: ViewData, scene: Scene) -> None:
    """From which their positions follow, to a sixteenth of a pixel and a 2000th of the depth."""
    head, columns = unpacked(actual.sides[0].splats)
    ids, rights, downs, depths = columns[:, :4].T
    np.testing.assert_array_equal(ids, np.arange(len(scene.gaussians)))
    frame, (width, height) = scene_frame(scene), (scene.cameras.width, scene.cameras.height)
    assert (head["width"], head["height"], len(head["cameras"])) == (width, height, 3)
    camera = frame.enter_cameras(scene.cameras)[[1]]
    rows = ids // (width * height) == 1
    seen = frame.enter(scene.gaussians).means[rows] @ camera.viewmats[0, :3, :3].T + camera.viewmats[0, :3, 3]
    pixels = ids[rows] % (width * height)
    middles = np.stack([pixels % width, pixels // width], 1) + 0.5
    projected = seen @ camera.Ks[0].T
    shifts = np.stack([rights, downs], 1)[rows] / 8
    assert np.abs(middles + shifts - projected[:, :2] / projected[:, 2:]).max() < 0.07
    np.testing.assert_allclose(np.exp(depths[rows] / 1024), seen[:, 2], rtol=6e-4)


def test_many_gaussians_are_less_exact(half: Gaussians, monkeypatch: pytest.MonkeyPatch) -> None:
    exact, _ = pack_splats(half)
    monkeypatch.setattr(splats, "COARSE_COUNT", len(half) - 1)
    coarse, _ = pack_splats(half)
    assert len(coarse or b"") < 0.9 * len(exact or b"")
    (_, fine), (head, rough) = unpacked(exact), unpacked(coarse)
    assert np.abs(16 * rough[:, 3] - fine[:, 3]).max() <= 8
    assert (head["steps"], head["levels"]) == ([16, 2, 2], 31)


def test_a_light_page_has_no_gaussians_of_the_scene(small: Scene) -> None:
    light = collect_page_data("room", small, {"half": small.gaussians[::2]}, (2, 1), light=True)
    assert [side.splats is None for side in light.sides] == [True, False]
    assert not any("stills only" in note or "harmonics" in note for note in light.notes)


def test_too_many_gaussians_are_left_out(small: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    half = small.gaussians[::2]
    monkeypatch.setattr(data, "MAX_GAUSSIANS", len(half) + 1)
    monkeypatch.setattr(splats, "MAX_GAUSSIANS", len(half) + 1)
    actual = collect_page_data("room", small, {"half": half}, (2, 1))
    assert actual.sides[0].splats is None
    assert actual.sides[1].splats is not None
    assert noted(actual.notes, "stills")


def test_harmonics_that_do_not_fit_are_left_out(half: Gaussians, monkeypatch: pytest.MonkeyPatch) -> None:
    curved = replace(half, shN=np.full((len(half), 15, 3), 0.1, np.float32))
    assert pack_splats(curved)[1] == 3
    monkeypatch.setattr(splats, "MAX_SPZ_BYTES", 45 * len(half))
    content, degree = pack_splats(curved)
    assert degree == 2
    assert unpacked(content)[1].shape == (len(half), 13 + 24)


def test_higher_degrees_of_zeros_are_left_out(small: Scene) -> None:
    half = small.gaussians[::2]
    flat = np.zeros((len(half), 15, 3), np.float32)
    flat[:, :3] = 0.1
    assert pack_splats(replace(half, shN=flat))[1] == 1
    assert pack_splats(replace(half, shN=0 * flat)) == pack_splats(half)
    actual = collect_page_data("room", small, {"half": replace(half, shN=flat)}, (2, 1))
    assert not any("harmonics" in note for note in actual.notes)


def test_pixels_in_order_take_less_than_their_spz(scene: Scene) -> None:
    frame, ids = scene_frame(scene), np.arange(len(scene.gaussians))
    gaussians = frame.enter(scene.gaussians)
    packed, _ = pack_splats(gaussians, frame.enter_cameras(scene.cameras), ids)
    assert len(packed or b"") < 0.8 * len(pack_splats(gaussians)[0] or b"") < 0.8 * len(spz_bytes(gaussians))


def test_gaussians_not_finite_or_too_faint_are_left_out(half: Gaussians) -> None:
    means, opacities = half.means.copy(), half.opacities.copy()
    means[0, 1], opacities[1] = np.nan, 0.003
    content, _ = pack_splats(replace(half, means=means, opacities=opacities))
    whole, _ = pack_splats(half)
    counts = [unpacked(one)[0]["count"] for one in (content, whole)]
    assert counts[0] == counts[1] - 2


def test_many_views_are_thinned_to_some_with_the_worst(small: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(data, "MAX_SHOWN_VIEWS", 1)
    actual = collect_page_data("room", small, {"half": small.gaussians[::2]}, (2, 1))
    everything = evaluate(small, {"half": small.gaussians[::2]}, None, EvaluateOptions(lpips=())).results[1].scores
    assert 1 <= len(actual.views) <= 2
    assert actual.views[0].scores[1].psnr == min(score.masked.psnr or 0 for score in everything)
    assert noted(actual.notes, f"{len(actual.views)} of 3")


def test_without_photos_results_are_compared_with_the_input(small: Scene) -> None:
    bare = replace(small, images=None)
    actual = collect_page_data("room", replace(bare, pixels=None), {"half": small.gaussians[::2]}, (2, 1))
    assert [view.photo for view in actual.views] == [None] * 3
    assert actual.reference == "renders of the input"
    colored = collect_page_data("room", bare, {"half": small.gaussians[::2]}, (2, 1))
    assert all(view.photo is not None for view in colored.views)
    assert colored.reference == ROW_COLORS


@pytest.mark.parametrize(
    ("names", "short"),
    [
        (("images/a.png", "images/b.png"), ["a", "b"]),
        (("left\\0.png", "right\\0.png"), ["left\\0.png", "right\\0.png"]),
        (("a.png", "a.jpg"), ["a.png", "a.jpg"]),
        ((), []),
    ],
)
def test_short_names_leave_out_folder_and_suffix_unless_they_collide(names: tuple[str, ...], short: list[str]) -> None:
    assert short_names(names) == short


def test_a_still_keeps_red_red() -> None:
    red = np.zeros((16, 16, 3), np.float32)
    red[..., 0] = 1
    assert psnr(decoded(encode_still(to_picture(red))), red) > 30


def test_stills_of_a_result_are_from_its_own_cameras(small: Scene) -> None:
    own = replace(small.cameras, viewmats=motions.random_motions(len(small), 2.0, 0.1) @ small.cameras.viewmats)
    given, moved = (
        collect_page_data("room", small, {"half": small.gaussians[::2]}, (2, 1), cameras=one)
        for one in (None, {"half": own})
    )
    for before, after in zip(*(sorted(one.views, key=attrgetter("place")) for one in (given, moved)), strict=True):
        assert before.stills[0] == after.stills[0]
        assert before.stills[1] != after.stills[1]
        np.testing.assert_array_equal(before.camera.viewmats, after.camera.viewmats)


def test_a_cut_out_lies_on_a_chequered_ground(scene: Scene) -> None:
    """Of stills; in 3D its ground is grey."""
    middle = np.abs(scene.gaussians.means[:, 0]) < 0.2
    cut = replace(scene, gaussians=scene.gaussians[np.flatnonzero(middle)], pixels=None)
    data = collect_page_data("cut", cut, {"same": cut.gaussians}, [1, 1])
    assert data.cut_out
    still = decoded(data.views[0].stills[0])
    levels = np.unique((10 * still[:, :4]).round())  # beside the object
    assert set(levels) <= {4, 6} | {5}
    assert not collect_page_data("whole", scene, {}, [1]).cut_out
