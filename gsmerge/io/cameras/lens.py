"""Photos without lens distortion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from gsmerge.errors import SceneError
from gsmerge.io.cameras.camera_file import CameraFile, Lens, sizes_of, to_cameras
from gsmerge.io.photos import Photos, photo_size, same_shape
from gsmerge.runtime.threads import parallel_map


def as_pinholes(camera_file: CameraFile, photos: Photos | None) -> tuple[CameraFile, Photos | None, list[str]]:
    """Photos without lens distortion and cameras that are pinholes, with the same intrinsics; and a note about it.
    SceneError if a lens is no pinhole and there are no photos of the camera's shape.
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
    straight = undistort_photos(photos, to_cameras(pinholes, size).Ks, camera_file.lenses)
    return pinholes, straight, [f"the photos are undistorted ({name}); the intrinsics stay"]


def undistort_photos(photos: Photos, Ks: np.ndarray, lenses: Sequence[Lens | None]) -> list[np.ndarray]:
    """The photos that pinholes with the same intrinsics would have taken; where one shows nothing, its border is
    repeated.

    ``photos`` are uint8 ``[h,w,3]``; ``Ks [c,3,3]`` at their size, the top-left pixel's centre at (0.5, 0.5).
    """

    def one(item: tuple[np.ndarray, np.ndarray, Lens | None]) -> np.ndarray:
        photo, K, lens = item
        if lens is None:
            return photo
        centred = K.astype(np.float64).copy()
        centred[:2, 2] -= 0.5  # OpenCV has the top-left pixel's centre at (0, 0)
        size, length = (photo.shape[1], photo.shape[0]), 4 if lens.model == "fisheye" else 8
        coefficients = np.pad(np.array(lens.coefficients, np.float64), (0, length - len(lens.coefficients)))
        make = cv2.fisheye.initUndistortRectifyMap if lens.model == "fisheye" else cv2.initUndistortRectifyMap
        maps = make(centred, coefficients, np.eye(3), centred, size, cv2.CV_32FC1)
        return cv2.remap(photo, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    return parallel_map(one, list(zip(photos, Ks, lenses, strict=True)))
