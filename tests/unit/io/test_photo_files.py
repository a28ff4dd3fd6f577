"""Photos are found by name, decoded, and refused silently where they are damaged."""

from __future__ import annotations

import struct
import subprocess
import sys
import weakref
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from messages import refuses
from PIL import Image, features
from sweeps import sweep
from tiny_scene import Tiny, write_images

from gsmerge.errors import SceneError
from gsmerge.io import bounds, read_images
from gsmerge.io import photo_files as photos
from gsmerge.io.image_names import match_images, natural_key
from gsmerge.io.photo_files import PhotoTransform, decode_image, image_size, resize_and_crop, resize_to
from gsmerge.runtime.threads import use_threads
from gsmerge.types import Cameras


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def test_photos_are_read_as_floats_in_rgb_order(tmp_path: Path, tiny: Tiny) -> None:
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
def test_names_are_matched_with_or_without_folder_or_extension(tmp_path: Path, tiny: Tiny, shorten) -> None:
    write_images(tmp_path, tiny)
    order = [2, 0, 1]
    images = read_images(tmp_path, [shorten(tiny.names[i]) for i in order])
    assert np.array_equal((images * 255).round(), tiny.images[order])


def save_tiff(path: Path, pixels: np.ndarray, **options: Any) -> Path:
    """Write a TIFF of 8 bits, or of 16 bits with the same levels."""
    if pixels.dtype == np.uint8:
        Image.fromarray(pixels).save(path, **options)
    else:
        assert cv2.imwrite(str(path), pixels[..., ::-1] if pixels.ndim == 3 else pixels)
    return path


@pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_deflate"])
@pytest.mark.parametrize("turn", [1, 3, 6])
def test_a_tiff_is_read_upright(tmp_path: Path, compression: str | None, turn: int) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (10, 14, 3), np.uint8)
    path = save_tiff(tmp_path / "a.tif", pixels, compression=compression, tiffinfo={274: turn})
    upright = np.rot90(pixels, {1: 0, 3: 2, 6: -1}[turn])
    assert image_size(path) == upright.shape[1::-1]
    assert np.array_equal(decode_image(path, image_size(path)), upright)
    assert photos.orientation_turn(path) == 0


def test_a_tiff_of_16_bits_has_the_levels_of_8(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (10, 14, 3), np.uint8)
    for name, levels in (("rgb.tif", pixels), ("grey.tiff", pixels[..., 0])):
        path = save_tiff(tmp_path / name, levels.astype(np.uint16) * 257)
        expected = np.stack([levels] * 3, -1) if levels.ndim == 2 else levels
        assert np.array_equal(decode_image(path, (14, 10)), expected)
    assert np.array_equal(photos.decode_levels(tmp_path / "grey.tiff"), pixels[..., 0])  # as a mask


def test_a_tiff_of_a_kind_that_is_not_read_is_refused(tmp_path: Path) -> None:
    """Printers' colours, floats, planes of 16 bits, more than 4 GB, and half a file; each ends in one line."""
    Image.new("CMYK", (14, 10)).save(tmp_path / "a.tif")
    Image.new("F", (14, 10)).save(tmp_path / "b.tif")
    whole = save_tiff(tmp_path / "c.tif", np.full((10, 14, 3), 1000, np.uint16)).read_bytes()
    planes = struct.pack("<HHI", 284, 3, 1), struct.pack("<HHI", 284, 3, 1) + b"\2\0"
    (tmp_path / "c.tif").write_bytes(whole.replace(planes[0] + b"\1\0", planes[1]))
    (tmp_path / "d.tif").write_bytes(b"II+\0".ljust(600, b"\1"))
    (tmp_path / "e.tif").write_bytes(whole[:200])
    for name, found in (("a", "CMYK"), ("b", "32 bits"), ("c", "planes"), ("d", "BigTIFF"), ("e", "cannot be decoded")):
        with refuses(SceneError, path := tmp_path / f"{name}.tif", found, "convert it to .jpg or .png"):
            image_size(path)


@pytest.mark.skipif(not features.check("avif"), reason="Pillow was built without libavif")
def test_an_avif_is_read_and_its_turn_is_known(tmp_path: Path) -> None:
    pixels = np.repeat(np.arange(0, 240, 15, dtype=np.uint8)[:, None, None], 24, 1).repeat(3, 2)
    exif = Image.Exif()
    exif[274] = 6
    Image.fromarray(pixels).save(path := tmp_path / "a.avif", quality=95, exif=exif.tobytes())
    assert image_size(path) == (24, 16)
    assert photos.orientation_turn(path) == 3
    assert np.abs(decode_image(path, (24, 16)).astype(int) - pixels).max() <= 3
    path.write_bytes(path.read_bytes()[:-40])
    with refuses(SceneError, path, "cannot be decoded"):
        decode_image(path, image_size(path))


def test_names_with_dots_are_matched(tmp_path: Path) -> None:
    touch(tmp_path, "view.0001.png", "view.0002.png")
    assert [p.name for p in match_images(tmp_path, ["view.0002", "view.0001"])] == ["view.0002.png", "view.0001.png"]


def test_the_longest_path_decides_between_photos_of_one_name(tmp_path: Path) -> None:
    touch(tmp_path, "left/1.png", "right/1.png")
    actual = match_images(tmp_path, ["right/1", "left/1.png"])
    assert [p.parent.name for p in actual] == ["right", "left"]
    with refuses(SceneError, tmp_path, "1.png", "left/1.png", "right/1.png", "--images"):
        match_images(tmp_path, ["1.png", "left/1.png"])


def test_unknown_names_take_the_order_if_the_counts_agree(tmp_path: Path) -> None:
    touch(tmp_path, "2.png", "10.png", "1.png", "notes.txt", ".hidden.png")
    actual = match_images(tmp_path, ["view 0", "view 1", "view 2"])
    assert [p.name for p in actual] == ["1.png", "2.png", "10.png"]
    with refuses(SceneError, tmp_path, "2 images", 3, "view 0"):
        match_images(tmp_path, ["view 0", "view 1"])
    with refuses(SceneError, tmp_path, "3 images", 3, "view 1"):
        match_images(tmp_path, ["1", "view 1", "2"])


def test_photos_are_matched_in_a_list_of_files(tmp_path: Path) -> None:
    touch(tmp_path, "a.png", "b.png")
    files = [tmp_path / "b.png", tmp_path / "a.png"]
    assert match_images(files, ["a", "b"]) == files[::-1]
    assert match_images(files, ["view 0", "view 1"]) == files
    with refuses(SceneError, tmp_path, "3 images", 2, "c"):
        match_images(files, ["a", "b", "c"])


def test_one_image_cannot_serve_two_views(tmp_path: Path) -> None:
    touch(tmp_path, "1.png", "2.png")
    with refuses(SceneError, tmp_path, "1.png", "two"):
        match_images(tmp_path, ["left/1.png", "right/1.png"])


def test_photos_in_a_wrong_place_are_refused(tmp_path: Path, tiny: Tiny) -> None:
    write_images(tmp_path, tiny)
    with pytest.raises(SceneError, match="no such"):
        read_images(tmp_path / "none", tiny.names)
    with refuses(SceneError, "2.png", "folder", "file"):
        read_images(tmp_path / tiny.names[0], tiny.names)


def test_images_of_two_sizes_are_both_named(tmp_path: Path, tiny: Tiny) -> None:
    write_images(tmp_path, tiny)
    cv2.imwrite(str(tmp_path / tiny.names[2]), np.zeros((7, 10, 3), np.uint8))
    with refuses(SceneError, "11.png", "10 x 7", "20 x 14"):
        read_images(tmp_path, tiny.names)


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


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".webp", ".ppm", ".pgm"])
def test_stored_size_is_that_of_the_decoded_image(suffix: str, tmp_path: Path) -> None:
    kinds = {".jpg": [[cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]]}
    kinds[".webp"] = [[cv2.IMWRITE_WEBP_QUALITY, 101]]  # without loss
    path = tmp_path / f"a{suffix}"
    for width, height in ((7, 5), (300, 20), (64, 513)):
        picture = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
        for flags in ([], *kinds.get(suffix, [])):
            assert cv2.imwrite(str(path), picture[..., 0] if suffix == ".pgm" else picture, flags)
            assert image_size(path) == (width, height)


def test_natural_key_counts_any_number_of_digits() -> None:
    names = ["a10", "a2", "a02b", "a" + "1" * 5000, "a1", "b0"]
    assert sorted(names, key=natural_key) == ["a1", "a2", "a02b", "a10", "a" + "1" * 5000, "b0"]


PICTURE = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
DATA = cv2.imencode(".png", PICTURE[..., ::-1])[1].tobytes()


def chunk(kind: bytes, content: bytes, crc: int | None = None) -> bytes:
    own = zlib.crc32(kind + content) if crc is None else crc
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", own)


def with_chunk(more: bytes) -> bytes:
    """Put a chunk between the header and the picture."""
    return DATA[:33] + more + DATA[33:]


def read(path: Path, data: bytes) -> np.ndarray:
    path.write_bytes(data)
    return (read_images([path], ["a"])[0] * 255).round().astype(np.uint8)


@pytest.mark.parametrize(
    "data",
    [
        DATA,
        DATA + b"junk",
        DATA[:-1] + b"x",
        with_chunk(chunk(b"iCCP", b"ICC\0\0" + zlib.compress(b"no profile"))),
        with_chunk(chunk(b"tEXt", b"a\0b", crc=0)),
        with_chunk(chunk(b"gAMA", struct.pack(">I", 220_000))),
        with_chunk(chunk(b"eXIf", b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0")),
    ],
    ids=["sound", "more behind", "end", "profile", "text", "gamma", "orientation"],
)
def test_chunks_beside_the_picture_do_not_change_a_photo(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], data: bytes
) -> None:
    assert np.array_equal(read(tmp_path / "a.png", data), PICTURE)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("kind", ["grey", "16 bit", "alpha", "palette"])
def test_kinds_of_png_are_decoded_as_by_opencv(tmp_path: Path, kind: str) -> None:
    rng, path = np.random.default_rng(1), tmp_path / "a.png"
    pictures = {
        "grey": PICTURE[..., 0],
        "16 bit": rng.integers(0, 65535, (20, 30, 3), np.uint16),
        "alpha": rng.integers(0, 255, (20, 30, 4), np.uint8),
    }
    if kind == "palette":
        head = struct.pack(">IIBBBBB", 4, 1, 8, 3, 0, 0, 0)
        parts = (
            (b"IHDR", head),
            (b"PLTE", bytes(range(12))),
            (b"tRNS", b"\0\xff"),
            (b"IDAT", zlib.compress(b"\0\0\1\2\3")),
        )
        data = DATA[:8] + b"".join(chunk(*part) for part in (*parts, (b"IEND", b"")))
    else:
        data = cv2.imencode(".png", pictures[kind])[1].tobytes()
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(read(path, data), expected[..., ::-1])


def test_a_file_that_several_views_name_is_decoded_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [tmp_path / f"{name}.png" for name in "ab"]
    for level, path in enumerate(paths):
        cv2.imwrite(str(path), np.full((3, 4, 3), level, np.uint8))
    decoded: list[Path] = []
    monkeypatch.setattr(photos, "decode_image", lambda path, size: decoded.append(path) or decode_image(path, size))
    actual = photos.decode_images([paths[i] for i in (1, 0, 1, 1)])
    assert sorted(decoded) == paths
    assert [photo.max() for photo in actual] == [1, 0, 1, 1]


def test_photos_of_more_pixels_than_their_files_allow_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each view counts, and the bytes of each file once."""
    path = tmp_path / "a.png"
    path.write_bytes(DATA)
    monkeypatch.setattr(photos, "_PHOTOS_PER_BYTE", 0)
    monkeypatch.setattr(photos, "_FREE_PHOTOS", 3 * PICTURE.nbytes)
    assert len(photos.decode_images([path] * 3)) == 3
    with refuses(SceneError, tmp_path, "4 of 30 x 20", f"{len(DATA):,} bytes"):
        photos.decode_images([path] * 4)


def test_running_out_of_memory_is_not_taken_for_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV returns nothing then, as for a damaged file."""
    path = tmp_path / "a.png"
    path.write_bytes(DATA)

    def fail(*_: object, **__: object) -> None:
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(photos.cv2, "imdecode", lambda *_: None)
        with refuses(SceneError, path, "decoded"):
            decode_image(path, (30, 20))
        patch.setattr(photos.np, "empty", fail)
        with pytest.raises(MemoryError):
            decode_image(path, (30, 20))
    monkeypatch.setattr(photos.Image, "open", fail)
    with pytest.raises(MemoryError):
        photos.decode_levels(path)


KINDS = {  # what Pillow writes of one colour, with much, little and no memory beside the pixels
    "lossless.webp": {"lossless": True},
    "alpha.webp": {},
    "moving.webp": {"save_all": True},
    "whole.jpg": {"progressive": True, "subsampling": 0},
    "half.jpg": {"progressive": True, "subsampling": 2},
    "ink.jpg": {"progressive": True},
    "grey.png": {},
    "alpha.png": {},
}
MODES = {"alpha": "RGBA", "ink": "CMYK", "grey": "L"}
DECODE = """
import re, sys
from pathlib import Path
from gsmerge.io import photo_files as photos
def read(path):
    counted = []
    photos.ReadBudget.check_memory = lambda budget, num_bytes, what: counted.append(num_bytes)
    if sys.argv[2] == "mask":
        photos.decode_levels(path), photos.decode_alpha(path)
    else:
        photos.decode_image(path, photos.image_size(path))
    return max(counted)
peak = lambda: 1024 * int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1])
path = Path(sys.argv[1])
read(path.with_stem("small"))  # whatever is loaded once
before = peak()
print(read(path), peak() - before)
"""


@sweep("kind", sorted(KINDS), often=0)
@pytest.mark.parametrize("what", ["photo", "mask"])
@pytest.mark.skipif(sys.platform != "linux", reason="memory as Linux counts it")
def test_decoding_takes_no_more_memory_than_is_counted(kind: str, what: str, tmp_path: Path) -> None:
    path = tmp_path / kind
    mode = MODES.get(path.stem, "RGB")
    for place, side in ((path.with_stem("small"), 20), (path, 3000)):
        frames = [Image.new(mode, (side, side), color) for color in (0, 1)[: 1 + ("save_all" in KINDS[kind])]]
        frames[0].save(place, append_images=frames[1:], **KINDS[kind])
    words = [sys.executable, "-c", DECODE, path, what]
    counted, taken = map(float, subprocess.run(words, check=True, capture_output=True, text=True).stdout.split())
    assert taken <= counted + 2 * path.stat().st_size + 4e6  # of the libraries themselves


@pytest.mark.parametrize(("kind", "subsampling", "side"), [("webp", None, 330), ("jpg", 0, 360), ("jpg", 2, 560)])
def test_a_photo_of_more_pixels_than_its_bytes_allow_is_refused(
    kind: str, subsampling: int | None, side: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"a.{kind}"
    monkeypatch.setattr(bounds, "_FREE_MEMORY", 640_000)
    Image.new("RGB", (side, side)).save(path, **({} if subsampling is None else {"subsampling": subsampling}))
    with refuses(SceneError, path, f"{side} x {side}", f"{path.stat().st_size:,}"):
        image_size(path)
    path.write_bytes(path.read_bytes() + bytes(side * side // 8))  # as an ordinary photo of 24 megapixels and 3 MB
    assert image_size(path) == (side, side)


@pytest.mark.parametrize("mapping", [resize_to((100, 60), (50, 24)), resize_and_crop((100, 60), (30, 30))])
def test_photo_transforms_move_a_camera_as_they_move_its_photo(mapping: PhotoTransform) -> None:
    photo = np.zeros((60, 100, 3), np.uint8)
    photo[24:36, 64:72] = 255
    (small,) = mapping.photos([photo])
    assert small.shape == (mapping.height, mapping.width, 3)
    y, x = (np.average(np.arange(n) + 0.5, weights=small[..., 0].sum(axis)) for n, axis in
            ((mapping.height, 1), (mapping.width, 0)))  # fmt: skip
    K = np.array([[[1.0, 0, 68], [0, 1, 30], [0, 0, 1]]], np.float64)
    (moved,) = mapping.cameras(Cameras(np.eye(4)[None], K, 100, 60)).Ks
    assert (x, y) == pytest.approx((float(moved[0, 2]), float(moved[1, 2])), abs=0.1)
