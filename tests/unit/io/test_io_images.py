from __future__ import annotations

import weakref
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_scene import Tiny, write_images

from gsmerge.errors import SceneError
from gsmerge.io import photos, read_images
from gsmerge.io.photos import match_images, natural_key
from gsmerge.runtime.threads import use_threads


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def test_values_and_colour_order(tmp_path: Path, tiny: Tiny) -> None:
    write_images(tmp_path, tiny)
    images = read_images(tmp_path, tiny.names)
    assert images.dtype == np.float32
    assert images.shape == (3, 14, 20, 3)
    assert np.array_equal((images * 255).round(), tiny.images)
    assert images.max() <= 1


@pytest.mark.parametrize("shorten", [
    lambda n: n, lambda n: Path(n).name, lambda n: Path(n).stem, lambda n: f"images/{n}", lambda n: f"./{n}",
    lambda n: n.removesuffix(".png"), lambda n: n.replace(".png", ".jpg"), lambda n: n.replace("/", "\\"),
])  # fmt: skip
def test_names_with_and_without_folder_and_extension(tmp_path: Path, tiny: Tiny, shorten) -> None:
    write_images(tmp_path, tiny)
    order = [2, 0, 1]
    images = read_images(tmp_path, [shorten(tiny.names[i]) for i in order])
    assert np.array_equal((images * 255).round(), tiny.images[order])


def test_names_with_dots(tmp_path: Path) -> None:
    touch(tmp_path, "view.0001.png", "view.0002.png")
    assert [p.name for p in match_images(tmp_path, ["view.0002", "view.0001"])] == ["view.0002.png", "view.0001.png"]


def test_the_longest_path_decides(tmp_path: Path) -> None:
    touch(tmp_path, "left/1.png", "right/1.png")
    actual = match_images(tmp_path, ["right/1", "left/1.png"])
    assert [p.parent.name for p in actual] == ["right", "left"]
    with pytest.raises(SceneError, match=r"expected one image named 1\.png, found 1\.png and 1\.png"):
        match_images(tmp_path, ["1.png", "left/1.png"])


def test_unknown_names_take_the_order_if_the_counts_agree(tmp_path: Path) -> None:
    touch(tmp_path, "2.png", "10.png", "1.png", "notes.txt", ".hidden.png")
    actual = match_images(tmp_path, ["view 0", "view 1", "view 2"])
    assert [p.name for p in actual] == ["1.png", "2.png", "10.png"]
    with pytest.raises(SceneError, match="expected 2 images, one per camera, found 3 and none for view 0"):
        match_images(tmp_path, ["view 0", "view 1"])
    with pytest.raises(SceneError, match="expected 3 images, one per camera, found 3 and none for view 1"):
        match_images(tmp_path, ["1", "view 1", "2"])


def test_a_list_of_files(tmp_path: Path) -> None:
    touch(tmp_path, "a.png", "b.png")
    files = [tmp_path / "b.png", tmp_path / "a.png"]
    assert match_images(files, ["a", "b"]) == files[::-1]
    assert match_images(files, ["view 0", "view 1"]) == files
    with pytest.raises(SceneError, match="expected 3 images, one per camera, found 2"):
        match_images(files, ["a", "b", "c"])


def test_one_image_cannot_serve_two_views(tmp_path: Path) -> None:
    touch(tmp_path, "1.png", "2.png")
    with pytest.raises(SceneError, match=r"an image of its own for each camera, found 1\.png for two"):
        match_images(tmp_path, ["left/1.png", "right/1.png"])


def test_what_cannot_be_read(tmp_path: Path, tiny: Tiny) -> None:
    write_images(tmp_path, tiny)
    (tmp_path / tiny.names[1]).write_text("no image")
    with pytest.raises(SceneError, match=r"10\.png: expected an image, found a file that cannot be decoded"):
        read_images(tmp_path, tiny.names)
    (tmp_path / tiny.names[1]).write_bytes(b"")
    with pytest.raises(SceneError, match=r"10\.png: expected an image"):
        read_images(tmp_path, tiny.names)
    with pytest.raises(SceneError, match="no such folder"):
        read_images(tmp_path / "none", tiny.names)
    with pytest.raises(SceneError, match="expected a folder of images, found a file"):
        read_images(tmp_path / tiny.names[0], tiny.names)


def test_images_of_two_sizes_are_both_named(tmp_path: Path, tiny: Tiny) -> None:
    write_images(tmp_path, tiny)
    cv2.imwrite(str(tmp_path / tiny.names[2]), np.zeros((7, 10, 3), np.uint8))
    with pytest.raises(SceneError, match=r"11\.png: .*found 10 x 7 here and 20 x 14 in .*2\.png"):
        read_images(tmp_path, tiny.names)


def test_grey_and_transparent_images_become_rgb(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((2, 3), 51, np.uint8))
    cv2.imwrite(str(tmp_path / "b.png"), np.full((2, 3, 4), 102, np.uint8))
    images = read_images(tmp_path, ["a", "b"])
    assert np.unique(images[0]).tolist() == pytest.approx([0.2])
    assert np.unique(images[1]).tolist() == pytest.approx([0.4])


def test_numbers_sort_as_numbers() -> None:
    names = ["view 10", "view 2", "a/1", "3", "view 2b"]
    assert sorted(names, key=natural_key) == ["3", "a/1", "view 2", "view 2b", "view 10"]


def test_many_large_photos_are_decoded_one_by_one(tmp_path: Path, tiny: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    """As those in memory, in every way that photos are used; few at a time."""
    write_images(tmp_path, tiny)
    kept = photos.decode_images(photos.match_images(tmp_path, tiny.names))
    monkeypatch.setattr(photos, "_AT_ONCE", 0)
    held, most = [0], [0]

    def decode(path: Path, size: tuple[int, int]) -> np.ndarray:
        image = decode_image(path, size)
        held[0] += 1
        most[0] = max(most[0], held[0])
        weakref.finalize(image, lambda: held.__setitem__(0, held[0] - 1))
        return image

    decode_image = photos.decode_image
    monkeypatch.setattr(photos, "decode_image", decode)
    read = photos.decode_images(photos.match_images(tmp_path, tiny.names))
    assert isinstance(read, photos.PhotoReader)
    with use_threads(1):
        np.testing.assert_array_equal(photos.as_floats(read), photos.as_floats(kept))
        assert photos.photo_size(read) == photos.photo_size(kept)
        smaller = photos.resize_to(photos.photo_size(read), (4, 3))
        expected = smaller.photos(kept)
        for actual in (smaller.photos(read), photos.keep_photos(smaller.photos(read))):
            assert photos.photo_size(actual) == (4, 3)
            np.testing.assert_array_equal(photos.as_floats(actual), photos.as_floats(expected))
    assert most[0] <= 2
    with pytest.raises(IndexError):
        read[len(tiny.names)]


def test_a_damaged_photo_among_many_large_ones(tmp_path: Path, tiny: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(photos, "_AT_ONCE", 0)
    write_images(tmp_path, tiny)
    path = photos.match_images(tmp_path, tiny.names)[-1]
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(SceneError, match="cannot be decoded"):
        read_images(tmp_path, tiny.names)
