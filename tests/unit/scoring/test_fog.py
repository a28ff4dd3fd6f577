"""Fog, veils and holes are measured in cases that can be worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from messages import says
from tiny_scene import rotation

from gsmerge.method.fit.outside import PLACES, STEP_BACK_HIGH, STEP_BACK_LOW
from gsmerge.method.fit.outside import outside_cameras as place_views
from gsmerge.method.geometry.transforms import camera_centres
from gsmerge.method.kernels import elementary
from gsmerge.scoring.fog import (
    ALL,
    FOG_CAMERAS,
    HAZE,
    VEILED,
    Fog,
    OutsidePicture,
    describe_fog,
    fog_cameras,
    mean_fog,
    measure_fog,
    sum_pixels,
)
from gsmerge.types import Cameras, Gaussians

DEPTH = 2.0  # of the wall, which just fills the picture of a camera at the origin
WIDTH, HEIGHT = 160, 120  # pixels, and the focal length is the width


def balls(means: np.ndarray, scale: float, opacity: float) -> Gaussians:
    """Make grey round Gaussians at ``means [n,3]``."""
    n = len(means)
    return Gaussians(
        means.astype(np.float32), np.tile(np.float32([1, 0, 0, 0]), (n, 1)), np.full((n, 3), scale, np.float32),
        np.full(n, opacity, np.float32), np.zeros((n, 1, 3), np.float32), np.zeros((n, 0, 3), np.float32),
    )  # fmt: skip


def wall(left: float = -1.0, right: float = 1.0) -> Gaussians:
    """Make an opaque wall between two x, at which the picture spans -1 to 1."""
    x, y = np.meshgrid(np.arange(left, right, 0.02) + 0.01, np.arange(-0.75, 0.75, 0.02) + 0.01)
    return balls(np.stack([x.ravel(), y.ravel(), np.full(x.size, DEPTH)], 1), 0.014, 0.95)


def curtain(opacity: float, place: tuple[float, float, float] = (0, 0, DEPTH), size: float = 1e4) -> Gaussians:
    """Make one Gaussian, which has everywhere the same opacity unless its size, world units, says otherwise."""
    return balls(np.array([place]), size, opacity)


def cameras(width: int = WIDTH, height: int = HEIGHT, views: int = 1) -> Cameras:
    return Cameras(np.tile(np.eye(4), (views, 1, 1)), scenes.intrinsics(views, width, height), width, height)


def needle(length: float, width: float) -> Gaussians:
    """Make a white Gaussian in the middle of the wall, along x; standard deviations, world units."""
    one = balls(np.array([[0, 0, DEPTH - 0.2]]), width, 0.95)
    return replace(one, scales=np.float32([[length, width, width]]), sh0=one.sh0 + np.float32(1.7))


def fog_of(given: Gaussians, result: Gaussians, seen: Cameras | None = None, near: float = 0.01) -> dict[str, Fog]:
    return measure_fog(given, {"it": result}, seen or cameras(), near)["it"]


def figures(kinds: dict[str, Fog]) -> np.ndarray:
    """Return near fog, far fog, holes and veils ``[3,5]``, of cameras stepped back, turned, and all."""
    return np.array([list(vars(kinds[kind]).values()) for kind in (*FOG_CAMERAS, ALL)], float)


def test_the_input_itself_has_no_fog() -> None:
    assert figures(fog_of(wall(), wall())) == pytest.approx(0, abs=2e-3)


def test_a_curtain_is_fog_of_its_opacity() -> None:
    result = Gaussians.concat([wall(), curtain(0.3)])
    assert figures(fog_of(wall(), result))[:, :2] == pytest.approx(0.3, abs=2e-3)
    assert figures(fog_of(wall(), result))[:, 2:] == pytest.approx(0)
    both = measure_fog(wall(), {"clean": wall(), "foggy": result}, cameras())
    assert list(both) == ["clean", "foggy"]
    assert both["foggy"] == fog_of(wall(), result)


def test_a_rim_about_the_outline_is_no_fog() -> None:
    """Stepped back by half the depth the wall is 107 pixels wide, and what it is widened by a third less, too."""
    thin = fog_of(wall(), wall(-1.1, 1.1))["back"]  # 5 pixels a side: within the eroded rim
    assert list(vars(thin).values()) == pytest.approx([0] * 7, abs=2e-3)
    wide = fog_of(wall(), wall(-1.3, 1.3))["back"]  # 16 pixels, a tenth of the width: near fog alone
    assert wide.fog_near > 0.02
    assert wide.fog_far == pytest.approx(0, abs=2e-3)


def test_pixels_count_by_their_distance_from_the_outline() -> None:
    """Of a picture of 100 columns whose left 20 are solid: empty from the 28th on, far from the 30th on."""
    given, result = np.zeros((50, 100)), np.zeros((50, 100))
    given[:, :20] = 0.95
    result[:, :5], result[:, 20:28], result[:, 28:30] = 0.6, 1, 0.5
    counts = count_pixels(given, result)
    assert counts[:3] == pytest.approx(np.array([[50 * 2 * 0.5, 50 * 72], [0, 50 * 70], [50 * 15, 50 * 20]]))
    assert mean_fog(counts[None]) == Fog(1 / 72, 0, 0.75, 0, 0)
    given[:, 50] = 0.06  # neither solid nor empty, so that the rim is about it, too
    assert count_pixels(given, result)[:3, 1] == pytest.approx([50 * (72 - 17), 50 * (70 - 21), 50 * 20])


def test_far_pixels_of_a_narrow_picture_are_no_nearer_than_near_ones() -> None:
    given = np.zeros((50, 40))
    given[:, 0] = 0.95
    near, far, *_ = count_pixels(given, given)
    assert near.tolist() == far.tolist() == [0, 50 * 31]


def test_a_veil_is_what_stands_before_seven_tenths_of_the_depth() -> None:
    for depth, veil in ((0.69, 1), (0.71, 0)):
        result = curtain(0.95, (0, 0, depth * (DEPTH + 1) - 1), size=50)
        assert fog_of(wall(), result)["back"].veil == pytest.approx(veil / 2, abs=0.01)
        assert fog_of(wall(), result)["back"].veil_worst == pytest.approx(veil, abs=0.01)
    near = curtain(0.95, (0, 0, -0.51), size=50)  # nearer to one camera than a quarter of the depth
    assert fog_of(wall(), Gaussians.concat([wall(), near]))["back"].veil == pytest.approx(0.5, abs=0.01)


def test_cameras_count_alike_in_a_veil_whatever_they_see() -> None:
    seen, half, ones = np.full((4, 4), 0.95), np.repeat([[2.0, 0.5]], 4, 0).repeat(2, 1), np.ones((4, 4))
    few = np.zeros((4, 4))
    few[0, 3] = 0.95
    counts = [
        sum_pixels(OutsidePicture(given, given, 2 * ones), OutsidePicture(seen, seen, half))
        for given in (seen, few, np.zeros((4, 4)))
    ]
    fog = mean_fog(np.stack(counts))
    assert (fog.veil, fog.veil_worst) == (0.75, 1)


def count_pixels(given: np.ndarray, result: np.ndarray) -> np.ndarray:
    """Count the pixels of two pictures of opacities at one depth."""
    return sum_pixels(*(OutsidePicture(one, one, np.ones_like(one)) for one in (given, result)))


def test_missing_pieces_are_holes() -> None:
    kinds = fog_of(wall(), wall(-1.0, 0.5))
    assert kinds["back"].holes == pytest.approx(0.25, abs=0.02)
    assert kinds["turned"].holes == pytest.approx(0.25, abs=0.03)  # larger from one side, smaller from the other
    assert figures(kinds)[:, :2] == pytest.approx(0, abs=2e-3)
    assert fog_of(wall(), curtain(0.45))[ALL].holes == 1


def test_pictures_without_empty_or_solid_pixels_have_no_score_of_them() -> None:
    kinds = (*FOG_CAMERAS, ALL)
    assert fog_of(curtain(0.95), curtain(0.95)) == dict.fromkeys(kinds, Fog(None, None, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert fog_of(curtain(0.5), curtain(0.2)) == dict.fromkeys(kinds, Fog(spikes=0.0, strokes=0.0))


def test_fog_cameras_stand_behind_or_beside_their_views() -> None:
    """Of each view two behind it, and two beside it at half the depth more from what it looks at."""
    seen = cameras(views=7)
    seen.viewmats[:, 1, 3] = -np.arange(7) / 10  # the second, fourth and sixth are taken
    places = [(kind, *camera_centres(camera.viewmats)[0]) for kind, camera, _ in fog_cameras(curtain(1), seen[[3]])]
    y, side, back = 0.3, 3 * elementary.sin(np.radians(30)), 2 - 3 * elementary.cos(np.radians(30))
    expected = [("back", 0, y, -1), ("back", 0, y, -3), ("turned", -side, y, back), ("turned", side, y, back)]
    for (kind, *place), (expected_kind, *expected_place) in zip(places, expected, strict=True):
        assert kind == expected_kind
        assert place == pytest.approx(expected_place, abs=1e-6)
    every = [camera_centres(camera.viewmats)[0, 1] for _, camera, _ in fog_cameras(wall(), seen)]
    assert every == pytest.approx(np.repeat([0.1, 0.3, 0.5], 4))


@pytest.mark.parametrize("size", [(1920, 1440), (1440, 1920)])
def test_fog_of_large_pictures_is_measured_in_smaller_ones(size: tuple[int, int]) -> None:
    result = Gaussians.concat([wall(-1.0, 0.5), curtain(0.3)])
    large, small = cameras(*size), cameras(size[0] // 4, size[1] // 4)
    for _, camera, _ in fog_cameras(wall(), large):
        assert (camera.width, camera.height) == (small.width, small.height)
    assert fog_of(wall(), result, large) == fog_of(wall(), result, small)


@pytest.mark.parametrize("factor", [1e-3, 1, 1e3])
def test_fog_does_not_depend_on_units_or_rigid_motions(factor: float) -> None:
    """With holes and a curtain on one side; the near plane is in the scene's units."""
    added = curtain(0.8, (1.5, 0.2, DEPTH), size=0.2), curtain(0.9, (0.3, 0, 0.5), size=0.1)
    result = Gaussians.concat([wall(-1.0, 0.5), *added])
    expected = figures(fog_of(wall(), result))
    assert (expected[2, :5] > 0.01).all()
    turn, shift = rotation(0.4, -0.3, 0.9), factor * np.array([3.0, -2, 1])
    given, moved = (scenes.move_gaussians(one, turn, factor, shift) for one in (wall(), result))
    viewmats = np.eye(4)[None].copy()
    viewmats[:, :3, :3] = turn.T
    viewmats[:, :3, 3] = -turn.T @ shift
    actual = fog_of(given, moved, replace(cameras(), viewmats=viewmats), 0.01 * factor)
    assert figures(actual)[:, :3] == pytest.approx(expected[:, :3], abs=2e-4)
    assert figures(actual)[:, 3:] == pytest.approx(expected[:, 3:], abs=3e-3)  # pixels at its edge are few


def test_haze_or_a_thick_veil_is_described() -> None:
    assert describe_fog("a", Fog(0.9, HAZE, 0)) is None
    assert describe_fog("a", Fog(None, None, 0, 0.08, VEILED)) is None
    assert says(describe_fog("a", Fog(None, None, 0, 0.02, 0.3)) or "", "a", "outside", "30 %")
    note = describe_fog("small.ply", Fog(0.4, 0.314, 0))
    assert note is not None
    assert says(note, "small.ply", "outside", "fog 0.31")


@pytest.mark.parametrize(
    ("length", "width", "spikes", "strokes"),
    [(0.2, 0.02, True, True), (0.2, 0.05, False, True), (0.2, 0.1, False, False), (0.01, 0.001, False, False)],
)
def test_long_thin_gaussians_are_spikes(length: float, width: float, spikes: bool, strokes: bool) -> None:
    """Of at least five times, or three times, their second axis; short ones, and round ones, are none."""
    fog = fog_of(wall(), Gaussians.concat([wall(), needle(length, width)]))[ALL]
    assert (fog.spikes > 0, fog.strokes > 0) == (spikes, strokes)
    assert max(fog.spikes, fog.strokes) < 0.05
    assert fog_of(wall(), wall())[ALL].strokes == 0


@pytest.mark.parametrize("views", [2, 7, 12])
def test_fog_cameras_are_not_the_outside_views_of_a_fit(views: int) -> None:
    """Cameras outside are a fiftieth of the depth apart, or look elsewhere by a degree."""
    scene = scenes.make_scene(scenes.room(), scenes.arc(views, 32, 24))
    points = scene.gaussians.means
    fitted = place_views(points, scene.cameras, max(PLACES, views), STEP_BACK_LOW, STEP_BACK_HIGH)
    for _, camera, depth in fog_cameras(scene.gaussians, scene.cameras):
        apart = np.linalg.norm(fitted.centres - camera.centres, axis=1) / depth
        cosines = (fitted.viewmats[:, 2, :3] * camera.viewmats[0, 2, :3]).sum(1)
        assert ((apart > 0.02) | (cosines < np.cos(np.radians(1)))).all()
