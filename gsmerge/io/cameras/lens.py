"""Lens distortion: what camera files say of it, and photos without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from gsmerge.runtime.threads import parallel_map


@dataclass(frozen=True)
class Lens:
    """A lens that is no pinhole.

    Args:
        name: As the camera file calls the model.
        model: "perspective": radial and tangential, as ``cv2.undistort``; "fisheye": as ``cv2.fisheye``.
        coefficients: The first of k1, k2, p1, p2, k3, k4, k5, k6, or of a fisheye's k1, k2, k3, k4; others are 0.
    """

    name: str
    model: Literal["perspective", "fisheye"]
    coefficients: tuple[float, ...]


def perspective(name: str, coefficients: Sequence[float]) -> Lens | None:
    """A lens with coefficients in the order k1, k2, p1, p2, k3, k4, k5, k6; None where all are zero: a pinhole."""
    return Lens(name, "perspective", tuple(coefficients)) if any(coefficients) else None


def fisheye(name: str, coefficients: Sequence[float]) -> Lens:
    """A fisheye with up to four coefficients; with none of them it is no pinhole either."""
    return Lens(name, "fisheye", tuple(coefficients))


def undistorted(
    photos: Sequence[np.ndarray] | np.ndarray, Ks: np.ndarray, lenses: Sequence[Lens | None]
) -> list[np.ndarray]:
    """The photos that pinholes with the same intrinsics would have taken.

    Args:
        photos: c uint8 photos ``[h,w,3]``.
        Ks: ``[c,3,3]`` at the photos' size; the top-left pixel's centre is (0.5, 0.5).
        lenses: Of each photo.

    Returns:
        c photos of the same size; where a photo shows nothing, its border is repeated.
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
