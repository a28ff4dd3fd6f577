"""Find how scenes of one place lie in one another, by what their photos show and the depths under it.

Keypoints of two photos that look alike are points of both scenes, at the depths of their Gaussians. Three of them give
a similarity (Umeyama 1991); the one that most agree with is chosen from seeded samples. All scenes are then moved at
once, by Gauss-Newton steps, until points project to where the other photo shows them. A depth may be wrong by itself,
so a point is free to lie elsewhere along its ray, within the spread that the depths have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from gsmerge.geometry import (
    camera_depths,
    lower_median,
    motion_matrices,
    normalize,
    quat_to_rotmat,
    rotmat_to_quat,
)
from gsmerge.io.alignment import IDENTITY, Similarity
from gsmerge.io.registration.keypoints import Matches, Photo, find_keypoints, match_photos
from gsmerge.kernels.elementary import exp, log, log1p
from gsmerge.kernels.matrices import eigh, matmul, solve
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

SAMPLES, TRIALS = 2000, 60  # triples of matches; how many of their similarities are tried in the photos
CLOSE = 0.25  # distance of two matched points, share of their depths, up to which a triple counts them
DEPTH_SPREAD, MIN_DEPTH_SPREAD = 0.1, 0.01  # of the logarithm of a depth, before it is measured; the least of it
AGREE = 9.0  # squared residual, in standard deviations, up to which a match agrees
DOUBT = 4.0  # squared residual from which on a match counts less
MIN_MATCHES = 16  # that agree, for two scenes to be connected: unrelated photos of the same kind have up to 8
MIN_SHARE = 0.15  # of the matches
STEPS, FIRST_DAMPING, EASE, BRAKE, MAX_DAMPING = 40, 1e-4, 0.1, 10.0, 1e6
MIN_GAIN = 1e-9  # share of the cost that a step must take away for another one to follow
ROUNDS = 3  # of choosing the matches of a pair that agree, and moving it by them
LOOSE = (100.0, 10.0, 2.0, 2.0)  # times AGREE, with all scenes: a chain of them has drifted
MIN_PIXELS = 0.2  # least standard deviation of a keypoint
DIGITS = 7  # decimals of a turn, a shift in units of the depth, and a scale: the last bits of a solution mean nothing
SIZE = 7  # numbers of a similarity's step: turn, shift, logarithm of the scale


@dataclass(frozen=True, eq=False)
class Registration:
    """Where the scenes lie in the frame of the first one that is connected."""

    places: tuple[Similarity | None, ...]  # of each scene; None where it is not connected
    matches: tuple[int, ...]  # keypoints of each that agree with those of others


def register(scenes: Sequence[Scene]) -> Registration:
    """Find the similarity of every aligned scene to the first, or to the first of the largest connected set."""
    photos = [find_keypoints(scene) for scene in scenes]
    pairs = [match_photos((a, b), photos[a], photos[b], scenes[a]) for a, b in combinations(range(len(scenes)), 2)]
    found = [link for link in parallel_map(connect, pairs) if link is not None]
    edges, matches = [edge for edge, _ in found], [some for _, some in found]
    places = _chain(edges, matches, len(scenes))
    inside = [some for some in matches if places[some.scenes[0]] is not None and places[some.scenes[1]] is not None]
    spread = DEPTH_SPREAD
    for loose in LOOSE if inside else ():
        agreeing = [some.select(_squares(*_ends(places, some), some, spread) < loose * AGREE) for some in inside]
        places = _refine(places, agreeing, spread)
        inside, spread = _measure_spreads(places, inside)
    inside = [some.select(_agrees(*_ends(places, some), some, spread)) for some in inside]
    counts = [sum(len(some) for some in inside if scene in some.scenes) for scene in range(len(scenes))]
    unit = _unit(photos, places)
    return Registration(tuple(place and _rounded(place, unit) for place in places), tuple(counts))


# Two scenes


def connect(matches: Matches) -> tuple[Similarity, Matches] | None:
    """Find the similarity from the first scene to the second that most matches agree with; None where too few do."""
    if len(matches) < MIN_MATCHES:
        return None
    trials = _sample_places(matches)
    scores = [(1 - _squares(one, IDENTITY, matches, DEPTH_SPREAD) / AGREE).clip(0).sum() for one in trials]
    best = trials[int(np.argmax(scores))]
    agree = _agrees(best, IDENTITY, matches, DEPTH_SPREAD)
    for _ in range(ROUNDS):
        if agree.sum() < max(3, MIN_MATCHES // 2):
            return None
        pair = replace(matches.select(agree), scenes=(0, 1))
        best = _refine([best, IDENTITY], [pair], DEPTH_SPREAD, fixed=1)[0] or best
        agree = _agrees(best, IDENTITY, matches, DEPTH_SPREAD)
    enough = agree.sum() >= max(MIN_MATCHES, MIN_SHARE * len(matches))
    return (best, matches.select(agree)) if enough else None


def _sample_places(matches: Matches) -> list[Similarity]:
    """Fit similarities to triples of matches; return those that leave most matches close, without their cameras."""
    (p, q), rng = matches.points, np.random.default_rng(0)
    near, far = (camera_depths(points, views) for points, views in zip(matches.points, matches.viewmats, strict=True))
    rows = rng.integers(0, len(matches), (SAMPLES, 3))
    rotations, scales, shifts = fit_similarities(p[rows], q[rows], (1 / (near * far))[rows])
    moved = scales[:, None, None] * matmul(p, rotations.swapaxes(1, 2)) + shifts[:, None]
    away = ((moved - q) ** 2).sum(2) / np.minimum(far, scales[:, None] * near) ** 2
    order = np.argsort(-(1 - away / CLOSE**2).clip(0).sum(1), kind="stable")[:TRIALS]
    return [Similarity(rotations[i], float(scales[i]), shifts[i], kind="other") for i in order]


def fit_similarities(p: np.ndarray, q: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit ``q = scale * rotation @ p + shift`` to b sets of points ``[b,n,3]`` with weights ``[b,n]``.

    Rotations by Horn (1987); the scale is that of both spreads, as both have errors. Returns rotations ``[b,3,3]``,
    scales ``[b]`` and shifts ``[b,3]``.
    """
    share = (weights / weights.sum(1, keepdims=True))[..., None]
    middles = [(share * points).sum(1) for points in (p, q)]
    a, b = (points - middle[:, None] for points, middle in zip((p, q), middles, strict=True))
    spreads = [np.maximum((share * points**2).sum((1, 2)), 1e-30) for points in (a, b)]
    m = matmul((share * b).swapaxes(1, 2), a)
    trace = np.trace(m, axis1=1, axis2=2)
    form = np.empty((len(m), 4, 4))
    form[:, 0, 0] = trace
    form[:, 1:, 1:] = m + m.swapaxes(1, 2) - trace[:, None, None] * np.eye(3)
    turn = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], 1)
    form[:, 0, 1:] = turn
    form[:, 1:, 0] = turn
    rotations = quat_to_rotmat(eigh(form)[1][:, :, -1])
    scales = np.sqrt(spreads[1] / spreads[0])
    shifts = middles[1] - scales[:, None] * matmul(rotations, middles[0][..., None])[..., 0]
    return rotations, scales, shifts


def _ends(places: Sequence[Similarity | None], matches: Matches) -> tuple[Similarity, Similarity]:
    first, second = (places[scene] for scene in matches.scenes)
    assert first is not None
    assert second is not None
    return first, second


def _after(second: Similarity, first: Similarity) -> Similarity:
    """Return the similarity that applies ``first``, then ``second``."""
    rotation = matmul(second.rotation, first.rotation)
    return Similarity(rotation, second.scale * first.scale, move_points(second, first.shift), kind="other")


def _inverse(place: Similarity) -> Similarity:
    shift = -matmul(place.rotation.T, place.shift) / place.scale
    return Similarity(place.rotation.T, 1 / place.scale, shift, kind="other")


def _between(one: Similarity, other: Similarity) -> Similarity:
    """Return the similarity from the frame of the scene at ``one`` to that of the scene at ``other``."""
    return _after(_inverse(other), one)


def move_points(place: Similarity, points: np.ndarray) -> np.ndarray:
    """Move points ``[n,3]`` or ``[3]`` by a similarity."""
    return np.asarray(place.scale * matmul(points, place.rotation.T) + place.shift)


@dataclass(frozen=True, eq=False)
class _Residuals:
    """What the points of one scene miss in the photos of another, in standard deviations."""

    moved: np.ndarray  # [m,3] points in the other's frame
    values: np.ndarray  # [m,3]: two of the place in the photo, one of the depth
    slopes: np.ndarray  # [m,3,3] their derivatives by ``moved``


def _residuals(place: Similarity, matches: Matches, spread: float, way: int) -> _Residuals:
    """Project points of one end (``way`` 0: the first) into the photos of the other, by the similarity between them."""
    points, there = matches.points[way], 1 - way
    viewmats, K = matches.viewmats[there], matches.Ks[there]
    own = matches.viewmats[way]
    centres = -matmul(own[:, :3, :3].swapaxes(1, 2), own[:, :3, 3:])[..., 0]
    moved = move_points(place, points)
    turn = viewmats[:, :3, :3]
    camera = matmul(turn, moved[..., None])[..., 0] + viewmats[:, :3, 3]
    z = np.maximum(camera[:, 2], 1e-9 * np.abs(camera).max(1) + 1e-30)
    image = matmul(K, camera[..., None])[..., 0]
    projected = image[:, :2] / z[:, None]
    slope = (K[:, :2] - projected[..., None] * np.array([0, 0, 1.0])) / z[:, None, None]
    along = place.scale * matmul(matmul(points - centres, place.rotation.T)[:, None], turn.swapaxes(1, 2))[:, 0]
    streak = spread * matmul(slope, along[..., None])[..., 0]  # how a wrong depth moves it in the photo
    length = (streak * streak).sum(1)
    shrink = (1 - matches.spread / np.sqrt(matches.spread**2 + length)) / np.maximum(length, 1e-30)
    whiten = (np.eye(2) - shrink[:, None, None] * streak[:, :, None] * streak[:, None]) / matches.spread
    miss = (projected - matches.pixels[there])[..., None]
    theirs = camera_depths(matches.points[there], viewmats)
    ahead = camera[:, 2] > 0
    deep = np.where(ahead, log(z / theirs), 1e3) / (np.sqrt(2) * spread)
    values = np.concatenate([matmul(whiten, miss)[..., 0], deep[:, None]], 1)
    by_camera = np.zeros((len(points), 3, 3))
    by_camera[:, :2] = matmul(whiten, slope)
    by_camera[:, 2, 2] = 1 / (np.sqrt(2) * spread * z)
    return _Residuals(moved, values, matmul(by_camera, turn))


def _squares(one: Similarity, other: Similarity, matches: Matches, spread: float) -> np.ndarray:
    """Return the squared residual ``[m]`` of each match, the larger of both ways."""
    ways = (_between(one, other), _between(other, one))
    both = [(_residuals(place, matches, spread, way).values ** 2).sum(1) for way, place in enumerate(ways)]
    return np.asarray(np.maximum(*both))


def _agrees(one: Similarity, other: Similarity, matches: Matches, spread: float) -> np.ndarray:
    return np.asarray(_squares(one, other, matches, spread) < AGREE)


def _measure_spreads(places: Sequence[Similarity | None], matches: Sequence[Matches]) -> tuple[list[Matches], float]:
    """Measure how far keypoints and the logarithms of depths are off, robustly: matches with theirs, and the latter."""
    values = [_residuals(_between(*_ends(places, some)), some, DEPTH_SPREAD, 0).values for some in matches]
    lengths = [some.spread * np.sqrt((one[:, :2] ** 2).sum(1)) for some, one in zip(matches, values, strict=True)]
    depth = float(lower_median(np.abs(np.concatenate(values)[:, 2]))) * 1.4826 * DEPTH_SPREAD
    pixels = float(lower_median(np.concatenate(lengths))) / 1.1774
    pixels = max(pixels, MIN_PIXELS)
    measured = [replace(some, spread=min(pixels, some.spread)) for some in matches]
    return measured, min(max(depth, MIN_DEPTH_SPREAD), DEPTH_SPREAD)


# All scenes


def _chain(edges: Sequence[Similarity], matches: Sequence[Matches], count: int) -> list[Similarity | None]:
    """Place every scene of the largest connected set by the strongest edges, in the frame of its first scene."""
    best: list[Similarity | None] = [None] * count
    strength = [sum(len(some) for some in matches if scene in some.scenes) for scene in range(count)]
    for start in sorted(range(count), key=lambda scene: -strength[scene]):
        places: list[Similarity | None] = [None] * count
        places[start] = IDENTITY
        while True:
            ends = [(edge, some) for edge, some in zip(edges, matches, strict=True)
                    if (places[some.scenes[0]] is None) != (places[some.scenes[1]] is None)]  # fmt: skip
            if not ends:
                break
            edge, some = max(ends, key=lambda end: len(end[1]))
            a, b = (places[scene] for scene in some.scenes)
            if a is None and b is not None:
                places[some.scenes[0]] = _after(b, edge)
            elif a is not None:
                places[some.scenes[1]] = _after(a, _inverse(edge))
        if sum(place is not None for place in places) > sum(place is not None for place in best):
            best = places
    first = next(place for place in best if place is not None)
    return [place and _between(place, first) for place in best]


def _refine(
    places: Sequence[Similarity | None], matches: Sequence[Matches], spread: float, fixed: int | None = None
) -> list[Similarity | None]:
    """Move all placed scenes but one until the matches agree best, by damped Gauss-Newton steps.

    ``fixed``: the scene that stays; None: the first that is placed.
    """
    fixed = next(i for i, place in enumerate(places) if place is not None) if fixed is None else fixed
    free = [i for i, place in enumerate(places) if place is not None and i != fixed]
    current, damping = list(places), FIRST_DAMPING
    cost, curvature, slope = _normal_equations(current, matches, spread, free)
    for _ in range(STEPS):
        scale = damping * np.diag(curvature) + 1e-12 * curvature.trace() + 1e-30
        step = -solve(curvature + np.diag(scale), slope).reshape(-1, SIZE)
        if not np.isfinite(step).all():
            break
        moved = list(current)
        for i, vector in zip(free, step, strict=True):
            moved[i] = _stepped(current[i] or IDENTITY, vector)
        trial = _normal_equations(moved, matches, spread, free)
        if not trial[0] < cost:
            damping *= BRAKE
            if damping > MAX_DAMPING:
                break
            continue
        gain, current, damping = 1 - trial[0] / cost, moved, damping * EASE
        cost, curvature, slope = trial
        if gain < MIN_GAIN:
            break
    return current


def _stepped(place: Similarity, step: np.ndarray) -> Similarity:
    """Return a similarity after a turn, a shift and a change of scale of its scene, in the scene's frame."""
    turn = motion_matrices(np.concatenate([step[:3], np.zeros(3)])[None])[0, :3, :3]
    growth = float(exp(np.array([step[6]]).clip(-1, 1))[0])
    return _after(place, Similarity(turn, growth, step[3:6], kind="other"))


def _normal_equations(
    places: Sequence[Similarity | None], matches: Sequence[Matches], spread: float, free: Sequence[int]
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the cost (Cauchy's), its curvature and its slope by the steps of the free scenes."""
    size = len(free) * SIZE
    curvature, slope = np.zeros((size, size)), np.zeros(size)
    cost = 0.0
    for some in matches:
        ends = _ends(places, some)
        for way in (0, 1):
            place = _between(ends[way], ends[1 - way])
            found = _residuals(place, some, spread, way)
            squares = (found.values**2).sum(1)
            weights = 1 / (1 + squares / DOUBT)
            cost += DOUBT * float(log1p(squares / DOUBT).sum())
            own = _by_step(found.slopes, some.points[way], place)
            other = -_by_step(found.slopes, found.moved, IDENTITY)
            parts = zip((some.scenes[way], some.scenes[1 - way]), (own, other), strict=True)
            sides = [(scene, part) for scene, part in parts if scene in free]
            for scene, part in sides:
                at = slice(free.index(scene) * SIZE, (free.index(scene) + 1) * SIZE)
                weighted = (weights[:, None, None] * part).reshape(-1, SIZE)
                slope[at] += matmul(weighted.T, found.values.reshape(-1))
                for second, more in sides:
                    to = slice(free.index(second) * SIZE, (free.index(second) + 1) * SIZE)
                    curvature[at, to] += matmul(weighted.T, more.reshape(-1, SIZE))
    return cost, curvature, slope


def _by_step(slopes: np.ndarray, points: np.ndarray, place: Similarity) -> np.ndarray:
    """Derive residuals ``[m,3,7]`` by a turn, a shift and the logarithm of a scale before ``place`` is applied."""
    by_point = place.scale * matmul(slopes, place.rotation)
    x, y, z = points.T
    zero = np.zeros_like(x)
    turns = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)
    scale = matmul(by_point, points[..., None])
    return np.concatenate([matmul(by_point, turns), by_point, scale], 2)


def _unit(photos: Sequence[Sequence[Photo]], places: Sequence[Similarity | None]) -> float:
    """Return the power of two next to the median depth of the first placed scene's points."""
    first = next(some for some, place in zip(photos, places, strict=True) if place is not None)
    depths = [camera_depths(photo.points, photo.viewmat) for photo in first if len(photo.points)]
    return float(2.0 ** np.frexp(lower_median(np.concatenate(depths)))[1]) if depths else 1.0


def _rounded(place: Similarity, unit: float) -> Similarity:
    """Round a similarity to :data:`DIGITS`."""
    quat = normalize(rotmat_to_quat(place.rotation[None]).round(DIGITS))
    shift = unit * (place.shift / unit).round(DIGITS)
    return Similarity(quat_to_rotmat(quat)[0], round(place.scale, DIGITS), shift, kind="other")
