"""Solve for the frame of the Gaussians: the pose of each view, and the similarity that moves the cameras there.

If rows are pixels, they determine the pose of each view, because a Gaussian lies on the ray of its pixel:
``(x - c) x d = 0`` with the camera's centre c and the ray's direction d. The Gaussians stay in place, and the cameras
are moved.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from gsmerge.alignment.resection import projection_errors, refine_poses, start_pose
from gsmerge.alignment.score import Correspondences
from gsmerge.arrays import distinct
from gsmerge.geometry import IDENTITY, Similarity, camera_centres, mean_pose_frame, median, medians, robust_weights
from gsmerge.kernels.elementary import arccos, log
from gsmerge.kernels.matrices import closest_rotation, eigh, invert, matmul, solve_symmetric, transform
from gsmerge.types import Cameras

_ROUNDS = 4  # of reweighted least squares
_MIN_POSE_POINTS, _MAX_POINTS = 6, 2000  # least and most points that a camera's pose is solved from
_SAME_ROTATION = 0.01  # largest difference of entries of rotation matrices that count as equal
_NEAR_ROTATION = 0.2  # largest difference of entries between an exporter's rotation and the mean rotation of own poses
_MIN_AGREEMENT = 0.9  # smallest singular value of a mean rotation; it is near 1 if the rotations agree
_SMALL_ROTATION, _SMALL_SCALE = 10.0, 0.05  # degrees, and natural logarithm
_HALF = np.sqrt(0.5)
# Rotation of the world by the pixelSplat family: axes swapped, then an eighth of a turn about the last axis
UPRIGHT = np.array([[-_HALF, 0, _HALF], [-_HALF, 0, -_HALF], [0, -1, 0]])
_VIEWER = np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])  # rotation of the world by Splatter Image's demo


def scale_by(scale: float, note: str = "") -> Similarity:
    """Return the similarity that only scales."""
    text = f"positions scaled by {scale:.4g}{note}"
    return Similarity(np.eye(3), scale, np.zeros(3), text, "scaled")


def _usual_rotations(cameras: Cameras) -> tuple[tuple[np.ndarray, str, str], ...]:
    """Return the rotations of exporters, each with its description and its kind."""
    first, middle = cameras.viewmats[0, :3, :3], cameras.viewmats[len(cameras) // 2, :3, :3]
    return (
        (np.eye(3), "", ""),
        (first, "rotated into the first camera", "first"),
        (middle, "rotated into the middle camera", "middle"),
        (matmul(UPRIGHT, first), "rotated upright from the first camera", "upright"),
    )


def usual_frames(cameras: Cameras, scale: float | None = None) -> list[Similarity]:
    """List the frames of exporters in which nothing has to be solved for, the frame of the cameras first.

    ``scale`` is the length of one unit of the cameras' world in the world of the Gaussians, if known.
    """
    frames = [IDENTITY if scale is None else scale_by(scale, ", as given")]
    for rotation, name, kind in _usual_rotations(cameras)[1:]:
        frames.append(Similarity(rotation, scale or 1.0, np.zeros(3), name, kind))
    return frames if scale is not None else [*frames, mean_pose_frame(cameras.viewmats)]


def exporter_frames(cameras: Cameras, scale: float | None = None) -> list[Similarity]:
    """List the usual frames, the frames of viewers, and the frame of the first camera.

    The frame of the cameras comes first, and the frame of the first camera last.
    """
    pose, unit = cameras.viewmats[0], scale or 1.0
    origin = np.zeros(3)
    return [
        *usual_frames(cameras, scale),
        Similarity(np.diag([1.0, -1, -1]), unit, origin, "turned to y up, as .spz files are", "other"),
        Similarity(_VIEWER, unit, origin, "turned for a viewer, as by Splatter Image", "other"),
        Similarity(pose[:3, :3], unit, unit * pose[:3, 3], "moved into the first camera", "first"),
    ]


def solved_frames(
    pairs: Correspondences, cameras: Cameras, own: Mapping[int, np.ndarray], scale: float | None = None
) -> Iterator[tuple[int, Similarity]]:
    """Yield the frames that fit the ``pairs``, simple frames first; none if the views disagree on the rotation.

    The frames have an exporter's rotation with a scale, then with scale and shift, then any rotation. ``own`` are poses
    ``[4,4]`` of views in the frame of the Gaussians. Each frame comes with its effort, see :class:`ScoredLayout`.
    """
    mean = mean_rotation(own, cameras.viewmats)
    if mean is None:
        return
    rays = ray_directions(pairs, cameras)
    for rotation, name, kind in _usual_rotations(cameras):
        if np.abs(rotation - mean).max() > _NEAR_ROTATION:
            continue
        for shifted in (False, True) if scale is None else (True,):
            frame = solve_frame(pairs.points, rays, rotation, shifted=shifted)
            if frame is not None:
                text = f"positions scaled by {frame.scale:.4g}" + (" and shifted" if shifted else "")
                text = f"{name}, {text}" if name else text
                yield 1, replace(frame, description=text, kind=kind or ("shifted" if shifted else "scaled"))
    frame = solve_frame(pairs.points, rays, mean, shifted=True)
    if frame is None and len(own) == 1:  # a single view has no scale
        ((view, pose),) = own.items()
        shift = camera_centres(pose[None])[0] - matmul(mean, camera_centres(cameras.viewmats)[view])
        frame = Similarity(mean, 1.0, shift)
    if frame is not None:
        angle = np.degrees(arccos(np.clip((np.trace(frame.rotation) - 1) / 2, -1, 1)))
        if angle < _SMALL_ROTATION and abs(log(frame.scale)) < _SMALL_SCALE:
            return  # no exporter rotates so little: the cameras are inexact, and a rotation would hide that
        upright_rotations = (matmul(UPRIGHT, viewmat[:3, :3]) for viewmat in cameras.viewmats)
        is_upright = any(np.abs(rotation - mean).max() < _SAME_ROTATION for rotation in upright_rotations)
        name = "rotated upright" if is_upright else f"rotated by {angle:.1f} degrees"
        text = f"{name}, positions scaled by {frame.scale:.4g} and shifted"
        yield 2, replace(frame, description=text, kind="upright" if is_upright else "other")


def mean_rotation(own: Mapping[int, np.ndarray], viewmats: np.ndarray) -> np.ndarray | None:
    """Average the rotation from the frame of ``viewmats`` to the frame of ``own`` over views; None if they disagree.

    ``viewmats [c,4,4]`` and ``own`` are poses of the same views in two frames.
    """
    if not own:
        return None
    mean = np.mean([matmul(pose[:3, :3].T, viewmats[view, :3, :3]) for view, pose in own.items()], 0)
    squares, _ = eigh(matmul(mean.T, mean))
    return closest_rotation(mean) if squares[0] >= _MIN_AGREEMENT**2 else None


def ray_directions(pairs: Correspondences, cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Compute unit directions ``[t,3]`` and origins ``[t,3]`` of the rays of pixels in the world of the cameras."""
    ones = np.ones((len(pairs.pixels), 1))
    inverse = invert(cameras.Ks)[pairs.views]
    local = transform(inverse, np.concatenate([pairs.pixels, ones], 1))
    rays = transform(cameras.viewmats[pairs.views, :3, :3].swapaxes(1, 2), local)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), camera_centres(cameras.viewmats)[pairs.views]


def solve_frame(
    points: np.ndarray, rays_and_centres: tuple[np.ndarray, np.ndarray], rotation: np.ndarray, *, shifted: bool
) -> Similarity | None:
    """Solve robustly for the scale and shift that bring rotated and moved rays nearest to their points ``[t,3]``.

    ``rotation`` is given. Without ``shifted`` only the scale is solved for. None if the scale is not positive.
    """
    rays, centres = (matmul(vectors, rotation.T) for vectors in rays_and_centres)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    columns = [transform(across, centres)[:, :, None]] + ([across] if shifted else [])
    A, b = np.concatenate(columns, 2), transform(across, points)
    weights, solution = np.ones(len(points)), np.zeros(A.shape[2])
    for _ in range(_ROUNDS):
        weighted = (A * weights[:, None, None]).reshape(-1, A.shape[2])
        normal, target = matmul(weighted.T, A.reshape(-1, A.shape[2])), matmul(weighted.T, b.reshape(-1))
        unit = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        solution = solve_symmetric(normal / np.outer(unit, unit), target / unit) / unit
        if not np.isfinite(solution).all() or solution[0] <= 0:
            return None
        shift = solution[1:] if shifted else np.zeros(3)
        from_centres = points - solution[0] * centres - shift
        depth = np.abs((from_centres * rays).sum(1)) + 1e-12
        angle = np.linalg.norm(transform(across, from_centres), axis=1) / depth
        weights = robust_weights(angle, 3, 1e-12, depth)
    return Similarity(rotation, float(solution[0]), shift)


def own_poses(pairs: Correspondences, Ks: np.ndarray) -> dict[int, np.ndarray]:
    """Solve for the pose ``[4,4]`` of each view from its own pixels only; leave out views where that fails."""
    poses = ((int(view), solve_pose(pairs, int(view), Ks[view])) for view in distinct(pairs.views))
    return {view: pose for view, pose in poses if pose is not None}


def solve_pose(pairs: Correspondences, view: int, K: np.ndarray) -> np.ndarray | None:
    """Solve for the world-to-camera matrix ``[4,4]`` of a view from its own pixels; None if that fails."""
    rows = np.flatnonzero(pairs.views == view)
    rows = rows[:: max(1, len(rows) // _MAX_POINTS)]
    if len(rows) < _MIN_POSE_POINTS:
        return None
    points, pixels = pairs.points[rows], pairs.pixels[rows]
    middle = medians(points)
    unit = median(np.abs(points - middle)) or 1.0
    points, K = (points - middle) / unit, K.astype(np.float64)
    for _ in range(2):  # the second time without points far from their pixels
        start = start_pose(points, pixels, K)
        if start is None:
            return None
        pose = start
        errors = projection_errors(points, pixels, K, pose)
        is_near = errors <= max(1.0, 3 * median(errors))
        points, pixels = points[is_near], pixels[is_near]
    try:
        _, (pose,) = refine_poses([points], [pixels], K, pose[None])
    except np.linalg.LinAlgError:  # points in one place
        return None
    pose[:3, 3] = unit * pose[:3, 3] - matmul(pose[:3, :3], middle)
    return pose if np.isfinite(pose).all() else None
