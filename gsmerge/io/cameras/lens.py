"""Photos without lens distortion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import COEFFICIENTS, CameraFile, Lens, sizes_of, to_cameras
from gsmerge.io.photos import Photos, Size, change_photos, photo_size, same_shape

_MIN_SHARE = (
    0.25  # of an undistorted photo's pixels that lie within the photo: at half of the image's diagonal r, a lens
)
# with k1 = 1 / r^2, stronger than any, still has a third
_GRID = 32  # pixels a side on which that is measured


def as_pinholes(camera_file: CameraFile, photos: Photos | None) -> tuple[CameraFile, Photos | None, list[str]]:
    """Photos without lens distortion and cameras that are pinholes, with the same intrinsics; and a note about it.
    SceneError if a lens is no pinhole and there are no photos of the camera's shape, or shows next to nothing of one.
    """
    if not camera_file.lenses:
        return camera_file, photos, []
    pinholes = replace(camera_file, lenses=())
    name = next(lens.name for lens in camera_file.lenses if lens is not None)
    size = photo_size(photos)
    if photos is None or size is None:
        problem = f"expected a pinhole camera, or images to undistort, found {name} with lens distortion and no images"
        raise SceneError(camera_file.path, problem, "name the images with --images, or undistort them first")
    for w, h in sizes_of(camera_file):
        if not same_shape((w, h), size):
            problem = f"expected images of the cameras' {w} x {h} to undistort ({name}), found {size[0]} x {size[1]}"
            raise SceneError(camera_file.path, problem, "give the images as they were taken, or undistort them first")
    Ks = to_cameras(pinholes, size).Ks
    for view, K, lens in zip(camera_file.names, Ks, camera_file.lenses, strict=True):
        share = 1.0 if lens is None else _share_inside(K, lens, size)
        if lens is not None and share < _MIN_SHARE:
            values = zip(COEFFICIENTS[lens.model], lens.coefficients, strict=False)
            found = ", ".join(f"{key} = {value:g}" for key, value in values if value)
            problem = f"view {view}: expected {lens.name} coefficients of a lens, found {found}, with which"
            problem += f" {100 * (1 - share):.0f} % of the undistorted photo would lie outside of the photo"
            raise SceneError(camera_file.path, problem, "correct them, or undistort the images first")
    straight = undistort_photos(photos, Ks, camera_file.lenses)
    return pinholes, straight, [f"the photos are undistorted ({name}); the intrinsics stay"]


def undistort_photos(photos: Photos, Ks: np.ndarray, lenses: Sequence[Lens | None]) -> Photos:
    """The photos that pinholes with the same intrinsics would have taken; where one shows nothing, its border is
    repeated.

    ``photos`` are uint8 ``[h,w,3]``; ``Ks [c,3,3]`` at their size, the top-left pixel's centre at (0.5, 0.5).
    """

    def one(view: int, photo: np.ndarray) -> np.ndarray:
        lens = lenses[view]
        if lens is None:
            return photo
        maps = _rectify_maps(Ks[view], lens, (photo.shape[1], photo.shape[0]))
        return cv2.remap(photo, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    return change_photos(photos, photo_size(photos), one)


def _rectify_maps(K: np.ndarray, lens: Lens, size: Size) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel of a pinhole's image lies in the lens's: x and y ``[h,w]`` float32, pixels."""
    centred = K.astype(np.float64).copy()
    centred[:2, 2] -= 0.5  # OpenCV has the top-left pixel's centre at (0, 0)
    coefficients = np.pad(lens.coefficients, (0, len(COEFFICIENTS[lens.model]) - len(lens.coefficients)))
    make = cv2.fisheye.initUndistortRectifyMap if lens.model == "fisheye" else cv2.initUndistortRectifyMap
    x, y = make(centred, coefficients.astype(np.float64), np.eye(3), centred, size, cv2.CV_32FC1)
    return x, y


def _share_inside(K: np.ndarray, lens: Lens, size: Size) -> float:
    """Share of the undistorted photo's pixels that lie within the photo."""
    small = np.diag([_GRID / size[0], _GRID / size[1], 1.0]) @ K
    maps = _rectify_maps(small, lens, (_GRID, _GRID))
    return float(np.all([(m >= -0.5) & (m <= _GRID - 0.5) for m in maps], 0).mean())
