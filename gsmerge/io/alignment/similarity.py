"""Where the cameras stand in the frame of the Gaussians, from pixels whose Gaussian is known.

A Gaussian lies on the ray of its pixel: ``(x - c) x d = 0`` with the camera's centre c and the ray's direction d. The
Gaussians stay where they are; it is the cameras that are moved.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

_ROUNDS = 4  # of reweighted least squares
_POSED = 2000  # points that a camera's pose is solved from
_SMALL_TURN, _SMALL_SCALE = 10.0, 0.05  # degrees, and natural logarithm
_AS_GOOD, _AS_GOOD_PX = 1.5, 0.05  # one frame for all cameras, beside a pose for each


@dataclass(frozen=True)
class Frame:
    """``x_gaussians = scale * rotation @ x_cameras + shift``.

    Args:
        rotation: ``[3,3]``.
        scale: Positive.
        shift: ``[3]``.
        words: What it is, for people; empty where both frames are the same.
        kind: "same", "scaled", "shifted"; "first", "middle" or "upright" by which camera it was turned; "other".
    """

    rotation: np.ndarray
    scale: float
    shift: np.ndarray
    words: str = ""
    kind: str = "same"

    def move_cameras(self, viewmats: np.ndarray) -> np.ndarray:
        """``[c,4,4]`` world-to-camera matrices, for the frame of the Gaussians."""
        out = viewmats.copy()
        out[:, :3, :3] = viewmats[:, :3, :3] @ self.rotation.T
        out[:, :3, 3] = self.scale * viewmats[:, :3, 3] - out[:, :3, :3] @ self.shift
        return out


SAME = Frame(np.eye(3), 1.0, np.zeros(3))


@dataclass(frozen=True)
class Sightings:
    """t Gaussians, each with the pixel and the view that it is thought to belong to.

    Args:
        points: ``[t,3]`` float64.
        pixels: ``[t,2]`` pixel centres.
        views: ``[t]`` rows of the camera arrays.
        blocks: ``[t]`` what wrote them, in order: a view, or one layer of it.
    """

    points: np.ndarray
    pixels: np.ndarray
    views: np.ndarray
    blocks: np.ndarray


def ray_directions(seen: Sightings, viewmats: np.ndarray, Ks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions ``[t,3]`` and origins ``[t,3]`` of the pixels' rays in the cameras' world."""
    ones = np.ones((len(seen.pixels), 1))
    inverse = np.linalg.inv(Ks)
    local = np.einsum("tij,tj->ti", inverse[seen.views], np.concatenate([seen.pixels, ones], 1))
    rotations = viewmats[:, :3, :3]
    rays = np.einsum("tji,tj->ti", rotations[seen.views], local)
    centres = -np.einsum("vji,vj->vi", rotations, viewmats[:, :3, 3])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True), centres[seen.views]


def pixel_errors(seen: Sightings, viewmats: np.ndarray, Ks: np.ndarray) -> np.ndarray:
    """``[t]`` distances of the projected Gaussians from their pixels' centres, pixels; inf behind the camera."""
    with np.errstate(all="ignore"):
        V = viewmats[seen.views]
        camera = np.einsum("tij,tj->ti", V[:, :3, :3], seen.points) + V[:, :3, 3]
        image = np.einsum("tij,tj->ti", Ks[seen.views], camera)
        error = np.linalg.norm(image[:, :2] / image[:, 2:] - seen.pixels, axis=1)
    return np.where((camera[:, 2] > 0) & np.isfinite(error), error, np.inf)


def candidate_frames(
    seen: Sightings, viewmats: np.ndarray, Ks: np.ndarray, *, scale: float | None = None, effort: int = 2
) -> Iterator[Frame]:
    """Frames in the order in which they are to be believed: the simplest first.

    Args:
        seen: Gaussians with their pixels.
        viewmats: ``[c,4,4]`` of the cameras' own world.
        Ks: ``[c,3,3]``.
        scale: Size of the Gaussians' world in units of the cameras', where it is known.
        effort: 0 solves for nothing, 1 for scale and shift, 2 for the rotation as well.

    Yields:
        The same frame; a scale; turned by the first or the middle camera, alone, scaled, or scaled and shifted, as
        exporters do; any similarity, from the poses that the cameras must have.
    """
    if scale is not None:
        yield Frame(np.eye(3), scale, np.zeros(3), f"positions scaled by {scale:.4g}, as told", "scaled")
    else:
        yield SAME
    rays, centres = ray_directions(seen, viewmats, Ks)
    for rotation, words, kind in _known_rotations(viewmats):
        turned = rays @ rotation.T, centres @ rotation.T
        if words:
            yield Frame(rotation, scale or 1.0, np.zeros(3), words, kind)
        if effort == 0:
            continue
        comma = f"{words}, " if words else ""
        for shifted in (False, True):
            frame = _similar(seen.points, *turned, rotation, shifted=shifted) if shifted or scale is None else None
            if frame is not None:
                said = f"{comma}positions scaled by {frame.scale:.4g}" + (" and shifted" if shifted else "")
                yield replace(frame, words=said, kind=kind or ("shifted" if shifted else "scaled"))
    if effort < 2:
        return
    free = _free_poses(seen, Ks)
    turn = _common_turn(free, viewmats)
    if turn is None:
        return
    frame = _similar(seen.points, rays @ turn.T, centres @ turn.T, turn, shifted=True)
    if frame is not None:
        angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
        if angle < _SMALL_TURN and abs(np.log(frame.scale)) < _SMALL_SCALE:
            return  # no exporter's habit: the cameras are inexact, and a turn hides it
        words = f"turned by {angle:.1f} degrees, positions scaled by {frame.scale:.4g} and shifted"
        yield replace(frame, words=words, kind="other")


def _known_rotations(viewmats: np.ndarray) -> Iterator[tuple[np.ndarray, str, str]]:
    yield np.eye(3), "", ""
    first, middle = viewmats[0, :3, :3], viewmats[len(viewmats) // 2, :3, :3]
    half = np.sqrt(0.5)
    upright = np.array([[half, half, 0], [-half, half, 0], [0, 0, 1]]) @ np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    yield first, "turned into the first camera", "first"
    yield middle, "turned into the middle camera", "middle"
    yield upright @ first, "turned upright from the first camera", "upright"


def _similar(
    points: np.ndarray, rays: np.ndarray, centres: np.ndarray, rotation: np.ndarray, *, shifted: bool
) -> Frame | None:
    """Scale and shift that bring every point nearest to its ray, robustly; None where nothing positive does.

    Args:
        points: ``[t,3]``.
        rays: ``[t,3]`` unit directions, turned already.
        centres: ``[t,3]`` origins, turned already.
        rotation: By which they were turned.
        shifted: Whether there may be a shift.
    """
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
    return Frame(rotation, float(solution[0]), np.asarray(shift, np.float64))


def _free_poses(seen: Sightings, Ks: np.ndarray) -> dict[int, np.ndarray]:
    """The pose that each view's pixels ask for, whatever its camera says."""
    poses = ((int(view), pose_from_grid(seen, int(view), Ks[view])) for view in np.unique(seen.views))
    return {view: pose for view, pose in poses if pose is not None}


def _common_turn(free: dict[int, np.ndarray], viewmats: np.ndarray) -> np.ndarray | None:
    """The rotation between the two frames; None where the views disagree."""
    if not free:
        return None
    turns = [pose[:3, :3].T @ viewmats[view, :3, :3] for view, pose in free.items()]
    u, size, vt = np.linalg.svd(np.mean(turns, 0))
    if size[-1] < 0.9:  # rotations that agree have a mean that is nearly one
        return None
    return np.asarray(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)


def explains(frame: Frame, seen: Sightings, viewmats: np.ndarray, Ks: np.ndarray) -> bool:
    """Whether one frame for all cameras does about as well as a pose for each: otherwise the cameras are wrong."""
    own = viewmats.copy()
    for view, pose in _free_poses(seen, Ks).items():
        own[view] = pose
    best, ours = (float(np.median(pixel_errors(seen, poses, Ks))) for poses in (own, frame.move_cameras(viewmats)))
    return ours <= max(_AS_GOOD * best, best + _AS_GOOD_PX)


def pose_from_grid(seen: Sightings, view: int, K: np.ndarray) -> np.ndarray | None:
    """World-to-camera ``[4,4]`` of one view in the frame of the Gaussians, from its pixels alone."""
    rows = np.flatnonzero(seen.views == view)
    rows = rows[:: max(1, len(rows) // _POSED)]
    if len(rows) < 6:
        return None
    points, pixels = seen.points[rows], seen.pixels[rows]
    middle, unit = np.median(points, 0), float(np.median(np.abs(points - np.median(points, 0)))) or 1.0
    near = (points - middle) / unit
    try:
        for _ in range(2):
            found, turn, shift = cv2.solvePnP(near, pixels, K, None, flags=cv2.SOLVEPNP_SQPNP)
            if not found:
                return None
            error = np.linalg.norm(cv2.projectPoints(near, turn, shift, K, None)[0][:, 0] - pixels, axis=1)
            good = error <= max(1.0, 3 * float(np.median(error)))
            near, pixels = near[good], pixels[good]
        turn, shift = cv2.solvePnPRefineLM(near, pixels, K, None, turn, shift)
    except cv2.error:  # points in one place
        return None
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(turn)[0]
    pose[:3, 3] = unit * shift[:, 0] - pose[:3, :3] @ middle
    return pose if np.isfinite(pose).all() else None
