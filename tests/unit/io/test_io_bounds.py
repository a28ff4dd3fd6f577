"""Limits on what a file may ask for, and the sizes that image headers say."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsmerge.errors import SceneError
from gsmerge.io import bounds
from gsmerge.io.bounds import check_file, check_pixels, read_text
from gsmerge.io.cameras.npz_files import array_names, read_arrays
from gsmerge.io.content_hash import content_hash
from gsmerge.io.photos import image_size, list_images, natural_key


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".webp", ".tiff", ".ppm", ".pgm"])
@pytest.mark.parametrize("size", [(7, 5), (300, 20), (64, 513)])
def test_stored_size_is_that_of_the_decoded_image(suffix: str, size: tuple[int, int], tmp_path: Path) -> None:
    width, height = size
    picture = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    path = tmp_path / f"a{suffix}"
    assert cv2.imwrite(str(path), picture[..., 0] if suffix == ".pgm" else picture)
    assert image_size(path) == size


@pytest.mark.parametrize("flags", [[cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]])
def test_stored_size_of_other_jpegs(flags: list[int], tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.jpg"), np.zeros((33, 17, 3), np.uint8), flags)
    assert image_size(tmp_path / "a.jpg") == (17, 33)


def test_stored_size_of_webp_without_loss(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.webp"), np.zeros((33, 17, 3), np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101])
    assert image_size(tmp_path / "a.webp") == (17, 33)


def test_images_beyond_all_use_are_refused(tmp_path: Path) -> None:
    check_pixels("a", 8192, 8192)
    with pytest.raises(SceneError, match="at most 67 million pixels an image, found 8193 x 8192"):
        check_pixels("a", 8193, 8192)
    with pytest.raises(SceneError, match="positive image size"):
        check_pixels("a", 0, 5)


def test_only_files_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(SceneError, match="found a pipe or a device"):
        check_file(tmp_path / "pipe")
    with pytest.raises(SceneError, match="found a folder"):
        check_file(tmp_path)
    with pytest.raises(SceneError, match="no such file"):
        check_file(tmp_path / "none")
    (tmp_path / "a").write_bytes(b"\xef\xbb\xbfab")
    assert check_file(tmp_path / "a") == 5
    assert read_text(tmp_path / "a") == "ab"
    with pytest.raises(SceneError, match="of at most 0 MiB"):
        read_text(tmp_path / "a", 4)


def test_arrays_are_read_by_name(tmp_path: Path) -> None:
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.eye(3, 2)), "c": np.array("text")}
    np.savez_compressed(tmp_path / "a.npz", **arrays, d=np.array([{}]))
    assert array_names(tmp_path / "a.npz") == {"a", "b", "c", "d"}
    actual = read_arrays(tmp_path / "a.npz", ("a", "b", "c", "e"))
    assert actual.keys() == {"a", "b", "c"}
    assert all(np.array_equal(actual[name], arrays[name]) for name in actual)
    with pytest.raises(SceneError, match="found objects, which are not read because they could run code"):
        read_arrays(tmp_path / "a.npz", ("d",))
    assert array_names(tmp_path / "none.npz") == frozenset()


def test_natural_key_counts_any_number_of_digits() -> None:
    names = ["a10", "a2", "a02b", "a" + "1" * 5000, "a1", "b0"]
    assert sorted(names, key=natural_key) == ["a1", "a2", "a02b", "a10", "a" + "1" * 5000, "b0"]


@pytest.mark.skipif(os.name == "nt", reason="links as POSIX has them")
def test_folders_of_photos_have_an_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a/1.png", "a/b/2.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "a" / "up").symlink_to(tmp_path)
    (tmp_path / "images").symlink_to("a")
    assert [path.name for path in list_images(tmp_path / "images")] == ["1.png", "2.png"]
    monkeypatch.setattr(bounds, "MAX_FILES", 3)
    for read in (list_images, lambda folder: content_hash([folder])):
        with pytest.raises(SceneError, match=r"more than 3 files and folders; name the folder .* with --images"):
            read(tmp_path / "images")
