from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from gsmerge.drawing import preview
from gsmerge.errors import SceneError
from gsmerge.types import Cameras, Gaussians


def blob(color: float) -> Gaussians:
    """Make one large opaque Gaussian two units in front of the camera."""
    return Gaussians(
        means=np.array([[0.0, 0, 2]], np.float32),
        quats=np.array([[1.0, 0, 0, 0]], np.float32),
        scales=np.full((1, 3), 5.0, np.float32),
        opacities=np.array([0.95], np.float32),
        sh0=np.full((1, 1, 3), (color - 0.5) / 0.28209479, np.float32),
        shN=np.zeros((1, 0, 3), np.float32),
    )


def cameras(count: int) -> Cameras:
    K = np.array([[20.0, 0, 10], [0, 20, 6], [0, 0, 1]], np.float64)
    return Cameras(np.tile(np.eye(4), (count, 1, 1)), np.tile(K, (count, 1, 1)), 20, 12)


def test_contact_sheet_shows_scenes_left_to_right_below_their_labels() -> None:
    photos = np.full((2, 12, 20, 3), 0.2, np.float32)
    sheet = preview.contact_sheet(
        preview.view_pictures([("dark", blob(0.3)), ("bright", blob(0.9))], cameras(2), photos), min_width=20
    )
    tile_height, tile_width = 12 + preview.LABEL_HEIGHT, 20
    assert sheet.shape == (2 * tile_height + preview.GAP_PIXELS, 3 * tile_width + 2 * preview.GAP_PIXELS, 3)
    middle = preview.LABEL_HEIGHT + 6
    columns = [tile_width // 2 + i * (tile_width + preview.GAP_PIXELS) for i in range(3)]
    photo, dark, bright = (int(sheet[middle, x, 0]) for x in columns)
    assert photo == 51
    assert dark == pytest.approx(0.95 * 0.3 * 255, abs=4)
    assert bright == pytest.approx(0.95 * 0.9 * 255, abs=4)


def test_a_view_without_a_photo_is_drawn_without_a_score() -> None:
    photo = np.full((12, 20, 3), 0.2, np.float32)
    first, second = preview.view_pictures([("one", blob(0.3))], cameras(2), [None, photo], ["a.jpg", "b.jpg"])
    assert [text for text, _ in first] == ["a.jpg: no photo", "one: 1"]
    assert float(first[0][1].mean()) == preview.LABEL_LEVEL
    assert [text.partition(",")[0] for text, _ in second] == ["b.jpg", "one: 1"]
    assert second[1][0].endswith("dB to the photo")


def test_scores_of_a_panel_are_those_where_photos_count() -> None:
    photo, mask = np.full((12, 20, 3), 0.2, np.float32), np.zeros((12, 20), bool)
    mask[4:8, 8:12] = True
    texts = [
        preview.view_pictures([("one", blob(0.3))], cameras(1), [where], masks=[mask])[0][1][0]
        for where in (photo, np.where(mask[..., None], photo, np.float32(1)))
    ]
    assert texts[0] == texts[1]
    assert texts[0].endswith("dB to the photo, where it counts")


def test_labels_of_equal_pictures_say_no_difference() -> None:
    ((_, (text, _)),) = preview.view_pictures([("one", blob(0.3)), ("two", blob(0.3))], cameras(1))
    assert text == "two: 1, no difference to one"


@pytest.mark.parametrize(("name", "most"), [("a.webp", 16383), ("a.jpg", 65500)])
def test_pictures_too_long_for_their_format_are_refused(name: str, most: int, tmp_path: Path) -> None:
    preview.save_picture(tmp_path / name, np.zeros((1, most, 3), np.uint8))
    with pytest.raises(SceneError, match=f"{most:,}"):
        preview.save_picture(tmp_path / name, np.zeros((1, most + 1, 3), np.uint8))


@pytest.mark.parametrize("photos", [True, False])
def test_pictures_from_outside_have_neither_photo_nor_score(photos: bool) -> None:
    row = preview.outside_pictures([("dark", blob(0.3)), ("bright", blob(0.9))], cameras(2), photos=photos)
    assert [text for text, _ in row] == ["step back: no photo"] * photos + ["dark: step back", "bright: step back"]
    *blank, dark, bright = [float(image.mean()) for _, image in row]
    assert blank == [preview.LABEL_LEVEL] * photos
    assert 0 < dark < bright < 255


def test_small_renders_are_enlarged_by_whole_pixels() -> None:
    sheet = preview.contact_sheet(preview.view_pictures([("one", blob(0.5))], cameras(1)), min_width=50)
    assert sheet.shape == (3 * 12 + preview.LABEL_HEIGHT, 3 * 20, 3)


def test_long_labels_are_shortened_at_the_end_before_the_middle() -> None:
    short, long = (preview.shorten_text("scene.ply: 12,345, 20.1 dB", width, 0.42, 1) for width in (130, 300))
    assert (short, long) == ("scene.ply: 12,345", "scene.ply: 12,345, 20.1 dB")
    middle = preview.shorten_text("a_long_name_of_a_scene.ply", 80, 0.42, 1)
    assert middle.startswith("a_lon")
    assert middle.endswith(".ply")
    assert "..." in middle


def test_labels_never_widen_a_tile() -> None:
    picture = np.zeros((4, 30, 3), np.uint8)
    assert preview.label(picture, "a label that is far too long for it").shape == (4 + preview.LABEL_HEIGHT, 30, 3)
    wide = np.zeros((4, 1920, 3), np.uint8)
    assert preview.label(wide, "larger on a large tile").shape == (4 + 3 * preview.LABEL_HEIGHT, 1920, 3)


def test_values_beyond_the_range_are_clamped_in_a_picture() -> None:
    assert preview.to_picture(np.array([[[-1.0, 0.5, 2.0]]], np.float32)).tolist() == [[[0, 128, 255]]]


def test_a_chequered_ground_shows_where_nothing_is() -> None:
    scene = [("one", blob(0.3))]
    ((_, (_, plain)),) = preview.view_pictures([*scene, *scene], cameras(1))
    ((_, (_, chequered)),) = preview.view_pictures([*scene, *scene], cameras(1), background=None)
    assert plain.shape == chequered.shape
    assert (chequered.astype(int) >= plain.astype(int) - 1).all()  # the ground shines through
    ground = preview.lay_on_chequer(np.zeros((32, 32, 3), np.float32), np.ones((32, 32), np.float32))
    assert set(np.unique(preview.to_picture(ground))) == {102, 153}
    assert (ground[:8, :8] != ground[8:16, :8]).all()


def test_a_picture_with_alpha_is_written(tmp_path: Path) -> None:
    picture = np.zeros((4, 6, 4), np.uint8)
    picture[1, 2] = 10, 20, 30, 255
    preview.save_picture(tmp_path / "a.png", picture)
    assert cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)[1, 2].tolist() == [30, 20, 10, 255]
