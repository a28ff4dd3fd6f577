"""Photos follow what was inserted, painted, moved or deleted after they were taken."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import scenes

from gsmerge import Scene
from gsmerge.method.geometry.transforms import camera_depths, project, rgb_to_sh0
from gsmerge.prepare.edits import follow_edits
from gsmerge.types import Gaussians, LargePhotos

VIEWS, WIDTH, HEIGHT = 4, 64, 48
ORANGE = np.array([1.0, 0.5, 0.0], np.float32)
BALL = scenes.ball((0.1, 0.05, 2.4), 0.3, scenes.flat(*ORANGE))
WALL = scenes.plane(3.0, scenes.waves(0))


@pytest.fixture(scope="module")
def wall() -> Scene:
    return solid([WALL])


@pytest.fixture(scope="module")
def with_ball() -> Scene:
    return solid([BALL, WALL])


def solid(surfaces: list[scenes.Surface], views: int = VIEWS) -> Scene:
    """Make a scene of nearly opaque Gaussians."""
    return scenes.make_scene(surfaces, scenes.arc(views, WIDTH, HEIGHT), opacity=(0.95, 0.95))


def shows_ball(scene: Scene) -> np.ndarray:
    """Return the mask ``[v,h,w]`` of the pixels of photos that show the ball."""
    return np.abs(scene.images - ORANGE).max(-1) < 0.01


def of_ball(scene: Scene) -> np.ndarray:
    """Return a mask ``[n]`` of the Gaussians of the ball."""
    return shows_ball(scene).reshape(-1)[scene.pixels.homes]


def grow(mask: np.ndarray, pixels: int) -> np.ndarray:
    """Grow, or shrink by a negative number, the masks ``[v,h,w]`` of views."""
    change = cv2.dilate if pixels > 0 else cv2.erode
    square = np.ones((2 * abs(pixels) + 1,) * 2, np.uint8)
    return np.stack([change(view.astype(np.uint8), square) > 0 for view in mask])


def changed(scene: Scene, rows: np.ndarray, **columns: np.ndarray) -> Scene:
    """Give some rows other values."""
    new = {name: getattr(scene.gaussians, name).copy() for name in columns}
    for name, values in columns.items():
        new[name][rows] = values
    return replace(scene, gaussians=replace(scene.gaussians, **new))


def insert_ball(wall: Scene, with_ball: Scene) -> Scene:
    """Insert the ball into a scene whose photos do not show it, and in which Gaussians belong to no pixels."""
    ball = with_ball.gaussians[of_ball(with_ball)]
    return replace(wall, gaussians=Gaussians.concat([wall.gaussians, ball]), pixels=None)


def move_ball(scene: Scene) -> Scene:
    """Move the Gaussians of the ball to the right by more than its diameter."""
    rows = of_ball(scene)
    return changed(scene, rows, means=scene.gaussians.means[rows] + np.array([0.7, 0, 0], np.float32))


def assert_unchanged(scene: Scene) -> None:
    followed, change = follow_edits(scene)
    assert followed is scene
    assert change == ""


def test_photos_show_what_was_inserted(wall: Scene, with_ball: Scene) -> None:
    edited = insert_ball(wall, with_ball)
    followed, change = follow_edits(edited)
    ball = shows_ball(with_ball)
    assert "the scene was edited" in change
    assert followed.gaussians is edited.gaussians
    assert np.abs(followed.images[grow(ball, -2)] - ORANGE).max() < 0.05
    beside = ~grow(ball, 6)
    np.testing.assert_array_equal(followed.images[beside], wall.images[beside])
    assert followed.masks is None


def test_photos_show_new_colours_of_painted_gaussians(with_ball: Scene) -> None:
    blue = np.array([0.1, 0.1, 0.9], np.float32)
    painted = changed(replace(with_ball, pixels=None), of_ball(with_ball), sh0=rgb_to_sh0(blue))
    followed, change = follow_edits(painted)
    ball = shows_ball(with_ball)
    assert change
    assert np.abs(followed.images[grow(ball, -2)] - blue).max() < 0.05
    np.testing.assert_array_equal(followed.images[~grow(ball, 6)], with_ball.images[~grow(ball, 6)])


def test_an_inserted_object_is_found_before_far_more_gaussians(wall: Scene, with_ball: Scene) -> None:
    rows = np.flatnonzero(of_ball(with_ball))[::4]
    ball = with_ball.gaussians[rows]
    few = replace(ball, scales=2 * ball.scales)
    _, change = follow_edits(replace(wall, gaussians=Gaussians.concat([wall.gaussians, few]), pixels=None))
    assert change


def test_single_gaussians_of_new_colours_are_no_edit(wall: Scene) -> None:
    rows = np.random.default_rng(0).random(len(wall.gaussians)) < 0.08
    assert_unchanged(changed(replace(wall, pixels=None), rows, sh0=rgb_to_sh0(ORANGE)))


def test_moved_gaussians_get_the_pixels_where_they_are_now(with_ball: Scene) -> None:
    rows = of_ball(with_ball)
    moved = move_ball(with_ball)
    followed, change = follow_edits(moved)
    assert change
    homes = followed.pixels.homes
    np.testing.assert_array_equal(homes[~rows], moved.pixels.homes[~rows])
    for view in range(VIEWS):
        own = np.flatnonzero(rows & (homes // followed.pixels_per_view == view))
        (places,), (depths,) = project(moved.gaussians.means[own], moved.cameras[[view]])
        inside = (places[:, 0] > 0) & (places[:, 0] < WIDTH)
        columns = homes[own] % WIDTH
        np.testing.assert_array_equal(columns[inside], np.floor(places[inside, 0]))
        front = followed.pixels.fronts[view].reshape(-1)[homes[own[inside]] % followed.pixels_per_view]
        assert rows[front].all()  # the ball is in front of the wall
        front_depths = camera_depths(moved.gaussians.means[front], moved.cameras.viewmats[view])
        assert (front_depths <= depths[inside] + 1e-6).all()


@pytest.mark.parametrize("own", [True, False])
def test_photos_show_moved_gaussians_and_leave_out_their_old_place(with_ball: Scene, own: bool) -> None:
    moved = move_ball(with_ball)
    followed, _ = follow_edits(moved if own else replace(moved, pixels=None))
    ball = shows_ball(with_ball)
    again = shows_ball(followed)
    assert again.sum() > 0.5 * ball.sum()
    assert not (again & grow(ball, -1)).any()
    assert followed.masks[~grow(ball, 4)].all()
    assert (~followed.masks).sum() > 0.2 * ball.sum()  # other views see the wall behind parts of the ball


def test_pixels_of_deleted_gaussians_stay_empty(with_ball: Scene) -> None:
    ball = shows_ball(with_ball)
    deleted = scenes.shown_in(with_ball, ~ball)
    followed, change = follow_edits(deleted)
    assert change
    assert followed.gaussians is deleted.gaussians
    assert not shows_ball(followed).any()
    assert followed.masks[~grow(ball, 4)].all()
    assert (~followed.masks).sum() > 0.2 * ball.sum()  # other views see the wall behind parts of the ball
    np.testing.assert_array_equal(followed.images[~grow(ball, 4)], with_ball.images[~grow(ball, 4)])


def test_masks_stay(wall: Scene, with_ball: Scene) -> None:
    masks = np.ones((VIEWS, HEIGHT, WIDTH), bool)
    masks[:, :5] = False
    followed, change = follow_edits(replace(insert_ball(wall, with_ball), masks=masks))
    assert change
    np.testing.assert_array_equal(followed.masks, masks)


def test_large_photos_follow_too(wall: Scene, with_ball: Scene) -> None:
    levels = np.rint(255 * wall.images).astype(np.uint8).repeat(2, 1).repeat(2, 2)
    zoom = np.array([[2], [2], [1]], np.float32)
    large = LargePhotos(zoom * wall.cameras.Ks, 2 * WIDTH, 2 * HEIGHT, tuple(range(VIEWS)), levels.__getitem__)
    followed, _ = follow_edits(replace(insert_ball(wall, with_ball), large_photos=large))
    ball = grow(shows_ball(with_ball), -3).repeat(2, 1).repeat(2, 2)
    photos = np.stack([followed.large_photos.read(view) for view in range(VIEWS)])
    assert np.abs(photos[ball] / 255 - ORANGE).max() < 0.1


@pytest.mark.parametrize("noise", [0.0, 0.03])
@pytest.mark.parametrize("own", [True, False])
def test_sound_scenes_stay(noise: float, own: bool) -> None:
    """Also with errors of depth, which move Gaussians along their rays."""
    scene = scenes.make_scene(scenes.room(), scenes.arc(VIEWS, WIDTH, HEIGHT), noise=noise)
    assert_unchanged(scene if own else replace(scene, pixels=None))


def test_pixels_that_do_not_count_are_no_edit() -> None:
    """Photos that were cropped are black beyond, which is the colour of no Gaussian there."""
    scene = scenes.make_scene(scenes.room(), scenes.arc(VIEWS, WIDTH, HEIGHT))
    masks = np.full(scene.images.shape[:3], True)
    masks[:, : HEIGHT // 4] = False
    cropped = replace(scene, images=scene.images * masks[..., None], masks=masks, pixels=None)
    assert "edited" in follow_edits(replace(cropped, masks=None))[1]
    assert_unchanged(cropped)


@pytest.mark.parametrize(("factors", "gamma"), [((1.3, 1.15, 0.95), 1), ((1.2, 1.05, 0.8), 1), ((1, 1, 1), 1.3)])
def test_photos_of_another_tone_are_no_edit(factors: tuple[float, float, float], gamma: float) -> None:
    """As of an editor that changes all photos alike: a part of them then has the colours of no Gaussian."""
    scene = scenes.make_scene(scenes.room(), scenes.arc(VIEWS, WIDTH, HEIGHT))
    toned = (scene.images ** np.float32(gamma) * np.array(factors, np.float32)).clip(0, 1)
    assert_unchanged(replace(scene, images=toned, pixels=None))


def test_scenes_of_two_views_stay() -> None:
    assert_unchanged(insert_ball(solid([WALL], 2), solid([BALL, WALL], 2)))


def test_scenes_without_photos_stay(with_ball: Scene) -> None:
    assert_unchanged(replace(with_ball, images=None))


@pytest.mark.parametrize(
    "missing", ["single pixels", "a border", "a part up to the border", "many parts", "masked pixels"]
)
def test_pixels_that_an_exporter_leaves_out_are_no_edit(with_ball: Scene, missing: str) -> None:
    gone = np.zeros((VIEWS, HEIGHT, WIDTH), bool)
    if missing == "single pixels":
        gone = np.random.default_rng(0).random(gone.shape) < 0.1
    elif missing == "a border":
        gone[:, :3] = True
        gone[:, :, :3] = True
    elif missing == "a part up to the border":
        gone[:, :12, 20:40] = True
    elif missing == "many parts":  # with that of an object
        gone = shows_ball(with_ball)
        for x in range(3):
            for y in range(3):
                gone[:, 4 + y : -2 : 9, 4 + x : -2 : 9] = True
    else:
        gone = shows_ball(with_ball)
        with_ball = replace(with_ball, masks=~gone)
    assert_unchanged(scenes.shown_in(with_ball, ~gone))


def test_deleted_pixels_whose_colours_the_scene_has_are_no_edit(wall: Scene) -> None:
    """Such as those of a wall whose Gaussians a model was not sure of."""
    gone = np.zeros((VIEWS, HEIGHT, WIDTH), bool)
    gone[0, 10:30, 10:30] = True
    gone[1, 10:30, 30:50] = True
    gone[2, 20:40, 20:40] = True
    assert_unchanged(scenes.shown_in(wall, ~gone))


def test_gaussians_that_are_mostly_elsewhere_are_no_edit(with_ball: Scene) -> None:
    """Such as those of a file with rows in another order."""
    shuffled = np.random.default_rng(0).permutation(len(with_ball.gaussians))
    assert_unchanged(replace(with_ball, gaussians=with_ball.gaussians[shuffled]))


def test_base_colours_that_harmonics_make_up_for_are_no_edit(with_ball: Scene) -> None:
    """Some trainers write base colours that are far off, and harmonics of degree 1 that bring them back."""
    gaussians = with_ball.gaussians
    off = of_ball(with_ball)[:, None] * np.float32([0.3, 0.3, 0.3])
    to_wall = np.sqrt(3 / (4 * np.pi))  # of the harmonic along z, which all cameras look along
    shN = np.zeros((len(gaussians), 3, 3), np.float32)
    shN[:, 1] = off / np.float32(to_wall)
    sh0 = gaussians.sh0 - rgb_to_sh0(off + 0.5)[:, None]
    scene = replace(with_ball, gaussians=replace(gaussians, sh0=sh0.astype(np.float32), shN=shN), pixels=None)
    assert_unchanged(scene)


def test_gaussians_that_are_rough_all_over_are_no_edit(wall: Scene) -> None:
    """A quarter of the Gaussians has a colour that no photo has, and drawings of them differ everywhere."""
    rough = np.random.default_rng(0).random(len(wall.gaussians)) < 0.25
    scene = replace(changed(wall, rough, sh0=np.full((1, 1, 3), -9, np.float32)), pixels=None)
    assert_unchanged(scene)
