"""Find how scenes of one place lie in one another, by their photos and the depths under them.

Keypoints of two photos that look alike are points of both scenes, at the depths of their Gaussians.
Three of them give a similarity (Umeyama 1991); of seeded samples the one is chosen that most
matches agree with. All scenes are then moved at once, by Gauss-Newton steps, until points project
to where the other photos show them. A depth may be wrong by itself: a point is free to lie
elsewhere along its ray, within the spread that the depths have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from gsmerge.alignment.registration.keypoints import End, KeypointMatches, Photo, find_keypoints, match_photos
from gsmerge.alignment.registration.similarities import apply_after, fit_similarities, invert_place, round_place
from gsmerge.geometry import IDENTITY, Damping, Similarity, camera_depths, descend, lower_median, motion_matrices
from gsmerge.kernels.elementary import exp, log, log1p
from gsmerge.kernels.matrices import matmul, solve, transform
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

SAMPLE_TRIPLES = 2000  # triples of matches
TRIALS = 60  # of their similarities, those that are tried in the photos
CLOSE = 0.25  # distance of matched points, share of their depths, up to which a triple counts it
DEPTH_SPREAD = 0.1  # standard deviation of the logarithm of a depth, before it is measured
MIN_DEPTH_SPREAD = 0.01  # the least that is measured
MIN_PIXELS = 0.2  # the least standard deviation of a keypoint that is measured
NORMAL = 1.4826  # standard deviation over the median size of a normal number
NORMAL_2D = 1 / 1.1774  # the same for the length of a vector of two
AGREE = 9.0  # squared residual, in standard deviations, up to which a match agrees
LOOSE = (100.0, 10.0, 2.0, 2.0)  # times AGREE, round by round: a chain of scenes has drifted
BEHIND = 1e3  # stands for the logarithm of a depth behind the camera
DOUBT = 4.0  # squared residual from which on a match counts less
MIN_MATCHES = 16  # that agree where two scenes are connected; of unrelated photos up to 5 do
MIN_SHARE = 0.15  # of the matches
ROUNDS = 3  # of choosing the matches of a pair that agree, and moving it by them
DAMPING = Damping(steps=40, first=1e-4, ease=0.1, brake=10.0, most=1e6, min_gain=1e-9)
SIZE = 7  # numbers of a step: turn, shift, logarithm of the scale

Similarities = Sequence[Similarity | None]
_Fit = tuple[Similarities, tuple[float, np.ndarray, np.ndarray]]  # with the cost there, its curvature and its slope


@dataclass(frozen=True, eq=False)
class Registration:
    """Similarity from each scene's frame to that of the first scene of the largest connected set."""

    similarities: tuple[Similarity | None, ...]  # of each scene; None where it is not connected
    matches: tuple[int, ...]  # keypoints of each that agree with those of others


def register(scenes: Sequence[Scene]) -> Registration:
    """Find the similarities that map aligned scenes, with grids of one size, into the frame of the first.

    If the scenes form several connected sets, the largest is used.
    """
    count, cameras = len(scenes), scenes[0].cameras
    photos = [find_keypoints(scene) for scene in scenes]
    size = cameras.width, cameras.height
    ids = combinations(range(count), 2)
    pairs = [match_photos((a, b), photos[a], photos[b], size) for a, b in ids]
    links = [link for link in parallel_map(connect, pairs) if link is not None]
    similarities = _chain(links, count)
    inside = [pair for _, pair in links if all(similarities[scene] is not None for scene in pair.scenes)]
    spread = DEPTH_SPREAD
    for loose in LOOSE if inside else ():
        kept = [pair.select(_squares(similarities, pair, spread) < loose * AGREE) for pair in inside]
        similarities = _refine(similarities, kept, spread)
        inside, spread = _measure_spreads(similarities, inside)
    agreeing = [pair.select(_squares(similarities, pair, spread) < AGREE) for pair in inside]
    matches = [sum(len(pair) for pair in agreeing if i in pair.scenes) for i in range(count)]
    unit = _unit(photos, similarities)
    rounded = tuple(None if place is None else round_place(place, unit) for place in similarities)
    return Registration(rounded, tuple(matches))


# Two scenes


def connect(matches: KeypointMatches) -> tuple[Similarity, KeypointMatches] | None:
    """Find the similarity from the first scene to the second that agrees with the most matches.

    Returns the similarity and the matches that agree; None if they are too few.
    """
    if len(matches) < MIN_MATCHES:
        return None
    pair = replace(matches, scenes=(0, 1))
    trials = _sample_places(matches)
    misses = [_squares((trial, IDENTITY), pair, DEPTH_SPREAD) for trial in trials]
    scores = [(1 - squares / AGREE).clip(0).sum() for squares in misses]
    similarities: Similarities = (trials[int(np.argmax(scores))], IDENTITY)
    agree = misses[int(np.argmax(scores))] < AGREE
    for _ in range(ROUNDS):
        if agree.sum() < MIN_MATCHES // 2:
            return None
        similarities = _refine(similarities, [pair.select(agree)], DEPTH_SPREAD, fixed=1)
        agree = _squares(similarities, pair, DEPTH_SPREAD) < AGREE
    place = similarities[0]
    if place is None or agree.sum() < max(MIN_MATCHES, MIN_SHARE * len(matches)):
        return None
    return place, matches.select(agree)


def _sample_places(matches: KeypointMatches) -> list[Similarity]:
    """Fit similarities to triples of matches; return those that most matches agree with."""
    rng = np.random.default_rng(0)
    p, q = (end.points for end in matches.ends)
    near, far = (camera_depths(end.points, end.viewmats) for end in matches.ends)
    rows = rng.integers(0, len(matches), (SAMPLE_TRIPLES, 3))
    weights = (1 / (near * far))[rows]
    rotations, scales, shifts = fit_similarities(p[rows], q[rows], weights)
    moved = scales[:, None, None] * matmul(p, rotations.swapaxes(1, 2)) + shifts[:, None]
    away = ((moved - q) ** 2).sum(2) / np.minimum(far, scales[:, None] * near) ** 2
    closeness = (1 - away / CLOSE**2).clip(0).sum(1)
    best = np.argsort(-closeness, kind="stable")[:TRIALS]
    return [Similarity(rotations[i], float(scales[i]), shifts[i], kind="other") for i in best]


def _between(similarities: Similarities, scenes: Sequence[int]) -> Similarity:
    """Return the similarity from the frame of the first of two placed scenes to the second's."""
    first, second = (similarities[scene] for scene in scenes)
    assert first is not None
    assert second is not None
    return apply_after(invert_place(second), first)


# Residuals


@dataclass(frozen=True, eq=False)
class _Residuals:
    """What points of one scene miss in the photos of another, in standard deviations."""

    moved: np.ndarray  # [m,3] points in the other's frame
    values: np.ndarray  # [m,3]: two of the place in the photo, one of the depth
    slopes: np.ndarray  # [m,3,3] their derivatives by ``moved``


def _residuals(place: Similarity, end: End, other: End, pixels: float, spread: float) -> _Residuals:
    """Compute the distances between projected points of one end and the keypoints of the other, in standard deviations.

    ``place`` maps between the frames of the two scenes. ``pixels``, ``spread``: standard deviations of a keypoint and
    of the logarithm of a depth.
    """
    turns = other.viewmats[:, :3, :3]
    moved = place.move_points(end.points)
    camera = transform(turns, moved) + other.viewmats[:, :3, 3]
    z = np.maximum(camera[:, 2], 1e-9 * np.abs(camera).max(1) + 1e-30)
    projected = transform(other.Ks, camera)[:, :2] / z[:, None]
    by_camera = np.zeros((len(moved), 3, 3))
    by_camera[:, :2] = (other.Ks[:, :2] - projected[..., None] * np.eye(3)[2]) / z[:, None, None]
    # how the place in the photo moves where a depth is wrong by one standard deviation
    poses = end.viewmats[:, :3, :3]
    eyes = -transform(poses.swapaxes(1, 2), end.viewmats[:, :3, 3])
    along = place.scale * transform(turns, matmul(end.points - eyes, place.rotation.T))
    streaks = spread * transform(by_camera[:, :2], along)
    lengths = np.maximum((streaks * streaks).sum(1), 1e-30)
    shrink = (1 - pixels / np.sqrt(pixels**2 + lengths)) / lengths
    outer = shrink[:, None, None] * streaks[:, :, None] * streaks[:, None]
    whiten = (np.eye(2) - outer) / pixels
    by_camera[:, :2] = matmul(whiten, by_camera[:, :2])
    depth_share = np.sqrt(2) * spread  # both depths have errors
    by_camera[:, 2, 2] = 1 / (depth_share * z)
    ratios = log(z / camera_depths(other.points, other.viewmats))
    values = np.empty((len(moved), 3))
    values[:, :2] = transform(whiten, projected - other.pixels)
    values[:, 2] = np.where(camera[:, 2] > 0, ratios, BEHIND) / depth_share
    return _Residuals(moved, values, matmul(by_camera, turns))


def _squares(similarities: Similarities, matches: KeypointMatches, spread: float) -> np.ndarray:
    """Return the squared residual ``[m]`` of each match: the larger one of both directions."""
    both = [(residuals.values**2).sum(1) for residuals in _both_ways(similarities, matches, spread)]
    return np.asarray(np.maximum(*both))


def _both_ways(similarities: Similarities, matches: KeypointMatches, spread: float) -> list[_Residuals]:
    first, second = matches.ends
    there = _between(similarities, matches.scenes)
    return [
        _residuals(there, first, second, matches.spread, spread),
        _residuals(invert_place(there), second, first, matches.spread, spread),
    ]


def _measure_spreads(
    similarities: Similarities, matches: Sequence[KeypointMatches]
) -> tuple[list[KeypointMatches], float]:
    """Measure errors robustly; return the matches with that of keypoints, and that of the logarithms of depths."""
    values = [_both_ways(similarities, pair, DEPTH_SPREAD)[0].values for pair in matches]
    lengths = [pair.spread * np.sqrt((errors[:, :2] ** 2).sum(1)) for pair, errors in zip(matches, values, strict=True)]
    ratios = np.abs(np.concatenate(values)[:, 2]) * DEPTH_SPREAD
    spread = NORMAL * float(lower_median(ratios))
    pixels = max(NORMAL_2D * float(lower_median(np.concatenate(lengths))), MIN_PIXELS)
    measured = [replace(pair, spread=min(pixels, pair.spread)) for pair in matches]
    return measured, min(max(spread, MIN_DEPTH_SPREAD), DEPTH_SPREAD)


# All scenes


def _chain(links: Sequence[tuple[Similarity, KeypointMatches]], count: int) -> Similarities:
    """Place the largest connected set by its strongest links, in the frame of its first scene."""
    strength = [0] * count
    for _, pair in links:
        for scene in pair.scenes:
            strength[scene] += len(pair)
    best: Similarities = []
    for start in sorted(range(count), key=lambda scene: -strength[scene]):
        similarities = _chain_from(start, links, count)
        if _num_connected(similarities) > _num_connected(best):
            best = similarities
    first = next(place for place in best if place is not None)
    back = invert_place(first)
    return [place and (IDENTITY if place is first else apply_after(back, place)) for place in best]


def _num_connected(similarities: Similarities) -> int:
    return sum(place is not None for place in similarities)


def _chain_from(start: int, links: Sequence[tuple[Similarity, KeypointMatches]], count: int) -> Similarities:
    """Place scenes in the frame of ``start``, each by its strongest link to a scene already placed."""
    similarities: list[Similarity | None] = [None] * count
    similarities[start] = IDENTITY
    while True:
        ends = [link for link in links if sum(similarities[scene] is not None for scene in link[1].scenes) == 1]
        if not ends:
            return similarities
        place, pair = max(ends, key=lambda link: len(link[1]))
        a, b = pair.scenes
        first = similarities[a]
        second = similarities[b]
        if second is not None:
            similarities[a] = apply_after(second, place)
        elif first is not None:
            similarities[b] = apply_after(first, invert_place(place))


def _refine(
    similarities: Similarities, matches: Sequence[KeypointMatches], spread: float, fixed: int | None = None
) -> Similarities:
    """Move all placed scenes but ``fixed`` (None: the first) until matches agree best, by damped Gauss-Newton steps."""
    placed = [i for i, place in enumerate(similarities) if place is not None]
    free = [i for i in placed if i != (placed[0] if fixed is None else fixed)]

    def fit(near: Similarities) -> _Fit:
        return near, _normal_equations(near, matches, spread, free)

    def step(state: _Fit, damping: float) -> _Fit | None:
        current_places, (_, curvature, slope) = state
        scale = damping * np.diag(curvature) + 1e-12 * curvature.trace() + 1e-30
        steps = -solve(curvature + np.diag(scale), slope).reshape(-1, SIZE)
        if not np.isfinite(steps).all():
            return None
        moved = list(current_places)
        for i, vector in zip(free, steps, strict=True):
            moved[i] = apply_after(current_places[i] or IDENTITY, _make_step(vector))
        return fit(moved)

    return descend(fit(similarities), lambda state: state[1][0], step, DAMPING)[0]


def _make_step(step: np.ndarray) -> Similarity:
    """Make a similarity of a turn, a shift and the logarithm of a scale, ``[7]``."""
    turn = motion_matrices(np.concatenate([step[:3], np.zeros(3)])[None])[0, :3, :3]
    growth = float(exp(step[6:].clip(-1, 1))[0])
    return Similarity(turn, growth, step[3:6], kind="other")


def _normal_equations(
    similarities: Similarities, matches: Sequence[KeypointMatches], spread: float, free: Sequence[int]
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return cost (Cauchy's), curvature and slope with respect to the steps of the free scenes."""
    size = len(free) * SIZE
    curvature = np.zeros((size, size))
    slope = np.zeros(size)
    cost = 0.0
    columns = {scene: slice(i * SIZE, (i + 1) * SIZE) for i, scene in enumerate(free)}
    for pair in matches:
        there = _between(similarities, pair.scenes)
        ways = _both_ways(similarities, pair, spread)
        for way, place, residuals in zip((0, 1), (there, invert_place(there)), ways, strict=True):
            squares = (residuals.values**2).sum(1)
            weights = 1 / (1 + squares / DOUBT)
            cost += DOUBT * float(log1p(squares / DOUBT).sum())
            jacobian = _by_step(residuals.slopes, pair.ends[way].points, place)
            other_jacobian = -_by_step(residuals.slopes, residuals.moved, IDENTITY)
            parts = {pair.scenes[way]: jacobian, pair.scenes[1 - way]: other_jacobian}
            parts = {scene: part for scene, part in parts.items() if scene in columns}
            for scene, part in parts.items():
                weighted = (weights[:, None, None] * part).reshape(-1, SIZE).T
                slope[columns[scene]] += matmul(weighted, residuals.values.reshape(-1))
                for second, more in parts.items():
                    block = matmul(weighted, more.reshape(-1, SIZE))
                    curvature[columns[scene], columns[second]] += block
    return cost, curvature, slope


def _by_step(slopes: np.ndarray, points: np.ndarray, place: Similarity) -> np.ndarray:
    """Differentiate residuals by a step of their points before ``place`` is applied: ``[m,3,7]``."""
    by_point = place.scale * matmul(slopes, place.rotation)
    x, y, z = points.T
    zero = np.zeros_like(x)
    turns = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)
    by_scale = matmul(by_point, points[..., None])
    return np.concatenate([matmul(by_point, turns), by_point, by_scale], 2)


def _unit(photos: Sequence[Sequence[Photo]], similarities: Similarities) -> float:
    """Return the power of two nearest to the median depth of the points of the first placed scene."""
    first = next(scene_photos for scene_photos, place in zip(photos, similarities, strict=True) if place is not None)
    depths = np.concatenate([camera_depths(photo.points, photo.viewmat) for photo in first])
    return float(2.0 ** np.frexp(lower_median(depths))[1]) if len(depths) else 1.0
