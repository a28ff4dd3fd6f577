"""Find keypoints in photos and their points in the scene, and match the keypoints of two scenes."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from gsmerge.frozen import dataclass, fields, replace
from gsmerge.io.photo_files import limit_size
from gsmerge.method.geometry.transforms import camera_depths, lower_median
from gsmerge.method.kernels.matrices import invert, matmul
from gsmerge.method.raster.photos import row_pictures
from gsmerge.types import Scene

KEYPOINT_PIXELS = 1600  # longest side of a photo in which keypoints are searched, pixels
GREY_WEIGHTS = np.array([77, 150, 29], np.int32)  # of red, green and blue in a grey value; they sum to 256
MATCH_RATIO = 0.8  # largest distance of the best match, divided by the distance of the second best (Lowe 2004)


@dataclass(frozen=True, eq=False)
class PhotoKeypoints:
    """Keypoints of one photo, and their points in the scene."""

    pixels: np.ndarray  # [n,2] positions in the scene's grid
    points: np.ndarray  # [n,3] float64, in the scene's frame
    descriptors: np.ndarray  # [n,128] float32, whole numbers up to 255
    viewmat: np.ndarray  # [4,4] float64, pose of the photo's camera in the scene's frame
    K: np.ndarray  # [3,3] of this camera


@dataclass(frozen=True, eq=False)
class MatchSide:
    """The keypoints of one scene in m matches with another scene: pixels, points and cameras."""

    points: np.ndarray  # [m,3] in the scene's frame
    pixels: np.ndarray  # [m,2] positions in the scene's grid
    viewmats: np.ndarray  # [m,4,4] pose of the camera that shows each keypoint
    Ks: np.ndarray  # [m,3,3] of this camera

    def select(self, mask: np.ndarray) -> MatchSide:
        """Select matches by a mask."""
        return MatchSide(*(getattr(self, field.name)[mask] for field in fields(self)))


@dataclass(frozen=True, eq=False)
class KeypointMatches:
    """Matches between the keypoints of two scenes, row by row."""

    scenes: tuple[int, int]  # numbers of the two scenes
    sides: tuple[MatchSide, MatchSide]
    spread: float  # standard deviation of a keypoint, pixels

    def __len__(self) -> int:
        return len(self.sides[0].points)

    def select(self, mask: np.ndarray) -> KeypointMatches:
        """Select matches by a mask."""
        first, second = self.sides
        return replace(self, sides=(first.select(mask), second.select(mask)))


def find_keypoints(scene: Scene) -> list[PhotoKeypoints]:
    """Find the keypoints in the photo of every view of a scene with pixels, except keypoints at edges of surfaces."""
    cameras = scene.cameras.numpy()
    photos = []
    for view in range(len(scene)):
        K = cameras.Ks[view].astype(np.float64)
        viewmat = cameras.viewmats[view].astype(np.float64)
        picture, picture_K = _read_picture(scene, view, K)
        picture_pixels, descriptors = detect_keypoints(picture, picture_K[1, 1] / picture_K[0, 0])
        focal_ratios = K[0, 0] / picture_K[0, 0], K[1, 1] / picture_K[1, 1]
        pixels = (picture_pixels - picture_K[:2, 2]) * focal_ratios + K[:2, 2]
        photos.append(place_keypoints(pixels, descriptors, _front_depths(scene, view, viewmat), viewmat, K))
    return photos


def place_keypoints(
    pixels: np.ndarray, descriptors: np.ndarray, depths: np.ndarray, viewmat: np.ndarray, K: np.ndarray
) -> PhotoKeypoints:
    """Return keypoints with the points that a view with ``depths [h,w]`` shows there, but none at edges of surfaces.

    Depths are infinite where there is no surface.
    """
    z, is_surface = _depths_at(depths, pixels)
    rays = matmul(np.concatenate([pixels, np.ones((len(pixels), 1))], 1), invert(K).T)
    points = matmul(rays[is_surface] * z[is_surface, None] - viewmat[:3, 3], viewmat[:3, :3])
    return PhotoKeypoints(pixels[is_surface], points, descriptors[is_surface], viewmat, K)


def _read_picture(scene: Scene, view: int, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a picture ``[h,w,3]`` uint8 of a view, and the picture's intrinsics.

    The picture is the photo at its own size, but its longer side has at most KEYPOINT_PIXELS pixels. Without photos the
    picture has the base colours of the Gaussians. ``K`` are the intrinsics of the view.
    """
    if scene.large_photos is not None:
        large = scene.large_photos
        photo = large.read(large.ids[view])
        size = limit_size((large.width, large.height), KEYPOINT_PIXELS)
        scale = np.array([[size[0] / large.width], [size[1] / large.height], [1.0]])
        small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA) if size[0] < large.width else photo
        return small, large.Ks[view].astype(np.float64) * scale
    return to_bytes(row_pictures(scene)[view] if scene.images is None else scene.images[view]), K


def to_bytes(picture: np.ndarray) -> np.ndarray:
    """Convert a picture in [0, 1] to uint8."""
    return (picture.clip(0, 1) * 255).round().astype(np.uint8)


def detect_keypoints(picture: np.ndarray, stretch: float) -> tuple[np.ndarray, np.ndarray]:
    """Find keypoints of a picture ``[h,w,3]`` uint8; return their pixels ``[n,2]`` and descriptors ``[n,128]``.

    ``stretch`` is the width of a pixel's footprint divided by its height. The search resizes the picture to square
    pixels.
    """
    height, width = picture.shape[:2]
    min_side = 8  # least side of a photo in which keypoints are searched, pixels
    wide = max(min_side, round(width * max(stretch, 1)))
    high = max(min_side, round(height / min(stretch, 1)))
    grey = ((picture.astype(np.int32) * GREY_WEIGHTS).sum(-1) >> 8).astype(np.uint8)
    max_keypoints = 4000  # most keypoints of a photo
    contrast = 0.02  # least contrast of a keypoint; OpenCV's default finds too few on plain walls
    finder = cv2.SIFT.create(max_keypoints, contrastThreshold=contrast)
    # OpenCV uses only instructions of all processors, so that keypoints are equal on all
    before = cv2.useOptimized()
    cv2.setUseOptimized(False)
    try:
        square = cv2.resize(grey, (wide, high), interpolation=cv2.INTER_LINEAR)
        keypoints, descriptors = finder.detectAndCompute(square, None)
    finally:
        cv2.setUseOptimized(before)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    places = np.array([keypoint.pt for keypoint in keypoints], np.float64) + 0.5
    return places * (width / wide, height / high), descriptors


def _front_depths(scene: Scene, view: int, viewmat: np.ndarray) -> np.ndarray:
    """Return the depth ``[h,w]`` of the front Gaussian of each pixel of a view; infinite without a Gaussian."""
    rows = scene.get_pixels().fronts[view]
    depths = camera_depths(scene.gaussians.means[rows].astype(np.float64), viewmat)
    return np.where((rows >= 0) & (depths > 0), depths, np.inf)


def _depths_at(depths: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the median depth ``[n]`` of 3 x 3 pixels around ``pixels [n,2]``, and whether these show one surface."""
    padded = np.pad(depths, 1, mode="edge")
    height, width = depths.shape
    x = np.floor(pixels[:, 0]).astype(int).clip(0, width - 1)
    y = np.floor(pixels[:, 1]).astype(int).clip(0, height - 1)
    window = np.array([padded[y + down, x + right] for down in range(3) for right in range(3)])
    same_depth = 0.15  # largest relative difference of depths around a keypoint on one surface
    is_surface = np.isfinite(window).all(0) & (window.max(0) < window.min(0) * (1 + same_depth))
    return lower_median(window), is_surface


def match_photos(
    scenes: tuple[int, int],
    photos: Sequence[PhotoKeypoints],
    other_photos: Sequence[PhotoKeypoints],
    size: tuple[int, int],
) -> KeypointMatches:
    """Match the keypoints of all photos of two scenes; ``size`` is width and height of their grids, pixels.

    Two keypoints match if the descriptor of each is the best match of the other, and clearly better than the
    second-best match.
    """
    pairs = [(a, b) for a in photos for b in other_photos]
    # of each pair of photos: the keypoints of the first that have a match, and their matches in the second
    rows = [match_descriptors(a.descriptors, b.descriptors) for a, b in pairs]
    first = _make_side([a for a, _ in pairs], [ids for ids, _ in rows])
    second = _make_side([b for _, b in pairs], [ids for _, ids in rows])
    diagonal = float(np.sqrt(size[0] ** 2 + size[1] ** 2))
    pixel_spread = 0.003  # standard deviation of a keypoint, divided by the diagonal of the picture
    return KeypointMatches(scenes, (first, second), pixel_spread * diagonal)


def match_descriptors(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the keypoints ``[m]`` of one photo that have a match, and their matches ``[m]`` in another photo."""
    if min(len(a), len(b)) < 2:  # without a second-best match nothing can be decided
        return np.empty(0, int), np.empty(0, int)
    # all sums are whole numbers below 2^24, so float32 is exact in any order of summation
    distances = (a * a).sum(1)[:, None] + (b * b).sum(1) - 2 * (a @ b.T)
    best = distances.argmin(1)
    two_best = np.partition(distances, 1, axis=1)[:, :2].astype(np.float64)
    is_clear = two_best[:, 0] < MATCH_RATIO**2 * two_best[:, 1]
    matched = is_clear & (distances.argmin(0)[best] == np.arange(len(a)))
    return np.flatnonzero(matched), best[matched]


def _make_side(photos: Sequence[PhotoKeypoints], rows: Sequence[np.ndarray]) -> MatchSide:
    """Collect the keypoints that have a match, of which ``rows`` are the indices in each photo."""
    photo_rows = list(zip(photos, rows, strict=True))
    counts = [len(ids) for ids in rows]
    return MatchSide(
        points=np.concatenate([photo.points[ids] for photo, ids in photo_rows]),
        pixels=np.concatenate([photo.pixels[ids] for photo, ids in photo_rows]),
        viewmats=np.repeat([photo.viewmat for photo in photos], counts, 0),
        Ks=np.repeat([photo.K for photo in photos], counts, 0),
    )
