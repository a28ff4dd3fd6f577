"""Read rotations that an exporter stored in another order of components or in the frame of the camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmerge.alignment.layouts import spread_step
from gsmerge.geometry import multiply_quats, normalize, quat_to_rotmat, rotmat_to_quat
from gsmerge.kernels.matrices import matmul
from gsmerge.kernels.pictures import convolve
from gsmerge.runtime.memory import free_pages
from gsmerge.runtime.threads import parallel_map
from gsmerge.settings.reading import QuatChoice
from gsmerge.types import Scene

_SAMPLE_PIXELS = 3000  # pixels per view whose normals are used
_MAX_VIEWS = 200  # views whose normals are used
_STEP = 2  # pixels to the neighbours that span the surface
_FLAT = 0.8  # largest thinnest scale, divided by the middle scale, at which the thinnest axis is taken for the normal
_MIN_TESTED = 300  # Gaussians
# Another format needs this mean cosine between thinnest axis and normal, and this gain over wxyz
_MIN_COSINE, _MIN_GAIN = 0.6, 0.15
_SIGNED_GAIN = 0.04  # the gain needed for xyzw if the last column is never negative, which is typical of w
_AROUND = 5  # side of the square over which means are averaged before roots are compared, pixels
_FOLLOWS = 0.95  # cosine above which an axis is the normal of the surface
# Share of Gaussians whose axis is no normal under either root, divided by the least share under the other formats
_MAX_MISSES = 0.5
_XYZW_TO_WXYZ = [3, 0, 1, 2]  # columns of xyzw in the order wxyz
_FORMATS: tuple[QuatChoice, ...] = ("wxyz", "xyzw", "camera")
_DESCRIPTIONS = {
    "xyzw": "stored with w last",
    "camera": "relative to each view's camera",
    "xyzw-root": "stored with w last and each applied twice",
}


def read_rotations(scene: Scene, quats: QuatChoice, world_rotation: np.ndarray | None = None) -> Scene:
    """Convert the rotations of a scene, which were read as wxyz, from another format; see :class:`ReadHints`.

    ``world_rotation [3,3]`` is the rotation of the world, and of the Gaussians with it, that the exporter applied; None
    if it applied none. For "xyzw-root" each rotation becomes its square root whose thinnest axis is nearer to the
    normal of the surface. If views have no Gaussians of their own, only "xyzw" has an effect.
    """
    if quats in ("auto", "wxyz") or not (scene.has_own_pixels or quats == "xyzw"):
        return scene
    stored = scene.gaussians.quats
    if quats == "xyzw":
        converted = from_xyzw(stored)
    elif quats == "xyzw-root":
        normals, thinnest = _smooth_normals(scene)[scene.get_pixels().homes], scene.gaussians.scales.argmin(1)
        roots = square_roots(from_xyzw(stored))
        first, second = (_cosines(root, thinnest, normals) for root in roots)
        converted = np.where((second > first)[:, None], roots[1], roots[0])
    else:
        views = scene.get_pixels().homes // scene.pixels_per_view
        converted = multiply_quats(_camera_quats(scene, world_rotation)[views], stored)
    return replace(scene, gaussians=replace(scene.gaussians, quats=converted))


def from_xyzw(quats: np.ndarray) -> np.ndarray:
    """Reorder quaternions ``[n,4]`` from xyzw to wxyz."""
    return quats[:, _XYZW_TO_WXYZ]


def square_roots(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute both square roots of rotations ``[n,4]`` wxyz: half the angle, and half the angle plus 180 degrees."""
    unit = normalize(quats)
    unit = np.where(unit[:, :1] < 0, -unit, unit)
    half = normalize(unit + np.array((1, 0, 0, 0), unit.dtype))
    return half, _add_half_turn(half)


def choose_rotations(scene: Scene, world_rotation: np.ndarray | None = None) -> tuple[QuatChoice, str]:
    """Choose the format of rotations under which the thinnest axes are normals of the surface; in doubt "wxyz".

    A last column that is never negative suggests "xyzw", so a smaller gain is needed then. Also returns a note.
    ``world_rotation`` is as in :func:`read_rotations`.
    """
    normals, rows, views = _normals(scene)
    scales = scene.gaussians.scales[rows]
    free_pages(vars(scene.gaussians).values())
    ordered = np.sort(scales, 1)
    flat = ordered[:, 0] < _FLAT * ordered[:, 1]
    normals, rows, views = normals[flat], rows[flat], views[flat]
    if len(rows) < _MIN_TESTED:
        return "wxyz", ""
    thinnest, quats = scales[flat].argmin(1), scene.gaussians.quats[rows]
    free_pages([scene.gaussians.quats])
    as_xyzw = from_xyzw(quats)
    by_format = [quats, as_xyzw, multiply_quats(_camera_quats(scene, world_rotation)[views], quats)]
    means = parallel_map(lambda format_quats: float(_cosines(format_quats, thinnest, normals).mean()), by_format)
    cosine: dict[QuatChoice, float] = dict(zip(_FORMATS, means, strict=True))
    best: QuatChoice = max(_FORMATS, key=lambda name: cosine[name])
    gain = _SIGNED_GAIN if best == "xyzw" and w_seems_last(scene.gaussians.quats) else _MIN_GAIN
    if _is_root(scene, rows, by_format, thinnest, normals):
        best, cosine["xyzw-root"] = "xyzw-root", _score_better_of(square_roots(as_xyzw), thinnest, normals, 0.0)
    elif best == "wxyz" or cosine[best] < max(_MIN_COSINE, cosine["wxyz"] + gain):
        return "wxyz", ""
    return best, (
        f"rotations are {_DESCRIPTIONS[best]}: the mean cosine between thinnest axes and normals of the surface is"
        f" {cosine[best]:.2f}, and {cosine['wxyz']:.2f} as wxyz; --hint quats=wxyz keeps them as wxyz"
    )


def w_seems_last(quats: np.ndarray) -> bool:
    """Return True if the last column of quaternions ``[n,4]`` is never negative, but the first sometimes is.

    Quaternions computed from matrices rarely have a negative w. An exception is Depth Anything 3, which makes the last
    component of wxyz positive.
    """
    return bool(quats[:, 3].min(initial=0) >= 0 > quats[:, 0].min(initial=0))


def _camera_quats(scene: Scene, world_rotation: np.ndarray | None) -> np.ndarray:
    """Compute rotations ``[v,4]`` wxyz from each camera to the world, after undoing a rotation of the world."""
    rotmats = scene.cameras.viewmats[:, :3, :3].swapaxes(1, 2)
    return rotmat_to_quat(rotmats if world_rotation is None else matmul(rotmats, world_rotation.T)).astype(np.float32)


def _cosines(quats: np.ndarray, thinnest: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Compute the cosines ``[n]``, 0 to 1, between the thinnest axes of Gaussians with ``quats [n,4]`` and normals."""
    x, y, z = (quat_to_rotmat(quats)[np.arange(len(quats)), :, thinnest] * normals).T
    return np.abs(x + y + z)


def _is_root(
    scene: Scene, rows: np.ndarray, by_format: list[np.ndarray], thinnest: np.ndarray, normals: np.ndarray
) -> bool:
    """Return True if square roots of xyzw rotations match the normals far better than the rotations of other formats.

    The better of two rotations has a higher cosine by chance as well. So each rotation of another format also gets a
    second one, half a turn further. ``by_format`` are rotations ``[t,4]`` read as wxyz, as xyzw, and as relative to the
    camera. ``normals`` are rough and serve a quick first comparison.
    """
    pairs = [square_roots(by_format[0]), *((quats, _add_half_turn(quats)) for quats in by_format)]
    roots = square_roots(by_format[1])
    scores = parallel_map(lambda pair: _score_better_of(pair, thinnest, normals, 0.0), [roots, *pairs])
    root_score, *other_scores = scores
    if root_score <= max(other_scores):
        return False
    smooth = _smooth_normals(scene)[scene.get_pixels().homes[rows]]
    best_other = max(_score_better_of(pair, thinnest, smooth, _FOLLOWS) for pair in pairs)
    return 1 - _score_better_of(roots, thinnest, smooth, _FOLLOWS) <= _MAX_MISSES * (1 - best_other)


def _score_better_of(
    pair: tuple[np.ndarray, np.ndarray], thinnest: np.ndarray, normals: np.ndarray, threshold: float
) -> float:
    """Average the cosine of the better of two rotations ``[n,4]``; with a threshold, return the share above it."""
    better = np.maximum(*(_cosines(quats, thinnest, normals) for quats in pair))
    return float((better > threshold).mean() if threshold else better.mean())


def _add_half_turn(quats: np.ndarray) -> np.ndarray:
    """Add half a turn about the own axis to each rotation ``[n,4]``; for the identity, about z."""
    length = np.linalg.norm(quats[:, 1:], axis=1, keepdims=True)
    axis = np.where(length > 0, normalize(quats[:, 1:]), np.array((0, 0, 1), quats.dtype))
    return np.concatenate([-length, quats[:, :1] * axis], 1)


def _smooth_normals(scene: Scene) -> np.ndarray:
    """Compute surface normals ``[v·h·w,3]`` at all pixels from means averaged over a neighbourhood; 0 on overflow."""
    fronts = scene.get_pixels().fronts
    (_, h, w), shown = fronts.shape, fronts >= 0
    weights, means = shown[..., None].astype(np.float32), scene.gaussians.means[fronts]
    middle = means.mean((0, 1, 2), np.float64, where=weights > 0).astype(means.dtype)
    with np.errstate(over="ignore"):
        weighted = np.concatenate([np.where(weights > 0, means - middle, 0).astype(np.float32), weights], 3)
    averages = np.stack([_average_around(view) for view in weighted])  # the last channel is the mean weight
    grid = averages[..., :3] / np.maximum(averages[..., 3:], np.float32(1e-6))
    x, y = np.arange(w), np.arange(h)
    with np.errstate(all="ignore"):  # means as large as 1e38 overflow
        across = grid[:, :, np.minimum(x + _STEP, w - 1)] - grid[:, :, np.maximum(x - _STEP, 0)]
        down = grid[:, np.minimum(y + _STEP, h - 1)] - grid[:, np.maximum(y - _STEP, 0)]
        normals = normalize(np.cross(across, down).reshape(-1, 3))
    return np.where(np.isfinite(normals).all(1, keepdims=True), normals, 0)


def _average_around(picture: np.ndarray) -> np.ndarray:
    """Average a picture ``[h,w,c]`` over squares of ``_AROUND`` pixels per side; pixels outside count as zero."""
    half = _AROUND // 2
    taps = np.full(_AROUND, 1 / _AROUND)
    return convolve(np.pad(picture, ((half, half), (half, half), (0, 0))), taps, taps)[half:-half, half:-half]


def _normals(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute surface normals ``[t,3]`` at a sample of pixels; also return the row and the view of each pixel."""
    v, h, w = scene.get_pixels().fronts.shape
    inner = np.arange(h * w).reshape(h, w)[_STEP:-_STEP, _STEP:-_STEP].reshape(-1)
    step = spread_step(len(inner) // _SAMPLE_PIXELS, w - 2 * _STEP)
    views = np.arange(0, v, -(-v // _MAX_VIEWS))
    pixels = (h * w * views[:, None] + inner[::step]).reshape(-1)
    fronts, means = scene.get_pixels().fronts.reshape(-1), scene.gaussians.means
    left, right, above, below = (fronts[pixels + offset] for offset in (-_STEP, _STEP, -_STEP * w, _STEP * w))
    has_neighbours = np.minimum.reduce([fronts[pixels], left, right, above, below]) >= 0
    pixels, left, right, above, below = (ids[has_neighbours] for ids in (pixels, left, right, above, below))
    with np.errstate(all="ignore"):  # means as large as 1e38 overflow, and their pixels are left out
        across, down = ((means[b] - means[a]).astype(np.float32) for a, b in ((left, right), (above, below)))
        normals = normalize(np.cross(across, down))
    finite = np.isfinite(normals).all(1)
    pixels = pixels[finite]
    return normals[finite], fronts[pixels], pixels // (h * w)
