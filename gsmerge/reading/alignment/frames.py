"""Solve for the frame of the Gaussians: each view's pose in this frame, and the similarity that moves cameras to it.

Rows that are pixels determine the pose of each view, because a Gaussian lies on the ray of its pixel. The Gaussian's
mean m satisfies ``cross(m - c, d) = 0`` with the camera's centre c and the ray's direction d. The Gaussians stay in
place, and the cameras are moved.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product

import numpy as np

from gsmerge.method.geometry.transforms import (
    IDENTITY,
    Similarity,
    camera_centres,
    fit_similarity,
    mean_pose_frame,
    median,
    medians,
    robust_weights,
)
from gsmerge.method.kernels.elementary import arccos
from gsmerge.method.kernels.matrices import determinant, invert, matmul, solve_symmetric, transform
from gsmerge.reading.alignment.resection import projection_errors, refine_poses, start_pose
from gsmerge.reading.alignment.score import Correspondences
from gsmerge.types import Cameras

_ROUNDS = 4  # number of rounds of reweighted least squares
_HALF = np.sqrt(0.5)
# Rotation of the world by exporters of the pixelSplat family: axes are swapped, and then turned by 45 degrees about the
# last axis
UPRIGHT = np.array([[-_HALF, 0, _HALF], [-_HALF, 0, -_HALF], [0, -1, 0]])
_VIEWER = np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])  # rotation of the world by Splatter Image's demo


def scale_by(scale: float, note: str = "") -> Similarity:
    """Return a similarity that only scales. ``note`` is added to the description of the similarity."""
    text = f"positions scaled by {scale:.4g}{note}"
    return Similarity(np.eye(3), scale, np.zeros(3), text)


def exporter_frames(cameras: Cameras, scale: float | None = None) -> list[Similarity]:
    """List the frames of exporters and viewers that follow from the cameras, as similarities from the cameras' frame.

    The frame of the cameras itself comes first, and the frame of the first camera last. ``scale`` is the length of one
    unit of the cameras' world in the world of the Gaussians, if it is known.
    """
    unit = scale or 1.0
    first = cameras.viewmats[0]
    middle = cameras.viewmats[len(cameras) // 2]
    rotations = (
        (first[:3, :3], "rotated into the first camera"),
        (middle[:3, :3], "rotated into the middle camera"),
        (matmul(UPRIGHT, first[:3, :3]), "rotated upright from the first camera"),
        (np.diag([1.0, -1, -1]), "turned to y up, as .spz files are"),
        (_VIEWER, "turned for a viewer, as by Splatter Image"),
    )
    return [
        IDENTITY if scale is None else scale_by(scale, ", as given"),
        *(Similarity(rotation, unit, np.zeros(3), name) for rotation, name in rotations),
        *([mean_pose_frame(cameras.viewmats)] if scale is None else []),
        Similarity(first[:3, :3], unit, unit * first[:3, 3], "moved into the first camera"),
    ]


def axis_turns() -> list[Similarity]:
    """List the 23 turns of the world that put each axis onto an axis, as from y up to z up, or as nerfstudio's."""
    turns = list[Similarity]()
    for axes in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            rotation = np.eye(3)[list(axes)] * np.array(signs)[:, None]
            name = ", ".join(("" if sign > 0 else "-") + "xyz"[axis] for axis, sign in zip(axes, signs, strict=True))
            if determinant(rotation) > 0:
                turns.append(Similarity(rotation, 1.0, np.zeros(3), f"turned from axes x, y, z to {name}"))
    return turns[1:]


def fit_frame(cameras: Cameras, poses: np.ndarray, scale: float | None) -> Similarity:
    """Fit the similarity that moves cameras to ``poses [c,4,4]``, with a description in words.

    If all cameras stand in one place, they do not determine the scale, and ``scale`` is used, or 1 if ``scale`` is
    None.
    """
    return describe_frame(fit_similarity(cameras.viewmats, poses, scale or 1.0))


def describe_frame(frame: Similarity) -> Similarity:
    """Return a similarity with a description in words, which leaves out what the similarity does not change."""
    angle = f"{np.degrees(arccos(np.clip((np.trace(frame.rotation) - 1) / 2, -1, 1))):.1f}"
    scale = f"{frame.scale:.4g}"
    text = "moved" if angle == "0.0" else f"rotated by {angle} degrees"
    moves = [] if scale == "1" else [f"scaled by {scale}"]
    same_place = 1e-4  # shifts are errors below it, in units of the cameras' world
    if np.abs(frame.shift).max() > same_place * frame.scale:
        moves.append(f"shifted by {', '.join(f'{value:.4g}' for value in frame.shift)}")
    return replace(frame, description=f"{text}, positions {' and '.join(moves)}" if moves else text)


def ray_directions(pairs: Correspondences, cameras: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Compute unit directions ``[t,3]`` and origins ``[t,3]`` of the rays of pixels in the world of the cameras."""
    ones = np.ones((len(pairs.pixels), 1))
    inverse = invert(cameras.Ks)[pairs.views]
    local = transform(inverse, np.concatenate([pairs.pixels, ones], 1))
    rays = transform(cameras.viewmats[pairs.views, :3, :3].swapaxes(1, 2), local)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), camera_centres(cameras.viewmats)[pairs.views]


def solve_frame(
    points: np.ndarray, rays_and_centres: tuple[np.ndarray, np.ndarray], rotation: np.ndarray
) -> Similarity | None:
    """Solve robustly for the frame in which rays pass nearest to their ``points [t,3]``.

    The ``rotation`` of the frame is known, so only scale and shift are solved for. ``rays_and_centres`` are the two
    results of :func:`ray_directions`. Returns None if the scale would not be positive.
    """
    rays, centres = (matmul(vectors, rotation.T) for vectors in rays_and_centres)
    # Linear equations of scale and shift: a point and its camera's centre have one projection onto the plane across the
    # ray
    projections = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    columns = [transform(projections, centres)[:, :, None], projections]
    A = np.concatenate(columns, 2)
    b = transform(projections, points)
    weights = np.ones(len(points))
    solution = np.zeros(A.shape[2])
    for _ in range(_ROUNDS):
        weighted = (A * weights[:, None, None]).reshape(-1, A.shape[2])
        normal = matmul(weighted.T, A.reshape(-1, A.shape[2]))
        target = matmul(weighted.T, b.reshape(-1))
        unit = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        solution = solve_symmetric(normal / np.outer(unit, unit), target / unit) / unit
        if not np.isfinite(solution).all() or solution[0] <= 0:
            return None
        scale = solution[0]
        shift = solution[1:]
        from_centres = points - scale * centres - shift
        depth = np.abs((from_centres * rays).sum(1)) + 1e-12
        angle = np.linalg.norm(transform(projections, from_centres), axis=1) / depth
        weights = robust_weights(angle, 3, 1e-12, depth)
    return Similarity(rotation, float(scale), shift)


def solve_pose(pairs: Correspondences, view: int, K: np.ndarray) -> np.ndarray | None:
    """Solve for the world-to-camera matrix ``[4,4]`` of a view from its own pixels; None if that fails."""
    rows = np.flatnonzero(pairs.views == view)
    # least and most points that a camera's pose is solved from
    min_points = 6
    max_points = 2000
    rows = rows[:: max(1, len(rows) // max_points)]
    if len(rows) < min_points:
        return None
    points = pairs.points[rows]
    pixels = pairs.pixels[rows]
    middle = medians(points)
    unit = median(np.abs(points - middle)) or 1.0
    points = (points - middle) / unit
    K = K.astype(np.float64)
    for _ in range(2):  # the second round leaves out points far from their pixels
        start = start_pose(points, pixels, K)
        if start is None:
            return None
        pose = start
        errors = projection_errors(points, pixels, K, pose)
        is_near = errors <= max(1.0, 3 * median(errors))
        points = points[is_near]
        pixels = pixels[is_near]
    try:
        _, (pose,) = refine_poses([points], [pixels], K, pose[None])
    except np.linalg.LinAlgError:  # points in one place
        return None
    pose[:3, 3] = unit * pose[:3, 3] - matmul(pose[:3, :3], middle)
    return pose if np.isfinite(pose).all() else None
