"""Photos of a scene, found by name and decoded in parallel."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import torch
from torch import Tensor

from gsmerge.errors import SceneError
from gsmerge.io.image_header import stored_size, told_size
from gsmerge.io.png import SIGNATURE, checked_png
from gsmerge.runtime.threads import parallel_map

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".ppm"})

ImageSource = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]


def read_images(source: ImageSource, names: Sequence[str]) -> Tensor:
    """Read the image of every view.

    Args:
        source: A folder (with its sub-folders), or the image files themselves.
        names: One name per view, as camera files give them: with or without folders and extension. If no name is
            found but there are as many images as names, the images are taken in order (of their names with numbers
            counted as numbers, or of the list).

    Returns:
        ``[c,h,w,3]`` float32, sRGB in [0, 1], in the order of ``names``.

    Raises:
        SceneError: If an image is missing or cannot be read, or two differ in size.
    """
    return as_tensor(decode_images(source, names))


def decode_images(source: ImageSource, names: Sequence[str]) -> list[np.ndarray]:
    """:func:`read_images` as c arrays ``[h,w,3]`` uint8."""
    paths = match_images(source, names)
    sizes = [stored_size(path) for path in paths]
    for path, (w, h) in zip(paths, sizes, strict=True):
        if (w, h) != sizes[0]:
            w0, h0 = sizes[0]
            raise SceneError(path, f"expected images of one size, found {w} x {h} here and {w0} x {h0} in {paths[0]}")
    return parallel_map(_decode, paths)


def as_tensor(images: Sequence[np.ndarray] | np.ndarray) -> Tensor:
    """``[c,h,w,3]`` float32 in [0, 1] from c uint8 images of one size."""
    out = np.empty((len(images), *images[0].shape), np.float32)
    parallel_map(lambda i: np.multiply(images[i], np.float32(1 / 255), out=out[i]), range(len(images)))
    return torch.from_numpy(out)


def match_images(source: ImageSource, names: Sequence[str]) -> list[Path]:
    """The image file of every view; see :func:`read_images`."""
    if isinstance(source, str | os.PathLike):
        root = Path(source)
        if not root.is_dir():
            problem = "expected a folder of images, found a file" if root.exists() else "no such folder"
            raise SceneError(root, problem)
        files = list_images(root)
    else:
        files = [Path(p) for p in source]
        root = files[0].parent if files else Path()
    keys = _index([f.relative_to(root) if f.is_relative_to(root) else f for f in files], files)
    found = [_lookup(root, keys, name) for name in names]
    if all(f is None for f in found) and len(files) == len(names):
        return files
    missing = [name for name, f in zip(names, found, strict=True) if f is None]
    if missing:
        raise SceneError(
            root,
            f"expected {len(names)} images, one per camera, found {len(files)} and none for {missing[0]}",
            "add what is missing, or name the right folder with --images",
        )
    matched = [f for f in found if f is not None]
    if len(set(matched)) < len(matched):
        twice = next(f for f in matched if matched.count(f) > 1)
        raise SceneError(root, f"expected an image of its own for each camera, found {twice.name} for two of them")
    return matched


def list_images(folder: Path) -> list[Path]:
    """All images below a folder, numbers in their names counted as numbers."""
    files = [Path(base) / f for base, _, inside in os.walk(folder) for f in inside]
    images = [f for f in files if f.suffix.lower() in IMAGE_SUFFIXES and not f.name.startswith(".")]
    return sorted(images, key=lambda f: natural_key(f.relative_to(folder).as_posix()))


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts "view 2" before "view 10"."""
    parts = [(p, p.lstrip("0")) for p in re.split(r"([0-9]+)", name) if p]
    return [(0, len(digits), digits) if p[0] in "0123456789" else (1, 0, p) for p, digits in parts]


def find_image(folder: Path, name: str) -> Path | None:
    """The image that a camera file beside it names, with or without its extension; None where there is none."""
    path = os.path.join(folder, name)
    candidates = [path, *(path + suffix for suffix in sorted(IMAGE_SUFFIXES))]
    return next((Path(c) for c in candidates if os.path.isfile(c)), None)


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image, pixels."""
    return stored_size(path)


def _index(relative: Sequence[Path], files: Sequence[Path]) -> dict[str, list[Path]]:
    """Files by every ending of their path, with and without extension."""
    keys: dict[str, list[Path]] = {}
    for short, file in zip(relative, files, strict=True):
        parts = short.parts
        for i in range(len(parts)):
            ending = PurePosixPath(*parts[i:])
            for key in {str(ending), str(ending.with_suffix(""))}:
                keys.setdefault(key, []).append(file)
    return keys


def _lookup(root: Path, keys: dict[str, list[Path]], name: str) -> Path | None:
    parts = [part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in ("/", "//", "..")]
    for i in range(len(parts)):
        ending = PurePosixPath(*parts[i:])
        for key in (str(ending), str(ending.with_suffix(""))):
            hits = keys.get(key, [])
            if len(hits) > 1:
                raise SceneError(root, f"expected one image named {name}, found {hits[0].name} and {hits[1].name}")
            if hits:
                return hits[0]
    return None


def decode_photos(path: Path, names: Sequence[str], files: Sequence[np.ndarray], limit: int) -> np.ndarray:
    """Images that lie in another file.

    Args:
        path: That file, for messages.
        names: What to call each image.
        files: ``[b]`` uint8 each: the bytes of an image file.
        limit: Bytes that they may have when decoded.

    Returns:
        ``[c,h,w,3]`` uint8 sRGB.

    Raises:
        SceneError: If one cannot be decoded, two differ in size, or they are too many.
    """
    sizes = [told_size(path, io.BytesIO(data.tobytes())) for data in files]
    width, height = sizes[0]
    odd = next((name for name, size in zip(names, sizes, strict=True) if size != sizes[0]), None)
    if odd is not None:
        raise SceneError(path, f"{odd}: expected images of one size, found another than {width} x {height}")
    if 3 * width * height * len(files) > limit:
        raise SceneError(
            path, f"expected images of at most {limit >> 20} MiB, found {len(files)} of {width} x {height}"
        )
    out = np.empty((len(files), height, width, 3), np.uint8)
    parallel_map(lambda i: np.copyto(out[i], _decoded(path, files[i], sizes[i])), range(len(files)))
    return out


def _decode(path: Path) -> np.ndarray:
    """``[h,w,3]`` uint8 sRGB of an image file."""
    size = stored_size(path)
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise SceneError(path, f"cannot be read ({error.strerror})") from error
    return _decoded(path, data, size)


def _decoded(path: Path, data: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """``[h,w,3]`` uint8 sRGB. The orientation tag is ignored, as camera solvers do."""
    width, height = size
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    sound = checked_png(data) if data[: len(SIGNATURE)].tobytes() == SIGNATURE else data
    try:
        image = cv2.imdecode(sound, flags) if sound is not None and len(sound) else None
    except cv2.error:
        image = None
    if image is None:
        raise SceneError(path, "expected an image, found a file that cannot be decoded", "replace it")
    if image.shape != (height, width, 3):
        raise SceneError(path, f"expected {width} x {height} pixels as its header says, found others", "replace it")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)
