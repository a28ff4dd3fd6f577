"""Compact arrays and tensors in memory, after their conventions were checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gsmerge.cameras import (
    check_pairs,
    choose_poses,
    explain_misalignment,
    misalignment_error,
    move_cameras,
    other_conventions,
    sample_pixels,
)
from gsmerge.compaction.compact import compact
from gsmerge.compaction.result import CompactResult
from gsmerge.errors import SceneError
from gsmerge.geometry.transforms import normalize, rgb_to_sh0
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
from gsmerge.io.formats.read import clear_invalid, clear_rows, find_empty
from gsmerge.io.photo_files import photo_array
from gsmerge.runtime.record import Progress
from gsmerge.scene.input import TOLERANCE, check_numbers, check_poses, check_values
from gsmerge.types import NO_CAMERAS, Cameras, Gaussians, Pixels, Scene
from gsmerge.values.arrays import Array, as_array, to_float32
from gsmerge.values.words import count_words

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
    **settings: Any,
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
        images: ``[V,H,W,3]`` photos, sRGB in [0, 1]; None: the colours of the pixels' Gaussians stand in for them, or
            renders of the scene with ``order="none"``.
        viewmats: ``[V,4,4]`` or ``[V,3,4]`` world to camera, OpenCV axes.
        Ks: ``[V,3,3]`` intrinsics in pixels; the top-left pixel's centre is (0.5, 0.5).
        shape: Views, height and width; None: those of the images.
        names: Names of the views; None: numbers.
        order: ``"view-major"``: one Gaussian per pixel, as above; ``"none"``: Gaussians without pixels
            (trained scenes, voxels); cameras are then optional.
        progress: See :func:`gsmerge.compact`.
        **settings: Settings of :func:`gsmerge.compact`, such as ``budget="4%"``, ``k=2``.

    Returns:
        The result of :func:`gsmerge.compact`, with the precision of ``means``; of tensors on its device if ``means`` is
        a tensor.

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
        "means": _rows("means", means, 3),
        "quats": _rows("quats", quats, 4),
        "scales": _rows("scales", scales, 3),
        "opacities": _rows("opacities", opacities),
        "sh0": _read_base(sh0, colors),
    }
    columns["shN"] = _read_harmonics(shN, len(columns["means"]))
    gaussians, valid, notes = make_gaussians(columns)
    cameras, photos = NO_CAMERAS, None
    if order != "none" or viewmats is not None or images is not None:
        cameras, photos = _read_views(viewmats, Ks, images, shape)
    scene, scene_notes = make_scene(gaussians, valid, cameras, photos, names, order)
    scene_notes += _rotation_notes(scene.gaussians.quats)
    result = compact(scene, progress=progress, **settings)
    result.report.notes[:0] = notes + scene_notes
    if gaussians.means.dtype == np.float32:
        result = result.to_single()
    return result.to(means.device if hasattr(means, "detach") else None)


def make_scene(
    gaussians: Gaussians,
    valid: np.ndarray,
    cameras: Cameras,
    images: np.ndarray | None,
    names: Sequence[str] | None,
    order: str,
) -> tuple[Scene, list[str]]:
    """Combine Gaussians and views into a scene in the given order; return the scene and notes."""
    if names is None or len(cameras) == 0:
        names = [f"view{view}" for view in range(len(cameras))]
    views = tuple(map(str, names))
    if len(views) != len(cameras):
        raise SceneError("names", f"expected {len(cameras)} names, one for each view, found {len(views)}")
    if order == "none":
        notes = _check_seen(gaussians, valid, cameras, images) if len(cameras) else []
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
    """Return an array or tensor as a NumPy array; raise SceneError if it holds no numbers."""
    check_numbers(name, values)
    return as_array(values)


def _rows(name: str, values: Any, *tail: int) -> np.ndarray:
    """Copy values ``[...,*tail]`` to ``[n,*tail]`` float32; means may be float64."""
    array = _to_numpy(name, values)
    if array.ndim < len(tail) or array.shape[array.ndim - len(tail) :] != tail:
        expected = ", ".join(map(str, ("n", *tail)))
        raise SceneError(name, f"expected shape [{expected}], found {list(array.shape)}")
    array = array.reshape(-1, *tail)
    return array.copy() if name == "means" and array.dtype == np.float64 else to_float32(array)


def make_gaussians(out: dict[str, np.ndarray]) -> tuple[Gaussians, np.ndarray, list[str]]:
    """Make Gaussians from columns, which are changed in place; rows with NaN or infinities become transparent.

    Returns the Gaussians, a mask ``[n]`` of valid rows, which are finite and not empty, and notes.
    """
    n = len(out["means"])
    for name, column in out.items():
        if len(column) != n:
            remedy = "pass sh0=sh[:, :1] and shN=sh[:, 1:]" if name == "sh0" and len(column) % max(n, 1) == 0 else ""
            raise SceneError(name, f"expected {n} rows, one for each mean, found {len(column)}", remedy)
    if n == 0:
        raise SceneError("means", "expected at least one Gaussian, found none")
    valid = np.ones(n, np.bool_)
    for column in out.values():
        valid &= np.isfinite(column.reshape(n, -1)).all(1)
    num_bad = clear_invalid("means", out | {"valid": valid})
    check_values(out)
    _check_lengths(out["quats"][valid])
    np.clip(out["opacities"], 0, 1, out=out["opacities"])
    min_difference = 1e-5  # of a quaternion's length from 1, from which on it is normalised
    off = np.flatnonzero(np.abs(np.linalg.norm(out["quats"], axis=1) - 1) > min_difference)
    out["quats"][off] = normalize(out["quats"][off])
    out["quats"][(out["quats"] == 0).all(1)] = (1, 0, 0, 0)
    notes = [count_words(num_bad, "row", "with NaN or inf, set aside")] if num_bad else []
    empty = find_empty("means", out | {"valid": valid})
    clear_rows(out | {"valid": valid}, empty)
    notes += [count_words(len(empty), "empty row", "at the origin, set aside")] if len(empty) else []
    return Gaussians(**out), valid, notes


def _read_base(sh0: Array | None, colors: Array | None) -> np.ndarray:
    """Return ``sh0 [n,1,3]`` as given, or compute it from colours."""
    if (sh0 is None) == (colors is None):
        found = "neither" if sh0 is None else "both"
        raise SceneError("sh0", f"expected either sh0 or colors, found {found}")
    if sh0 is not None:
        return _rows("sh0", sh0, 3).reshape(-1, 1, 3)
    rgb = _rows("colors", colors, 3)
    max_color = 2.0  # largest colour; harmonics may take colours a little beyond 1
    _expect_unit_range("colors", rgb[np.isfinite(rgb)], max_color - 1)
    return rgb_to_sh0(rgb)[:, None]


def _read_harmonics(shN: Array | None, n: int) -> np.ndarray:
    """Return ``shN [n,k-1,3]``, with k = 1 if there are no higher harmonics; SceneError for any other shape."""
    shape = (0, 3) if shN is None else _to_numpy("shN", shN).shape
    if shape[-2:] == (0, 3):
        return np.zeros((n, 0, 3), np.float32)
    counts = (3, 8, 15, 24)
    if len(shape) < 3 or shape[-1] != 3 or shape[-2] not in counts:
        swapped = len(shape) >= 3 and shape[-2] == 3 and shape[-1] in counts
        problem = f"expected shape [n, k-1, 3] with 3, 8, 15 or 24 coefficients, found {list(shape)}"
        raise SceneError("shN", problem, "pass shN.transpose(-1, -2): each coefficient's colours last" * swapped)
    return _rows("shN", shN, shape[-2], 3)


def _check_lengths(quats: np.ndarray) -> None:
    """Raise SceneError for quaternions of other lengths than 1; a scene may have them, as no stage uses lengths."""
    lengths = np.linalg.norm(quats, axis=1)
    # Difference of a quaternion's length from 1; share of rows that may exceed it
    max_difference, max_share = 0.01, 0.01
    share = float((np.abs(lengths - 1) > max_difference).mean())
    if share > max_share:
        sizes = f"{100 * share:.3g} % with lengths of {lengths.min():.3g} to {lengths.max():.3g}"
        remedy = "pass torch.nn.functional.normalize(quats, dim=-1)"
        raise SceneError("quats", f"expected unit quaternions wxyz, found {sizes}", remedy)


def _expect_unit_range(name: str, values: np.ndarray, slack: float) -> None:
    """Raise SceneError for colours more than ``slack`` outside [0, 1]; the message guesses their range."""
    low, high = float(values.min(initial=0)), float(values.max(initial=0))
    if -slack <= low and high <= 1 + slack:
        return
    remedy = ""
    if low >= 0 and high <= 255 + slack:
        remedy = f"they look like 0 to 255: pass {name} / 255"
    elif low >= -1 - slack and high <= 1 + slack:
        remedy = f"they look like -1 to 1: pass ({name} + 1) / 2"
    raise SceneError(name, f"expected sRGB in [0, 1], found {low:.3g} to {high:.3g}", remedy)


def _read_views(
    viewmats: Array | None, Ks: Array | None, images: Array | None, shape: Sequence[int] | None
) -> tuple[Cameras, np.ndarray | None]:
    """Return the cameras and ``images [v,h,w,3]``, after each was checked alone."""
    if viewmats is None or Ks is None:
        raise SceneError("viewmats" if viewmats is None else "Ks", "expected one matrix for each view, found none")
    photos = None if images is None else _to_numpy("images", images)
    views, height, width = _view_shape(shape, photos)
    matrices = _matrices("viewmats", viewmats, ((3, 4), (4, 4)), views)
    intrinsics = _matrices("Ks", Ks, ((3, 3),), views)
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


def _matrices(name: str, values: Any, shapes: Sequence[tuple[int, int]], views: int) -> np.ndarray:
    """Return one float64 matrix for each view; SceneError if its shape is none of ``shapes``."""
    array = _to_numpy(name, values).astype(np.float64, order="C")
    if array.shape[-2:] not in shapes or array.size != views * array.shape[-2] * array.shape[-1]:
        expected = " or ".join(str([views, *shape]) for shape in shapes)
        raise SceneError(name, f"expected shape {expected}, found {list(array.shape)}")
    return array.reshape(views, *array.shape[-2:])


def _view_shape(shape: Sequence[int] | None, photos: np.ndarray | None) -> tuple[int, int, int]:
    """Return the number of views, height and width: as given, or those of the images."""
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
    return views, height, width


def _image_error(photos: np.ndarray, expected: str) -> SceneError:
    """Return the error for images of a wrong shape, with a remedy."""
    first = photos.ndim >= 4 and photos.shape[-3] == 3 != photos.shape[-1]
    remedy = "channels come first: pass images.permute(0, 2, 3, 1)" if first else "resize them to the model's input"
    return SceneError("images", f"expected shape {expected}, found {list(photos.shape)}", remedy)


def _check_pixels(
    gaussians: Gaussians, cameras: Cameras, valid: np.ndarray, names: tuple[str, ...]
) -> tuple[Cameras, list[str]]:
    """Check that Gaussians project into their own pixels; return the cameras, moved slightly if needed, and notes."""
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


def _rotation_notes(quats: np.ndarray) -> list[str]:
    """Return a note on quaternions whose w may come last, or none: the last column is never negative, the first is.

    Quaternions computed from matrices rarely have a negative w. An exception is Depth Anything 3, which makes the last
    component of wxyz positive.
    """
    if not quats[:, 3].min(initial=0) >= 0 > quats[:, 0].min(initial=0):
        return []
    return ["the last column of quats is never negative: if w comes last, pass quats[:, [3, 0, 1, 2]]"]


def _check_seen(gaussians: Gaussians, valid: np.ndarray, cameras: Cameras, images: np.ndarray | None) -> list[str]:
    """Raise SceneError for poses that see the Gaussians only in another convention; return notes on other poses."""
    poses, check, note = choose_poses(gaussians, valid, cameras, photo_array(images), W2C_OPENCV)
    if poses is not None:
        raise _convention_error(poses.convention, poses.description, check.description)
    return [text for text in (note, None if check.ok else check.description) if text]


def _convention_error(convention: Convention, description: str, fact: str) -> SceneError:
    """Return the error for view matrices of another convention, with a remedy."""
    problem = f"expected world-to-camera matrices with OpenCV axes, found that {fact} when the matrices are read as"
    return SceneError("viewmats", f"{problem} {description}", _REMEDIES[convention])
