"""The size of the Gaussian grid, where cameras, photos and grid may each have another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from gsmerge.errors import SceneError
from gsmerge.io.alignment.crop import Mapping, Size, counted, cover, patched, stretch
from gsmerge.io.alignment.mismatch import ASPECT_TOLERANCE
from gsmerge.io.cameras.camera_file import CameraFile, sizes_of, to_cameras
from gsmerge.io.cameras.lens import undistorted
from gsmerge.io.formats.ply import PlyInfo
from gsmerge.types import Cameras

_MOST_ENLARGED = 1.5  # times the side of a photo; some networks enlarge small ones

Photos = Sequence[np.ndarray] | np.ndarray


@dataclass(frozen=True)
class Fit:
    """One way in which cameras and photos may be brought to the grid.

    Args:
        cameras: At the grid's size.
        mapping: What is done to the photos; None: nothing.
        notes: What it is, for people.
        rank: What speaks for it: a size that files have (0); the number of rows and the photos' shape (1); the number
            of rows alone (2); a network's habit (3).
    """

    cameras: Cameras
    mapping: Mapping | None
    notes: tuple[str, ...]
    rank: int = 0

    @property
    def guessed(self) -> bool:
        """Whether it is one of many that the number of rows allows."""
        return self.rank in (1, 2)


def photo_size(photos: Photos | None) -> Size | None:
    """(width, height) of the photos; None without any."""
    return None if photos is None else (photos[0].shape[1], photos[0].shape[0])


def as_is(camera_file: CameraFile, size: Size | None) -> Fit:
    """The grid has the photos' size, or that of the cameras where there are no photos.

    Raises:
        SceneError: If the cameras' size is not the photos' or a multiple of it.
    """
    if size is None:
        return Fit(to_cameras(camera_file), None, ())
    width, height = size
    for w, h in sizes_of(camera_file):
        if not _alike((w, h), size):
            swapped = (w, h) == (height, width)
            raise SceneError(
                camera_file.path,
                f"expected cameras of the images' size {width} x {height} or a multiple of it, found {w} x {h}",
                "width and height are swapped" if swapped else "crop cameras and images alike",
            )
    other = [s for s in sizes_of(camera_file) if s != size]
    notes = tuple(f"intrinsics scaled from {w} x {h} to the images' {width} x {height}" for w, h in other)
    return Fit(to_cameras(camera_file, size), None, notes)


def mapped(ply: PlyInfo, camera_file: CameraFile, size: Size | None) -> Iterator[Fit]:
    """All else that the files and the number of rows allow, the likely ones first.

    Args:
        ply: What was found in the ``.ply``.
        camera_file: The cameras at the size that their file has.
        size: (width, height) of the photos; None without any.
    """
    known = sizes_of(camera_file)
    own = known[0] if len(known) == 1 else None
    if size is not None and own is not None and own != size:
        yield from _between(camera_file, size, own)
    base = size or own
    if base is None or any(not _alike(s, base) for s in known):
        return
    cameras = to_cameras(camera_file, base)
    patches = patched(base) if ply.sh_degree == 0 and ply.opacity_encoding == "logit" else iter(())
    what = "photos and cameras" if size is not None else "cameras"
    for rank, mapping in [(1 if m.is_whole else 2, m) for m in counted(ply.count, len(camera_file), base)] + [
        (3, m) for m in patches if ply.count < len(camera_file) * m.width * m.height
    ]:
        note = f"{what} of {base[0]} x {base[1]} are {mapping.words}, the Gaussian grid's size"
        yield Fit(_moved(cameras, mapping.intrinsics(cameras.Ks), mapping), mapping, (note,), rank)
        if not known and not mapping.is_whole:
            whole = to_cameras(camera_file, (mapping.width, mapping.height))
            yield Fit(whole, mapping, (f"{note}; the intrinsics are those of the result",), rank)


def small_photos(ply: PlyInfo, camera_file: CameraFile, size: Size | None) -> SceneError | None:
    """Why photos do not do where the rows are as many as the cameras have pixels, but of another size."""
    own = next((s for s in sizes_of(camera_file) if ply.count == len(camera_file) * s[0] * s[1]), None)
    if size is None or own is None or own == size:
        return None
    return SceneError(
        camera_file.path,
        f"expected images of the Gaussian grid's size {own[0]} x {own[1]} or larger, found {size[0]} x {size[1]}",
        "give the images that the backbone saw, or their originals",
    )


def _between(camera_file: CameraFile, size: Size, own: Size) -> Iterator[Fit]:
    """Photos brought to the cameras' size, or cameras of uncropped pictures brought to the photos'."""
    cameras = to_cameras(camera_file, own)
    for mapping in (stretch(size, own), cover(size, own)):
        if max(mapping.scale_x, mapping.scale_y) > _MOST_ENLARGED:
            continue  # previews: a fit to them would blur the Gaussians
        note = f"photos of {size[0]} x {size[1]} are {mapping.words}, the cameras' and the Gaussian grid's size"
        yield Fit(cameras, mapping, (note,))
    if not _alike(own, size):
        for mapping in (stretch(own, size), cover(own, size)):
            note = f"cameras of {own[0]} x {own[1]} are {mapping.words}, the images' size"
            yield Fit(_moved(cameras, mapping.intrinsics(cameras.Ks), mapping), None, (note,))


def _moved(cameras: Cameras, Ks: torch.Tensor, mapping: Mapping) -> Cameras:
    return replace(cameras, Ks=Ks, width=mapping.width, height=mapping.height)


def _alike(one: Size, other: Size) -> bool:
    """Whether two sizes have the same shape, but for rounding."""
    return abs(one[0] * other[1] / (one[1] * other[0]) - 1) <= ASPECT_TOLERANCE


def as_pinholes(camera_file: CameraFile, photos: Photos | None) -> tuple[CameraFile, Photos | None, list[str]]:
    """Photos without lens distortion and cameras that are pinholes, with the same intrinsics; and a note of it.

    Raises:
        SceneError: If a lens is no pinhole and there are no photos of the camera's shape.
    """
    if not camera_file.lenses:
        return camera_file, photos, []
    pinholes = replace(camera_file, lenses=())
    name = next(lens.name for lens in camera_file.lenses if lens is not None)
    size = photo_size(photos)
    if photos is None or size is None:
        raise SceneError(
            camera_file.path,
            f"expected a pinhole camera, or images to undistort, found {name} with lens distortion and no images",
            "name the images with --images, or undistort them first",
        )
    other = next((s for s in sizes_of(camera_file) if not _alike(s, size)), None)
    if other is not None:
        raise SceneError(
            camera_file.path,
            f"expected images of the cameras' {other[0]} x {other[1]} to undistort ({name}), found"
            f" {size[0]} x {size[1]}",
            "give the images as they were taken, or undistort them first",
        )
    straight = undistorted(photos, to_cameras(pinholes, size).Ks.numpy(), camera_file.lenses)
    return pinholes, straight, [f"the photos are undistorted ({name}); the intrinsics stay"]
