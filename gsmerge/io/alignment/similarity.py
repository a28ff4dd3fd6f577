"""Where the cameras stand in the frame of the Gaussians, from pixels whose Gaussian is known.

A Gaussian lies on the ray of its pixel: ``(x - c) x d = 0`` with the camera's centre c and the ray's direction d. The
Gaussians stay where they are; it is the cameras that are moved.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from gsmerge.geometry import project_points

_ROUNDS = 4  # of reweighted least squares
_MAX_POINTS = 2000  # that a camera's pose is solved from
_SMALL_ROTATION, _SMALL_SCALE = 10.0, 0.05  # degrees, and natural logarithm
_AS_GOOD, _AS_GOOD_PX = 1.5, 0.05  # one similarity for all cameras, compared with a pose for each


@dataclass(frozen=True)
class Similarity:
    """``x_gaussians = scale * rotation @ x_cameras + shift``."""

    rotation: np.ndarray  # ``[3,3]``
    scale: float  # positive
    shift: np.ndarray  # ``[3]``, units of the Gaussians
    description: str = ""  # what it is, for people; empty where both frames are the same
    # "same", "scaled", "shifted"; "first", "middle" or "upright" by which camera it was rotated; "other"
    kind: str = "same"

    def move_viewmats(self, viewmats: np.ndarray) -> np.ndarray:
        """``[c,4,4]`` world-to-camera matrices, for the frame of the Gaussians."""
        out = viewmats.copy()
        out[:, :3, :3] = viewmats[:, :3, :3] @ self.rotation.T
        out[:, :3, 3] = self.scale * viewmats[:, :3, 3] - out[:, :3, :3] @ self.shift
        return out


IDENTITY = Similarity(np.eye(3), 1.0, np.zeros(3))


def scale_by(scale: float, note: str = "") -> Similarity:
    """The cameras' frame in other units."""
    return Similarity(np.eye(3), scale, np.zeros(3), f"positions scaled by {scale:.4g}{note}", "scaled")


@dataclass(frozen=True)
class Correspondences:
    """t Gaussians, each with the pixel and the view to which it is assumed to belong."""

    points: np.ndarray  # ``[t,3]`` float64 means
    pixels: np.ndarray  # ``[t,2]`` pixel centres (x, y)
    views: np.ndarray  # ``[t]`` rows of the camera arrays
    blocks: np.ndarray  # ``[t]`` what wrote them, in order: a view, or one layer of it
    rows: np.ndarray  # ``[t]`` of the file

    def select(self, some: np.ndarray) -> Correspondences:
        """Some of them."""
        return Correspondences(*(column[some] for column in vars(self).values()))


def ray_directions(pairs: Correspondences, viewmats: np.ndarray, Ks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions ``[t,3]`` and origins ``[t,3]`` of the pixels' rays in the cameras' world."""
    ones = np.ones((len(pairs.pixels), 1))
    inverse = np.linalg.inv(Ks)
    local = np.einsum("tij,tj->ti", inverse[pairs.views], np.concatenate([pairs.pixels, ones], 1))
    rotations = viewmats[:, :3, :3]
    rays = np.einsum("tji,tj->ti", rotations[pairs.views], local)
    centres = -np.einsum("vji,vj->vi", rotations, viewmats[:, :3, 3])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), centres[pairs.views]


def pixel_errors(pairs: Correspondences, viewmats: np.ndarray, Ks: np.ndarray) -> np.ndarray:
    """``[t]`` distances of the projected Gaussians from their pixels' centres, pixels; inf behind the camera."""
    with np.errstate(all="ignore"):
        xy, depth = project_points(pairs.points[:, None], viewmats[pairs.views], Ks[pairs.views])
        error = np.linalg.norm(xy[:, 0] - pairs.pixels, axis=1)
    return np.where((depth[:, 0] > 0) & np.isfinite(error), error, np.inf)


def candidate_similarities(
    pairs: Correspondences | None, viewmats: np.ndarray, Ks: np.ndarray, *, scale: float | None = None, effort: int = 2
) -> Iterator[Similarity]:
    """Similarities from the most to the least plausible, the simplest first: the same frame; a scale; rotated by the
    first or the middle camera, alone, scaled, or scaled and shifted, as exporters do; any, from the poses that the
    pixels ask for.

    Cameras ``viewmats [c,4,4]``, ``Ks [c,3,3]`` are in their own world; ``scale`` is the size of the Gaussians' world
    in its units, where it is given. Effort 0 solves for nothing (then there may be no pairs), 1 for scale and shift, 2
    for the rotation as well.
    """
    yield IDENTITY if scale is None else scale_by(scale, ", as given")
    rays = None if pairs is None or effort == 0 else ray_directions(pairs, viewmats, Ks)
    for rotation, name, kind in _known_rotations(viewmats):
        if name:
            yield Similarity(rotation, scale or 1.0, np.zeros(3), name, kind)
        if pairs is None or rays is None:
            continue
        for shifted in (False, True) if scale is None else (True,):
            frame = _solve(pairs.points, rays, rotation, shifted=shifted)
            if frame is not None:
                text = f"positions scaled by {frame.scale:.4g}" + (" and shifted" if shifted else "")
                text = f"{name}, {text}" if name else text
                yield replace(frame, description=text, kind=kind or ("shifted" if shifted else "scaled"))
    if pairs is None or rays is None or effort < 2:
        return
    free = _mean_rotation(_pose_of_each_view(pairs, Ks), viewmats)
    frame = None if free is None else _solve(pairs.points, rays, free, shifted=True)
    if frame is not None:
        angle = np.degrees(np.arccos(np.clip((np.trace(frame.rotation) - 1) / 2, -1, 1)))
        if angle < _SMALL_ROTATION and abs(np.log(frame.scale)) < _SMALL_SCALE:
            return  # no exporter does so: the cameras are inexact, and a rotation hides it
        text = f"rotated by {angle:.1f} degrees, positions scaled by {frame.scale:.4g} and shifted"
        yield replace(frame, description=text, kind="other")


def _known_rotations(viewmats: np.ndarray) -> Iterator[tuple[np.ndarray, str, str]]:
    yield np.eye(3), "", ""
    first, middle = viewmats[0, :3, :3], viewmats[len(viewmats) // 2, :3, :3]
    half = np.sqrt(0.5)
    upright = np.array([[half, half, 0], [-half, half, 0], [0, 0, 1]]) @ np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    yield first, "rotated into the first camera", "first"
    yield middle, "rotated into the middle camera", "middle"
    yield upright @ first, "rotated upright from the first camera", "upright"


def _solve(
    points: np.ndarray, rays_and_centres: tuple[np.ndarray, np.ndarray], rotation: np.ndarray, *, shifted: bool
) -> Similarity | None:
    """Scale and shift that, after a rotation, bring every point nearest to its ray, robustly; None if not positive."""
    rays, centres = (part @ rotation.T for part in rays_and_centres)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    columns = [np.einsum("tij,tj->ti", across, centres)[:, :, None]] + ([across] if shifted else [])
    A, b = np.concatenate(columns, 2), np.einsum("tij,tj->ti", across, points)
    weights, solution = np.ones(len(points)), np.zeros(A.shape[2])
    for _ in range(_ROUNDS):
        heavy = (A * weights[:, None, None]).reshape(-1, A.shape[2])
        left, right = heavy.T @ A.reshape(-1, A.shape[2]), heavy.T @ b.reshape(-1)
        scale_of = np.sqrt(np.maximum(np.diag(left), 1e-300))
        solution = np.linalg.lstsq(left / np.outer(scale_of, scale_of), right / scale_of, rcond=1e-12)[0] / scale_of
        if not np.isfinite(solution).all() or solution[0] <= 0:
            return None
        shift = solution[1:] if shifted else np.zeros(3)
        away = points - solution[0] * centres - shift
        depth = np.abs((away * rays).sum(1)) + 1e-12
        angle = np.linalg.norm(np.einsum("tij,tj->ti", across, away), axis=1) / depth
        spread = 3 * np.median(angle) + 1e-12
        weights = 1 / (depth**2 * (1 + (angle / spread) ** 2))
    return Similarity(rotation, float(solution[0]), shift)


def _pose_of_each_view(pairs: Correspondences, Ks: np.ndarray) -> dict[int, np.ndarray]:
    """The pose that each view's pixels ask for, whatever its camera says."""
    poses = ((int(view), solve_pose(pairs, int(view), Ks[view])) for view in np.unique(pairs.views))
    return {view: pose for view, pose in poses if pose is not None}


def _mean_rotation(poses: dict[int, np.ndarray], viewmats: np.ndarray) -> np.ndarray | None:
    """The rotation between the two frames; None where the views disagree."""
    if not poses:
        return None
    rotations = [pose[:3, :3].T @ viewmats[view, :3, :3] for view, pose in poses.items()]
    u, size, vt = np.linalg.svd(np.mean(rotations, 0))
    if size[-1] < 0.9:  # rotations that agree have a mean that is nearly one
        return None
    return np.asarray(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)


def fits_all_cameras(frame: Similarity, pairs: Correspondences, viewmats: np.ndarray, Ks: np.ndarray) -> bool:
    """Whether one similarity does about as well as a pose for each camera: otherwise the cameras are wrong."""
    own = viewmats.copy()
    for view, pose in _pose_of_each_view(pairs, Ks).items():
        own[view] = pose
    best, ours = (float(np.median(pixel_errors(pairs, poses, Ks))) for poses in (own, frame.move_viewmats(viewmats)))
    return ours <= max(_AS_GOOD * best, best + _AS_GOOD_PX)


def solve_pose(pairs: Correspondences, view: int, K: np.ndarray) -> np.ndarray | None:
    """World-to-camera ``[4,4]`` of one view in the frame of the Gaussians, from its pixels alone."""
    rows = np.flatnonzero(pairs.views == view)
    rows = rows[:: max(1, len(rows) // _MAX_POINTS)]
    if len(rows) < 6:
        return None
    points, pixels = pairs.points[rows], pairs.pixels[rows]
    middle, unit = np.median(points, 0), float(np.median(np.abs(points - np.median(points, 0)))) or 1.0
    near = (points - middle) / unit
    try:
        for _ in range(2):
            solved, rotation, shift = cv2.solvePnP(near, pixels, K, None, flags=cv2.SOLVEPNP_SQPNP)
            if not solved:
                return None
            error = np.linalg.norm(cv2.projectPoints(near, rotation, shift, K, None)[0][:, 0] - pixels, axis=1)
            good = error <= max(1.0, 3 * float(np.median(error)))
            near, pixels = near[good], pixels[good]
        rotation, shift = cv2.solvePnPRefineLM(near, pixels, K, None, rotation, shift)
    except cv2.error:  # points in one place
        return None
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rotation)[0]
    pose[:3, 3] = unit * shift[:, 0] - pose[:3, :3] @ middle
    return pose if np.isfinite(pose).all() else None
