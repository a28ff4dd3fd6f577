"""Photos that do not show the scene are left out: black, noise, of another scene or view (stability.md, case 56)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scenes
from messages import noted
from sweeps import sweep

from gsmerge import CompactResult, Gaussians, Scene, compact
from gsmerge.method.compare.view_pictures import show_views
from gsmerge.method.facts.pictures import ROW_COLORS
from gsmerge.method.geometry.frame import canonicalise
from gsmerge.prepare.compare_photos import compare_photos, find_matching_views
from gsmerge.types import PicturedScene

Photos = np.ndarray
VIEWS = 6
WIDTH, HEIGHT = 64, 48
FIT = {"superpixels": 50, "fit_steps": 30, "checkpoint": "none", "poses": "fixed"}


def only(view: int, change: Callable[[Photos], Photos], photos: Photos) -> Photos:
    """Change one photo alone."""
    return np.where(np.arange(VIEWS)[:, None, None, None] == view, change(photos), photos)


def two_swapped(photos: Photos) -> Photos:
    return photos[[0, 4, 2, 3, 1, 5]]


def one_black(photos: Photos) -> Photos:
    return only(3, all_black, photos)


def all_black(photos: Photos) -> Photos:
    return np.zeros_like(photos)


def all_noise(photos: Photos) -> Photos:
    return np.random.default_rng(0).random(photos.shape, np.float32)


def all_of_another_view(photos: Photos) -> Photos:
    return np.roll(photos, 3, 0)


def all_of_another_scene(photos: Photos) -> Photos:
    return scenes.make_scene(scenes.wall(9), scenes.arc(VIEWS, WIDTH, HEIGHT)).images


def one_of_noise(photos: Photos) -> Photos:
    return only(2, all_noise, photos)


def one_of_another_scene(photos: Photos) -> Photos:
    return only(4, all_of_another_scene, photos)


SPOILT: dict[Callable[[Photos], Photos], list[int]] = {  # which photos are odd then
    two_swapped: [1, 4],
    one_black: [3],
    one_of_noise: [2],
    one_of_another_scene: [4],
    all_black: list(range(VIEWS)),
    all_noise: list(range(VIEWS)),
    all_of_another_view: list(range(VIEWS)),
    all_of_another_scene: list(range(VIEWS)),
}


def make_room() -> Scene:
    return scenes.make_scene(scenes.room(), scenes.arc(VIEWS, WIDTH, HEIGHT), noise=0.005)


@pytest.fixture(scope="module")
def room() -> Scene:
    return make_room()


@pytest.fixture(scope="module")
def unspoilt() -> CompactResult:
    return compact(make_room(), **FIT)


def with_photos(room: Scene, change: Callable[[Photos], Photos], *, aligned: bool = True) -> Any:
    scene = replace(room, images=change(room.images))
    return scene if aligned else Scene(scene.gaussians, scene.cameras, scene.images, None, scene.names)


def odd_photos(room: Scene, change: Callable[[Photos], Photos]) -> list[int]:
    scene, _ = canonicalise(with_photos(room, change, aligned=False))
    pictured = PicturedScene.with_pictures(scene, scene.images, None)
    return sorted(
        {*range(len(scene))} - {*find_matching_views(pictured, range(len(scene)), scene.images, show_views(pictured))}
    )


def novel_psnr(gaussians: Gaussians) -> float:
    return scenes.psnr_of(gaussians, scenes.make_scene(scenes.room(), scenes.arc(1, WIDTH, HEIGHT, start=-0.2)))


@sweep("change", SPOILT, often=4)
def test_odd_photos_are_recognised_in_drawings(room: Scene, change: Callable[[Photos], Photos]) -> None:
    assert odd_photos(room, change) == SPOILT[change]


@sweep("change", [change for change, odd in SPOILT.items() if len(odd) < VIEWS])
def test_colours_of_rows_replace_photos_of_something_else(room: Scene, change: Callable[[Photos], Photos]) -> None:
    """Where the photo is that of another view, what both show alike stays."""
    compared, views, _ = compare_photos(PicturedScene.with_pictures(canonicalise(room)[0], change(room.images), None))
    away = np.abs(compared.images - room.images).mean((1, 2, 3))
    assert away.max() < 0.05
    assert set(range(VIEWS)) - set(views) <= set(SPOILT[change])


def darker(photos: Photos) -> Photos:
    return photos * np.linspace(0.05, 1, VIEWS, dtype=np.float32)[:, None, None, None]


def overexposed(photos: Photos) -> Photos:
    return (photos * np.linspace(1, 2, VIEWS, dtype=np.float32)[:, None, None, None]).clip(0, 1)


def tinted(photos: Photos) -> Photos:
    gains = np.random.default_rng(0).uniform(0.3, 1, (VIEWS, 1, 1, 3)).astype(np.float32)
    return gains * np.sqrt(photos)


def shifted(photos: Photos) -> Photos:
    """Shift photos by a pixel, as where the cameras are not exact."""
    return np.roll(photos, 1, 2)


@pytest.mark.parametrize(
    "change",
    [np.copy, darker, overexposed, tinted, shifted],
    ids=["unchanged", "darker one by one", "overexposed", "tinted", "shifted by a pixel"],
)
def test_photos_of_the_scene_stay(room: Scene, change: Callable[[Photos], Photos]) -> None:
    assert odd_photos(room, change) == []


def test_gaussians_that_show_nothing_leave_out_no_photo(room: Scene) -> None:
    plain = replace(room, gaussians=replace(room.gaussians, sh0=np.zeros_like(room.gaussians.sh0)))
    assert odd_photos(plain, np.copy) == []


def test_photos_of_a_few_pixels_are_not_left_out() -> None:
    assert odd_photos(scenes.make_scene(scenes.room(), scenes.arc(3, 24, 16)), np.copy) == []


@sweep("change", [one_black, one_of_noise, one_of_another_scene])
def test_fit_without_odd_photos_is_nearly_as_good(
    room: Scene, unspoilt: CompactResult, change: Callable[[Photos], Photos]
) -> None:
    """Nearly as good as with all photos, and as the input; the note and the report name them."""
    odd = SPOILT[change]
    result = compact(with_photos(room, change), **FIT)
    names = [room.names[view] for view in odd]
    assert noted(result.report.notes, f"{len(odd)} of {VIEWS}", ", ".join(names))
    assert result.report.choices["photos_left_out"] == names
    assert result.report.choices["fit"]["accepted"]
    assert novel_psnr(result.gaussians) > novel_psnr(unspoilt.gaussians) - 1
    assert result.report.psnr_after == pytest.approx(unspoilt.report.psnr_after, abs=1)


@sweep("change", [all_black, all_noise, all_of_another_scene])
@sweep("settings", [{}, {"budget": 125}, {"budget": "auto"}])
def test_no_photo_is_used_where_most_are_wrong(
    room: Scene, change: Callable[[Photos], Photos], settings: dict[str, Any]
) -> None:
    wanted = {**FIT, **settings}
    result, without = (compact(one, **wanted) for one in (with_photos(room, change), replace(room, images=None)))
    assert noted(result.report.notes, f"{VIEWS} of {VIEWS}", "photos", "no photo is used")
    assert result.report.psnr_reference == without.report.psnr_reference == ROW_COLORS
    assert scenes.identical(result.gaussians, without.gaussians)


def test_unaligned_gaussians_are_fitted_to_renders(room: Scene) -> None:
    scene = with_photos(room, all_black, aligned=False)
    result, without = compact(scene, **FIT), compact(replace(scene, images=None), **FIT)
    assert result.report.choices["fidelity"] == without.report.choices["fidelity"]
    assert scenes.identical(result.gaussians, without.gaussians)


def test_good_photos_get_no_note(unspoilt: CompactResult) -> None:
    assert [note for note in unspoilt.report.notes if note != unspoilt.report.worse] == []
    assert "photos_left_out" not in unspoilt.report.choices


@pytest.mark.slow
def test_quality_target_is_measured_on_the_other_photos(room: Scene) -> None:
    """A black photo would keep any result from it."""
    result = compact(with_photos(room, one_black), quality="22dB", **FIT)
    assert result.report.unmet is None
    assert result.report.choices["photos_left_out"] == [room.names[3]]
