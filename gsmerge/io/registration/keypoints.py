"""Find the keypoints of photos with the points of the scene under them, and match those of two scenes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np

from gsmerge.geometry import camera_depths, lower_median, sh0_to_rgb
from gsmerge.kernels.matrices import invert, matmul
from gsmerge.types import Scene

SIDE = 1600  # longest side of a photo that keypoints are looked for in, pixels
KEYPOINTS = 4000  # most of a photo
CONTRAST = 0.02  # of a keypoint; OpenCV's default finds too few on plain walls
GREY = np.array([77, 150, 29], np.int32)  # red, green and blue of a grey value, 256ths
RATIO = 0.8  # distance of the best match to that of the second best (Lowe 2004)
OPAQUE = 0.5  # share of a pixel's largest opacity from which the nearest of its Gaussians is its surface
SAME_DEPTH = 0.15  # logarithm of the depths around a keypoint within which it lies on one surface
PIXEL_SPREAD = 0.003  # standard deviation of a keypoint, share of the photo's diagonal


@dataclass(frozen=True, eq=False)
class Photo:
    """The keypoints of one photo, and the scene's points under them."""

    pixels: np.ndarray  # [n,2] of the scene's grid
    points: np.ndarray  # [n,3] float64, in the scene's frame
    descriptors: np.ndarray  # [n,128] float32, whole numbers up to 255
    viewmat: np.ndarray  # [4,4] float64, of its camera in the scene's frame
    K: np.ndarray  # [3,3]


@dataclass(frozen=True, eq=False)
class Matches:
    """Keypoints of two scenes that look alike: arrays with one row for each of both."""

    scenes: tuple[int, int]
    points: tuple[np.ndarray, np.ndarray]  # [m,3] in each scene's frame
    pixels: tuple[np.ndarray, np.ndarray]  # [m,2] of each grid
    viewmats: tuple[np.ndarray, np.ndarray]  # [m,4,4] cameras that see them
    Ks: tuple[np.ndarray, np.ndarray]  # [m,3,3]
    spread: float  # standard deviation of a keypoint, pixels

    def __len__(self) -> int:
        return len(self.points[0])

    def select(self, some: np.ndarray) -> Matches:
        """Select some matches by a mask."""

        def take(name: str) -> tuple[np.ndarray, np.ndarray]:
            one, other = getattr(self, name)
            return one[some], other[some]

        return Matches(self.scenes, take("points"), take("pixels"), take("viewmats"), take("Ks"), self.spread)


@contextmanager
def _any_processor() -> Iterator[None]:
    """Have OpenCV use instructions alone that all processors have, so that keypoints are the same on each."""
    before = cv2.useOptimized()
    cv2.setUseOptimized(False)
    try:
        yield
    finally:
        cv2.setUseOptimized(before)


def find_keypoints(scene: Scene) -> list[Photo]:
    """Find the keypoints of every camera of an aligned scene that lie on one surface.

    Without photos they are those of the Gaussians' base colours. Views with one camera are layers of one photo.
    """
    cameras = scene.cameras.numpy()
    keys = np.concatenate([cameras.viewmats.reshape(len(scene), -1), cameras.Ks.reshape(len(scene), -1)], 1)
    firsts = [int((keys == key).all(1).argmax()) for key in keys]
    out = []
    for view in sorted(set(firsts)):
        layers = [i for i, first in enumerate(firsts) if first == view]
        K, viewmat = cameras.Ks[view].astype(np.float64), cameras.viewmats[view].astype(np.float64)
        picture, shown = _picture(scene, view, K)
        places, descriptors = _describe(picture, shown[1, 1] / shown[0, 0])
        pixels = (places - shown[:2, 2]) * (K[0, 0] / shown[0, 0], K[1, 1] / shown[1, 1]) + K[:2, 2]
        depths = _surface(scene, layers, viewmat)
        z, ok = _depths_at(depths, pixels)
        rays = matmul(np.concatenate([pixels, np.ones((len(pixels), 1))], 1), invert(K).T)
        points = matmul(rays[ok] * z[ok, None] - viewmat[:3, 3], viewmat[:3, :3])
        out.append(Photo(pixels[ok], points, descriptors[ok], viewmat, K))
    return out


def _picture(scene: Scene, view: int, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what a view shows, ``[h,w,3]`` uint8, of at most SIDE pixels a side, and the intrinsics of that picture.

    The largest photo that there is, or the Gaussians' base colours.
    """
    if scene.large_photos is not None:
        large = scene.large_photos
        photo, Ks = large.read(large.ids[view]), large.Ks[view].astype(np.float64)
        share = min(1.0, SIDE / max(large.width, large.height))
        size = max(1, round(large.width * share)), max(1, round(large.height * share))
        small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA) if share < 1 else photo
        return small, Ks * np.array([[size[0] / large.width], [size[1] / large.height], [1.0]])
    if scene.images is None:
        colors = sh0_to_rgb(scene.gaussians.sh0.reshape(-1, scene.cameras.height, scene.cameras.width, 3)[view])
    else:
        colors = scene.images[view]
    return (colors.clip(0, 1) * 255).round().astype(np.uint8), K


def _describe(picture: np.ndarray, stretch: float) -> tuple[np.ndarray, np.ndarray]:
    """Find and describe keypoints of a picture ``[h,w,3]`` uint8; ``stretch`` makes its pixels square again."""
    height, width = picture.shape[:2]
    wide = (max(8, round(width * stretch)), height) if stretch > 1 else (width, max(8, round(height / stretch)))
    grey = ((picture.astype(np.int32) * GREY).sum(-1) >> 8).astype(np.uint8)
    with _any_processor():
        grey = cv2.resize(grey, wide, interpolation=cv2.INTER_LINEAR) if wide != (width, height) else grey
        keypoints, descriptors = cv2.SIFT.create(KEYPOINTS, contrastThreshold=CONTRAST).detectAndCompute(grey, None)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    places = np.array([keypoint.pt for keypoint in keypoints], np.float64) + 0.5
    return places * (width / wide[0], height / wide[1]), descriptors


def _surface(scene: Scene, layers: Sequence[int], viewmat: np.ndarray) -> np.ndarray:
    """Return the depths ``[h,w]`` of what one camera sees, of the nearest opaque layer; infinite where there is none.

    ``layers`` are the views that have the camera.
    """
    shape = (len(scene), scene.cameras.height, scene.cameras.width)
    means = scene.gaussians.means.reshape(*shape, 3)[list(layers)].astype(np.float64)
    opacities = scene.gaussians.opacities.reshape(shape)[list(layers)] * scene.stored[list(layers)]
    depths = camera_depths(means, viewmat)
    seen = (depths > 0) & (opacities >= OPAQUE * opacities.max(0)) & (opacities > 0)
    return np.asarray(np.where(seen, depths, np.inf).min(0))


def _depths_at(depths: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Look up the median depth around places ``[n,2]``, and whether they lie on one surface."""
    height, width = depths.shape
    x, y = np.floor(pixels).astype(int).T
    around = [
        depths[(y + dy).clip(0, height - 1), (x + dx).clip(0, width - 1)] for dy in (-1, 0, 1) for dx in (-1, 0, 1)
    ]
    nine = np.array(around).reshape(9, -1)
    finite = np.isfinite(nine).all(0)
    return lower_median(nine), finite & (nine.max(0) < nine.min(0) * (1 + SAME_DEPTH))


def match_photos(scenes: tuple[int, int], one: Sequence[Photo], other: Sequence[Photo], scene: Scene) -> Matches:
    """Match the keypoints of all photos of two scenes, both ways."""
    rows = [(a, b, *_match(a.descriptors, b.descriptors)) for a in one for b in other]

    def both(name: str) -> tuple[np.ndarray, np.ndarray]:
        first = np.concatenate([getattr(a, name)[i] for a, _, i, _ in rows])
        return first, np.concatenate([getattr(b, name)[j] for _, b, _, j in rows])

    def each(name: str) -> tuple[np.ndarray, np.ndarray]:
        first = np.concatenate([np.repeat(getattr(a, name)[None], len(i), 0) for a, _, i, _ in rows])
        return first, np.concatenate([np.repeat(getattr(b, name)[None], len(i), 0) for _, b, i, _ in rows])

    spread = PIXEL_SPREAD * float(np.sqrt(scene.cameras.width**2 + scene.cameras.height**2))
    return Matches(scenes, both("points"), both("pixels"), each("viewmat"), each("K"), spread)


def _match(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of both that are each other's best match, and clearly better than the second best."""
    if min(len(a), len(b)) < 2:
        return np.empty(0, int), np.empty(0, int)
    # whole numbers below 2^24: float32 has them exactly, in any order of summation
    distances = (a * a).sum(1)[:, None] + (b * b).sum(1) - 2 * (a @ b.T)
    best = distances.argmin(1)
    two = np.partition(distances, 1, axis=1)[:, :2].astype(np.float64)
    good = (two[:, 0] < RATIO**2 * two[:, 1]) & (distances.argmin(0)[best] == np.arange(len(a)))
    return np.flatnonzero(good), best[good]
