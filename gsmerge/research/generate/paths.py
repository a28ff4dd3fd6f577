"""Camera paths through a stage, and whether a view of it is usable."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from gsmerge.research.generate.photograph import FAR, Hits, Stage
from gsmerge.research.generate.shapes import Array

MIN_NEAR = 0.22  # first percentile of the depths, as a share of their median
MAX_TURN = 50  # degrees between neighbouring views
Pose = Callable[[float], Array]  # camera to world at 0, the start of a path, to 1
Path = Callable[[Stage, np.random.Generator, int], Pose]


def look_at(eye: Array, target: Array, roll: float = 0.0) -> Array:
    """``[4,4]`` camera to world, OpenCV axes, the image's down near +y, rotated by ``roll`` radians."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    out = np.eye(4)
    out[:3, 0] = np.cos(roll) * right + np.sin(roll) * down
    out[:3, 1] = np.cos(roll) * down - np.sin(roll) * right
    out[:3, 2], out[:3, 3] = forward, eye
    return out


def _orbit_point(stage: Stage, angle: float, distance: float, height: float) -> Array:
    """``[3]`` position at an angle (degrees, 0 towards -z) and distance from the focus, and above the ground."""
    x, _, z = stage.focus
    return np.array([x + distance * np.sin(np.deg2rad(angle)), -height, z - distance * np.cos(np.deg2rad(angle))])


def arc(stage: Stage, rng: np.random.Generator, num_views: int, low: float, high: float) -> Pose:
    """Along an arc of ``low`` to ``high`` degrees about the focus, or as far as there is room, up and down a little."""
    limit = MAX_TURN * max(1, num_views - 1)
    span = min(rng.uniform(min(low, limit), min(high, limit)), 2 * stage.swing)
    start = rng.uniform(-stage.swing, stage.swing - span) if span < 2 * stage.swing else -span / 2
    distance, height = rng.uniform(*stage.distance), rng.uniform(*stage.height)
    swing = rng.uniform(0, 0.4) * (stage.height[1] - stage.height[0])
    phase, closer = rng.uniform(0, 6.28), rng.uniform(-0.12, 0.12)

    def pose(s: float) -> Array:
        eye = _orbit_point(stage, start + span * s, distance * (1 + closer * s), height + swing * np.sin(6 * s + phase))
        return look_at(eye, stage.focus, 0.03 * np.sin(5 * s + phase))

    return pose


def forward(stage: Stage, rng: np.random.Generator, num_views: int) -> Pose:
    """Back and forth in a plane, in one direction of view."""
    angle, distance = rng.uniform(-0.5, 0.5) * min(stage.swing, 40), rng.uniform(*stage.distance)
    eye = _orbit_point(stage, angle, distance, rng.uniform(*stage.height))
    axes, reach = look_at(eye, stage.focus), rng.uniform(0.06, 0.2) * distance
    sways, turn = rng.integers(2, 4), rng.normal(0, 0.03, 3)

    def pose(s: float) -> Array:
        across, down = reach * np.sin(2 * np.pi * sways * s), reach * (s - 0.5)
        place = eye + across * axes[:3, 0] + down * axes[:3, 1]
        return look_at(place, stage.focus + place - eye + turn * np.sin(7 * s + np.arange(3)), 0.02 * np.sin(9 * s))

    return pose


def walk(stage: Stage, rng: np.random.Generator, num_views: int) -> Pose:
    """From one position towards another, the direction of view varying."""
    side = min(stage.swing, 40)
    a, b = (_orbit_point(stage, rng.uniform(-side, side), d, rng.uniform(*stage.height)) for d in stage.distance[::-1])
    b = a + rng.uniform(0.3, 0.9) * (b - a)
    wander = rng.normal(0, 0.12, 3) * stage.distance[0]
    phase = rng.uniform(0, 6.28, 3)

    def pose(s: float) -> Array:
        return look_at(a + (b - a) * s, stage.focus + wander * np.sin(4 * s + phase), 0.03 * np.sin(6 * s + phase[0]))

    return pose


PATHS: dict[str, Path] = {
    "arc": partial(arc, low=15, high=60),
    "forward": forward,
    "walk": walk,
    "orbit": partial(arc, low=200, high=340),
    "wide": partial(arc, low=60, high=110),
}


def is_usable(hits: Hits) -> bool:
    """Whether a view is neither inside a shape nor too close to one."""
    depth = hits.depth[hits.depth < FAR]
    if depth.size < 0.6 * hits.depth.size:
        return False
    return bool(np.percentile(depth, 1) > MIN_NEAR * np.median(depth) or np.percentile(depth, 1) > 0.6)
