"""Read rotations that an exporter stored in another order, or left in the camera's frame."""

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

_SAMPLE_PIXELS = 3000  # pixels per view whose surface is used
_MOST_VIEWS = 200  # whose surfaces are used
_STEP = 2  # pixels to the neighbours that span the surface
_FLAT = 0.8  # thinnest over middle scale, at most, where a Gaussian's thinnest axis is a normal of its surface
_MIN_TESTED = 300  # Gaussians
_MIN_COSINE, _MIN_GAIN = 0.6, 0.15  # of the mean cosine between thinnest axis and normal, for another reading
_SIGNED_GAIN = 0.04  # the same for xyzw where the last column is never negative, as w often is not
_AROUND = 5  # pixels of the square over which means are averaged before roots are compared
_FOLLOWS = 0.95  # cosine above which an axis follows the surface
_MAX_LEFT = 0.5  # share of Gaussians that follow under no root, over that under any other reading
_READINGS: tuple[QuatChoice, ...] = ("wxyz", "xyzw", "camera")
_DESCRIPTIONS = {
    "xyzw": "stored with w last",
    "camera": "relative to each view's camera",
    "xyzw-root": "stored with w last and each applied twice",
}


def read_rotations(scene: Scene, quats: QuatChoice, turn: np.ndarray | None = None) -> Scene:
    """Reinterpret the rotations of a scene, read as wxyz before, in another way; see :class:`ReadHints`.

    ``turn [3,3]`` is the rotation of the world, and of the Gaussians with it, that the exporter applied; None: none.
    For "xyzw-root", the one of two square roots is taken whose thinnest axis follows the surface better. Where
    views have no Gaussians of their own, only "xyzw" has an effect.
    """
    if quats in ("auto", "wxyz") or not (scene.has_own_pixels or quats == "xyzw"):
        return scene
    stored = scene.gaussians.quats
    if quats == "xyzw":
        read = from_xyzw(stored)
    elif quats == "xyzw-root":
        normals, thinnest = _smooth_normals(scene)[scene.get_pixels().homes], scene.gaussians.scales.argmin(1)
        roots = square_roots(from_xyzw(stored))
        first, second = (_cosines(root, thinnest, normals) for root in roots)
        read = np.where((second > first)[:, None], roots[1], roots[0])
    else:
        read = multiply_quats(_camera_quats(scene, turn)[scene.get_pixels().homes // scene.pixels_per_view], stored)
    return replace(scene, gaussians=replace(scene.gaussians, quats=read))


def from_xyzw(quats: np.ndarray) -> np.ndarray:
    """Reorder quaternions ``[n,4]`` from xyzw to wxyz."""
    return quats[:, [3, 0, 1, 2]]


def square_roots(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute both square roots of rotations ``[n,4]`` wxyz: of half the angle, and that turned by half a turn."""
    unit = normalize(quats)
    unit = np.where(unit[:, :1] < 0, -unit, unit)
    half = normalize(unit + np.array((1, 0, 0, 0), unit.dtype))
    return half, _half_a_turn_more(half)


def choose_rotations(scene: Scene, turn: np.ndarray | None = None) -> tuple[QuatChoice, str]:
    """Choose the reading of rotations whose thinnest axes follow the surface normals; in doubt "wxyz".

    A last column that is never negative speaks for "xyzw", so less of a difference decides then. Also returns a note.
    ``turn`` as in :func:`read_rotations`.
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
    single = [quats, as_xyzw, multiply_quats(_camera_quats(scene, turn)[views], quats)]
    means = parallel_map(lambda read: float(_cosines(read, thinnest, normals).mean()), single)
    cosine: dict[QuatChoice, float] = dict(zip(_READINGS, means, strict=True))
    best: QuatChoice = max(_READINGS, key=lambda name: cosine[name])
    gain = _SIGNED_GAIN if best == "xyzw" and w_seems_last(scene.gaussians.quats) else _MIN_GAIN
    if _is_root(scene, rows, single, thinnest, normals):
        best, cosine["xyzw-root"] = "xyzw-root", _better_of(square_roots(as_xyzw), thinnest, normals, 0.0)
    elif best == "wxyz" or cosine[best] < max(_MIN_COSINE, cosine["wxyz"] + gain):
        return "wxyz", ""
    return best, (
        f"rotations are {_DESCRIPTIONS[best]}: the thinnest axes are at a mean cosine of {cosine[best]:.2f} to the"
        f" surface then, {cosine['wxyz']:.2f} as stored; --hint quats=wxyz says otherwise"
    )


def w_seems_last(quats: np.ndarray) -> bool:
    """Return whether the last column of quaternions ``[n,4]`` is never negative, and the first one is.

    Rotations from matrices rarely have a negative w; but Depth Anything 3 takes the sign from the last of wxyz.
    """
    return bool(quats[:, 3].min(initial=0) >= 0 > quats[:, 0].min(initial=0))


def _camera_quats(scene: Scene, turn: np.ndarray | None) -> np.ndarray:
    """Compute rotations ``[v,4]`` wxyz from each camera to the world, with a turn of the world undone first."""
    rotmats = scene.cameras.viewmats[:, :3, :3].swapaxes(1, 2)
    return rotmat_to_quat(rotmats if turn is None else matmul(rotmats, turn.T)).astype(np.float32)


def _cosines(quats: np.ndarray, thinnest: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Compute cosines ``[n]`` between Gaussians' thinnest axes under ``quats [n,4]`` and the normals, 0 to 1."""
    axes = np.take_along_axis(quat_to_rotmat(quats), thinnest[:, None, None], 2)[:, :, 0]
    return np.abs((axes * normals).sum(1))


def _is_root(
    scene: Scene, rows: np.ndarray, single: list[np.ndarray], thinnest: np.ndarray, normals: np.ndarray
) -> bool:
    """Return whether the square roots of xyzw rotations follow the surface far better than all other readings.

    The better of two rotations is better by chance as well, so every other reading is also given a second rotation,
    half a turn further. ``single`` are readings ``[t,4]``, first as stored, then as xyzw. ``normals`` are rough, for a
    quick comparison.
    """
    pairs = [square_roots(single[0]), *((quats, _half_a_turn_more(quats)) for quats in single)]
    roots = square_roots(single[1])
    of_roots, *others = parallel_map(lambda pair: _better_of(pair, thinnest, normals, 0.0), [roots, *pairs])
    if of_roots <= max(others):
        return False
    smooth = _smooth_normals(scene)[scene.get_pixels().homes[rows]]
    best_other = max(_better_of(pair, thinnest, smooth, _FOLLOWS) for pair in pairs)
    return 1 - _better_of(roots, thinnest, smooth, _FOLLOWS) <= _MAX_LEFT * (1 - best_other)


def _better_of(
    pair: tuple[np.ndarray, np.ndarray], thinnest: np.ndarray, normals: np.ndarray, threshold: float
) -> float:
    """Average the cosine of the better one of two rotations ``[n,4]``, or the share above a threshold > 0."""
    better = np.maximum(*(_cosines(quats, thinnest, normals) for quats in pair))
    return float((better > threshold).mean() if threshold else better.mean())


def _half_a_turn_more(quats: np.ndarray) -> np.ndarray:
    """Turn rotations ``[n,4]`` by another half turn about their own axes; without an angle, about any axis."""
    length = np.linalg.norm(quats[:, 1:], axis=1, keepdims=True)
    axis = np.where(length > 0, normalize(quats[:, 1:]), np.array((0, 0, 1), quats.dtype))
    return np.concatenate([-length, quats[:, :1] * axis], 1)


def _smooth_normals(scene: Scene) -> np.ndarray:
    """Compute surface normals ``[v·h·w,3]`` at all pixels from means averaged over neighbours; 0 on overflow."""
    fronts = scene.get_pixels().fronts
    (_, h, w), shown = fronts.shape, fronts >= 0
    weights, means = shown[..., None].astype(np.float32), scene.gaussians.means[fronts]
    middle = means.mean((0, 1, 2), np.float64, where=weights > 0).astype(means.dtype)
    with np.errstate(over="ignore"):
        both = np.concatenate([np.where(weights > 0, means - middle, 0).astype(np.float32), weights], 3)
    around = np.stack([_average_around(view) for view in both])
    grid = around[..., :3] / np.maximum(around[..., 3:], np.float32(1e-6))
    x, y = np.arange(w), np.arange(h)
    with np.errstate(all="ignore"):  # means as large as 1e38 overflow
        across = grid[:, :, np.minimum(x + _STEP, w - 1)] - grid[:, :, np.maximum(x - _STEP, 0)]
        down = grid[:, np.minimum(y + _STEP, h - 1)] - grid[:, np.maximum(y - _STEP, 0)]
        normals = normalize(np.cross(across, down).reshape(-1, 3))
    return np.where(np.isfinite(normals).all(1, keepdims=True), normals, 0)


def _average_around(picture: np.ndarray) -> np.ndarray:
    """Average a picture ``[h,w,c]`` over squares of ``_AROUND`` pixels a side, zero outside."""
    half = _AROUND // 2
    taps = np.full(_AROUND, 1 / _AROUND)
    return convolve(np.pad(picture, ((half, half), (half, half), (0, 0))), taps, taps)[half:-half, half:-half]


def _normals(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute surface normals ``[t,3]`` at a sample of pixels; also return the rows and views of these."""
    v, h, w = scene.get_pixels().fronts.shape
    inner = np.arange(h * w).reshape(h, w)[_STEP:-_STEP, _STEP:-_STEP].reshape(-1)
    step = spread_step(len(inner) // _SAMPLE_PIXELS, w - 2 * _STEP)
    views = np.arange(0, v, -(-v // _MOST_VIEWS))
    places = (h * w * views[:, None] + inner[::step]).reshape(-1)
    fronts, means = scene.get_pixels().fronts.reshape(-1), scene.gaussians.means
    left, right, above, below = (fronts[places + away] for away in (-_STEP, _STEP, -_STEP * w, _STEP * w))
    good = np.minimum.reduce([fronts[places], left, right, above, below]) >= 0
    places, left, right, above, below = (each[good] for each in (places, left, right, above, below))
    with np.errstate(all="ignore"):  # means as large as 1e38 overflow: their pixels are left out
        across, down = ((means[b] - means[a]).astype(np.float32) for a, b in ((left, right), (above, below)))
        normals = normalize(np.cross(across, down))
    finite = np.isfinite(normals).all(1)
    places = places[finite]
    return normals[finite], fronts[places], places // (h * w)
