"""Compute geometry on batches: quaternions, covariances, projection, harmonics, similarities, motions and regions.

The module also has medians, and a damped descent, which solves small problems of least squares.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from gsmerge.arrays import Array
from gsmerge.frozen import dataclass, replace
from gsmerge.method.kernels.elementary import arctan2, cos, sin
from gsmerge.method.kernels.gaussians.cross_view import make_tree, nearest_of_others
from gsmerge.method.kernels.matrices import closest_rotation, invert, matmul, solve
from gsmerge.method.kernels.raster.project import view_colors
from gsmerge.runtime.threads import parallel_map, use_threads
from gsmerge.types import SH_C0, Cameras, Gaussians, Region, SceneT

DescentState = TypeVar("DescentState")  # state that a descent changes
SH_DIRECTIONS = 96  # directions in which harmonics are compared before and after a rotation
# To find the median of more than FEW_VALUES values, only the values between the quantiles AROUND_MEDIAN of a sample are
# ordered. The sample has about SAMPLE_VALUES values
FEW_VALUES = 1 << 17
SAMPLE_VALUES = 1 << 14
AROUND_MEDIAN = (0.47, 0.53)
NORMAL_SPREAD = 1.4826  # standard deviation of a normal distribution, divided by its median absolute deviation
NEAREST_ROWS = 1 << 14  # points per task of a search for nearest points
BRIGHT_SH0 = np.float32(20.0)  # harmonic of degree 0 so large that no colour is clipped at 0


def quat_to_rotmat(quats: np.ndarray) -> np.ndarray:
    """Return the rotation matrices ``[...,3,3]``, local to world, of quaternions ``[...,4]`` wxyz of any length."""
    entries = rotation_entries(*np.moveaxis(normalize(quats), -1, 0))
    return np.stack(entries, -1).reshape(*quats.shape[:-1], 3, 3)


def rotation_entries(w: Array, x: Array, y: Array, z: Array) -> list[Array]:
    """Return the nine entries, row by row, of the rotations of unit quaternions, as arrays or tensors."""
    return [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip


def normalize(vectors: np.ndarray) -> np.ndarray:
    """Return vectors ``[...,d]`` scaled to length 1; zero stays zero."""
    with np.errstate(over="ignore"):  # vectors whose length overflows become zero
        norms = vector_lengths(vectors)
    return vectors / np.maximum(norms, norms.dtype.type(1e-12))


def rotmat_to_quat(rotations: np.ndarray) -> np.ndarray:
    """Return unit quaternions ``[n,4]`` wxyz of rotations, with a positive largest component (Shepperd 1978)."""
    a, b, c, d, e, f, g, h, i = rotations.reshape(-1, 9).T
    candidates = np.stack(  # one quaternion in four scalings, by each of its components
        [
            np.stack([1 + a + e + i, h - f, c - g, d - b], -1),
            np.stack([h - f, 1 + a - e - i, b + d, c + g], -1),
            np.stack([c - g, b + d, 1 - a + e - i, f + h], -1),
            np.stack([d - b, c + g, f + h, 1 - a - e + i], -1),
        ],
        -2,
    )
    best = np.diagonal(candidates, axis1=-2, axis2=-1).argmax(-1)
    return normalize(candidates[np.arange(len(best)), best])


def multiply_quats(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the products of quaternions ``[...,4]`` wxyz: first ``b``, then ``a``."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    product = [
        aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw,
    ]  # fmt: skip
    return np.stack(product, -1)


def covariances(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return covariances ``R diag(scales)^2 R^T [...,3,3]`` from quaternions wxyz and scales (paper section 3)."""
    half = quat_to_rotmat(quats) * scales[..., None, :]
    return matmul(half, half.swapaxes(-1, -2))


def project(means: np.ndarray, cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Project points ``[n,3]`` into c cameras, in float64.

    Returns positions ``[c,n,2]`` in pixels, with pixel centres at +0.5, and depths ``[c,n]`` along z. Positions of
    points with a depth of 0 or less are meaningless.
    """
    with np.errstate(divide="ignore", invalid="ignore"):  # some points have a depth of 0
        return project_points(*(array.astype(np.float64) for array in (means, cameras.viewmats, cameras.Ks)))


def project_points(points: np.ndarray, viewmats: np.ndarray, Ks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project points ``[...,n,3]`` as :func:`project` does, but for any leading shape and in the points' precision.

    ``viewmats [...,4,4]`` are world to camera, ``Ks [...,3,3]`` in pixels. Returns positions ``[...,n,2]`` and depths
    ``[...,n]``.
    """
    camera = matmul(points, viewmats[..., :3, :3].swapaxes(-1, -2)) + viewmats[..., None, :3, 3]
    image = matmul(camera, Ks.swapaxes(-1, -2))
    return image[..., :2] / image[..., 2:], camera[..., 2]


def is_inside(pixels: np.ndarray, cameras: Cameras) -> np.ndarray:
    """Return a mask ``[...]`` of the positions ``[...,2]`` (pixels) inside the cameras' pictures."""
    column = pixels[..., 0]
    row = pixels[..., 1]
    return np.asarray((column >= 0) & (column < cameras.width) & (row >= 0) & (row < cameras.height))


def camera_depths(points: np.ndarray, viewmats: np.ndarray, ids: np.ndarray | None = None) -> np.ndarray:
    """Return the depths ``[...]`` along z of points ``[...,3]`` in cameras ``[...,4,4]``, world to camera.

    If each of ``[n,3]`` points has a camera of its own, ``ids [n]`` are the numbers of these cameras.
    """
    x, y, z = np.moveaxis(points, -1, 0)
    a, b, c, d = np.moveaxis(viewmats[..., 2, :], -1, 0)
    if ids is not None:
        a = a[ids]
        b = b[ids]
        c = c[ids]
        d = d[ids]
    return x * a + y * b + z * c + d


def motion_matrices(vectors: np.ndarray) -> np.ndarray:
    """Return rigid motions ``[v,4,4]`` float64 from ``[v,6]``: rotation vectors about the origin (radians), and shifts.

    A motion rotates first, and then shifts.
    """
    vectors = vectors.astype(np.float64)
    angles = vector_lengths(vectors[:, :3])
    # sin(angle / 2) / angle, which tends to 0.5 for small angles
    factors = np.where(angles > 0, sin(angles / 2) / np.where(angles > 0, angles, 1), 0.5)
    motions = np.tile(np.eye(4), (len(vectors), 1, 1))
    motions[:, :3, :3] = quat_to_rotmat(np.concatenate([cos(angles / 2), factors * vectors[:, :3]], 1))
    motions[:, :3, 3] = vectors[:, 3:]
    return motions


def euler_to_rotmat(degrees: np.ndarray) -> np.ndarray:
    """Return the rotation ``[3,3]`` about the axes x, y and z, in this order, by ``degrees [3]``."""
    about_x, about_y, about_z = motion_matrices(np.pad(np.diag(np.radians(degrees)), ((0, 0), (0, 3))))[:, :3, :3]
    return matmul(about_z, matmul(about_y, about_x))


def motion_vectors(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the rigid motions ``[v,6]`` between viewmats ``[v,4,4]``: ``end = start @ motion_matrices(motions)``."""
    motions = matmul(invert(start), end)
    quats = rotmat_to_quat(motions[:, :3, :3])
    quats *= np.where(quats[:, :1] < 0, -1, 1)  # the angle is at most half a turn
    sines = vector_lengths(quats[:, 1:])
    # angle / sin(angle / 2), which tends to 2 for small angles
    factors = np.where(sines > 0, 2 * arctan2(sines, quats[:, :1]) / np.where(sines > 0, sines, 1), 2)
    return np.concatenate([factors * quats[:, 1:], motions[:, :3, 3]], 1)


def without_common_motion(start: np.ndarray, end: np.ndarray, middle: Callable[..., np.ndarray]) -> np.ndarray:
    """Return the viewmats ``end [v,4,4]`` without the common part of all motions from ``start``.

    The common part is the ``middle`` of the motions, which is ``np.mean`` or ``np.median``.
    """
    common = middle(motion_vectors(start, end), axis=0)
    return matmul(end, invert(motion_matrices(common[None])))


def move_views(scene: SceneT, viewmats: np.ndarray) -> SceneT:
    """Return the scene with the cameras at poses ``[v,4,4]``, and each view's Gaussians moved with its camera.

    Higher harmonics are not rotated, because poses move by a degree or two, which hardly changes the colours.
    """
    g, view_rows = scene.gaussians, scene.get_pixels().rows_of_views
    motions = matmul(invert(viewmats), scene.cameras.viewmats.astype(np.float64))
    rotations, means, quats = rotmat_to_quat(motions[:, :3, :3]), g.means.copy(), g.quats.copy()

    def move(view: int) -> None:
        """Move the Gaussians of a view, in ``means`` and ``quats``."""
        rows = view_rows[view]
        means[rows] = matmul(g.means[rows], motions[view, :3, :3].T) + motions[view, :3, 3]
        quats[rows] = multiply_quats(rotations[view], g.quats[rows])

    parallel_map(move, range(len(scene)))
    gaussians = replace(g, means=means, quats=quats)
    return replace(scene, gaussians=gaussians, cameras=replace(scene.cameras, viewmats=viewmats))


def camera_centres(viewmats: np.ndarray) -> np.ndarray:
    """Return the world-frame centres ``[...,3]`` of cameras with rigid viewmats ``[...,4,4]``."""
    return -(viewmats[..., :3, :3] * viewmats[..., :3, 3:]).sum(-2)


def middle_depth(means: np.ndarray, camera: Cameras) -> float:
    """Measure the median depth of the points ``[n,3]`` inside one camera's picture; 1 if there are none."""
    return float(quantiles(depths_inside(means, camera), (0.5,))[0])


def depths_inside(means: np.ndarray, camera: Cameras) -> np.ndarray:
    """Return the depths of a sample of the points ``[n,3]`` inside one camera's picture; a single 1.0 for no points."""
    depth_sample = 50_000  # number of points; the median depth in a view is measured on about this many
    points = means[:: max(1, len(means) // depth_sample)]
    (pixels,), (depths,) = project(points, camera)
    inside = (depths > 0) & ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(1)
    return np.asarray(depths[inside]) if inside.any() else np.ones(1)


def step_outside(
    viewmat: np.ndarray, depth: float, back: float, azimuth: float = 0.0, elevation: float = 0.0
) -> np.ndarray:
    """Return the viewmat ``[4,4]`` float64 of a camera that moves around the point in front of it and steps back.

    The camera keeps looking at the point that is ``depth`` in front of it, in world units. ``azimuth`` moves the camera
    to the right and ``elevation`` upwards, in degrees. ``back`` is the step away from the point, as a share of
    ``depth``.
    """
    angles = np.radians([[0.0, azimuth, 0.0], [elevation, 0.0, 0.0]])
    about_y, about_x = motion_matrices(np.concatenate([angles, np.zeros((2, 3))], 1))
    pivot = np.eye(4)
    pivot[2, 3] = depth
    away = pivot.copy()
    away[2, 3] = (1 + back) * depth
    return matmul(matmul(away, matmul(about_x, about_y)), matmul(invert(pivot), viewmat.astype(np.float64)))


def pose_changes(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measure how far cameras moved between viewmats ``[v,4,4]``: angles ``[v]`` in degrees, and distances ``[v]``."""
    # the difference of two rotation matrices has the norm sqrt(8) * sin(angle / 2)
    sines = (np.linalg.norm(end[:, :3, :3] - start[:, :3, :3], axis=(1, 2)) / np.sqrt(8)).clip(0, 1)
    distances = vector_lengths(camera_centres(end) - camera_centres(start))[:, 0]
    return np.degrees(2 * arctan2(sines, np.sqrt((1 - sines) * (1 + sines)))), distances


def vector_lengths(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths ``[...,1]`` of vectors ``[...,d]``."""
    columns = np.moveaxis(vectors * vectors, -1, 0)  # summing column by column is faster for short vectors
    return np.asarray(np.sqrt(sum(columns, vectors.dtype.type(0))))[..., None]


def find_nearest(points: np.ndarray, count: int, rows: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Find the ``count`` nearest other points of each of ``rows [m]``; return rows and distances ``[m,count]``.

    The nearest point comes first. There must be more than ``count`` points ``[n,3]``, all finite. If ``rows`` is None,
    the neighbours of all points are found.
    """
    rows = np.arange(len(points)) if rows is None else rows
    others = np.ones(len(points), bool)
    others[rows] = False
    order = np.concatenate([rows, np.flatnonzero(others)])  # the given rows come first
    points, neighbours = points[order].astype(np.float64), np.empty((len(points), count), np.int64)
    tree, axes, splits = make_tree(points)
    no_view = np.full(len(points), -1)  # all points may be neighbours of points without a view
    distances = np.empty((len(rows), count))

    def search(start: int) -> None:
        """Find the neighbours of a part of the given rows, and their distances."""
        part = slice(start, min(start + NEAREST_ROWS, len(rows)))
        nearest_of_others(
            points, no_view, order=tree, axes=axes, splits=splits, first=part.start, last=part.stop, most=len(points),
            out=neighbours,
        )  # fmt: skip
        distances[part] = np.sqrt(((points[neighbours[part]] - points[part, None]) ** 2).sum(2))

    with use_threads():
        parallel_map(search, range(0, len(rows), NEAREST_ROWS))
    return order[neighbours[: len(rows)]], distances


def nearest_views(centres: np.ndarray, view: int) -> np.ndarray:
    """Return the other views ``[v-1]`` of cameras with ``centres [v,3]``, ordered by their distance from ``view``."""
    order = np.argsort(((centres - centres[view]) ** 2).sum(1), kind="stable")
    return order[order != view]


def camera_distances(cameras: Cameras) -> np.ndarray:
    """Return distances ``[v,v]`` of cameras: the distance of centres plus the distance of unit viewing directions."""
    viewmats = cameras.viewmats.astype(np.float64)
    centres_and_directions = (camera_centres(viewmats), viewmats[:, 2, :3])
    differences = [vectors[:, None] - vectors[None] for vectors in centres_and_directions]
    return np.asarray(sum(np.sqrt((difference * difference).sum(-1)) for difference in differences))


def order_others(distances: np.ndarray) -> np.ndarray:
    """Return the other views ``[v,v-1]`` of each view by their distances ``[v,v]``, the nearest first."""
    ordered = distances.copy()
    np.fill_diagonal(ordered, -1)  # so that each view comes first in its own order
    return np.argsort(ordered, axis=1, kind="stable")[:, 1:]


def median(values: np.ndarray) -> float:
    """Return the median of all ``values``; NaN if there are no values, or if a value is NaN.

    The function is several times as fast as ``np.median``.
    """
    values = values.reshape(-1)
    if len(values) > FEW_VALUES and not np.isnan(values.min()):
        sample = np.sort(values[:: len(values) // SAMPLE_VALUES])
        low, high = sample[[int(share * (len(sample) - 1)) for share in AROUND_MEDIAN]]
        near = values[(values >= low) & (values <= high)]
        num_lower = int(np.count_nonzero(values < low))
        middle = len(values) // 2 - num_lower  # index of the median in the ordered values of `near`
        if 0 < middle < len(near):
            ordered = np.partition(near, (middle - 1, middle))
            return float(ordered[middle] if len(values) % 2 else (ordered[middle - 1] + ordered[middle]) / 2)
    return float(medians(values)) if len(values) else math.nan


def medians(values: np.ndarray) -> np.ndarray:
    """Return the median of each column of ``[n,...]`` rows, n >= 1; NaN if a value of the column is NaN."""
    middle = len(values) // 2
    ordered = np.partition(values, (max(0, middle - 1), middle, -1), axis=0)  # NaN are last
    result = ordered[middle] if len(values) % 2 else (ordered[middle - 1] + ordered[middle]) / 2
    return np.asarray(np.where(np.isnan(ordered[-1]), ordered[-1], result))


def quantiles(values: np.ndarray, shares: Sequence[float]) -> np.ndarray:
    """Return the quantiles ``[s,...]`` of each column of ``[n,...]`` rows, n >= 1, interpolated as by ``np.quantile``.

    ``shares [s]`` are from 0 to 1. No value may be NaN.
    """
    places = (len(values) - 1) * np.array(shares, np.float64)
    before = np.floor(places).astype(np.int64)
    after = np.minimum(before + 1, len(values) - 1)
    ordered = np.partition(values, [*before, *after], axis=0)
    low = ordered[before]
    high = ordered[after]
    steps = (places - before).reshape(-1, *[1] * (values.ndim - 1))
    # start from the nearer of two values, so that results are rounded as by np.quantile
    return np.where(steps < 0.5, low + (high - low) * steps, high - (high - low) * (1 - steps))


def lower_median(values: np.ndarray) -> np.ndarray:
    """Return the median of each column of ``[n,...]`` rows, n >= 1; the lower middle value if n is even."""
    middle = (len(values) - 1) // 2
    return np.partition(values, middle, axis=0)[middle]


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return Pearson's correlation of two rows of numbers ``[n]``."""
    a, b = (values - values.mean() for values in (a.astype(np.float64), b.astype(np.float64)))
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum()))


def morton_codes(points: np.ndarray) -> np.ndarray:
    """Return Morton codes ``[n]`` int64 of points ``[n,3]``, by which they are ordered along a space-filling curve."""
    codes = np.zeros(len(points), np.int64)
    if len(points) == 0:
        return codes
    low = points.min(0)
    high = points.max(0)
    axis_bits = 21  # bits for each axis; three axes fit into 63 bits
    steps = (points - low) / np.maximum(high - low, 1e-30) * (2**axis_bits - 1)
    for axis, column in enumerate(steps.astype(np.int64).T):
        for bit in range(axis_bits):
            codes |= (column >> bit & 1) << (3 * bit + axis)
    return codes


def rotate_harmonics(shN: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Rotate spherical harmonics ``[n,k-1,3]`` by ``rotation [3,3]``, as their Gaussians rotate."""
    num = shN.shape[1]
    if num == 0 or len(shN) == 0:
        return shN
    return apply_harmonics_rotation(shN, harmonics_rotation(num, rotation))


def harmonics_rotation(num: int, rotation: np.ndarray) -> np.ndarray:
    """Return the matrix ``[num,num]`` that rotates ``num`` harmonics; see :func:`apply_harmonics_rotation`.

    The matrix is fitted to colours in directions before and after the rotation. The fit is exact.
    """
    directions = normalize(np.random.default_rng(0).normal(size=(SH_DIRECTIONS, 3)))
    before = evaluate_harmonics(matmul(directions, rotation), num)
    after = evaluate_harmonics(directions, num)
    return solve(matmul(after.T, after), matmul(after.T, before))


def apply_harmonics_rotation(shN: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Rotate harmonics ``[n,k-1,3]`` by a ``matrix [k-1,k-1]`` of :func:`harmonics_rotation`."""
    rows = matmul(shN.swapaxes(1, 2).reshape(-1, len(matrix)), matrix.T)
    return np.ascontiguousarray(rows.reshape(-1, 3, len(matrix)).swapaxes(1, 2), shN.dtype)


def evaluate_harmonics(directions: np.ndarray, num: int) -> np.ndarray:
    """Evaluate the higher harmonics in directions ``[d,3]``; return ``[d,num]`` float64.

    A harmonic is evaluated as the change of colour that it gives a Gaussian in the kernel for drawing.
    """
    means = directions.astype(np.float32)
    count = len(means)
    sh0 = np.full((count, 1, 3), BRIGHT_SH0)
    ids = np.arange(count, dtype=np.int32)
    degree0_colors = np.empty((count, 3), np.float32)
    colors = np.empty((count, 3), np.float32)
    eye = np.zeros(3, np.float32)
    view_colors(means, sh0, np.zeros((count, num, 3), np.float32), ids, eye, 0, count, degree0_colors)
    columns = []
    for harmonic in range(num):
        shN = np.zeros((count, num, 3), np.float32)
        shN[:, harmonic] = 1
        view_colors(means, sh0, shN, ids, eye, 0, count, colors)
        columns.append((colors - degree0_colors)[:, 0].astype(np.float64))
    return np.stack(columns, 1)


def sh0_to_rgb(sh0: np.ndarray) -> np.ndarray:
    """Return the base colours (sRGB) of harmonics of degree 0; colours outside [0, 1] cannot be displayed."""
    return 0.5 + SH_C0 * sh0


def rgb_to_sh0(rgb: np.ndarray) -> np.ndarray:
    """Return the harmonics of degree 0 of base colours, the inverse of :func:`sh0_to_rgb`."""
    return (rgb - 0.5) / SH_C0


def robust_weights(errors: np.ndarray, multiple: float, least: float, units: np.ndarray | float = 1.0) -> np.ndarray:
    """Return Cauchy's weights ``[n]`` for reweighted least squares, which are small for errors far above the median.

    The weights are ``1 / (units^2 (1 + (errors / limit)^2))`` with ``limit = multiple * median + least``. Each residual
    counts as a multiple of its unit in ``units``.
    """
    return np.asarray(1 / (units**2 * (1 + (errors / (multiple * median(errors) + least)) ** 2)))


@dataclass(frozen=True)
class Damping:
    """Limits of the steps of :func:`descend`, and how the damping of steps changes."""

    steps: int  # Largest number of steps
    first: float  # Damping of the first step, a share of the curvature
    decrease: float  # Factor on the damping after a step that lowers the error
    increase: float  # Factor on the damping after a step that does not lower the error
    largest: float  # Largest damping; no step is tried with more
    min_gain: float  # Share of the error that a step must remove for another step to follow


def descend(
    start: DescentState,
    error: Callable[[DescentState], float],
    step: Callable[[DescentState, float], DescentState | None],
    damping: Damping,
) -> DescentState:
    """Take damped steps that each lower the error, by Levenberg and Marquardt's rule, and return the last state.

    ``step`` takes a state and the amount of damping, and returns the next state, or None if the step fails.
    """
    state = start
    amount = damping.first
    least_error = error(state)
    for _ in range(damping.steps):
        trial = step(state, amount)
        if trial is None:
            break
        trial_error = error(trial)
        if not trial_error < least_error:
            amount *= damping.increase
            if amount > damping.largest:
                break
            continue
        gain = 1 - trial_error / least_error
        state = trial
        least_error = trial_error
        if gain < damping.min_gain:
            break
        amount *= damping.decrease
    return state


@dataclass(frozen=True, eq=False)
class Similarity:
    """A map from a frame of cameras to a frame of Gaussians: ``x_gaussians = scale * rotation @ x_cameras + shift``."""

    rotation: np.ndarray  # [3,3]
    scale: float  # Positive
    shift: np.ndarray  # [3] in units of the Gaussians
    description: str = ""  # Text for people; empty if both frames are the same

    def move_points(self, points: np.ndarray) -> np.ndarray:
        """Move points ``[n,3]`` or ``[3]`` into the frame of the Gaussians."""
        return np.asarray(self.scale * matmul(points, self.rotation.T) + self.shift)

    def move_gaussians(self, g: Gaussians) -> Gaussians:
        """Move Gaussians, with their harmonics, from the frame of cameras into the frame of Gaussians."""
        return Gaussians(
            means=self.move_points(g.means).astype(g.means.dtype),
            quats=multiply_quats(rotmat_to_quat(self.rotation[None])[0], g.quats).astype(g.quats.dtype),
            scales=(self.scale * g.scales).astype(g.scales.dtype),
            opacities=g.opacities,
            sh0=g.sh0,
            shN=rotate_harmonics(g.shN, self.rotation),
        )

    def move_viewmats(self, viewmats: np.ndarray) -> np.ndarray:
        """Move world-to-camera matrices ``[c,4,4]`` into the frame of the Gaussians."""
        out = viewmats.copy()
        out[:, :3, :3] = matmul(viewmats[:, :3, :3], self.rotation.T)
        out[:, :3, 3] = self.scale * viewmats[:, :3, 3] - matmul(out[:, :3, :3], self.shift)
        return out

    def move_cameras(self, cameras: Cameras) -> Cameras:
        """Move cameras into the frame of the Gaussians."""
        return replace(cameras, viewmats=self.move_viewmats(cameras.viewmats))


IDENTITY = Similarity(np.eye(3), 1.0, np.zeros(3))


def move_region(region: Region, origin: np.ndarray, unit: float) -> Region:
    """Return a region in a frame with another origin and unit, whose positions are stored in float32."""
    middle = (region.middle - origin) / unit
    half = region.half / unit
    float32_rounding = float(np.finfo(np.float32).eps) * float(np.abs(middle).max() + half.max())
    return replace(region, middle=middle, half=half, rounding=region.rounding / unit + float32_rounding)


def lies_inside(region: Region, points: np.ndarray) -> np.ndarray:
    """Return a mask ``[n]`` of the ``points [n,3]`` inside a region, border included."""
    local = matmul(points - region.middle, region.axes.T)
    # distance by which rounding may move points on the border
    tolerance = 4 * float(np.finfo(np.float64).eps) * (np.abs(region.middle).max() + region.half.max())
    if region.is_sphere:
        return np.asarray(np.square(local).sum(1) <= (region.half[0] + tolerance) ** 2)
    return np.asarray((np.abs(local) <= region.half + tolerance).all(1))


def clamp_inside(region: Region, points: np.ndarray) -> np.ndarray:
    """Return ``points [n,3]`` in float64, where points outside a region are moved to its border."""
    local = matmul(points - region.middle, region.axes.T)
    # sides a little smaller than the region's, so that points are still inside after they are rounded
    half = np.maximum(region.half - region.rounding, region.half / 2)
    if region.is_sphere:
        lengths = np.sqrt(np.square(local).sum(1, keepdims=True))
        local *= np.minimum(1.0, half[0] / np.maximum(lengths, half[0]))
    else:
        local = np.clip(local, -half, half)
    return np.asarray(region.middle + matmul(local, region.axes))


def fit_similarity(start: np.ndarray, end: np.ndarray, scale: float = 1.0) -> Similarity:
    """Fit the similarity that maps cameras ``start [c,4,4]`` (world to camera) to ``end``, by least squares.

    If all cameras stand in one place, which does not determine the scale, ``scale`` is used.
    """
    rotation = closest_rotation(matmul(end[:, :3, :3].swapaxes(1, 2), start[:, :3, :3]).sum(0))
    a = matmul(camera_centres(start), rotation.T)
    b = camera_centres(end)
    a_offsets = a - a.mean(0)
    b_offsets = b - b.mean(0)
    spread = float((a_offsets**2).sum())
    if spread > 1e-12 * max(float((a**2).sum()), 1e-300) and len(end) > 1:
        scale = float((a_offsets * b_offsets).sum()) / spread
    return Similarity(rotation, scale, b.mean(0) - scale * a.mean(0))


def mean_pose_frame(viewmats: np.ndarray) -> Similarity:
    """Return the similarity into the mean pose of cameras ``[c,4,4]``, with all centres within +-1, as in Long-LRM."""
    down = viewmats[:, 1, :3].mean(0)
    forward = normalize(viewmats[:, 2, :3].mean(0)).astype(np.float64)
    down = normalize(down - (down * forward).sum() * forward)  # now perpendicular to `forward`
    rotation = np.stack([np.cross(down, forward), down, forward])
    centres = camera_centres(viewmats)
    shift = -matmul(rotation, centres.mean(0))
    farthest = float(np.abs(matmul(centres, rotation.T) + shift).max())
    scale = 1 / farthest if farthest > 0 else 1.0
    text = "moved into their mean pose and scaled to lie within 1"
    return Similarity(rotation, scale, scale * shift, text)
