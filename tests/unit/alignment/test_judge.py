"""Readings that the pixels alone do not tell apart, and photos that speak against a reading."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import Smooth, export_rows, save_export, smooth_scene, write_transforms
from tiny_scene import make_tiny, write_images

from gsmerge.alignment import readings
from gsmerge.alignment.judge import COLOR_MARGIN, Recovery, accept_reading
from gsmerge.alignment.readings import read_grid
from gsmerge.alignment.score import SHUFFLED_MARGIN, AlignmentInput
from gsmerge.io.photo_files import NO_IMAGES
from gsmerge.scene.read import load_scene
from gsmerge.types import SH_C0, Cameras


def clues_of(smooth: Smooth, images: np.ndarray | None, labellings: list[list[int]] | None = None) -> AlignmentInput:
    """Three cameras, the Gaussians and any photos."""
    w2c, Ks = smooth.w2c, np.tile(smooth.K, (3, 1, 1))
    photos = NO_IMAGES if images is None else images.astype(np.float32) / 255
    valid = np.ones(len(smooth.gaussians), bool)
    cameras = Cameras(w2c, Ks, smooth.width, smooth.height)
    return AlignmentInput(smooth.gaussians, valid, cameras, photos, labellings or [[0, 1, 2]], lambda: None)


def recover(inputs: AlignmentInput, *, exact_frames: bool = False) -> Recovery | None:
    """Read the rows of one grid and judge."""
    return accept_reading(inputs, read_grid(inputs, exact_frames=exact_frames))


@pytest.fixture(scope="module")
def twins() -> Smooth:
    """Two views from one place and another one; each has photos of its own."""
    tiny = smooth_scene(48, 36)
    c2w, size = tiny.c2w.copy(), 48 * 36
    c2w[1] = c2w[0]
    means = tiny.gaussians.means.copy()
    means[size : 2 * size] = means[:size]
    images = make_tiny(48, 36).images
    colors = (images.reshape(-1, 1, 3).astype(np.float32) / 255 - 0.5) / SH_C0
    return replace(tiny, c2w=c2w, images=images, gaussians=replace(tiny.gaussians, means=means, sh0=colors))


SWAPPED = [[0, 1, 2], [1, 0, 2]]


@pytest.mark.parametrize("true", SWAPPED)
def test_colours_tell_views_from_one_place_apart(twins: Smooth, true: list[int]) -> None:
    inverse = np.argsort(true, kind="stable")
    actual = recover(clues_of(twins, twins.images[inverse], SWAPPED))
    assert isinstance(actual, Recovery)
    assert list(actual.best.layout.views) == true
    assert actual.margin == pytest.approx(1, abs=0.1)
    assert actual.color_margin > COLOR_MARGIN
    assert "which fits the pixels as well" in actual.description
    assert actual.confirmed


def test_where_neither_decides_nothing_is_taken(twins: Smooth) -> None:
    strange = np.random.default_rng(7).integers(0, 256, twins.images.shape, np.uint8)
    assert recover(clues_of(twins, strange, SWAPPED)) is None


def test_readings_that_differ_in_nothing_need_no_decision(twins: Smooth) -> None:
    alike = twins.images.copy()
    alike[1] = alike[0]
    for images in (None, alike, np.full_like(alike, 99)):
        actual = recover(clues_of(twins, images, SWAPPED))
        assert isinstance(actual, Recovery)
        assert list(actual.best.layout.views) == [0, 1, 2]


def test_the_order_of_names_and_that_of_the_file(tmp_path: Path, twins: Smooth) -> None:
    """Cameras in the order 2, 10, 11 and rows by another one: only the colours know which photo is whose."""
    size = 48 * 36
    rows = export_rows(twins, np.concatenate([np.arange(size) + v * size for v in (1, 0, 2)]))
    folder = save_export(tmp_path, twins, rows, cameras=False)
    swapped = replace(twins, names=("b.png", "a.png", "c.png"))
    write_transforms(folder / "transforms.json", swapped)
    write_images(folder / "images", swapped)
    scene = load_scene(folder).pixel_scene()
    assert scene.names == ("images/a.png", "images/b.png", "images/c.png")
    base = 0.5 + SH_C0 * scene.gaussians.sh0.reshape(3, 36, 48, 3)
    assert np.abs(base - scene.images).max() < 0.01


def test_colours_do_not_overrule_pixels() -> None:
    """Photos in the wrong order: the reading stands, and it is said that the photos do not confirm it."""
    tiny = replace(smooth_scene(48, 36), images=make_tiny(48, 36).images)
    actual = recover(clues_of(tiny, tiny.images))
    assert actual.confirmed is False
    assert actual.description.endswith("the photos' colours do not confirm it")


def test_photos_that_agree_or_cannot_tell() -> None:
    tiny = smooth_scene(48, 36)
    flat = np.full_like(tiny.images, 128)
    grey = replace(tiny, gaussians=replace(tiny.gaussians, sh0=np.zeros_like(tiny.gaussians.sh0)))
    for scene, images, confirmed in ((tiny, tiny.images, True), (tiny, None, None), (grey, flat, None)):
        actual = recover(clues_of(scene, images))
        assert actual.confirmed is confirmed
        assert "confirm" not in actual.description


def test_a_plain_file_is_not_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files in which the rows as they are leave a doubt are."""
    tiny, searched = smooth_scene(48, 36), []
    monkeypatch.setattr(readings, "possible_layouts", lambda inputs: searched.append(inputs) or [])
    plain = clues_of(tiny, tiny.images)
    actual = recover(plain)
    assert isinstance(actual, Recovery)
    assert actual.best.layout.is_plain
    assert actual.runner_up is None
    assert actual.margin > SHUFFLED_MARGIN
    assert searched == []
    order = np.arange(len(tiny.gaussians)).reshape(3, -1).T.reshape(-1)
    far = replace(plain.cameras, Ks=plain.cameras.Ks + np.array([[0, 0, 0.7], [0, 0, 0], [0, 0, 0]], np.float32))
    doubtful = (
        replace(plain, gaussians=plain.gaussians[order]),
        replace(plain, cameras=far),
        replace(plain, scale=1.0),
        replace(plain, order="column-major"),
        replace(plain, gaussians=plain.gaussians[:-1], valid=plain.valid[:-1]),
    )
    for number, inputs in enumerate(doubtful, 1):
        recover(inputs, exact_frames=True)
        assert len(searched) == number
