"""Check the conventions of arrays and tensors in memory, and compact the scene that they describe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmerge.arrays import Array, as_array, to_float32
from gsmerge.errors import SceneError, count_words
from gsmerge.io.bounds import check_image_size
from gsmerge.io.cameras.camera_file import (
    C2W_OPENCV,
    C2W_OPENGL,
    MAX_NORMALISED_FOCAL,
    W2C_OPENCV,
    W2C_OPENGL,
    Convention,
    check_size,
)
from gsmerge.io.formats.read_gaussians import clear_invalid, clear_rows, find_empty
from gsmerge.io.photo_files import photo_array
from gsmerge.method.geometry.transforms import normalize, rgb_to_sh0
from gsmerge.reading.alignment import (
    check_pairs,
    choose_poses,
    explain_misalignment,
    misalignment_error,
    move_cameras,
    other_conventions,
    sample_pixels,
)
from gsmerge.reading.input import TOLERANCE, check_numbers, check_poses, check_values
from gsmerge.results.result import CompactResult
from gsmerge.run import compact
from gsmerge.runtime.record import Progress
from gsmerge.types import NO_CAMERAS, Cameras, Gaussians, Pixels, Scene

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from gsmerge.settings.keywords import CompactSettings

TENSOR_ORDERS = ("view-major", "none")
_REMEDIES = {
    C2W_OPENCV: "pass their inverse, torch.linalg.inv(viewmats)",
    W2C_OPENGL: "negate the second and the third row of each",
    C2W_OPENGL: "negate the second and the third column of each, and pass the inverse",
}


def compact_tensors(
    *,
    means: Array,
    quats: Array,
    scales: Array,
    opacities: Array,
    sh0: Array | None = None,
    colors: Array | None = None,
    shN: Array | None = None,
    images: Array | None = None,
    viewmats: Array | None = None,
    Ks: Array | None = None,
    shape: tuple[int, int, int] | None = None,
    names: Sequence[str] | None = None,
    order: str = "view-major",
    progress: Progress | None = None,
    **settings: Unpack[CompactSettings],
) -> CompactResult:
    """Compact Gaussians given as arrays or tensors, as :func:`gsmerge.compact` compacts a scene.

    Arrays are NumPy's, or dense tensors of torch on any device, of any real numbers in any layout; they are copied
    without gradients. Leading axes are flattened, so ``[1,n,3]`` and ``[V,H,W,3]`` mean ``[n,3]``. Rows with NaN or
    infinities are left out.

    Args:
        means: ``[n,3]`` centres, world units; row ``(v·H + y)·W + x`` belongs to pixel (x, y) of view v.
        quats: ``[n,4]`` unit quaternions wxyz that rotate local to world.
        scales: ``[n,3]`` standard deviations, world units, linear.
        opacities: ``[n]`` in [0, 1].
        sh0: ``[n,1,3]`` or ``[n,3]`` harmonics of degree 0; rgb = 0.5 + 0.2821 sh0.
        colors: ``[n,3]`` sRGB in [0, 1], in place of ``sh0``.
        shN: ``[n,k-1,3]`` higher harmonics, basis-major; None: none.
        images: ``[V,H,W,3]`` photos, sRGB in [0, 1]; None: the colours of the pixels' Gaussians replace the photos or,
            with ``order="none"``, renders of the scene do.
        viewmats: ``[V,4,4]`` or ``[V,3,4]`` world to camera, OpenCV axes.
        Ks: ``[V,3,3]`` intrinsics in pixels; the top-left pixel's centre is (0.5, 0.5).
        shape: Views, height and width; None: as in ``images``.
        names: Names of the views; None: the views are numbered.
        order: ``"view-major"``: one Gaussian per pixel, view after view; ``"none"``: Gaussians without pixels (trained
            scenes, voxels); Gaussians without pixels need no cameras.
        progress: See :func:`gsmerge.compact`.
        **settings: Settings of :func:`gsmerge.compact`, such as ``budget="4%"``, ``k=2``.

    Returns:
        The result of :func:`gsmerge.compact`, with the precision of ``means``. If ``means`` is a tensor, the result has
        tensors on the same device.

    Raises:
        SceneError: If an array has another shape or convention; the message says what to pass instead.
        ValueError: If a setting is unknown or out of range.

    Example:
        >>> scene = gsmerge.read_scene("demo")
        >>> columns = vars(scene.gaussians)  # means, quats, scales, opacities, sh0, shN
        >>> views = {"viewmats": scene.cameras.viewmats, "Ks": scene.cameras.Ks, "images": scene.images}
        >>> len(gsmerge.compact_tensors(**columns, **views, effort="draft", budget=300).gaussians)
        300
    """
    if order not in TENSOR_ORDERS:
        raise ValueError(f"order: expected one of {', '.join(TENSOR_ORDERS)}, got {order!r}")
    columns = {
        "means": _copy_rows("means", means, 3),
        "quats": _copy_rows("quats", quats, 4),
        "scales": _copy_rows("scales", scales, 3),
        "opacities": _copy_rows("opacities", opacities),
    }
    if (sh0 is None) == (colors is None):
        found = "neither" if sh0 is None else "both"
        raise SceneError("sh0", f"expected either sh0 or colors, found {found}")
    if sh0 is not None:
        columns["sh0"] = _copy_rows("sh0", sh0, 3).reshape(-1, 1, 3)
    else:
        rgb = _copy_rows("colors", colors, 3)
        slack = 1.0  # colours of Gaussians may lie outside [0, 1], but hardly by more than this
        _expect_unit_range("colors", rgb[np.isfinite(rgb)], slack)
        columns["sh0"] = rgb_to_sh0(rgb)[:, None]
    columns["shN"] = _copy_harmonics(shN, len(columns["means"]))
    gaussians, valid, notes = _check_gaussians(columns)
    cameras = NO_CAMERAS
    photos = None
    if order != "none" or viewmats is not None or images is not None:
        cameras, photos = _check_cameras_and_images(viewmats, Ks, images, shape)
    scene, scene_notes = _combine(gaussians, valid, cameras=cameras, images=photos, names=names, order=order)
    rotations = scene.gaussians.quats
    # Quaternions that are computed from matrices rarely have a negative w. The note may be wrong for Depth Anything 3,
    # where the last column is z and is never negative
    if rotations[:, 3].min(initial=0) >= 0 > rotations[:, 0].min(initial=0):
        scene_notes.append("the last column of quats is never negative: if w comes last, pass quats[:, [3, 0, 1, 2]]")
    result = compact(scene, progress=progress, **settings)
    result.report.notes[:0] = notes + scene_notes
    if gaussians.means.dtype == np.float32:
        result = result.to_single()
    return result.to(means.device if hasattr(means, "detach") else None)


def _combine(
    gaussians: Gaussians,
    valid: np.ndarray,
    cameras: Cameras,
    images: np.ndarray | None,
    names: Sequence[str] | None,
    order: str,
) -> tuple[Scene, list[str]]:
    """Check that Gaussians and views fit each other, and return their scene, with notes.

    ``valid`` is a mask ``[n]`` of the Gaussians that the scene gets. ``order`` says whether each Gaussian belongs to a
    pixel.
    """
    if names is None or len(cameras) == 0:
        names = [f"view{view}" for view in range(len(cameras))]
    views = tuple(map(str, names))
    if len(views) != len(cameras):
        raise SceneError("names", f"expected {len(cameras)} names, one for each view, found {len(views)}")
    if order == "none":
        notes: list[str] = []
        if len(cameras) > 0:
            poses, check, note = choose_poses(gaussians, valid, cameras, photo_array(images), W2C_OPENCV)
            if poses is not None:  # the poses see the Gaussians only in another convention
                raise _convention_error(poses.convention, poses.description, check.description)
            notes = [text for text in (note, None if check.ok else check.description) if text]
        return Scene(gaussians[valid], cameras, images, None, views), notes
    count = len(cameras) * cameras.height * cameras.width
    if len(gaussians) != count:
        sizes = f"{len(cameras)} x {cameras.height} x {cameras.width} = {count}"
        problem = f"expected one Gaussian per pixel, {sizes} (views x height x width), found {len(gaussians)}"
        raise SceneError("means", problem, 'pass shape=(V, H, W) as the model has it, or order="none"')
    cameras, notes = _check_pixels(gaussians, cameras, valid, views)
    has_gaussian = valid.reshape(len(cameras), cameras.height, cameras.width)
    gaussians = gaussians if valid.all() else gaussians[valid]
    return Scene(gaussians, cameras, images, Pixels.of_grid(has_gaussian), views), notes


def _to_numpy(name: str, values: Any) -> np.ndarray:
    """Return the argument ``name``, an array or tensor, as a NumPy array; SceneError if ``values`` holds no numbers."""
    check_numbers(name, values)
    return as_array(values)


def _copy_rows(name: str, values: Any, *row_shape: int) -> np.ndarray:
    """Return a float32 copy ``[n,*row_shape]`` of values ``[...,*row_shape]``; means may stay float64."""
    array = _to_numpy(name, values)
    if array.ndim < len(row_shape) or array.shape[array.ndim - len(row_shape) :] != row_shape:
        expected = ", ".join(map(str, ("n", *row_shape)))
        raise SceneError(name, f"expected shape [{expected}], found {list(array.shape)}")
    array = array.reshape(-1, *row_shape)
    return array.copy() if name == "means" and array.dtype == np.float64 else to_float32(array)


def _check_gaussians(columns: dict[str, np.ndarray]) -> tuple[Gaussians, np.ndarray, list[str]]:
    """Check columns, and make Gaussians of them; SceneError if the values have another convention.

    The columns are changed in place: rows with NaN or infinities become transparent, opacities are cut to [0, 1], and
    quaternions get the length 1. Returns the Gaussians, a mask ``[n]`` of the rows that are finite and not empty, and
    notes.
    """
    n = len(columns["means"])
    for name, column in columns.items():
        if len(column) != n:
            remedy = "pass sh0=sh[:, :1] and shN=sh[:, 1:]" if name == "sh0" and len(column) % max(n, 1) == 0 else ""
            raise SceneError(name, f"expected {n} rows, one for each mean, found {len(column)}", remedy)
    if n == 0:
        raise SceneError("means", "expected at least one Gaussian, found none")
    valid = np.ones(n, np.bool_)
    for column in columns.values():
        valid &= np.isfinite(column.reshape(n, -1)).all(1)
    columns_and_mask = columns | {"valid": valid}
    num_bad = clear_invalid("means", columns_and_mask)
    check_values(columns)
    quats = columns["quats"]
    opacities = columns["opacities"]
    lengths = np.linalg.norm(quats[valid], axis=1)
    # If many lengths differ from 1, the quats may have another meaning
    # at most this share of the lengths may differ from 1 by more than this
    max_difference = 0.01
    max_share = 0.01
    share = float((np.abs(lengths - 1) > max_difference).mean())
    if share > max_share:
        sizes = f"{100 * share:.3g} % with lengths of {lengths.min():.3g} to {lengths.max():.3g}"
        remedy = "pass torch.nn.functional.normalize(quats, dim=-1)"
        raise SceneError("quats", f"expected unit quaternions wxyz, found {sizes}", remedy)
    np.clip(opacities, 0, 1, out=opacities)
    small_difference = 1e-5  # a quaternion is normalised if its length differs from 1 by more
    rows = np.flatnonzero(np.abs(np.linalg.norm(quats, axis=1) - 1) > small_difference)
    quats[rows] = normalize(quats[rows])
    quats[(quats == 0).all(1)] = (1, 0, 0, 0)
    notes = [count_words(num_bad, "row", "with NaN or inf, set aside")] if num_bad else []
    empty = find_empty("means", columns_and_mask)
    clear_rows(columns_and_mask, empty)  # these rows are no longer valid
    notes += [count_words(len(empty), "empty row", "at the origin, set aside")] if len(empty) else []
    return Gaussians(**columns), valid, notes


def _copy_harmonics(shN: Array | None, n: int) -> np.ndarray:
    """Return a copy of ``shN [n,k-1,3]``, with k = 1 if there are no higher harmonics; SceneError for other shapes."""
    shape = (0, 3) if shN is None else _to_numpy("shN", shN).shape
    if shape[-2:] == (0, 3):
        return np.zeros((n, 0, 3), np.float32)
    counts = (3, 8, 15, 24)
    if len(shape) < 3 or shape[-1] != 3 or shape[-2] not in counts:
        swapped = len(shape) >= 3 and shape[-2] == 3 and shape[-1] in counts
        problem = f"expected shape [n, k-1, 3] with 3, 8, 15 or 24 coefficients, found {list(shape)}"
        raise SceneError("shN", problem, "pass shN.transpose(-1, -2): each coefficient's colours last" * swapped)
    return _copy_rows("shN", shN, shape[-2], 3)


def _expect_unit_range(name: str, values: np.ndarray, slack: float) -> None:
    """Raise SceneError for colours that are more than ``slack`` outside [0, 1].

    If the colours look like 0 to 255 or -1 to 1, the error says how to convert them.
    """
    low = float(values.min(initial=0))
    high = float(values.max(initial=0))
    if -slack <= low and high <= 1 + slack:
        return
    remedy = ""
    if low >= 0 and high <= 255 + slack:
        remedy = f"they look like 0 to 255: pass {name} / 255"
    elif low >= -1 - slack and high <= 1 + slack:
        remedy = f"they look like -1 to 1: pass ({name} + 1) / 2"
    raise SceneError(name, f"expected sRGB in [0, 1], found {low:.3g} to {high:.3g}", remedy)


def _check_cameras_and_images(
    viewmats: Array | None, Ks: Array | None, images: Array | None, shape: Sequence[int] | None
) -> tuple[Cameras, np.ndarray | None]:
    """Check cameras and images, and return them as cameras and ``[v,h,w,3]``; SceneError for wrong shapes or values."""
    if viewmats is None or Ks is None:
        raise SceneError("viewmats" if viewmats is None else "Ks", "expected one matrix for each view, found none")
    photos = None if images is None else _to_numpy("images", images)
    if shape is not None:
        if len(shape) != 3:
            raise SceneError("shape", f"expected views, height and width, found {list(shape)}")
        views, height, width = (int(side) for side in shape)
    elif photos is None:
        raise SceneError("shape", "expected the number of views, their height and width, found neither it nor images")
    else:
        if photos.ndim < 4 or photos.shape[-1] != 3:
            raise _image_error(photos, "[V, H, W, 3]")
        views, height, width = photos.shape[-4:-1]
    check_image_size("shape", width, height)
    matrices = _to_matrices("viewmats", viewmats, ((3, 4), (4, 4)), views)
    intrinsics = _to_matrices("Ks", Ks, ((3, 3),), views)
    poses = np.tile(np.eye(4), (views, 1, 1))
    poses[:, : matrices.shape[1]] = matrices
    check_poses(poses, intrinsics)
    for view, K in enumerate(intrinsics):
        if max(K[0, 0], K[1, 1]) < MAX_NORMALISED_FOCAL <= min(width, height):
            problem = f"view {view}: expected intrinsics in pixels, found a focal length of {K[0, 0]:.3g}"
            raise SceneError("Ks", problem, "they look divided by the image's size: multiply the rows by W, H and 1")
        check_size("Ks", str(view), K, (width, height))
    cameras = Cameras(poses, intrinsics, width, height)
    if photos is None:
        return cameras, None
    expected = (views, height, width, 3)
    if photos.shape[-4:] != expected or photos.size != np.prod(expected):
        raise _image_error(photos, str(list(expected)))
    if not np.isfinite(photos).all():
        raise SceneError("images", "expected finite numbers, found NaN or inf")
    _expect_unit_range("images", photos, TOLERANCE)
    return cameras, to_float32(photos.reshape(expected)).clip(0, 1)


def _to_matrices(name: str, values: Any, shapes: Sequence[tuple[int, int]], views: int) -> np.ndarray:
    """Return a float64 matrix of the argument ``name`` for each view.

    SceneError if number or shape of the matrices is wrong.
    ``views`` is the number of views, and ``shapes`` are the shapes that a matrix may have.
    """
    array = _to_numpy(name, values).astype(np.float64, order="C")
    if array.shape[-2:] not in shapes or array.size != views * array.shape[-2] * array.shape[-1]:
        expected = " or ".join(str([views, *shape]) for shape in shapes)
        raise SceneError(name, f"expected shape {expected}, found {list(array.shape)}")
    return array.reshape(views, *array.shape[-2:])


def _image_error(photos: np.ndarray, expected: str) -> SceneError:
    """Return the error for images of a wrong shape, with a remedy."""
    is_turned = photos.ndim >= 4 and photos.shape[-3] == 3 != photos.shape[-1]
    remedy = "channels come first: pass images.permute(0, 2, 3, 1)" if is_turned else "resize them to the model's input"
    return SceneError("images", f"expected shape {expected}, found {list(photos.shape)}", remedy)


def _check_pixels(
    gaussians: Gaussians, cameras: Cameras, valid: np.ndarray, names: tuple[str, ...]
) -> tuple[Cameras, list[str]]:
    """Check that Gaussians project into their pixels; return the cameras, which may be moved slightly, and notes.

    Raises SceneError if Gaussians do not project into their pixels. If the cameras look like those of another
    convention or another image size, the error says so.
    """
    pairs = sample_pixels(gaussians, cameras, valid)
    alignment = check_pairs(pairs, cameras)
    if alignment.ok:
        return cameras, []
    for poses in other_conventions(cameras.viewmats, W2C_OPENCV):
        if check_pairs(pairs, replace(cameras, viewmats=poses.viewmats)).ok:
            raise _convention_error(poses.convention, poses.description, "the means project into their own pixels")
    factors = np.array([cameras.width, cameras.height]) / np.maximum(2 * cameras.Ks[0, :2, 2], 1e-6)
    scaled = cameras.Ks * np.array([*factors, 1])[:, None]
    if check_pairs(pairs, replace(cameras, Ks=scaled)).ok:
        problem = f"expected intrinsics of {cameras.width} x {cameras.height} pixels, found those of another size"
        remedy = f"multiply their first row by {factors[0]:.6g} and the second by {factors[1]:.6g}"
        raise SceneError("Ks", problem, remedy)
    reason = explain_misalignment(gaussians, cameras, valid)
    moved = None if reason else move_cameras(pairs, cameras, names)
    if moved is not None:
        return moved.cameras, [moved.note]
    raise misalignment_error("means", alignment, reason)


def _convention_error(convention: Convention, description: str, fact: str) -> SceneError:
    """Return the error for view matrices of another convention, with its ``description``, a ``fact`` and a remedy."""
    problem = f"expected world-to-camera matrices with OpenCV axes, found that {fact} when the matrices are read as"
    return SceneError("viewmats", f"{problem} {description}", _REMEDIES[convention])
