"""Solve for the poses of cameras, and for their intrinsics, from points and the pixels that show them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from gsmerge.geometry import Damping, descend, motion_matrices, robust_weights
from gsmerge.kernels import reproject
from gsmerge.kernels.matrices import eigh, matmul, solve

DAMPING = Damping(steps=30, first=1e-3, ease=0.1, brake=10.0, most=1e8, min_gain=1e-10)
MAX_STRETCH = 0.5  # of the focal length, in a step
ONE_FOCAL, TWO_FOCALS, ALL_INTRINSICS = 1, 2, 4  # numbers of the intrinsics: fx = fy; fx, fy; fx, fy, cx, cy
_Fit = tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray, float]]  # intrinsics, poses, equations
MIN_POINTS = 24  # fewer fit any camera
_FLAT = 1e-10  # of the largest second moment: an axis along which points do not differ
_PROJECTIVE_ROUNDS = 8  # of reweighted least squares
_SMALLEST_ERROR = 1e-6  # of the pixels' spread


def start_pose(points: np.ndarray, pixels: np.ndarray, K: np.ndarray) -> np.ndarray | None:
    """Solve for the pose ``[4,4]``, world to camera, that shows points ``[n,3]`` at ``pixels [n,2]``; None if it fails.

    Uses SQPnP (Terzakis and Lourakis 2020), which is close to the optimum. Needs at least three points, which should
    lie near zero.
    """
    try:
        solved, rotation, shift = cv2.solvePnP(points, pixels, K, None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:  # points in one place
        return None
    return motion_matrices(np.concatenate([rotation, shift]).T)[0] if solved else None


def projection_errors(points: np.ndarray, pixels: np.ndarray, K: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Measure the distances ``[n]`` of projected points ``[n,3]`` from their ``pixels [n,2]``, pixels."""
    places = matmul(matmul(points, pose[:3, :3].T) + pose[:3, 3], K.T)
    with np.errstate(all="ignore"):
        return np.asarray(np.linalg.norm(places[:, :2] / places[:, 2:] - pixels, axis=1))


def refine_poses(
    points: Sequence[np.ndarray], pixels: Sequence[np.ndarray], K: np.ndarray, poses: np.ndarray, *, free: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Refine poses by least squares so that points ``[n,3]`` of each view project to their ``pixels [n,2]``.

    Also solves for common intrinsics of the views, as many as ``free`` says: ONE_FOCAL, TWO_FOCALS or ALL_INTRINSICS.
    Returns intrinsics ``[3,3]`` and poses ``[v,4,4]``. Raises numpy.linalg.LinAlgError if the points do not determine
    them.
    """

    def fit(near_K: np.ndarray, near: np.ndarray) -> _Fit:
        return near_K, near, _linearise(points, pixels, near_K, near, free)

    def step(state: _Fit, damping: float) -> _Fit:
        current_K, current_poses, (curvature, slope, _) = state
        with np.errstate(all="ignore"):  # a step beyond all numbers has no less error
            change, motions = _step(curvature, slope, damping)
            return fit(_change_intrinsics(current_K, change), matmul(motion_matrices(motions), current_poses))

    K, poses, _ = descend(fit(K, poses), lambda state: state[2][2], step, DAMPING)
    return K, poses


def _linearise(
    points: Sequence[np.ndarray], pixels: Sequence[np.ndarray], K: np.ndarray, poses: np.ndarray, free: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return Gauss-Newton's curvature ``[v,6+f,6+f]`` and slope ``[v,6+f]`` of the squared error, and the error.

    The parameters are rotation and shift of each camera, the logarithms of focal lengths, and the principal point.
    """
    size = 6 + free
    curvature, slope, error = np.empty((len(poses), size, size)), np.empty((len(poses), size)), 0.0
    for view, pose in enumerate(poses):
        jacobian, residual = np.empty((2 * len(points[view]), size)), np.empty(2 * len(points[view]))
        values = (np.ascontiguousarray(array, np.float64) for array in (points[view], pixels[view], K, pose))
        reproject.linearise(*values, jacobian, residual)
        with np.errstate(all="ignore"):  # points in the camera's plane
            curvature[view], slope[view] = matmul(jacobian.T, jacobian), matmul(jacobian.T, residual)
            error += float((residual * residual).sum())
    return curvature, slope, error


def _step(curvature: np.ndarray, slope: np.ndarray, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Return changes ``[f]`` of the common intrinsics and motions ``[v,6]`` of the cameras."""
    size = curvature.shape[1]
    damped = curvature + damping * np.eye(size) * curvature
    down, across = slope[:, :6, None], damped[:, :6, 6:]
    if size == 6:
        return np.empty(0), -solve(damped, down)[..., 0]
    solved = solve(damped[:, :6, :6], np.concatenate([down, across], 2))  # the cameras' unknowns are eliminated
    whole = np.concatenate([slope[:, 6:, None], damped[:, 6:, 6:]], 2)
    reduced = (whole - matmul(across.swapaxes(1, 2), solved)).sum(0)
    change = -solve(reduced[:, 1:], reduced[:, 0])
    change[:TWO_FOCALS] = change[:TWO_FOCALS].clip(-MAX_STRETCH, MAX_STRETCH)
    return change, -solved[..., 0] - matmul(solved[..., 1:], change)


def _change_intrinsics(K: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Apply changes of the logarithms of focal lengths and of the principal point; see :func:`_linearise`."""
    K = K.copy()
    if len(change):
        K[(0, 1), (0, 1)] *= 1 + change[:TWO_FOCALS]
        K[:2, 2] += change[TWO_FOCALS:] if len(change) == ALL_INTRINSICS else 0
    return K


def focal_uncertainty(
    points: Sequence[np.ndarray], pixels: Sequence[np.ndarray], Ks: np.ndarray, poses: np.ndarray
) -> float:
    """Estimate the relative standard error of a focal length for pixel errors of one; inf for points in a plane.

    ``points [n,3]`` and ``pixels [n,2]`` are given for each view. The error is that of one focal length for all views.
    """
    weight = 0.0
    for p, q, K, pose in zip(points, pixels, Ks, poses, strict=True):
        (curvature,), _, _ = _linearise([p], [q], K, pose[None], ONE_FOCAL)
        try:
            explained = matmul(curvature[6, :6], solve(curvature[:6, :6], curvature[:6, 6]))
        except np.linalg.LinAlgError:  # points in one place
            continue
        weight += float(curvature[6, 6] - explained)
    return 1 / math.sqrt(weight) if weight > 0 else math.inf


def projective_error(points: np.ndarray, pixels: np.ndarray) -> float:
    """Measure the median distance of points ``[n,3]`` from ``pixels [n,2]`` under the best projective camera, pixels.

    0 if there are too few points to decide.
    """
    return 0.0 if len(points) < MIN_POINTS else projective_camera(points, pixels)[1]


def projective_camera(points: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, float]:
    """Solve for the projective camera ``[3,4]`` that shows points ``[n,3]`` nearest to their ``pixels [n,2]``.

    Any matrix is one. It is solved by the direct linear transform with reweighting (Hartley and Zisserman 2004, section
    7.1). Also returns the median distance from the pixels.
    """
    middle = np.median(points, 0)
    unit = float(np.median(np.abs(points - middle))) or 1.0
    near = np.concatenate([(points - middle) / unit, np.ones((len(points), 1))], 1)
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    values, axes = eigh(matmul(near.T, near))
    used = values > _FLAT * values[-1]  # of points in a plane or in a line, other axes say nothing
    basis = axes[:, used] / np.sqrt(values[used])
    near = matmul(near, basis)
    centre, size = pixels.mean(0), float(pixels.std()) or 1.0
    wanted = (pixels - centre) / size
    zero = np.zeros_like(near)
    across = np.concatenate([near, zero, -wanted[:, :1] * near], 1)
    down = np.concatenate([zero, near, -wanted[:, 1:] * near], 1)
    weights = np.ones(len(points))
    camera, error = np.zeros((3, near.shape[1])), np.full(len(points), np.inf)
    for _ in range(_PROJECTIVE_ROUNDS):
        heavy = np.concatenate([across * weights[:, None], down * weights[:, None]])
        camera = eigh(matmul(heavy.T, heavy))[1][:, 0].reshape(3, -1)
        places = matmul(near, camera.T)
        with np.errstate(all="ignore"):
            error = np.linalg.norm(places[:, :2] / places[:, 2:] - wanted, axis=1)
            error = np.where(np.isfinite(error), error, np.inf)
            weights = np.sqrt(robust_weights(error, 2, _SMALLEST_ERROR, np.abs(places[:, 2]) + _SMALLEST_ERROR))
    camera = matmul(camera, basis.T)
    camera[:2] = size * camera[:2] + centre[:, None] * camera[2]
    camera[:, :3] /= unit
    camera[:, 3] -= matmul(camera[:, :3], middle)
    return camera, size * float(np.median(error))
