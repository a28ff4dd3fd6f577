"""Pictures of the input are drawn where no view looks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import scenes
import unaligned_scenes
from messages import noted

from gsmerge import Compactor, CompactResult, Scene, compact, render
from gsmerge.method.geometry.frame import canonicalise
from gsmerge.method.geometry.views import subset
from gsmerge.prepare.draw_outside import draw_outside
from gsmerge.prepare.prepare_scene import prepare
from gsmerge.prepare.steps import without
from gsmerge.prepare.true_pixels import with_pixels
from gsmerge.types import SH_C0, LargePhotos, PicturedScene

VIEWS = 3
DOUBLE = np.array([[2.0], [2.0], [1.0]])  # intrinsics of photos of twice the size


def make_room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(VIEWS, 32, 24, span=3.0))


@pytest.fixture(scope="module")
def room() -> Scene:
    return make_room()


def seen_from(room: Scene, views: Sequence[int]) -> Scene:
    """Return all Gaussians of the room in no order, with the cameras and photos of some views."""
    whole = unaligned_scenes.without_order(room)
    names = tuple(room.names[view] for view in views)
    return replace(whole, cameras=room.cameras[views], images=room.images[views], names=names)


def pictured(scene: Scene) -> PicturedScene:
    """Return the canonical scene with its pixels and pictures."""
    return PicturedScene.with_pictures(with_pixels(canonicalise(scene)[0]), scene.images, None)


def make_part() -> PicturedScene:
    """Return the room as two of three views see it, with all that may belong to a photo."""
    scene, rng = pictured(seen_from(make_room(), [0, 1])), np.random.default_rng(0)
    masks, empty, importance = rng.random((3, *scene.images.shape[:3]), np.float32)
    large = LargePhotos(scene.cameras.Ks * DOUBLE, 64, 48, (7, 4), lambda photo: np.full((48, 64, 3), photo, np.uint8))
    return replace(scene, masks=masks < 0.5, empty=empty < 0.5, importance=1 + importance, large_photos=large)


@pytest.fixture(scope="module")
def drawings() -> tuple[PicturedScene, PicturedScene]:
    """Return that part of the room, and the same with drawings from outside."""
    part = make_part()
    return part, draw_outside(part)[0]


def test_drawings_from_outside_count_where_they_show_what_no_view_sees(
    drawings: tuple[PicturedScene, PicturedScene],
) -> None:
    part, drawn = drawings
    placed = drawn.cameras[range(len(part), len(drawn))]
    np.testing.assert_array_equal(drawn.images[len(part) :], render(part.gaussians, placed).images.clip(0, 1))
    unseen = part.pixels.homes < 0
    whites = np.where(unseen, 0.5, -0.5)[:, None, None] / SH_C0  # all others are black
    slow = render(replace(part.gaussians, sh0=np.repeat(whites, 3, 2).astype(np.float32)), placed)
    surplus = slow.images[..., 0] - slow.alphas[..., 0] / 2
    clear, counts = np.abs(surplus) > 1e-4, drawn.masks[len(part) :]
    np.testing.assert_array_equal(counts[clear], surplus[clear] > 0)
    assert 0 < counts.mean() < 1
    assert drawn.pixels.homes[unseen].max() >= len(part) * part.pixels_per_view  # and so they are members


def test_drawings_from_outside_do_not_change_own_views(drawings: tuple[PicturedScene, PicturedScene]) -> None:
    part, drawn = drawings
    assert len({*drawn.names}) == len(drawn) > len(part)
    assert drawn.gaussians is part.gaussians
    own = subset(drawn, range(len(part)))
    for name in ("images", "masks", "importance", "empty", "names"):
        np.testing.assert_array_equal(getattr(own, name), getattr(part, name))
    np.testing.assert_array_equal(own.cameras.viewmats, part.cameras.viewmats)
    assert (drawn.importance[len(part) :] == 1).all()
    assert not drawn.empty[len(part) :].any()
    assert draw_outside(replace(part, masks=None))[0].masks[: len(part)].all()


def test_larger_photos_get_larger_drawings(drawings: tuple[PicturedScene, PicturedScene]) -> None:
    """Those of the views are read as before, by their own numbers."""
    part, drawn = drawings
    photos = drawn.large_photos
    assert [photos.read(number)[0, 0, 0] for number in photos.ids[: len(part)]] == [7, 4]
    np.testing.assert_allclose(photos.Ks, drawn.cameras.Ks * DOUBLE)
    pictures = np.stack([photos.read(number) for number in photos.ids[len(part) :]])
    placed = replace(drawn.cameras, Ks=photos.Ks, width=64, height=48)[range(len(part), len(drawn))]
    np.testing.assert_allclose(pictures / 255, render(part.gaussians, placed).images.clip(0, 1), atol=0.5 / 254)


@pytest.mark.parametrize("far", [0, VIEWS * 32 * 24], ids=["views see all", "views see nothing"])
def test_nothing_is_drawn_where_views_see_all_or_nothing(room: Scene, far: int) -> None:
    scene = pictured(seen_from(room, range(VIEWS)))
    if far:
        scene = with_pixels(replace(scene, gaussians=unaligned_scenes.far_behind(scene.gaussians, far), pixels=None))
    assert draw_outside(scene)[0] is scene


def refuse(_: PicturedScene) -> PicturedScene:
    raise AssertionError


CALLS: dict[str, Callable[[Scene], object]] = {
    "prepare": lambda room: prepare(seen_from(room, [0, 1]), steps=without("outside")),
    "blocks": lambda room: compact(room, blocks=2, superpixels="10%", fit="none"),
    "features": lambda room: Compactor(recipe="paper", superpixels="10%").extend(seen_from(room, [0, 1])),
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_nothing_is_drawn_for_parts_of_a_scene(
    room: Scene, monkeypatch: pytest.MonkeyPatch, call: Callable[[Scene], object]
) -> None:
    """Other views may see what theirs do not."""
    monkeypatch.setattr("gsmerge.prepare.steps.draw_outside", refuse)
    call(room)


def test_gaussians_that_no_view_sees_stay_in_a_result(room: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    part, away = seen_from(room, [0, 1]), seen_from(room, [2])

    def compact_part() -> CompactResult:
        return compact(part, budget=300, fit_steps=20)

    result = compact_part()
    assert len(result.gaussians) == 300
    assert noted(result.report.choices["changes"], "no view sees 5 % of the Gaussians", "from 1 place beside")
    monkeypatch.setattr("gsmerge.prepare.steps.draw_outside", lambda scene: (scene, ""))
    scores = [scenes.psnr_of(gaussians, away) for gaussians in (result.gaussians, compact_part().gaussians)]
    assert scores[0] > scores[1] + 4  # dB: without drawings a part is missing
    assert scores[0] > scenes.psnr_of(part.gaussians, away) - 3  # dB: a result of 300 Gaussians is coarser
