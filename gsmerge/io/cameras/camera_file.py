"""The cameras of a file: check and convert them, and undistort their photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import cv2
import numpy as np

from gsmerge.errors import SceneError
from gsmerge.frozen import dataclass, field, replace
from gsmerge.io.bounds import MAX_VIEWS, check_image_size
from gsmerge.io.photo_files import PhotoArrays, PhotoTransform, Size, change_photos, photo_size, same_shape
from gsmerge.method.geometry.transforms import Similarity, pose_changes
from gsmerge.method.kernels.matrices import determinant, invert, matmul
from gsmerge.runtime.arguments import check_arguments
from gsmerge.settings.reading import Order
from gsmerge.types import Cameras, StrPath

# Largest number in poses and intrinsics, largest side of an image, and smallest focal length, in pixels. Cameras beyond
# these three limits are not real, and their numbers would overflow in later steps
MAX_NUMBER = 1e12
_MAX_SIDE = 1e6
_MIN_FOCAL = 1e-6
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # turns OpenGL's camera axes (y up, z backward) to OpenCV's (y down, z forward)

# A principal point is in the middle if twice its coordinates differ by at most these pixels from the image's size
CENTRED_PX = 1e-3
MAX_NORMALISED_FOCAL = 10.0  # longest focal length in sides of the image; a longer focal length is in pixels

# Orders of the Gaussians' rows that a camera file may state
ORDERS: tuple[str, ...] = get_args(Order)
# How a format stores poses: the direction of the matrix, and the axes of the camera
Convention = tuple[str, str]
W2C_OPENCV: Convention = ("world-to-camera", "OpenCV")
C2W_OPENCV: Convention = ("camera-to-world", "OpenCV")
W2C_OPENGL: Convention = ("world-to-camera", "OpenGL")
C2W_OPENGL: Convention = ("camera-to-world", "OpenGL")
CONVENTIONS = (W2C_OPENCV, C2W_OPENCV, W2C_OPENGL, C2W_OPENGL)

COEFFICIENTS = {  # names of the coefficients of each model of lens, in order
    "perspective": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
# If a smaller share of an undistorted photo's pixels lies within the original photo, the coefficients of the lens are
# wrong. No real lens is as strong as k1 = 1 / r^2, where r is half of the image's diagonal, and even for k1 = 1 / r^2 a
# third of the undistorted photo's pixels lies within the original photo
_MIN_INSIDE = 0.25


@dataclass(frozen=True)
class Lens:
    """A lens: perspective with distortion, or fisheye."""

    name: str  # as the camera file calls the model
    model: Literal["perspective", "fisheye"]  # as ``cv2.undistort`` (radial, tangential), or ``cv2.fisheye``
    coefficients: tuple[float, ...]  # values of COEFFICIENTS in their order; values that are left out at the end are 0


def make_lens(name: str, model: Literal["perspective", "fisheye"], coefficients: Sequence[float]) -> Lens | None:
    """Make a lens; None for a pinhole, which is a perspective lens without distortion."""
    return Lens(name, model, tuple(coefficients)) if model == "fisheye" or any(coefficients) else None


@dataclass(frozen=True, eq=False)
class CameraFile:
    """The c cameras of a file, in the order of the file."""

    path: str  # the file or folder
    viewmats: np.ndarray  # ``[c,4,4]`` world to camera, OpenCV axes, float64
    Ks: np.ndarray  # ``[c,3,3]`` intrinsics in pixels, float64; the top-left pixel's centre is (0.5, 0.5)
    widths: np.ndarray  # ``[c]`` int64, pixels; 0 if unknown, 1 if unknown and the intrinsics are relative to it
    heights: np.ndarray  # ``[c]`` int64, as widths
    names: tuple[str, ...]  # names of the images in the file
    source: str  # name of the format
    convention: Convention = W2C_OPENCV  # how the format stores poses
    images: PhotoArrays = ()  # ``[c,h,w,3]`` uint8 sRGB; empty if the file holds no images
    order: str = "auto"  # order of the Gaussians' rows; "auto" if the file does not state it
    lenses: tuple[Lens | None, ...] = ()  # of each camera, None for a pinhole; empty if all are pinholes
    masks: Mapping[str, str] = field(default_factory=dict)  # name of an image -> name of its mask
    counts: np.ndarray | None = None  # ``[c,h,w]`` bool, where images inside the file count; None: everywhere
    depths: np.ndarray | None = None  # depth maps in any unit, ``[c,h,w]`` if they are of these cameras; None: no maps
    has_intrinsics: bool = True  # False: the file has only poses, and `Ks` are placeholders
    # Size of the photos, and the transform from the photos' size to the cameras' size. None before the photos are known
    photo_map: tuple[Size, PhotoTransform] | None = None
    # ``[n]`` the pixel ``(view·H + y)·W + x`` of each Gaussian, -1 for a Gaussian without a pixel. None if the cameras
    # were not estimated from the order of the Gaussians' rows
    pixel_ids: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"CameraFile({len(self)} of {self.path}, {self.source})"


def drop_repeats(file: CameraFile) -> CameraFile:
    """Drop views that have the name, pose and intrinsics of an earlier view.

    If the file has images or pixel ids, all views are kept, since images and pixel ids refer to the numbers of views.
    """
    keys = [
        (name, viewmat.tobytes(), K.tobytes())
        for name, viewmat, K in zip(file.names, file.viewmats, file.Ks, strict=True)
    ]
    first_views = sorted({key: view for view, key in reversed(list(enumerate(keys)))}.values())
    if len(first_views) == len(file) or len(file.images) or file.pixel_ids is not None:
        return file
    return select_views(file, first_views)


class StoredView(NamedTuple):
    """One camera of a file, as the file stores it."""

    name: str  # of its image
    pose: np.ndarray  # 3x4 or 4x4, in the file's convention
    # ``[3,3]`` intrinsics in pixels, or divided by the image's size, or None. All views of a file have K in pixels, or
    # all have K divided by the size, or none has K
    K: np.ndarray | None
    size: tuple[int, int] = (0, 0)  # (width, height), pixels; 0 where unknown
    lens: Lens | None = None  # None for a pinhole
    mask: str = ""  # name of its image's mask; "" without one


def make_pinhole(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Make pinhole intrinsics ``[3,3]`` from focal lengths and principal point, pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


def make_camera_file(
    path: StrPath,
    source: str,
    convention: Convention,
    views: Sequence[StoredView],
    images: PhotoArrays = (),
    order: str = "auto",
) -> CameraFile:
    """Check the views of a file, and convert them to a camera file with OpenCV world-to-camera poses.

    Intrinsics that are small in all views are taken as divided by the image's size, and are converted to pixels.
    ``images [c,h,w,3]`` are images inside the file, and ``order`` is the order of rows that the file states. Raise
    SceneError if there is no camera, a pose is not 3x4 or 4x4, a number is infinite or too large, a rotation is not
    orthonormal, or a focal length is not positive.
    """
    if not views:
        raise SceneError(path, "expected at least one camera, found none")
    check_camera_count(path, len(views))
    lacks_intrinsics = all(view.K is None for view in views)
    if lacks_intrinsics:  # the checks need some intrinsics
        focals = [float(max(view.size)) or 1.0 for view in views]
        views = [view._replace(K=make_pinhole(f, f, 0, 0)) for view, f in zip(views, focals, strict=True)]
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    Ks = np.array([view.K for view in views], np.float64)
    max_coefficient = 1e6  # smaller coefficients are checked by their effect, when photos are undistorted
    for i, view in enumerate(views):
        pose = np.asarray(view.pose, np.float64)
        if pose.shape not in ((3, 4), (4, 4)):
            raise SceneError(path, f"view {view.name}: expected a pose of 3x4 or 4x4 numbers, found {pose.shape}")
        lens = view.lens or Lens("", "perspective", ())
        for name, coefficient in zip(COEFFICIENTS[lens.model], lens.coefficients, strict=False):
            if not abs(coefficient) <= max_coefficient:  # also refuses NaN
                problem = f"expected a lens coefficient {name} within +-{max_coefficient:g}, found {coefficient:g}"
                text = f"view {view.name}: {problem} ({lens.name})"
                raise SceneError(path, text, "correct it, or undistort the images first")
        poses[i, :3] = pose[:3]
        check_camera(path, view.name, poses[i], Ks[i])
    for w, h in (view.size for view in views):
        if not (0 <= w <= _MAX_SIDE and 0 <= h <= _MAX_SIDE):
            raise SceneError(path, f"expected a positive image size, found {w:.6g} x {h:.6g}")
    sizes = [view.size for view in views]
    is_relative = (Ks[:, 0, 0] < MAX_NORMALISED_FOCAL) & (Ks[:, 1, 1] < MAX_NORMALISED_FOCAL)
    is_relative &= (np.abs(Ks[:, :2, 2] - 0.5) < 1).all(1)
    # If an image has only a few pixels, small focal lengths may be in pixels, too
    if is_relative.all() and not any(0 < min(size) <= MAX_NORMALISED_FOCAL for size in sizes):
        sizes = [size if min(size) > 0 else (1, 1) for size in sizes]  # an unknown size becomes 1 x 1
        Ks = Ks * np.array([(w, h, 1) for w, h in sizes], np.float64)[:, :, None]
    for view, K, size in zip(views, Ks, sizes, strict=True):
        check_size(path, view.name, K, size)
    lenses = tuple(view.lens for view in views)
    return CameraFile(
        path=str(path),
        viewmats=to_viewmats(poses, convention),
        Ks=Ks,
        widths=np.array([w for w, _ in sizes], np.int64),
        heights=np.array([h for _, h in sizes], np.int64),
        names=tuple(view.name for view in views),
        source=source,
        convention=convention,
        images=images,
        order=order,
        lenses=lenses if any(lenses) else (),
        masks={view.name: view.mask for view in views if view.mask},
        has_intrinsics=not lacks_intrinsics,
    )


def check_camera_count(path: StrPath, count: int) -> None:
    """Raise SceneError if a file has too many cameras. Readers call this before they allocate memory for cameras."""
    if count > MAX_VIEWS:
        raise SceneError(path, f"expected at most {MAX_VIEWS} cameras, found more")


def missing_intrinsics(path: StrPath) -> SceneError:
    """Make the SceneError for cameras without a focal length."""
    problem = "expected intrinsics of the cameras (fx, fy, cx, cy), found none"
    return SceneError(path, problem, "add them in pixels, for all views or for each")


def check_camera(path: StrPath, name: str, pose: np.ndarray, K: np.ndarray) -> None:
    """Raise SceneError if the pose ``[4,4]`` or the intrinsics ``[3,3]`` of a view are impossible."""
    if not (np.isfinite(pose).all() and np.isfinite(K).all()):
        raise SceneError(path, f"view {name}: expected finite numbers, found NaN or inf")
    largest = max(np.abs(pose).max(), np.abs(K).max())
    if largest > MAX_NUMBER:
        raise SceneError(path, f"view {name}: expected numbers up to {MAX_NUMBER:g}, found {largest:g}")
    rotation = pose[:3, :3]
    if not is_orthonormal(rotation):
        raise SceneError(path, f"view {name}: expected a rotation matrix, found one whose axes are not orthonormal")
    if determinant(rotation) < 0:
        problem = f"view {name}: expected a rotation, found a mirrored (left-handed) one"
        raise SceneError(path, problem, "negate one axis")
    if K[0, 0] < _MIN_FOCAL or K[1, 1] < _MIN_FOCAL:
        raise SceneError(path, f"view {name}: expected positive focal lengths, found {K[0, 0]:g} and {K[1, 1]:g}")
    if np.abs(K[2] - (0, 0, 1)).max() > 1e-3 or abs(K[1, 0]) > 1e-3 * K[0, 0]:
        raise SceneError(path, f"view {name}: expected intrinsics whose last row is 0 0 1, found others")


def is_orthonormal(axes: np.ndarray) -> bool:
    """Return whether axes ``[3,3]`` are orthonormal up to rounding, mirrored or not."""
    max_rotation_error = 0.02  # largest error of an entry of R R^T
    return bool(np.abs(matmul(axes, axes.T) - np.eye(3)).max() <= max_rotation_error)


def check_size(path: StrPath, name: str, K: np.ndarray, size: tuple[int, int]) -> None:
    """Raise SceneError if intrinsics ``[3,3]`` in pixels do not fit an image of (width, height)."""
    if min(size) <= 1:  # the size is not known
        return
    # Largest focal length and principal point, as multiples of the longer side of the image
    max_focal_sides = 1e5
    max_centre_sides = 1e3
    for quantity, pixels, max_sides in (
        ("a focal length", max(K[0, 0], K[1, 1]), max_focal_sides),
        ("a principal point", np.abs(K[:2, 2]).max(), max_centre_sides),
    ):
        if pixels > max_sides * max(size):
            problem = f"expected {quantity} that fits an image of {size[0]} x {size[1]}, found {pixels:g} pixels"
            raise SceneError(path, f"view {name}: {problem}", "give fx, fy, cx, cy in pixels of that size")


def to_viewmats(poses: np.ndarray, convention: Convention) -> np.ndarray:
    """Convert poses ``[c,4,4]`` of a convention to world-to-camera matrices with OpenCV axes."""
    direction, axes = convention
    if direction == "camera-to-world":
        poses = invert(poses)
    return matmul(FLIP, poses) if axes == "OpenGL" else poses


def from_viewmats(viewmats: np.ndarray, convention: Convention) -> np.ndarray:
    """Invert :func:`to_viewmats`: return poses in the convention of a file."""
    direction, axes = convention
    poses = matmul(FLIP, viewmats) if axes == "OpenGL" else viewmats
    return invert(poses) if direction == "camera-to-world" else poses


def with_convention(camera_file: CameraFile, convention: Convention) -> CameraFile:
    """Return the cameras that the file would have if its poses were stored in ``convention``."""
    stored = from_viewmats(camera_file.viewmats, camera_file.convention)
    return replace(camera_file, viewmats=to_viewmats(stored, convention), convention=convention)


def select_views(cameras: CameraFile, view_ids: Sequence[int]) -> CameraFile:
    """Return the cameras of some views, in the order of ``view_ids``."""
    ids = list(view_ids)
    lenses = tuple(cameras.lenses[i] for i in ids) if cameras.lenses else ()
    arrays = {name: getattr(cameras, name)[ids] for name in ("viewmats", "Ks", "widths", "heights")}
    for name in ("counts", "depths"):
        values = getattr(cameras, name)
        if values is not None and values.shape[:1] == (len(cameras),):  # another number of maps is not of these views
            arrays[name] = values[ids]
    images = cameras.images[ids] if isinstance(cameras.images, np.ndarray) else cameras.images
    names = tuple(cameras.names[i] for i in ids)
    return replace(cameras, **arrays, names=names, images=images, lenses=lenses if any(lenses) else ())


def _stored_sizes(camera_file: CameraFile) -> list[tuple[int, int]]:
    """List the different (width, height) of a file's cameras, with (0, 0) or (1, 1) for unknown sizes."""
    return sorted(set(zip(camera_file.widths.tolist(), camera_file.heights.tolist(), strict=True)))


def sizes_of(camera_file: CameraFile) -> list[tuple[int, int]]:
    """List the different (width, height) of a file's cameras, without unknown sizes."""
    return [(w, h) for w, h in _stored_sizes(camera_file) if min(w, h) > 0 and (w, h) != (1, 1)]


@check_arguments
def to_cameras(camera_file: CameraFile, size: tuple[int, int] | None = None) -> Cameras:
    """Convert to cameras of one image ``size`` (width, height) in pixels, by default the size in the file.

    Intrinsics for another size than ``size`` are scaled, each axis by itself. Raise SceneError if a lens is no pinhole,
    or if no ``size`` is given and the file has no size or several sizes.

    Example:
        >>> gsmerge.to_cameras(gsmerge.read_cameras("demo/transforms.json")).Ks.shape
        (5, 3, 3)
    """
    path = camera_file.path
    if not camera_file.has_intrinsics:
        raise missing_intrinsics(path)
    for name, lens in zip(camera_file.names, camera_file.lenses, strict=False):
        if lens is not None:
            problem = f"view {name}: expected a pinhole camera, found {lens.name} with lens distortion"
            raise SceneError(path, problem, "undistort the images first")
    if size is None:
        stored = _stored_sizes(camera_file)
        if len(stored) > 1:
            sizes = " and ".join(f"{w} x {h}" for w, h in stored[:2])
            raise SceneError(path, f"expected cameras of one image size, found {sizes}")
        size = stored[0]
        if 0 in size or size == (1, 1):
            remedy = "add it, or give one photo for each camera, with its name or in the same order"
            raise SceneError(path, "expected the image size (w, h) of the cameras, found none", remedy)
    check_image_size(path, *size)
    sides = np.stack([camera_file.widths, camera_file.heights], 1)
    has_size = (sides > 0).all(1, keepdims=True)
    Ks = camera_file.Ks.copy()
    Ks[:, :2] *= np.where(has_size, size / np.maximum(sides, 1), 1.0)[:, :, None]
    return Cameras(camera_file.viewmats, Ks, *size)


def as_pinholes(camera_file: CameraFile, photos: PhotoArrays) -> tuple[CameraFile, PhotoArrays, list[str]]:
    """Undistort photos, and replace their cameras by pinholes with the same intrinsics; also return notes.

    Raise SceneError if a lens has distortion and there are no photos, or photos of another aspect ratio. Also raise
    SceneError if most of an undistorted photo would lie outside of the original photo.
    """
    if not camera_file.lenses:
        return camera_file, photos, []
    pinholes = replace(camera_file, lenses=())
    name = next(lens.name for lens in camera_file.lenses if lens is not None)
    size = photo_size(photos)
    if size is None:
        problem = f"expected a pinhole camera, or images to undistort, found {name} with lens distortion and no images"
        raise SceneError(camera_file.path, problem, "name the images with --images, or undistort them first")
    for w, h in sizes_of(camera_file):
        if not same_shape((w, h), size):
            problem = f"expected images of the cameras' {w} x {h} to undistort ({name}), found {size[0]} x {size[1]}"
            raise SceneError(camera_file.path, problem, "give the images as they were taken, or undistort them first")
    Ks = to_cameras(pinholes, size).Ks
    for view, K, lens in zip(camera_file.names, Ks, camera_file.lenses, strict=True):
        if lens is None:
            continue
        # The share of an undistorted photo's pixels that lie within the original photo is counted on a coarse grid
        grid = 32  # pixels of each side of the grid
        maps = _rectify_maps(K * np.array([grid / size[0], grid / size[1], 1.0])[:, None], lens, (grid, grid))
        share = float(np.all([(positions >= -0.5) & (positions <= grid - 0.5) for positions in maps], 0).mean())
        if share < _MIN_INSIDE:
            coefficients = zip(COEFFICIENTS[lens.model], lens.coefficients, strict=False)
            nonzero = ", ".join(f"{key} = {coefficient:g}" for key, coefficient in coefficients if coefficient)
            problem = f"view {view}: expected {lens.name} coefficients of a lens, found {nonzero}, with which"
            problem += f" {100 * (1 - share):.0f} % of the undistorted photo would lie outside of the photo"
            raise SceneError(camera_file.path, problem, "correct them, or undistort the images first")
    undistorted = undistort_photos(photos, Ks, camera_file.lenses)
    return pinholes, undistorted, [f"the photos are undistorted ({name}); the intrinsics stay"]


def undistort_photos(photos: PhotoArrays, Ks: np.ndarray, lenses: Sequence[Lens | None]) -> PhotoArrays:
    """Undistort photos: return the photos that pinholes with the same intrinsics would take.

    Pixels that lie outside of the original photo repeat the nearest pixels of its border. ``Ks [c,3,3]`` are for the
    size of the ``photos``, uint8 ``[h,w,3]``, with the top-left pixel's centre at (0.5, 0.5).
    """

    def undistort(view: int, photo: np.ndarray) -> np.ndarray:
        """Undistort the photo of one view."""
        lens = lenses[view]
        if lens is None:
            return photo
        maps = _rectify_maps(Ks[view], lens, (photo.shape[1], photo.shape[0]))
        return cv2.remap(photo, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    return change_photos(photos, undistort)


def _rectify_maps(K: np.ndarray, lens: Lens, size: Size) -> tuple[np.ndarray, np.ndarray]:
    """Return where each pixel of a pinhole image lies in the image of the lens: x and y, each ``[h,w]`` float32."""
    centred = K.astype(np.float64).copy()
    centred[:2, 2] -= 0.5  # OpenCV has the top-left pixel's centre at (0, 0)
    coefficients = np.pad(lens.coefficients, (0, len(COEFFICIENTS[lens.model]) - len(lens.coefficients)))
    make_maps = cv2.fisheye.initUndistortRectifyMap if lens.model == "fisheye" else cv2.initUndistortRectifyMap
    x, y = make_maps(centred, coefficients.astype(np.float64), np.eye(3), centred, size, cv2.CV_32FC1)
    return x, y


def list_moves(names: Sequence[str], start: np.ndarray, end: np.ndarray, depth: float) -> list[dict[str, Any]]:
    """List for each view its name, its rotation in degrees, and its shift as a share of ``depth``.

    ``start`` and ``end`` are viewmats ``[v,4,4]`` before and after the moves. ``depth`` is the scene's depth in the
    unit of the viewmats.
    """
    degrees, distances = pose_changes(start, end)
    shifts = distances / depth if depth > 0 else distances
    return [
        {"view": name, "degrees": round(angle, 4), "shift": round(shift, 6)}
        for name, angle, shift in zip(names, degrees.tolist(), shifts.tolist(), strict=True)
    ]


def describe_moves(moves: Sequence[dict[str, Any]]) -> str:
    """Describe in words the mean and the largest rotation and shift of ``moves`` from :func:`list_moves`."""
    angles = [move["degrees"] for move in moves]
    shifts = [move["shift"] for move in moves]
    mean = f"{np.mean(angles):.2g} degrees and {100 * np.mean(shifts):.3g} % of the depth"
    largest = f"{max(angles):.2g} degrees and {100 * max(shifts):.3g} % of the depth"
    return f"{mean} on average, {largest} at most"


def make_similarity(path: Path, matrix: np.ndarray, scale: float) -> Similarity:
    """Make the similarity X' = scale (matrix [X; 1]) of a matrix ``[3,4]``; raise SceneError for other maps."""
    R = matrix[:3, :3]
    is_similarity = is_orthonormal(R) and determinant(R) >= 0 and 0 < scale < MAX_NUMBER
    if not is_similarity or not np.all(np.abs(matrix) < MAX_NUMBER):
        raise SceneError(path, "expected 'transform' to rotate and shift and 'scale' to be positive, found another map")
    return Similarity(R, scale, scale * matrix[:3, 3], f"moved into the Gaussians' frame by {path.name}")
