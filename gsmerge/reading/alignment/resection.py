"""Solve for the poses and intrinsics of cameras from points and their pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from gsmerge.method.geometry.transforms import Damping, descend, median, medians, motion_matrices, robust_weights
from gsmerge.method.kernels import reproject
from gsmerge.method.kernels.matrices import eigh, matmul, solve

POSE_DAMPING = Damping(steps=30, first=1e-3, decrease=0.1, increase=10.0, largest=1e8, min_gain=1e-10)
# Numbers of intrinsics that are solved for: fx = fy; or fx and fy; or fx, fy, cx and cy
ONE_FOCAL = 1
TWO_FOCALS = 2
ALL_INTRINSICS = 4
# Intrinsics, poses, and their curvature, slope and squared error; see _linearise
_PoseFit = tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray, float]]


def start_pose(points: np.ndarray, pixels: np.ndarray, K: np.ndarray) -> np.ndarray | None:
    """Solve for the pose ``[4,4]``, world to camera, that shows points ``[n,3]`` at ``pixels [n,2]``; None on failure.

    ``K [3,3]`` are the intrinsics. The solution of SQPnP (Terzakis and Lourakis 2020) is close to the optimum. At least
    three points are needed. Points should lie near the origin.
    """
    try:
        solved, rotation, shift = cv2.solvePnP(points, pixels, K, None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:  # all points coincide
        return None
    return motion_matrices(np.concatenate([rotation, shift]).T)[0] if solved else None


def projection_errors(points: np.ndarray, pixels: np.ndarray, K: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Measure the distances ``[n]`` of projected points ``[n,3]`` from their ``pixels [n,2]``, pixels."""
    projected = matmul(matmul(points, pose[:3, :3].T) + pose[:3, 3], K.T)
    with np.errstate(all="ignore"):
        return np.asarray(np.linalg.norm(projected[:, :2] / projected[:, 2:] - pixels, axis=1))


def refine_poses(
    points: Sequence[np.ndarray], pixels: Sequence[np.ndarray], K: np.ndarray, poses: np.ndarray, *, free: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Refine poses by least squares so that points ``[n,3]`` of each view project to their ``pixels [n,2]``.

    The search begins at ``K [3,3]`` and ``poses [v,4,4]``. ``free`` is the number of intrinsics that are also solved
    for: 0, ONE_FOCAL, TWO_FOCALS or ALL_INTRINSICS. Intrinsics are common to all views. Returns intrinsics ``[3,3]``
    and poses ``[v,4,4]``. Raises numpy.linalg.LinAlgError if the points do not determine poses and intrinsics.
    """

    def linearise(new_K: np.ndarray, new_poses: np.ndarray) -> _PoseFit:
        return new_K, new_poses, _linearise(points, pixels, new_K, new_poses, free)

    def step(state: _PoseFit, damping: float) -> _PoseFit:
        """Return the fit after one damped Gauss-Newton step."""
        current_K, current_poses, (curvature, slope, _) = state
        with np.errstate(all="ignore"):  # an overflowing step does not reduce the error, so it is rejected
            change, motions = _solve_normal_equations(curvature, slope, damping)
            new_K = current_K.copy()
            if free:
                new_K[(0, 1), (0, 1)] *= 1 + change[:TWO_FOCALS]  # if one focal length is free, it counts for both
                new_K[:2, 2] += change[TWO_FOCALS:] if free == ALL_INTRINSICS else 0
            return linearise(new_K, matmul(motion_matrices(motions), current_poses))

    K, poses, _ = descend(linearise(K, poses), lambda fit: fit[2][2], step, POSE_DAMPING)  # [2][2]: the squared error
    return K, poses


def _linearise(
    points: Sequence[np.ndarray], pixels: Sequence[np.ndarray], K: np.ndarray, poses: np.ndarray, free: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return Gauss-Newton's curvature ``[v,6+f,6+f]`` and slope ``[v,6+f]`` of the squared error, and this error.

    The cameras are ``K [3,3]`` and ``poses [v,4,4]``. The first 6 parameters are rotation and shift of a view's camera.
    The other f = ``free`` parameters are logarithms of focal lengths, and then the principal point.
    """
    size = 6 + free
    curvature = np.empty((len(poses), size, size))
    slope = np.empty((len(poses), size))
    error = 0.0
    for view, pose in enumerate(poses):
        jacobian = np.empty((2 * len(points[view]), size))
        residual = np.empty(2 * len(points[view]))
        inputs = (np.ascontiguousarray(array, np.float64) for array in (points[view], pixels[view], K, pose))
        reproject.linearise(*inputs, jacobian, residual)  # fills `jacobian` and `residual`
        with np.errstate(all="ignore"):  # points in the plane of the camera overflow
            curvature[view], slope[view] = matmul(jacobian.T, jacobian), matmul(jacobian.T, residual)
            error += float((residual * residual).sum())
    return curvature, slope, error


def _solve_normal_equations(curvature: np.ndarray, slope: np.ndarray, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Solve for the changes ``[f]`` of the common intrinsics and the motions ``[v,6]`` of the cameras.

    ``curvature`` and ``slope`` are results of :func:`_linearise`.
    """
    size = curvature.shape[1]
    damped = curvature + damping * np.eye(size) * curvature
    pose_slope = slope[:, :6, None]
    mixed = damped[:, :6, 6:]
    if size == 6:  # no intrinsics are free, so each view has a solution of its own
        return np.empty(0), -solve(damped, pose_slope)[..., 0]
    # the Schur complement eliminates the poses
    solved = solve(damped[:, :6, :6], np.concatenate([pose_slope, mixed], 2))
    of_intrinsics = np.concatenate([slope[:, 6:, None], damped[:, 6:, 6:]], 2)
    reduced = (of_intrinsics - matmul(mixed.swapaxes(1, 2), solved)).sum(0)
    change = -solve(reduced[:, 1:], reduced[:, 0])
    max_stretch = 0.5  # largest relative change of a focal length in one step
    change[:TWO_FOCALS] = change[:TWO_FOCALS].clip(-max_stretch, max_stretch)
    return change, -solved[..., 0] - matmul(solved[..., 1:], change)


def focal_uncertainty(
    points: Sequence[np.ndarray], pixels: Sequence[np.ndarray], Ks: np.ndarray, poses: np.ndarray
) -> float:
    """Estimate the relative standard error of one focal length for all views, if pixels have an error of 1 pixel.

    Each view has ``points [n,3]``, their ``pixels [n,2]``, and a camera ``Ks [3,3]``, ``poses [4,4]``. The result is
    inf for points in a plane.
    """
    information = 0.0  # inverse of the squared error
    for view_points, view_pixels, K, pose in zip(points, pixels, Ks, poses, strict=True):
        (curvature,), _, _ = _linearise([view_points], [view_pixels], K, pose[None], ONE_FOCAL)
        try:  # parameters 0 to 5 are the pose, and parameter 6 is the focal length
            explained_by_pose = matmul(curvature[6, :6], solve(curvature[:6, :6], curvature[:6, 6]))
        except np.linalg.LinAlgError:  # all points coincide
            continue
        information += float(curvature[6, 6] - explained_by_pose)
    return 1 / math.sqrt(information) if information > 0 else math.inf


def projective_error(points: np.ndarray, pixels: np.ndarray) -> float:
    """Measure the median distance of points ``[n,3]`` from ``pixels [n,2]`` under the best projective camera, pixels.

    Returns 0 for fewer points than a camera can be tested on.
    """
    min_points = 24  # with fewer points almost any projective camera fits
    return 0.0 if len(points) < min_points else projective_camera(points, pixels)[1]


def projective_camera(points: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, float]:
    """Solve for the projective camera ``[3,4]`` that shows points ``[n,3]`` nearest to their ``pixels [n,2]``.

    A projective camera is any ``[3,4]`` matrix. The matrix is solved for by the direct linear transform with
    reweighting (Hartley and Zisserman 2004, section 7.1). Also returns the median distance of the points from their
    pixels.
    """
    middle = medians(points)
    unit = median(np.abs(points - middle)) or 1.0
    # homogeneous coordinates in a basis of equal second moments
    homogeneous = np.concatenate([(points - middle) / unit, np.ones((len(points), 1))], 1)
    homogeneous /= np.linalg.norm(homogeneous, axis=1, keepdims=True)
    values, axes = eigh(matmul(homogeneous.T, homogeneous))
    # points lie in a plane across an axis if the second moment along it is below this share of the largest second
    # moment
    flatness = 1e-10
    used = values > flatness * values[-1]  # points in a plane or on a line do not determine the other axes
    basis = axes[:, used] / np.sqrt(values[used])
    local = matmul(homogeneous, basis)
    centre = pixels.mean(0)
    size = float(pixels.std()) or 1.0
    targets = (pixels - centre) / size
    zero = np.zeros_like(local)
    # for each point two linear equations of the camera, which hold if it projects to x, and to y, of its pixel
    of_x = np.concatenate([local, zero, -targets[:, :1] * local], 1)
    of_y = np.concatenate([zero, local, -targets[:, 1:] * local], 1)
    weights = np.ones(len(points))
    camera = np.zeros((3, local.shape[1]))
    error = np.full(len(points), np.inf)
    projective_rounds = 8  # number of rounds of reweighted least squares
    smallest_error = 1e-6  # added to errors and depths; unit: standard deviation of the pixels
    for _ in range(projective_rounds):
        equations = np.concatenate([of_x * weights[:, None], of_y * weights[:, None]])
        camera = eigh(matmul(equations.T, equations))[1][:, 0].reshape(3, -1)
        projected = matmul(local, camera.T)
        with np.errstate(all="ignore"):
            error = np.linalg.norm(projected[:, :2] / projected[:, 2:] - targets, axis=1)
            error = np.where(np.isfinite(error), error, np.inf)
            depth = np.abs(projected[:, 2]) + smallest_error
            weights = np.sqrt(robust_weights(error, 2, smallest_error, depth))
    camera = matmul(camera, basis.T)
    camera[:2] = size * camera[:2] + centre[:, None] * camera[2]
    camera[:, :3] /= unit
    camera[:, 3] -= matmul(camera[:, :3], middle)
    return camera, size * median(error)
