"""Readings that the pixels alone do not tell apart, and photos that speak against a reading."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exports import Smooth, export_rows, save_export, smooth_scene, write_transforms
from messages import names, refuses
from tiny_scene import make_tiny, write_images

from gsmerge.alignment import Recovery, rows_first
from gsmerge.alignment.judge import COLOR_MARGIN
from gsmerge.alignment.score import SHUFFLED_MARGIN
from gsmerge.errors import SceneError
from gsmerge.scene.read import Loaded, load_scene
from gsmerge.types import SH_C0

ROWS = np.arange(3 * 36 * 48).reshape(3, 36, 48)


def save(folder: Path, scene: Smooth, rows: np.ndarray, images: np.ndarray | None) -> Path:
    """Write rows, cameras and photos, if any."""
    save_export(folder, scene, rows, cameras=False)
    write_transforms(folder / "transforms.json", scene)
    if images is not None:
        write_images(folder / "images", replace(scene, images=images))
    return folder


def read(folder: Path, scene: Smooth, images: np.ndarray | None) -> tuple[Loaded, Recovery]:
    """Read a file whose rows are the pixels in order."""
    loaded = load_scene(save(folder, scene, export_rows(scene), images), order="view-major")
    assert loaded.recovery is not None
    return loaded, loaded.recovery


@pytest.fixture(scope="module")
def twins() -> Smooth:
    """Two views from one place and another one; each has photos of its own. By name the second comes first."""
    tiny = smooth_scene(48, 36)
    c2w, size = tiny.c2w.copy(), 48 * 36
    c2w[1] = c2w[0]
    means = tiny.gaussians.means.copy()
    means[size : 2 * size] = means[:size]
    images = make_tiny(48, 36).images
    colors = (images.reshape(-1, 1, 3).astype(np.float32) / 255 - 0.5) / SH_C0
    gaussians = replace(tiny.gaussians, means=means, sh0=colors)
    return replace(tiny, c2w=c2w, images=images, gaussians=gaussians, names=("b.png", "a.png", "c.png"))


@pytest.mark.parametrize("true", [[0, 1, 2], [1, 0, 2]])
def test_colours_tell_views_from_one_place_apart(tmp_path: Path, twins: Smooth, true: list[int]) -> None:
    loaded, recovery = read(tmp_path, twins, twins.images[np.argsort(true, kind="stable")])
    assert loaded.views.used == tuple(true)
    assert recovery.color_margin is not None
    assert recovery.color_margin > COLOR_MARGIN
    assert "which fits the pixels as well" in recovery.description
    assert recovery.confirmed


def test_where_neither_decides_nothing_is_taken(tmp_path: Path, twins: Smooth) -> None:
    strange = np.random.default_rng(7).integers(0, 256, twins.images.shape, np.uint8)
    with refuses(SceneError, "transforms.json", "several", "--hint order=NAME"):
        folder = save(tmp_path, twins, export_rows(twins), strange)
        load_scene(folder, order="view-major", cameras=folder, images=folder / "images")


def test_readings_that_differ_in_nothing_need_no_decision(tmp_path: Path, twins: Smooth) -> None:
    alike = twins.images.copy()
    alike[1] = alike[0]
    for i, images in enumerate((None, alike, np.full_like(alike, 99))):
        loaded, _ = read(tmp_path / str(i), twins, images)
        assert loaded.views.used == (0, 1, 2)


def test_the_order_of_names_and_that_of_the_file(tmp_path: Path, twins: Smooth) -> None:
    """Rows in the order of the names, cameras in another one: only the colours know which photo is whose."""
    rows = export_rows(twins, ROWS[[1, 0, 2]].reshape(-1))
    scene = load_scene(save(tmp_path, twins, rows, twins.images)).pixel_scene()
    assert scene.names == ("images/a.png", "images/b.png", "images/c.png")
    base = 0.5 + SH_C0 * scene.gaussians.sh0.reshape(3, 36, 48, 3)
    assert np.abs(base - scene.images).max() < 0.01


def test_colours_do_not_overrule_pixels(tmp_path: Path) -> None:
    """Photos of something else: the reading stands, and they are not used."""
    loaded, recovery = read(tmp_path, smooth_scene(48, 36), make_tiny(48, 36).images)
    assert recovery.confirmed is None
    assert loaded.scene.images is None
    assert names(str(loaded.left_out), "photos", "left out")


def test_photos_that_agree_or_cannot_tell(tmp_path: Path) -> None:
    tiny = smooth_scene(48, 36)
    flat = np.full_like(tiny.images, 128)
    grey = replace(tiny, gaussians=replace(tiny.gaussians, sh0=np.zeros_like(tiny.gaussians.sh0)))
    for i, (scene, images, confirmed) in enumerate(((tiny, tiny.images, True), (tiny, None, None), (grey, flat, None))):
        _, recovery = read(tmp_path / str(i), scene, images)
        assert recovery.confirmed is confirmed
        assert "confirm" not in recovery.description


def test_a_plain_file_is_not_searched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files in which the rows as they are leave a doubt are."""
    tiny, searched = smooth_scene(48, 36), []
    usual = rows_first._search

    def search(*args: object) -> object:
        searched.append(args)
        return usual(*args)

    monkeypatch.setattr(rows_first, "_search", search)
    _, recovery = read(tmp_path / "plain", tiny, tiny.images)
    assert recovery.best.layout.is_plain
    assert recovery.margin > SHUFFLED_MARGIN
    assert searched == []
    far = replace(tiny, K=tiny.K + np.array([[0, 0, 0.7], [0, 0, 0], [0, 0, 0]]))
    doubtful = (
        (tiny, export_rows(tiny, ROWS.reshape(3, -1).T.reshape(-1)), {}),
        (far, export_rows(tiny), {"order": "view-major"}),
        (tiny, export_rows(tiny), {"scene_scale": 1.0}),
        (tiny, export_rows(tiny, ROWS.transpose(0, 2, 1).reshape(-1)), {"order": "column-major"}),
        (tiny, export_rows(tiny)[:-1], {}),
    )
    for number, (scene, rows, hints) in enumerate(doubtful, 1):
        loaded = load_scene(save(tmp_path / str(number), scene, rows, tiny.images), **hints)
        assert loaded.scene.has_own_pixels
        assert len(searched) == number
