"""Read photos and masks: match them by name, decode them in parallel, resize and crop them. Encode pictures."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from PIL import Image, features

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, replace
from gsmerge.io.bounds import MAX_PIXELS, ReadBudget, check_file, check_image_size, read_errors
from gsmerge.io.first_bytes import CONVERT, read_start, refuse_picture
from gsmerge.io.image_names import ImageSource, match_images
from gsmerge.method.kernels.matrices import matmul
from gsmerge.method.kernels.pictures import turn_picture
from gsmerge.runtime.memory import free_pages, make_array
from gsmerge.runtime.threads import parallel_map, quiet_warnings
from gsmerge.types import Cameras

# Formats whose headers Pillow reads; headers of PNG are read here. Of the last two, Pillow also decodes the pixels
_FORMATS = ("JPEG", "WEBP", "BMP", "PPM", "TIFF", "AVIF")
# Orientation tag -> number of quarter turns counterclockwise, plus 4 if the photo is mirrored first
_TURNS = {2: 4, 3: 2, 4: 6, 5: 5, 6: 3, 7: 7, 8: 1}
_OPAQUE_SUFFIXES = frozenset({".jpg", ".jpeg", ".jfif", ".ppm"})
# Relative difference up to which two ratios of width and height are equal. A network that rounds a side of 350 pixels
# to a multiple of 14 changes the side by up to 7 pixels, which are 2 %
ASPECT_TOLERANCE = 0.02
# First and last bytes of a PNG file
PNG = b"\x89PNG\r\n\x1a\n"
PNG_END = b"\0\0\0\0IEND\xaeB`\x82"
# start of a file, and of each of its scans
_JPEG = b"\xff\xd8"
_SCAN = b"\xff\xda"
_PHOTO_MEMORY_PER_BYTE = 100  # bytes of memory per byte of a photo or mask that is decoded alone
_AVIF_MEMORY_PER_BYTE = 1000  # a photo in AVIF may have a tenth of a bit per pixel
_COPIES = 2, 3  # copies of all pixels in memory: while OpenCV decodes, and at most while Pillow decodes and converts
_PILLOW_BYTES = {"1": 1, "L": 1, "P": 1, "I;16": 2}  # bytes of a pixel by Pillow's mode; 4 in all other modes
# Bytes of memory for each pixel that a decoder needs besides the decoded pixel
_COEFFICIENT_BYTES = 2
_WEBP_BYTES = 4
_MOVING_WEBP_BYTES = 9
_PILLOW_WEBP_BYTES = 10
_TIFF_OR_AVIF_BYTES = 13
# First bytes of an image file -> the plugin of Pillow that opens the file
_TIFF = b"II*\0", b"MM\0*"
_PLUGINS = {PNG: "Png", _JPEG: "Jpeg", b"RIFF": "WebP", b"BM": "Bmp", **dict.fromkeys(_TIFF, "Tiff")}
_AVIF = b"ftyp"  # bytes 4 to 8, also of HEIC, which Pillow refuses
_TIFF_MODES = frozenset(
    {"1", "L", "LA", "P", "RGB", "RGBA", "RGBX", "YCbCr", "I;16", "I;16B"}
)  # Pillow's, that are read
_CHANNELS = 3  # bytes of a decoded photo's pixel
# Limit of the bytes of a scene's decoded photos: a constant, plus a number of bytes for each byte of the photos' files.
# A decoded pixel has 3 bytes, and even strongly compressed files have more than 3 / 100 bytes per pixel
_FREE_PHOTOS = 512_000_000
_PHOTOS_PER_BYTE = 100
_SMALLER = "reduce its size: a mask to that of its photo, a photo to about that of its view"
_BAND = 256  # rows of a mask that are converted at once
_REDUCTIONS = {  # number by which each side is divided -> OpenCV's flag
    1: cv2.IMREAD_COLOR, 2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4, 8: cv2.IMREAD_REDUCED_COLOR_8,
}  # fmt: skip
_PNG_CHUNKS = frozenset({b"IHDR", b"PLTE", b"tRNS", b"IDAT"})  # chunks that determine the pixels

Size = tuple[int, int]  # width and height in pixels
# Left, top, right and bottom of a part of a photo, as shares of its sides; a part may reach beyond the photo
Part = tuple[float, float, float, float]
WHOLE: Part = (0.0, 0.0, 1.0, 1.0)  # all of a photo
_AT_ONCE = 128 << 20  # most bytes of decoded photos in memory; if they need more, photos are decoded at each use


@dataclass(frozen=True, eq=False)
class PhotoReader:
    """A list of c photos of one size, which are decoded at each use and not stored in memory."""

    count: int
    size: Size
    read: Callable[[int], np.ndarray]  # index -> [h,w,3] uint8 sRGB; thread-safe

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, photo: int) -> np.ndarray:
        if not 0 <= photo < self.count:
            raise IndexError(photo)
        return self.read(photo)


PhotoArrays = Sequence[np.ndarray] | np.ndarray | PhotoReader  # c photos [h,w,3], uint8 sRGB; empty without photos
NO_IMAGES = np.empty((0, 1, 1, 3), np.float32)  # photos as floats, of a scene without photos


def read_images(source: ImageSource, names: Sequence[str]) -> np.ndarray:
    """Read the image of every view: ``[c,h,w,3]`` float32, sRGB in [0, 1], in the order of ``names``.

    ``source`` is a folder, which is searched with its sub-folders, or a list of image files. ``names`` are the names in
    a camera file, with or without folders and extension. If no name matches but there are as many images as names, the
    images of a folder are used in natural order ("2" before "10"), and images of a list in the order of the list. Raise
    SceneError if an image is missing or cannot be read, or if images differ in size.
    """
    return as_floats(decode_images(match_images(source, names)))


def decode_images(paths: Sequence[Path]) -> PhotoArrays:
    """Decode image files of one size to ``[h,w,3]`` uint8 each.

    A file that is several times in ``paths`` is decoded once. If all images together are large, they are decoded at
    each use instead. Raise SceneError if an image cannot be read, if two images differ in size, or if all images
    together take more memory than the bytes of their files allow.
    """
    files = list(dict.fromkeys(paths))
    sizes = {path: image_size(path) for path in files}
    for path, (w, h) in sizes.items():
        w0, h0 = size = sizes[files[0]]
        if (w, h) != size:
            problem = f"expected images of one size, found {w} x {h} here and {w0} x {h0} in {files[0]}"
            raise SceneError(path, problem, "resize them to one size")
    return decode_photos(paths, [0] * len(paths), size) if files else []


def decode_photos(
    paths: Sequence[Path | None],
    turns: Sequence[int],
    size: Size,
    parts: Sequence[Part] | None = None,
    damaged: dict[Path, str] | None = None,
) -> PhotoArrays:
    """Decode the photo of each view, turn it upright, and resize a part of it to ``[h,w,3]`` uint8 of one ``size``.

    ``parts`` has the part of each photo; None for whole photos. ``turns`` are those of :func:`orientation_turn`. A view
    without a file gets a black photo. If all photos together are large, they are decoded at each use. Otherwise each
    photo is decoded once, even if several views have the same photo. Raise SceneError as in :func:`decode_images`; but
    if ``damaged`` is given, a photo that cannot be decoded is black, and ``damaged`` gets its path and the reason.
    """
    files = list(dict.fromkeys(path for path in paths if path is not None))
    sizes = {path: image_size(path) for path in files}
    count = sum(path is not None for path in paths)
    file_bytes = sum(map(check_file, files))
    num_bytes = _CHANNELS * count * size[0] * size[1]
    max_bytes = _FREE_PHOTOS + _PHOTOS_PER_BYTE * file_bytes
    if num_bytes > max_bytes:
        problem = f"expected photos of at most {max_bytes / 1e6:,.0f} MB together from files of {file_bytes:,} bytes"
        found = f"found {count:,} of {size[0]} x {size[1]}, {num_bytes / 1e6:,.0f} MB"
        raise SceneError(files[0].parent, f"{problem}, {found}", "reduce their size, or leave some out")

    def decode(view: tuple[Path | None, int, Part]) -> np.ndarray:
        """Decode, turn, cut and resize the photo of a ``view``, given as the photo's path, turn and part."""
        path, turn, part = view
        if path is None:
            return np.zeros((size[1], size[0], 3), np.uint8)
        try:
            whole = decode_image(path, sizes[path])
        except SceneError as error:
            if damaged is None:
                raise
            damaged[path] = error.problem
            return np.zeros((size[1], size[0], 3), np.uint8)
        photo = np.ascontiguousarray(cut_part(turn_picture(whole, turn), part))
        photo_size = photo.shape[1], photo.shape[0]
        return photo if photo_size == size else resize_to(photo_size, size).photos([photo])[0]

    views = list(zip(paths, turns, parts or [WHOLE] * len(paths), strict=True))
    different = list(dict.fromkeys(views))
    if _CHANNELS * size[0] * size[1] * len(different) > _AT_ONCE:
        return PhotoReader(len(views), size, lambda view: decode(views[view]))
    decoded = dict(zip(different, parallel_map(decode, different), strict=True))
    return [decoded[view] for view in views]


def decode_small(path: Path, side: int) -> np.ndarray:
    """Decode a small version of a photo to ``[h,w,3]`` float32 sRGB in [0, 1].

    The longer side of the small version has ``side`` to twice ``side`` pixels. A photo whose longer side is below
    ``side`` keeps its size. The orientation tag is ignored. JPEG files are decoded at a reduced size, which is fast.
    """
    width, height = image_size(path)
    divisor = next(divisor for divisor in reversed(_REDUCTIONS) if max(width, height) >= divisor * side or divisor == 1)
    photo = decode_image(path, (width, height), divisor)
    ratio = max(photo.shape[:2]) / (2 * side)
    if ratio > 1:
        small_size = max(1, round(photo.shape[1] / ratio)), max(1, round(photo.shape[0] / ratio))
        photo = cv2.resize(photo, small_size, interpolation=cv2.INTER_AREA)
    return np.multiply(photo, np.float32(1 / 255), dtype=np.float32)


def change_photos(
    photos: PhotoArrays, change: Callable[[int, np.ndarray], np.ndarray], size: Size | None = None
) -> PhotoArrays:
    """Apply ``change(index, photo)`` to every photo. Photos of a :class:`PhotoReader` are changed at each use.

    ``size``: size of the changed photos; None if ``change`` keeps the size.
    """
    if isinstance(photos, PhotoReader):
        return PhotoReader(len(photos), size or photos.size, lambda index: change(index, photos[index]))
    return parallel_map(lambda index: change(index, photos[index]), range(len(photos)))


def keep_photos(photos: PhotoArrays) -> PhotoArrays:
    """Decode all photos of a :class:`PhotoReader` into memory, for callers that use each photo more than once."""
    return parallel_map(photos.read, range(len(photos))) if isinstance(photos, PhotoReader) else photos


def decode_image(path: Path, size: Size, divisor: int = 1) -> np.ndarray:
    """Decode an image file of known ``size`` to ``[h,w,3]`` uint8 sRGB; raise SceneError if it cannot be read.

    The orientation tag is ignored. If the file is a JPEG, each side is divided by ``divisor``. Also raise SceneError if
    the scans of a JPEG take longer than its bytes allow; each scan covers all pixels.
    """
    with read_errors(path):
        data = np.fromfile(path, np.uint8)
    is_jpeg = data[:2].tobytes() == _JPEG
    num_scans, divisor = (data.tobytes().count(_SCAN), divisor) if is_jpeg else (0, 1)
    pixels_per_step = 50_000  # pixels of an empty scan that are decoded in one step of a budget
    steps = num_scans * size[0] * size[1] // pixels_per_step
    ReadBudget(path, len(data)).check_steps(steps, f"steps of decoding {num_scans:,} scans")
    width, height = (-(-side // divisor) for side in size)
    pixels = _png_pixels(data) if data[: len(PNG)].tobytes() == PNG else data
    image = None
    with suppress(cv2.error):
        if data[:4].tobytes() in _TIFF or data[4:8].tobytes() == _AVIF:
            image = _decode_by_pillow(path)
        elif pixels is not None and len(pixels):
            image = cv2.imdecode(pixels, _REDUCTIONS[divisor] | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise _undecodable(path, size)
    if image.shape != (height, width, 3):
        problem = f"expected {width} x {height} pixels, as its header says, found another size"
        raise SceneError(path, problem, "replace it")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)


def as_floats(images: PhotoArrays) -> np.ndarray:
    """Convert c photos ``[h,w,3]`` uint8 to one array ``[c,h,w,3]`` float32 in [0, 1]."""
    width, height = photo_size(images) or (1, 1)  # the array has no entry if there are no photos
    out = make_array((len(images), height, width, 3), np.float32)

    def convert(i: int) -> None:
        np.multiply(images[i], np.float32(1 / 255), out=out[i])
        free_pages([out])  # a large array lies in a file, so that its memory can be released

    parallel_map(convert, range(len(images)))
    return out


def photo_size(photos: PhotoArrays) -> Size | None:
    """Return (width, height) of the photos; None without any."""
    if isinstance(photos, PhotoReader):
        return photos.size
    return (photos[0].shape[1], photos[0].shape[0]) if len(photos) else None


def photo_array(images: np.ndarray | None) -> np.ndarray:
    """Return photos ``[c,h,w,3]`` unchanged, and an empty array for None."""
    return NO_IMAGES if images is None else images


def part_size(size: Size, part: Part) -> Size:
    """Return the (width, height) of a part of a photo; ``size`` is the whole photo's."""
    left, top, right, bottom = (round(side * share) for side, share in zip(size * 2, part, strict=True))
    return max(1, right - left), max(1, bottom - top)


def cut_part(photo: np.ndarray, part: Part) -> np.ndarray:
    """Cut a part out of a photo ``[h,w,...]``, and extend it by zeros where it reaches beyond the photo.

    A part inside the photo shares the photo's memory.
    """
    width, height = part_size(photo.shape[1::-1], part)
    left = round(photo.shape[1] * part[0])
    top = round(photo.shape[0] * part[1])
    inside = photo[max(top, 0) : top + height, max(left, 0) : left + width]
    if inside.shape[:2] == (height, width):
        return inside
    out = np.zeros((height, width, *photo.shape[2:]), photo.dtype)
    out[max(-top, 0) :, max(-left, 0) :][: len(inside), : inside.shape[1]] = inside
    return out


def reaches_beyond(part: Part) -> bool:
    """Return whether a part reaches beyond its photo."""
    return min(part) < 0 or max(part) > 1


def same_shape(size: Size, other: Size) -> bool:
    """Return whether two sizes have the same aspect ratio, up to rounding."""
    return abs(size[0] * other[1] / (size[1] * other[0]) - 1) <= ASPECT_TOLERANCE


def decode_levels(path: Path, photo: Path | None = None) -> np.ndarray:
    """Decode the brightness ``[h,w]`` of a mask, times its opacity, as uint8 with white as 255.

    The file may store white as 1, 255 or 65,535. White is taken as the least of 1, 255 and 65,535 that no pixel
    exceeds. Memory is limited by the bytes of the mask's file and of its ``photo`` together, since masks compress to
    very few bytes.
    """
    grey = _decode_brightness(path, _photo_budget(path, *([] if photo is None else [photo])))
    brightest = float(grey.max(initial=0))
    whites = 1, 255, 65535  # of fractions or of 0 and 1, of 8 bits, and of 16 bits
    # Other files are scaled to the brightest pixel
    white = next((white for white in whites if brightest <= white), brightest)
    if grey.dtype == np.uint8 and white == 255:
        return grey
    levels = np.zeros(grey.shape, np.uint8)
    for top in range(0, len(grey), _BAND):
        block = slice(top, top + _BAND)
        levels[block] = np.round(np.clip(grey[block] * (255 / white), 0, 255))
    return levels


def _decode_brightness(path: Path, budget: ReadBudget) -> np.ndarray:
    """Decode the brightness ``[h,w]`` that a file stores; in 8-bit images, brightness times opacity."""
    # A function of its own, since Pillow's copy of the image has to be gone before its levels are computed
    with _open_pixels(path) as image:
        _check_pillow_memory(budget, image)
        if image.mode[0] in "IF":  # more than 8 bits
            return np.asarray(image)
        grey = np.empty(image.size[::-1], np.uint8)
        for top in range(0, image.height, _BAND):  # copies of a band take little memory
            band = image.crop((0, top, image.width, min(top + _BAND, image.height)))
            rows = grey[top : top + _BAND]
            rows[:] = band.convert("L")
            if "A" in image.getbands():
                rows[:] = np.round(rows * np.asarray(band.getchannel("A"), np.float32) / 255)
        return grey


def _decode_by_pillow(path: Path) -> np.ndarray:
    """Decode a TIFF or an AVIF to ``[h,w,3]`` uint8 BGR, as OpenCV decodes others; Pillow turns a TIFF upright."""
    with _open_pixels(path) as image:
        if image.mode in ("I;16", "I;16B"):
            levels = (np.asarray(image).astype(np.uint32) + 128) // 257  # of 255, rounded
            return np.repeat(levels[..., None].astype(np.uint8), _CHANNELS, axis=2)
        return np.ascontiguousarray(np.asarray(image.convert("RGB"))[..., ::-1])


def _tiff_size(path: Path, image: Image.Image) -> Size:
    """Return the (width, height) of a TIFF when it is upright; SceneError if its pixels are of a kind that is not read.

    Pillow shows some kinds of 16 bits wrong: planes one after another, and white as 0.
    """
    width_tag, height_tag, bits_tag, white_tag, orientation_tag, planes_tag = 256, 257, 258, 262, 274, 284
    tags: Any = image.tag_v2  # type: ignore[attr-defined]
    bits = max(tags.get(bits_tag, (1,)))
    is_odd = bits > 8 and (tags.get(planes_tag) == 2 or tags.get(white_tag) == 0)
    if image.mode not in _TIFF_MODES or is_odd:
        found = f"{bits} bits, {image.mode}" + (" in planes or with white as 0" if is_odd else "")
        raise SceneError(path, f"expected a TIFF of 8 or 16 bits, grey or RGB, found {found}", CONVERT)
    size = int(tags[width_tag]), int(tags[height_tag])
    return size[::-1] if tags.get(orientation_tag, 1) > 4 else size


def decode_alpha(path: Path) -> np.ndarray | None:
    """Decode where a photo is opaque: ``[h,w]`` bool, True for opaque pixels; None if the whole photo is opaque."""
    if path.suffix.lower() in _OPAQUE_SUFFIXES:
        return None
    with _open_pixels(path) as image:
        if "A" not in image.getbands() and "transparency" not in image.info:
            return None
        _check_pillow_memory(_photo_budget(path), image)
        values = np.asarray(image.convert("RGBA").getchannel("A"))
    half_opaque = 127  # of 255; pixels with a higher value are opaque
    return None if values.min() > half_opaque else values > half_opaque


def _photo_budget(path: Path, *beside: Path) -> ReadBudget:
    """Return the budget of a photo or mask that is decoded alone, by its bytes and those of the files ``beside`` it."""
    most = _AVIF_MEMORY_PER_BYTE if path.suffix.lower() == ".avif" else _PHOTO_MEMORY_PER_BYTE
    return ReadBudget(path, sum(map(check_file, (path, *beside))), most, _SMALLER)


def _check_pillow_memory(budget: ReadBudget, image: Image.Image) -> None:
    """Raise SceneError if Pillow would need more memory than ``budget`` allows to decode and convert an image."""
    pixel_bytes = _PILLOW_BYTES.get(image.mode, 4)
    decoder_bytes = _decoder_bytes(image) + (_PILLOW_WEBP_BYTES if image.format == "WEBP" else 0)
    num_bytes = max(_COPIES[1] * pixel_bytes, pixel_bytes + decoder_bytes) * image.width * image.height
    budget.check_memory(num_bytes, f"{image.width} x {image.height} pixels")


def _decoder_bytes(image: Image.Image) -> float:
    """Return how many bytes per pixel a decoder was measured to need besides the decoded pixels.

    A decoder of WebP needs this memory for frames, and a decoder of progressive JPEGs for coefficients.
    """
    if image.format in ("TIFF", "AVIF"):
        return _TIFF_OR_AVIF_BYTES
    if image.format == "WEBP":
        return _MOVING_WEBP_BYTES if getattr(image, "is_animated", False) else _WEBP_BYTES
    # A channel of a JPEG may have fewer samples than the image has pixels
    densities = [across * down for _, across, down, _ in getattr(image, "layer", ())]
    return _COEFFICIENT_BYTES * sum(densities) / max(densities, default=1)


@contextmanager
def _open_pixels(path: Path) -> Iterator[Image.Image]:
    """In a ``with`` block, yield an image that Pillow opened; raise SceneError if its pixels cannot be decoded."""
    size = image_size(path, limits_memory=False)  # raises SceneError for a file that is no image or is too large
    try:
        with quiet_warnings():
            data = np.fromfile(path, np.uint8)
            pixels = _png_pixels(data) if data[: len(PNG)].tobytes() == PNG else data
            if pixels is None:
                raise ValueError("damaged chunks")
            with _open_image(io.BytesIO(pixels.data), ("PNG", *_FORMATS)) as image:
                yield image
    except (SceneError, MemoryError):
        raise
    except Exception as error:  # damage may make the library raise any error
        raise _undecodable(path, size) from error


def _undecodable(path: Path, size: Size = (0, 0)) -> SceneError:
    """Make the error for a file that is no image, or that a library did not decode to its ``size``.

    Raise MemoryError if memory was the reason, and a SceneError for a picture of a known format.
    """
    work_bytes = 9  # additional bytes of a pixel while a library decodes it
    np.empty((_CHANNELS + work_bytes, *size), np.uint8)  # raises MemoryError, since the library does not say so
    refuse_picture(path)
    start = read_start(path, 8)
    if start[4:] == _AVIF and not features.check("avif"):
        return SceneError(
            path, "expected an image, found AVIF, which this Pillow does not read", "update Pillow to 11.3"
        )
    remedy = CONVERT if start[:4] in _TIFF else "replace it"
    return SceneError(path, "expected an image, found a file that cannot be decoded", remedy)


def image_size(path: Path, *, limits_memory: bool = True) -> Size:
    """Read (width, height) from the header of an image file; the orientation tag is ignored, but of a TIFF.

    Raise SceneError if the file has another format or cannot be read, if the size is impossible, or if the file has far
    more bytes than its pixels need. With ``limits_memory``, also raise SceneError if the pixels take more memory than
    the file allows.
    """
    num_bytes = check_file(path)
    work_bytes = 0.0
    with read_errors(path), path.open("rb") as file:
        start = file.read(24)
        file.seek(0)
        try:
            if start[:8] == PNG:  # Pillow would also refuse a PNG with damage outside its pixels
                width, height = struct.unpack(">II", start[16:24])
            else:
                with quiet_warnings():
                    image = _open_image(file, _FORMATS)
                work_bytes = _decoder_bytes(image)
                width, height = _tiff_size(path, image) if image.format == "TIFF" else image.size
        except (SceneError, MemoryError):
            raise
        except Image.DecompressionBombError as error:
            problem = f"expected at most {MAX_PIXELS // 1_000_000} million pixels per image, found more"
            raise SceneError(path, problem, "reduce its size") from error
        except Exception as error:  # a damaged header may make the library raise any error
            raise _undecodable(path) from error
    check_image_size(path, width, height)
    # most bytes of a pixel, four floats, and of profiles and thumbnails
    max_pixel_bytes = 16
    max_extra = 16 << 20
    if num_bytes > max_pixel_bytes * width * height + max_extra:
        limit = f"{max_pixel_bytes} bytes per pixel and {max_extra >> 20} MiB"
        found = f"{num_bytes >> 20} MiB for {width} x {height} pixels"
        raise SceneError(path, f"expected at most {limit}, found {found}", "save the image again")
    if limits_memory:
        pixel_bytes = max(_COPIES[0] * _CHANNELS, _CHANNELS + work_bytes)  # bytes that a decoder needs for each pixel
        _photo_budget(path).check_memory(pixel_bytes * width * height, f"{width} x {height} pixels")
    return width, height


def orientation_turn(path: Path) -> int:
    """Return the turn, 0 to 7, with which :func:`turn_picture` turns a photo upright, from its orientation tag."""
    with read_errors(path), quiet_warnings():
        try:
            with path.open("rb") as file, _open_image(file, (*_FORMATS, "PNG")) as image:
                orientation_tag = 274  # number of the tag in EXIF
                if image.format == "TIFF":
                    return 0  # Pillow turns its pixels itself
                return _TURNS.get(image.getexif().get(orientation_tag, 0), 0)
        except Exception:  # damage may make the library raise any error; pixels are checked later
            return 0


def _open_image(file: BinaryIO, formats: Sequence[str]) -> Image.Image:
    """Open an image in one of Pillow's ``formats``, as ``Image.open`` does, with the same errors.

    Only the plugin for the image's format is imported, where ``Image.open`` would import the plugins of all formats.
    """
    start = file.read(max(map(len, _PLUGINS)))
    plugin = next((plugin for first, plugin in _PLUGINS.items() if start.startswith(first)), None)
    plugin = "Avif" if start[4:8] == _AVIF else plugin
    if plugin is not None and plugin.upper() in formats:
        import_module(f"PIL.{plugin}ImagePlugin")
        formats = (plugin.upper(),)
    return Image.open(file, formats=tuple(formats))


def _png_pixels(data: np.ndarray) -> np.ndarray | None:
    """Return a PNG file ``[b]`` uint8 with only the chunks that determine its pixels; None if such a chunk is damaged.

    The other chunks are left out, since texts may have many MB, and decoders print messages about damaged colour
    profiles.
    """
    view = np.ascontiguousarray(data).data
    start = len(PNG)
    pixels = bytearray(PNG)
    while start + 12 <= len(view):
        length, kind = struct.unpack_from(">I4s", view, start)
        end = start + 12 + length
        if kind == b"IEND":
            pixels += PNG_END
            return np.frombuffer(pixels, np.uint8)
        if end > len(view) or (kind[:1].isupper() and kind not in _PNG_CHUNKS):
            return None
        if kind in _PNG_CHUNKS:
            if zlib.crc32(view[start + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
                return None
            pixels += view[start:end]
        start = end
    return None


@dataclass(frozen=True)
class PhotoTransform:
    """A resize, and then a crop to ``width`` x ``height``: ``u' = scale_x u - left``, ``v' = scale_y v - top``."""

    width: int
    height: int
    scale_x: float
    scale_y: float
    left: int = 0
    top: int = 0

    @property
    def crops(self) -> bool:
        """Return whether the transform crops photos at the left or at the top."""
        return bool(self.left or self.top)

    @property
    def description(self) -> str:
        """Say in words what the transform does."""
        return f"resized{' and centre-cropped' if self.crops else ''} to {self.width} x {self.height}"

    def cameras(self, cameras: Cameras) -> Cameras:
        """Return the cameras of the transformed photos, with intrinsics in float64."""
        matrix = [[self.scale_x, 0.0, -self.left], [0.0, self.scale_y, -self.top], [0.0, 0.0, 1.0]]
        return replace(cameras, Ks=matmul(matrix, cameras.Ks), width=self.width, height=self.height)

    def photos(self, images: PhotoArrays) -> PhotoArrays:
        """Resize and crop the uint8 photos ``[h,w,3]``."""

        def transform(_: int, image: np.ndarray) -> np.ndarray:
            """Resize and crop one photo."""
            height, width = image.shape[:2]
            size = round(width * self.scale_x), round(height * self.scale_y)
            shrinks = size[0] * size[1] < width * height
            resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
            return np.ascontiguousarray(resized[self.top : self.top + self.height, self.left : self.left + self.width])

        return change_photos(images, transform, (self.width, self.height))


def limit_size(size: Size, side: int) -> Size:
    """Shrink a size in proportion until the longer side has ``side`` pixels; smaller sizes stay unchanged."""
    if max(size) <= side:
        return size
    scale = side / max(size)
    width, height = (max(1, round(length * scale)) for length in size)
    return width, height


def resize_to(size: Size, to: Size) -> PhotoTransform:
    """Make the transform that resizes photos to the size ``to``, width and height independently."""
    return PhotoTransform(*to, to[0] / size[0], to[1] / size[1])


def resize_and_crop(size: Size, to: Size) -> PhotoTransform:
    """Make the transform that resizes photos in proportion until they cover the size ``to``, and crops their centre."""
    scale = max(to[0] / size[0], to[1] / size[1])
    width, height = (max(least, round(length * scale)) for least, length in zip(to, size, strict=True))
    return PhotoTransform(*to, width / size[0], height / size[1], (width - to[0]) // 2, (height - to[1]) // 2)


def encode_picture(picture: np.ndarray, quality: int) -> bytes:
    """Encode a picture ``[h,w,3]`` uint8 sRGB as a lossy WebP with a ``quality`` from 0 to 100."""
    from PIL import WebPImagePlugin  # noqa: F401 - without it, Pillow imports the plugins of all formats

    content = io.BytesIO()
    effort = 0  # of 0 to 6; an effort of 1 takes a quarter longer for 1 % fewer bytes, and an effort of 2 twice as long
    Image.fromarray(picture).save(content, "WEBP", quality=quality, method=effort)
    return content.getvalue()
