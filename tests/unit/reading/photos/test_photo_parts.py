"""Photos that show more than their views are cut to a part, or all are left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from exports import smooth_scene
from hypothesis import given
from hypothesis import strategies as st
from messages import noted

from gsmerge.io.photo_files import cut_part, part_size, reaches_beyond
from gsmerge.method.geometry.transforms import sh0_to_rgb
from gsmerge.method.kernels.pictures import count_bars
from gsmerge.reading.photos import photo_parts
from gsmerge.reading.photos.grid_fit import PartFit, clear_beyond
from gsmerge.reading.photos.photo_parts import BAR_SPREAD, find_edge, list_parts
from gsmerge.reading.read_scene import load_scene

SMOOTH = smooth_scene(48, 36)
Change = Callable[[np.ndarray], np.ndarray]


def other(photo: np.ndarray) -> np.ndarray:
    """Return a picture of the same size that shows something else."""
    return np.ascontiguousarray(cv2.GaussianBlur(photo[::-1, ::-1], (0, 0), 2))


def write_photos(folder: Path, change: Change) -> None:
    SMOOTH.save(folder)
    for name, image in zip(SMOOTH.names, SMOOTH.images, strict=True):
        assert cv2.imwrite(str(folder / "images" / name), change(image)[..., ::-1])


CASES: dict[str, tuple[Change, tuple[object, ...]]] = {
    "left": (lambda i: np.hstack([i, other(i)]), ("96 x 36", "48 x 36", "column 0")),
    "below": (lambda i: np.vstack([other(i), i]), ("48 x 72", "line 36")),
    "sheet": (lambda i: np.vstack([np.hstack([other(i)] * 2), np.hstack([other(i), i])]), ("96 x 72", "line 36")),
    "bars": (lambda i: np.pad(i, ((9, 9), (12, 12), (0, 0))), ("bars", "72 x 54", "48 x 36")),
    "both eyes squeezed": (
        lambda i: cv2.resize(np.hstack([i, other(i)]), (48, 36), interpolation=cv2.INTER_AREA),
        ("24 x 36", "48 x 36"),
    ),
    "squeezed": (lambda i: cv2.resize(i, (36, 36), interpolation=cv2.INTER_AREA), ("36 x 36", "48 x 36")),
}


@pytest.mark.parametrize("name", CASES)
def test_a_part_that_fits_is_cut_out(tmp_path: Path, name: str) -> None:
    change, words = CASES[name]
    write_photos(tmp_path, change)
    loaded = load_scene(tmp_path)
    images = loaded.scene.images
    assert noted(loaded.notes, *words)
    assert np.abs(images * 255 - SMOOTH.images).mean() < 6


# Columns and lines that are cut off photos of 192 x 144 at the left, above, on the right and below, and a later scale
CROPS = {
    "right": ((0, 0, 20, 0), 1),
    "all sides": ((12, 6, 8, 12), 1),
    "in proportion": ((16, 12, 8, 6), 1),
    "shrunk": ((0, 24, 0, 0), 0.75),
    "to three fifths": ((28, 8, 10, 28), 1),
}


@pytest.mark.parametrize("name", CROPS)
def test_photos_that_were_cropped_are_put_into_their_views(tmp_path: Path, name: str) -> None:
    """What was cut off does not count, and rows stay pixels of the whole views."""
    (left, top, right, bottom), scale = CROPS[name]
    whole = smooth_scene(192, 144)
    whole.save(tmp_path)
    rest = np.s_[top : 144 - bottom, left : 192 - right]
    for image_name, image in zip(whole.names, whole.images, strict=True):
        crop = cv2.resize(image[rest], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        assert cv2.imwrite(str(tmp_path / "images" / image_name), crop[..., ::-1])
    loaded = load_scene(tmp_path)
    scene = loaded.scene
    assert noted(loaded.notes, f"column {round(left * scale)} and line {round(top * scale)} on", "crops of the views")
    inner = np.s_[:, top + 2 : 142 - bottom, left + 2 : 190 - right]
    assert scene.has_own_pixels
    assert scene.masks[inner].all()
    assert scene.masks.sum() == pytest.approx(len(scene) * whole.images[0][rest].size / 3, rel=0.05)
    assert np.abs(scene.images[inner] * 255 - whole.images[inner]).mean() < (1 if scale == 1 else 4)


def test_smaller_photos_of_whole_views_are_compared_with_crops_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As beside cameras of the photos' full size."""
    whole = smooth_scene(192, 144)
    whole.save(tmp_path)
    for name, image in zip(whole.names, whole.images, strict=True):
        small = cv2.resize(image, (144, 108), interpolation=cv2.INTER_AREA)
        assert cv2.imwrite(str(tmp_path / "images" / name), small[..., ::-1])
    monkeypatch.setattr(photo_parts, "list_parts", None)
    loaded = load_scene(tmp_path)
    assert loaded.scene.masks is None
    assert len(loaded.scene.photo_views) == len(whole.images)
    assert not noted(loaded.notes, "crops of the views")


@pytest.mark.slow
def test_photos_of_which_no_part_fits_are_left_out(tmp_path: Path) -> None:
    write_photos(tmp_path, lambda i: np.hstack([other(i), other(i)]))
    loaded = load_scene(tmp_path)
    assert loaded.scene.images is None
    assert len(loaded.scene) == len(SMOOTH.images)
    assert noted(loaded.notes, tmp_path / "images", "96 x 36", "no part")


@pytest.mark.parametrize("least", [0, 0.6], ids=["from black to white", "bright"])
@pytest.mark.parametrize("as_rgb", [False, True])
def test_photos_decide_whether_colors_are_rgb(tmp_path: Path, as_rgb: bool, least: float) -> None:
    """All values lie in [0, 1]; photos are bright and faint if these are harmonics."""
    rgb = np.clip(sh0_to_rgb(SMOOTH.gaussians.sh0), 0, 1)
    values = least + (1 - least) * (rgb - rgb.min()) / np.ptp(rgb)
    photos = np.round(255 * (values if as_rgb else sh0_to_rgb(values))).reshape(SMOOTH.images.shape).astype(np.uint8)
    scene = replace(SMOOTH, images=photos, gaussians=replace(SMOOTH.gaussians, sh0=values.astype(np.float32)))
    scene.save(tmp_path)
    path = next(tmp_path.glob("*.ply"))
    path.write_bytes(path.read_bytes().replace(b"comment opacity: logit\n", b""))  # as of another program
    loaded = load_scene(tmp_path)
    assert noted(loaded.notes, "colors=sh") == as_rgb
    shown = sh0_to_rgb(loaded.scene.gaussians.sh0).reshape(photos.shape)
    assert np.abs(255 * shown - photos).max() < 2


def test_masks_are_cut_as_the_larger_photos_are(tmp_path: Path) -> None:
    write_photos(tmp_path, lambda i: cv2.resize(np.hstack([other(i), i]), (192, 72)))
    (tmp_path / "masks" / SMOOTH.names[0]).parent.mkdir(parents=True)
    mask = np.zeros((72, 192), np.uint8)
    mask[:, 144:] = 255  # the right half of the right picture
    for name in SMOOTH.names:
        assert cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), mask)
    scene = load_scene(tmp_path).scene
    assert scene.masks[:, :, 24:].all()
    assert not scene.masks[:, :, :24].any()
    assert (scene.large_photos.width, scene.large_photos.height) == (96, 72)


@pytest.mark.parametrize("quality", [50, 80, 95])
@pytest.mark.parametrize("level", [0, 255])
def test_the_edge_of_a_bar_is_found_in_a_jpeg(quality: int, level: int) -> None:
    """Its blocks of 16 pixels have lines that look neither like the bar nor like the photo."""
    photo = np.random.default_rng(0).integers(60, 200, (12, 17, 3), np.uint8)
    photo = cv2.resize(photo, (170, 120), interpolation=cv2.INTER_CUBIC)
    framed = cv2.copyMakeBorder(photo, 20, 45, 23, 20, cv2.BORDER_CONSTANT, value=(level,) * 3)
    stored = cv2.imdecode(cv2.imencode(".jpg", framed, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)
    above, below, left, right = count_bars(stored, BAR_SPREAD)
    columns = stored.swapaxes(0, 1)
    sides = [(stored, above), (stored[::-1], below), (columns, left), (columns[::-1], right)]
    assert max(above, left) < 23  # or nothing is shown
    assert [find_edge(lines, width) for lines, width in sides] == [20, 45, 23, 20]


def test_parts_have_the_shape_of_views_or_are_stretched_to_it() -> None:
    fits = list_parts((96, 36), (48, 36), (0, 0, 1, 1))
    for fit in fits:
        size = part_size((96, 36), fit.part)
        assert (fit.shape is None) == (abs(size[0] * 36 / (size[1] * 48) - 1) < 0.02)
    assert fits[0].shape is None
    assert fits[-1].shape == (48, 36)


def test_part_of_a_photo_is_cut_by_shares_of_its_sides() -> None:
    photo = np.arange(4 * 8 * 3, dtype=np.uint8).reshape(4, 8, 3)
    assert np.array_equal(cut_part(photo, (0.5, 0.25, 1, 1)), photo[1:, 4:])
    assert PartFit((0, 0, 0.5, 1), (8, 4)).cut(photo).shape == (4, 8, 3)


@given(st.integers(-3, 7), st.integers(-3, 4), st.integers(4, 12), st.integers(4, 12))
def test_a_part_that_reaches_beyond_a_photo_is_extended_by_zeros(left: int, top: int, width: int, height: int) -> None:
    photo = 1 + np.arange(8 * 5).reshape(5, 8)
    shares = (left / 8, top / 5, (left + width) / 8, (top + height) / 5)
    padded = np.pad(photo, 20)[20 + top : 20 + top + height, 20 + left : 20 + left + width]
    assert np.array_equal(cut_part(photo, shares), padded)
    assert reaches_beyond(shares) == (left < 0 or top < 0 or left + width > 8 or top + height > 5)
    weights = np.ones((height, width), np.float32)
    clear_beyond(weights, shares)
    assert np.array_equal(weights > 0, padded > 0)
