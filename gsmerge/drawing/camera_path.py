"""Make new cameras from the cameras of a scene: cameras along a path for videos, or one outside the capture.

All cameras are in float64.
"""

from __future__ import annotations

import re

import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.io.cameras.viewer_cameras import order_views
from gsmerge.method.geometry.transforms import (
    camera_centres,
    lower_median,
    middle_depth,
    normalize,
    quat_to_rotmat,
    rotmat_to_quat,
    step_outside,
)
from gsmerge.method.kernels.elementary import arctan2, cos, sin
from gsmerge.method.kernels.matrices import matmul
from gsmerge.scoring.fog import FOG_CAMERAS
from gsmerge.types import Cameras

PATH = re.compile(r"(?:orbit(?::(?P<turn>[^,]*))?|spline)(?:,back:(?P<back>[^,]*))?")
CURVE_PIECES = 64  # straight pieces of a curve between two cameras, which add up to its length
ORBIT_PIECES = 6 * CURVE_PIECES  # straight pieces of a whole orbit
# Least and largest extent of an orbit, to each side and upwards, as shares of the distance to its centre. With the
# least extent, a scene of a single photo shows few of its gaps. The largest extent turns the view by 14 degrees to each
# side
HORIZONTAL = (0.06, 0.25)
VERTICAL = (0.03, 0.125)


@dataclass(frozen=True)
class CameraPath:
    """Path of a camera for a video.

    Args:
        kind: "orbit" or "spline".
        turn: Degrees that an orbit turns to each side; None: chosen from the scene's cameras, see :func:`orbit`.
        back: How far all cameras of the path step back, as a share of the depth of the surfaces in view.
    """

    kind: str
    turn: float | None = None
    back: float = 0.0


def parse_camera_path(text: str) -> CameraPath | None:
    """Parse a path, such as ``orbit``, ``orbit:45`` or ``spline,back:0.5``. Returns None for the name of a file.

    Raises:
        ValueError: If the text begins with the kind of a path but is no path, or if a number is out of range.
    """
    kind = re.split("[:,]", text, maxsplit=1)[0]
    if kind not in ("orbit", "spline"):
        return None
    match = PATH.fullmatch(text)
    if match is None:
        form = f"{kind}{'[:DEGREES]' if kind == 'orbit' else ''}[,back:SHARE]"
        raise ValueError(f"path: expected {form}, got {text}")
    # largest degrees to each side, and largest share of the depth
    max_turn = 90.0
    max_back = 10.0
    turn = _parse_number(match["turn"], "orbit: expected degrees", max_turn)
    back = _parse_number(match["back"], "back: expected a share of the depth", max_back)
    return CameraPath(kind, turn, back or 0.0)


def _parse_number(text: str | None, expected: str, most: float) -> float | None:
    """Parse a number above 0 and at most ``most``. Returns None if there is no text.

    Raises ValueError for any other text. ``expected`` describes the number in the message.
    """
    if text is None:
        return None
    try:
        number = float(text)
    except ValueError:
        number = np.nan
    if not 0 < number <= most:
        raise ValueError(f"path, {expected} above 0 and at most {most:g}, got {text!r}")
    return number


def sample_path(path: CameraPath, cameras: Cameras, depth: float, count: int) -> Cameras:
    """Make ``count`` cameras on a path that leads through the cameras of a scene, or around the middle one.

    Args:
        path: Kind and size of the path.
        cameras: At least one camera of the scene; a spline passes the cameras in this order.
        depth: Distance of the surfaces that the cameras show, see :func:`viewing_depth`.
        count: Number of frames.

    Raises:
        ValueError: If a spline has fewer than two different cameras, or if there are fewer than two frames.
    """
    if count < 2:
        raise ValueError(f"frames: expected at least 2, got {count}")
    if path.kind == "spline":
        return spline(step_back(cameras, depth, path.back), (1 + path.back) * depth, count)
    return step_back(orbit(cameras, depth, count, path.turn), depth, path.back)


def step_back(cameras: Cameras, depth: float, back: float) -> Cameras:
    """Move cameras backwards by ``back`` times ``depth`` (world units)."""
    if not back:
        return cameras
    return replace(cameras, viewmats=np.stack([step_outside(viewmat, depth, back) for viewmat in cameras.viewmats]))


def outside_camera(cameras: Cameras, means: np.ndarray) -> tuple[Cameras, float]:
    """Make a camera outside the capture: turn the middle camera about a point in front of it, and step back.

    The point is at the median depth of the ``means [n,3]``. Returns the camera, and the camera's distance from the
    point, in world units. The fog of a result is also measured from outside cameras, see :mod:`gsmerge.scoring.fog`.
    """
    back, turn = FOG_CAMERAS["turned"][-1]
    middle = cameras[[median_camera(cameras)]]
    depth = viewing_depth(cameras, means)
    viewmat = step_outside(middle.viewmats[0], depth, back, turn)
    return replace(middle, viewmats=viewmat[None]), (1 + back) * depth


def viewing_depth(cameras: Cameras, means: np.ndarray) -> float:
    """Return the median depth, in world units, of the ``means [n,3]`` that the middle camera shows."""
    return middle_depth(means, cameras[[median_camera(cameras)]])


def median_camera(cameras: Cameras) -> int:
    """Return the index of the camera nearest to the median centre and the mean viewing direction."""
    return order_views(cameras)[0]


def orbit(cameras: Cameras, depth: float, count: int, turn: float | None = None) -> Cameras:
    """Turn the middle camera about the point ``depth`` in front of it, to the sides and up and down.

    Frames are evenly spaced and form a loop. The vertical of the picture stays that of the middle camera. The orbit
    turns by ``turn`` degrees to each side, and by half of this angle up and down. By default the orbit is as wide as
    the median offset of the cameras from the middle camera, within the limits ``HORIZONTAL`` and ``VERTICAL``.
    """
    middle = median_camera(cameras)
    viewmat = cameras.viewmats[middle].astype(np.float64)
    offsets = np.abs(matmul(camera_centres(cameras.viewmats) - camera_centres(viewmat), viewmat[:3, :3].T))
    # Sines of the default turns
    sines = (lower_median(offsets)[:2] / depth).clip(*np.transpose([HORIZONTAL, VERTICAL]))
    turns = np.degrees(arctan2(sines, np.sqrt(1 - sines**2))) if turn is None else turn * np.array([1, 0.5])

    def turn_middle(angles: np.ndarray) -> np.ndarray:
        """Return the viewmats ``[n,4,4]`` at angles along the loop."""
        degrees = turns * np.stack([sin(angles), cos(angles)], 1)  # [n,2] to the side, and up
        return np.stack([step_outside(viewmat, depth, 0, *side_and_up) for side_and_up in degrees])

    angles = np.linspace(0, 2 * np.pi, ORBIT_PIECES + 1)
    even_angles = _at_equal_steps(camera_centres(turn_middle(angles)), angles, np.arange(count) / count)
    return replace(cameras[[middle] * count], viewmats=turn_middle(even_angles))


def spline(cameras: Cameras, depth: float, count: int) -> Cameras:
    """Make cameras on a smooth curve that passes all cameras in their order, from the first to the last.

    Frames are evenly spaced. A rotation counts as the distance by which it moves a point that is ``depth`` away. The
    curve is a centripetal Catmull-Rom spline (Barry and Goldman 1988) of positions and quaternions. Intrinsics change
    linearly. Raises ValueError if there are fewer than two different cameras.
    """
    # The distance of two rows of ``poses [c,7]`` measures how much the poses differ. A row has the camera's position,
    # and the camera's quaternion times twice the depth, so that a small rotation changes a row by the angle times the
    # depth. A quaternion has the sign with which it is nearer to the quaternion of the row before
    quats = rotmat_to_quat(cameras.viewmats[:, :3, :3].astype(np.float64).swapaxes(1, 2))
    opposite = (quats[1:] * quats[:-1]).sum(1) < 0
    quats[1:] *= np.where(opposite, -1, 1).cumprod()[:, None]
    poses = np.concatenate([camera_centres(cameras.viewmats), 2 * depth * quats], 1)
    steps = _lengths(np.diff(poses, axis=0))
    tolerance = 1e-9  # poses count as equal up to this distance, as a share of a path's length
    is_new = np.concatenate([[True], steps > tolerance * max(steps.sum(), depth)])  # a pose differs from the one before
    origin = poses[0, :3].copy()
    poses = poses[is_new]
    Ks = cameras.Ks[is_new].astype(np.float64)
    if len(poses) < 2:
        raise ValueError("spline: expected at least 2 different cameras, got 1; use an orbit, which needs one")
    poses[:, :3] -= origin
    knots = np.concatenate([np.zeros(1), np.sqrt(_lengths(np.diff(poses, axis=0))).cumsum()])
    fine_times = np.interp(np.arange(CURVE_PIECES * (len(poses) - 1) + 1) / CURVE_PIECES, np.arange(len(poses)), knots)
    fine_poses = _curve(poses, knots, fine_times, depth)
    times = _at_equal_steps(fine_poses, fine_times, np.arange(count) / (count - 1))
    path_poses = _curve(poses, knots, times, depth)
    rotations = quat_to_rotmat(path_poses[:, 3:]).swapaxes(1, 2)
    pieces, shares = _pieces(knots, times)
    weights = shares[:, None, None]
    path_Ks = (1 - weights) * Ks[pieces] + weights * Ks[pieces + 1]
    viewmats = np.tile(np.eye(4), (count, 1, 1))
    viewmats[:, :3, :3] = rotations
    viewmats[:, :3, 3] = -(rotations * (origin + path_poses[:, :3])[:, None]).sum(-1)
    return replace(cameras, viewmats=viewmats, Ks=path_Ks)


def _curve(rows: np.ndarray, knots: np.ndarray, times: np.ndarray, depth: float) -> np.ndarray:
    """Evaluate a spline that passes the poses ``rows [c,7]`` at the times ``knots [c]``.

    Returns its poses ``[m,7]`` at ``times [m]``, as rows of :func:`spline` for ``depth``.
    """
    steps = np.diff(knots)[:, None]
    slopes = np.diff(rows, axis=0) / steps
    inner = (steps[1:] * slopes[:-1] + steps[:-1] * slopes[1:]) / (steps[1:] + steps[:-1])
    tangents = np.concatenate([slopes[:1], inner, slopes[-1:]])
    pieces, shares = _pieces(knots, times)
    s = shares[:, None]
    # Cubic Hermite interpolation
    poses = (1 + 2 * s) * (1 - s) ** 2 * rows[pieces] + s * s * (3 - 2 * s) * rows[pieces + 1]
    poses += s * (1 - s) * steps[pieces] * ((1 - s) * tangents[pieces] - s * tangents[pieces + 1])
    poses[:, 3:] = 2 * depth * normalize(poses[:, 3:])
    return poses


def _pieces(knots: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the piece of a spline that contains each of the ``times [m]``.

    Returns the pieces ``[m]``, and the times ``[m]`` as shares of their piece's duration, 0 to 1.
    """
    pieces = np.searchsorted(knots, times, side="right") - 1
    pieces = pieces.clip(0, len(knots) - 2)
    return pieces, (times - knots[pieces]) / np.diff(knots)[pieces]


def _at_equal_steps(points: np.ndarray, times: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Return the times at which a curve with ``points [m,d]`` at ``times [m]`` has run ``shares`` of its length."""
    # Distances of the points from the start, along the curve
    distances = np.concatenate([np.zeros(1), _lengths(np.diff(points, axis=0)).cumsum()])
    return np.interp(shares * distances[-1], distances, times)


def _lengths(vectors: np.ndarray) -> np.ndarray:
    """Return the lengths of vectors along the last axis."""
    return np.sqrt((vectors * vectors).sum(-1))
