"""Register scenes of one place: find the similarities between their frames from photos and depths.

Each keypoint of a photo stands for a point of the scene, at the depth of the Gaussian in the keypoint's pixel. Matching
keypoints of two scenes stand for the same place. Three matches of keypoints determine a similarity (Umeyama 1991).
Similarities are fitted to random triples, and the similarity that agrees with most matches is chosen. Then all scenes
are moved at once by Gauss-Newton steps, until points project to their keypoints in the other photos. Because depths may
be wrong, errors along a point's ray count less.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from gsmerge.frozen import dataclass, replace
from gsmerge.method.geometry.transforms import (
    IDENTITY,
    NORMAL_SPREAD,
    Damping,
    Similarity,
    camera_depths,
    descend,
    lower_median,
    motion_matrices,
    normalize,
    quat_to_rotmat,
    rotmat_to_quat,
)
from gsmerge.method.kernels.elementary import exp, log, log1p
from gsmerge.method.kernels.matrices import eigh, matmul, solve, transform
from gsmerge.reading.alignment.registration.keypoints import KeypointMatches, MatchSide, find_keypoints, match_photos
from gsmerge.runtime.threads import parallel_map
from gsmerge.types import Scene

DEPTH_SPREAD = 0.1  # standard deviation of the logarithm of a depth, before it is measured
NORMAL_2D = 1 / 1.1774  # standard deviation of two normal components, divided by the median length of their vector
AGREE = 9.0  # largest squared residual of a match that agrees; residuals are in standard deviations
# Each round uses the matches whose squared residual is at most this multiple of AGREE. The first rounds use large
# multiples, because errors add up along a chain of scenes
LOOSE = (100.0, 10.0, 2.0, 2.0)
MIN_MATCHES = 16  # least number of agreeing matches of two connected scenes; unrelated photos have up to 5
SIMILARITY_DAMPING = Damping(steps=40, first=1e-4, decrease=0.1, increase=10.0, largest=1e6, min_gain=1e-9)
NUM_PARAMETERS = 7  # parameters of a step: rotation, shift, logarithm of the scale
DIGITS = 7  # decimals to which a similarity is rounded; further digits have no meaning

Similarities = Sequence[Similarity | None]
# Similarities, and the cost of their residuals with the cost's curvature and slope; see _normal_equations
_SimilarityFit = tuple[Similarities, tuple[float, np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Registration:
    """Similarities from each scene's frame to the frame of the first scene of the largest connected set."""

    similarities: tuple[Similarity | None, ...]  # similarity of each scene; None for a scene that is not connected
    matches: tuple[int, ...]  # number of agreeing matches of each scene


def register(scenes: Sequence[Scene]) -> Registration:
    """Find the similarities that map scenes into the frame of the first connected scene.

    Scenes are connected if enough keypoints of their photos match. If scenes form several connected sets, the largest
    set is used. All scenes have pixels, and grids of one size.
    """
    count = len(scenes)
    cameras = scenes[0].cameras
    photos = [find_keypoints(scene) for scene in scenes]
    size = cameras.width, cameras.height
    id_pairs = combinations(range(count), 2)
    pairs = [match_photos((a, b), photos[a], photos[b], size) for a, b in id_pairs]
    links = [link for link in parallel_map(connect, pairs) if link is not None]
    similarities = _chain_largest_set(links, count)
    connected = [pair for _, pair in links if all(similarities[scene] is not None for scene in pair.scenes)]
    spread = DEPTH_SPREAD
    for multiple in LOOSE if connected else ():
        agreeing = [
            pair.select(_squared_residuals(similarities, pair, spread) < multiple * AGREE) for pair in connected
        ]
        similarities = _refine_similarities(similarities, agreeing, spread)
        connected, spread = _measure_spreads(similarities, connected)
    agreeing = [pair.select(_squared_residuals(similarities, pair, spread) < AGREE) for pair in connected]
    matches = [sum(len(pair) for pair in agreeing if i in pair.scenes) for i in range(count)]
    # Shifts are rounded in a power of two above the first placed scene's median depth. If it has no keypoints, in 1
    first = next(scene_photos for scene_photos, each in zip(photos, similarities, strict=True) if each is not None)
    depths = np.concatenate([camera_depths(photo.points, photo.viewmat) for photo in first])
    unit = float(2.0 ** np.frexp(lower_median(depths))[1]) if len(depths) else 1.0
    rounded = tuple(None if similarity is None else round_similarity(similarity, unit) for similarity in similarities)
    return Registration(rounded, tuple(matches))


# Similarities


def fit_similarities(p: np.ndarray, q: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit ``q = scale * rotation @ p + shift`` to b sets of points ``[b,n,3]`` with weights ``[b,n]``.

    Rotations are solved as by Horn (1987). The scale is the ratio of the spreads of ``q`` and ``p``, since both have
    errors. Returns rotations ``[b,3,3]``, scales ``[b]`` and shifts ``[b,3]``.
    """
    share = (weights / weights.sum(1, keepdims=True))[..., None]
    middle_p = (share * p).sum(1)
    middle_q = (share * q).sum(1)
    a = p - middle_p[:, None]
    b = q - middle_q[:, None]
    scales = np.sqrt(_spread(b, share) / _spread(a, share))
    m = matmul((share * b).swapaxes(1, 2), a)  # covariance of the two sets
    trace = np.trace(m, axis1=1, axis2=2)
    axis = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], 1)
    # the quaternion is the eigenvector of the largest eigenvalue of the quadratic form ``form``
    form = np.empty((len(m), 4, 4))
    form[:, 0, 0] = trace
    form[:, 0, 1:] = axis
    form[:, 1:, 0] = axis
    form[:, 1:, 1:] = m + m.swapaxes(1, 2) - trace[:, None, None] * np.eye(3)
    rotations = quat_to_rotmat(eigh(form)[1][:, :, -1])
    shifts = middle_q - scales[:, None] * transform(rotations, middle_p)
    return rotations, scales, shifts


def _spread(points: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return the weighted mean square ``[b]``, above 0, of b sets of centred points ``[b,n,3]``."""
    return np.asarray(np.maximum((share * points**2).sum((1, 2)), 1e-30))


def compose(second: Similarity, first: Similarity) -> Similarity:
    """Compose two similarities: apply ``first``, then ``second``."""
    rotation = matmul(second.rotation, first.rotation)
    shift = second.move_points(first.shift)
    return Similarity(rotation, second.scale * first.scale, shift)


def invert_similarity(similarity: Similarity) -> Similarity:
    """Return the inverse of a similarity."""
    shift = -matmul(similarity.rotation.T, similarity.shift) / similarity.scale
    return Similarity(similarity.rotation.T, 1 / similarity.scale, shift)


def round_similarity(similarity: Similarity, unit: float) -> Similarity:
    """Return a rounded similarity, so that tiny differences between keypoints do not change results.

    ``unit`` is the unit in which the shift is rounded.
    """
    quat = normalize(rotmat_to_quat(similarity.rotation[None]).round(DIGITS))
    shift = unit * (similarity.shift / unit).round(DIGITS)
    return Similarity(quat_to_rotmat(quat)[0], round(similarity.scale, DIGITS), shift)


# Two scenes


def connect(matches: KeypointMatches) -> tuple[Similarity, KeypointMatches] | None:
    """Find the similarity from the first scene to the second that agrees with the most matches.

    Returns the similarity and the matches that agree; None if too few matches agree.
    """
    if len(matches) < MIN_MATCHES:
        return None
    # similarities are fitted to random triples of matches
    rng = np.random.default_rng(0)
    p, q = (side.points for side in matches.sides)
    first_depths, second_depths = (camera_depths(side.points, side.viewmats) for side in matches.sides)
    num_triples = 2000  # number of random triples
    rows = rng.integers(0, len(matches), (num_triples, 3))
    weights = (1 / (first_depths * second_depths))[rows]
    rotations, scales, shifts = fit_similarities(p[rows], q[rows], weights)
    moved = scales[:, None, None] * matmul(p, rotations.swapaxes(1, 2)) + shifts[:, None]
    distances = ((moved - q) ** 2).sum(2) / np.minimum(second_depths, scales[:, None] * first_depths) ** 2
    max_distance = 0.25  # distance of matched points, divided by their depth, up to which a match supports a triple
    closeness = (1 - distances / max_distance**2).clip(0).sum(1)
    # of the similarities that agree with most matches, the best by residuals is taken
    num_trials = 60
    ids = np.argsort(-closeness, kind="stable")[:num_trials]
    trials = [Similarity(rotations[i], float(scales[i]), shifts[i]) for i in ids]
    pair = replace(matches, scenes=(0, 1))
    squares = [_squared_residuals((trial, IDENTITY), pair, DEPTH_SPREAD) for trial in trials]
    best = int(np.argmax([(1 - trial_squares / AGREE).clip(0).sum() for trial_squares in squares]))
    similarities: Similarities = (trials[best], IDENTITY)
    agree = squares[best] < AGREE
    rounds = 3  # each round refines the similarity, and selects the agreeing matches anew
    for _ in range(rounds):
        if agree.sum() < MIN_MATCHES // 2:
            return None
        similarities = _refine_similarities(similarities, [pair.select(agree)], DEPTH_SPREAD, fixed=1)
        agree = _squared_residuals(similarities, pair, DEPTH_SPREAD) < AGREE
    similarity = similarities[0]
    min_share = 0.15  # least share of agreeing matches
    if similarity is None or agree.sum() < max(MIN_MATCHES, min_share * len(matches)):
        return None
    return similarity, matches.select(agree)


def _similarity_between(similarities: Similarities, scenes: Sequence[int]) -> Similarity:
    """Return the similarity from the frame of the first of two placed scenes to the frame of the second."""
    first, second = (similarities[scene] for scene in scenes)
    assert first is not None
    assert second is not None
    return compose(invert_similarity(second), first)


# Residuals


@dataclass(frozen=True, eq=False)
class _Residuals:
    """Errors of points of one scene in the photos of another, in standard deviations."""

    moved: np.ndarray  # [m,3] points in the frame of the other scene
    values: np.ndarray  # [m,3] two errors of the position in the photo, and one of the depth
    slopes: np.ndarray  # [m,3,3] derivatives of ``values`` by ``moved``


def _one_way_residuals(
    similarity: Similarity, side: MatchSide, other: MatchSide, pixels: float, spread: float
) -> _Residuals:
    """Compute the errors between projected points of the scene ``side`` and the keypoints of the scene ``other``.

    ``similarity`` maps from the frame of ``side`` to the frame of ``other``. The errors are in standard deviations. A
    keypoint has the standard deviation ``pixels``, and the logarithm of a depth has the standard deviation ``spread``.
    """
    rotmats = other.viewmats[:, :3, :3]
    moved = similarity.move_points(side.points)
    camera = transform(rotmats, moved) + other.viewmats[:, :3, 3]
    z = np.maximum(camera[:, 2], 1e-9 * np.abs(camera).max(1) + 1e-30)
    projected = transform(other.Ks, camera)[:, :2] / z[:, None]
    by_camera = np.zeros((len(moved), 3, 3))
    by_camera[:, :2] = (other.Ks[:, :2] - projected[..., None] * np.eye(3)[2]) / z[:, None, None]
    # a depth that is wrong by one standard deviation shifts the projected point by a vector, the streak
    side_rotmats = side.viewmats[:, :3, :3]
    centres = -transform(side_rotmats.swapaxes(1, 2), side.viewmats[:, :3, 3])
    rays = similarity.scale * transform(rotmats, matmul(side.points - centres, similarity.rotation.T))
    streaks = spread * transform(by_camera[:, :2], rays)
    squared_lengths = np.maximum((streaks * streaks).sum(1), 1e-30)
    # errors along the streak count less
    shrink = (1 - pixels / np.sqrt(pixels**2 + squared_lengths)) / squared_lengths
    outer = shrink[:, None, None] * streaks[:, :, None] * streaks[:, None]
    whiten = (np.eye(2) - outer) / pixels
    by_camera[:, :2] = matmul(whiten, by_camera[:, :2])
    depth_share = np.sqrt(2) * spread  # both depths have errors
    by_camera[:, 2, 2] = 1 / (depth_share * z)
    ratios = log(z / camera_depths(other.points, other.viewmats))
    values = np.empty((len(moved), 3))
    values[:, :2] = transform(whiten, projected - other.pixels)
    behind = 1e3  # error of points behind the camera, whose depth ratio has no logarithm
    values[:, 2] = np.where(camera[:, 2] > 0, ratios, behind) / depth_share
    return _Residuals(moved, values, matmul(by_camera, rotmats))


def _squared_residuals(similarities: Similarities, matches: KeypointMatches, spread: float) -> np.ndarray:
    """Return the squared residual ``[m]`` of each match, in the direction in which it is larger.

    ``spread`` is the standard deviation of logarithms of depths.
    """
    both = [(residuals.values**2).sum(1) for residuals in _two_way_residuals(similarities, matches, spread)]
    return np.asarray(np.maximum(*both))


def _two_way_residuals(similarities: Similarities, matches: KeypointMatches, spread: float) -> list[_Residuals]:
    """Compute the residuals of matches in both directions: from the first scene to the second, and back.

    ``spread`` is the standard deviation of logarithms of depths.
    """
    first, second = matches.sides
    forward = _similarity_between(similarities, matches.scenes)
    return [
        _one_way_residuals(forward, first, second, matches.spread, spread),
        _one_way_residuals(invert_similarity(forward), second, first, matches.spread, spread),
    ]


def _measure_spreads(
    similarities: Similarities, matches: Sequence[KeypointMatches]
) -> tuple[list[KeypointMatches], float]:
    """Measure the standard deviations of keypoints and of logarithms of depths, robustly.

    Returns the matches with the standard deviation of keypoints, and the standard deviation of logarithms of depths.
    """
    errors = [_two_way_residuals(similarities, pair, DEPTH_SPREAD)[0].values for pair in matches]
    # converts residuals from standard deviations to pixels, and to differences of logarithms of depths
    lengths = [pair.spread * np.sqrt((xyz[:, :2] ** 2).sum(1)) for pair, xyz in zip(matches, errors, strict=True)]
    depth_errors = np.abs(np.concatenate(errors)[:, 2]) * DEPTH_SPREAD
    depth_spread = NORMAL_SPREAD * float(lower_median(depth_errors))
    min_pixels = 0.2  # least measured standard deviation of a keypoint, pixels
    pixels = max(NORMAL_2D * float(lower_median(np.concatenate(lengths))), min_pixels)
    measured = [replace(pair, spread=min(pixels, pair.spread)) for pair in matches]
    min_depth_spread = 0.01  # least measured standard deviation of the logarithm of a depth
    return measured, min(max(depth_spread, min_depth_spread), DEPTH_SPREAD)


# All scenes


def _chain_largest_set(links: Sequence[tuple[Similarity, KeypointMatches]], count: int) -> Similarities:
    """Return the similarities of the largest connected set of scenes, into the frame of its first scene.

    Scenes are placed one after the other, along the links with most matches. The result has None for scenes outside the
    largest set. ``count`` is the number of all scenes.
    """
    num_matches = [0] * count
    for _, pair in links:
        for scene in pair.scenes:
            num_matches[scene] += len(pair)
    starts = sorted(range(count), key=lambda scene: -num_matches[scene])
    chains = [_chain_from_scene(start, links, count) for start in starts]
    best = max(chains, key=lambda similarities: sum(similarity is not None for similarity in similarities))
    first = next(similarity for similarity in best if similarity is not None)
    to_first = invert_similarity(first)

    def move(similarity: Similarity | None) -> Similarity | None:
        """Return a similarity that leads into the frame of the first scene instead of the scene's frame."""
        if similarity is None:
            return None
        return IDENTITY if similarity is first else compose(to_first, similarity)

    return list(map(move, best))


def _chain_from_scene(start: int, links: Sequence[tuple[Similarity, KeypointMatches]], count: int) -> Similarities:
    """Place scenes in the frame of scene ``start``, each along the link with most matches to a scene already placed.

    A link is two connected scenes, with their similarity and matches. The result has None for those of ``count`` scenes
    that are not connected with ``start``.
    """
    similarities: list[Similarity | None] = [None] * count
    similarities[start] = IDENTITY
    while True:
        half_placed = [
            (similarity, pair)
            for similarity, pair in links
            if sum(similarities[scene] is not None for scene in pair.scenes) == 1
        ]
        if not half_placed:
            return similarities
        similarity, pair = max(half_placed, key=lambda link: len(link[1]))
        a, b = pair.scenes
        first = similarities[a]
        second = similarities[b]
        if second is not None:
            similarities[a] = compose(second, similarity)
        elif first is not None:
            similarities[b] = compose(first, invert_similarity(similarity))


def _refine_similarities(
    similarities: Similarities, matches: Sequence[KeypointMatches], spread: float, fixed: int | None = None
) -> Similarities:
    """Return the similarities with the least residuals of the matches, by damped Gauss-Newton steps.

    ``spread`` is the standard deviation of logarithms of depths. The scene ``fixed`` does not move; if ``fixed`` is
    None, the first placed scene does not move.
    """
    placed = [i for i, each in enumerate(similarities) if each is not None]
    free = [i for i in placed if i != (placed[0] if fixed is None else fixed)]

    def linearise(current: Similarities) -> _SimilarityFit:
        return current, _normal_equations(current, matches, spread, free)

    def step(state: _SimilarityFit, damping: float) -> _SimilarityFit | None:
        """Return the fit after one damped Gauss-Newton step; None if the step is not finite."""
        current, (_, curvature, slope) = state
        added = damping * np.diag(curvature) + 1e-12 * curvature.trace() + 1e-30
        steps = -solve(curvature + np.diag(added), slope).reshape(-1, NUM_PARAMETERS)
        if not np.isfinite(steps).all():
            return None
        moved = list(current)
        for i, vector in zip(free, steps, strict=True):  # rotation vector, shift and logarithm of the scale
            rotation = motion_matrices(np.concatenate([vector[:3], np.zeros(3)])[None])[0, :3, :3]
            scale = float(exp(vector[6:].clip(-1, 1))[0])
            moved[i] = compose(current[i] or IDENTITY, Similarity(rotation, scale, vector[3:6]))
        return linearise(moved)

    return descend(linearise(similarities), lambda fit: fit[1][0], step, SIMILARITY_DAMPING)[0]  # [1][0]: the cost


def _normal_equations(
    similarities: Similarities, matches: Sequence[KeypointMatches], spread: float, free: Sequence[int]
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return Cauchy's cost of the residuals, and the cost's curvature and slope by steps of the ``free`` scenes.

    Each free scene has NUM_PARAMETERS rows, in the order of ``free``.
    """
    size = len(free) * NUM_PARAMETERS
    curvature = np.zeros((size, size))
    slope = np.zeros(size)
    cost = 0.0
    columns = {scene: slice(i * NUM_PARAMETERS, (i + 1) * NUM_PARAMETERS) for i, scene in enumerate(free)}
    half_weight = 4.0  # squared residual at which the weight of a match halves
    for pair in matches:
        forward = _similarity_between(similarities, pair.scenes)
        both = _two_way_residuals(similarities, pair, spread)
        for source, similarity, residuals in zip((0, 1), (forward, invert_similarity(forward)), both, strict=True):
            squares = (residuals.values**2).sum(1)
            weights = 1 / (1 + squares / half_weight)
            cost += half_weight * float(log1p(squares / half_weight).sum())
            # a step of the first scene moves points before the similarity; a step of the second scene moves points back
            # after it
            source_jacobian = _differentiate_by_step(residuals.slopes, pair.sides[source].points, similarity)
            target_jacobian = -_differentiate_by_step(residuals.slopes, residuals.moved, IDENTITY)
            jacobians = {pair.scenes[source]: source_jacobian, pair.scenes[1 - source]: target_jacobian}
            # scenes that are not free stay where they are
            jacobians = {scene: jacobian for scene, jacobian in jacobians.items() if scene in columns}
            for scene, jacobian in jacobians.items():
                weighted = (weights[:, None, None] * jacobian).reshape(-1, NUM_PARAMETERS).T
                slope[columns[scene]] += matmul(weighted, residuals.values.reshape(-1))
                for second, second_jacobian in jacobians.items():
                    block = matmul(weighted, second_jacobian.reshape(-1, NUM_PARAMETERS))
                    curvature[columns[scene], columns[second]] += block
    return cost, curvature, slope


def _differentiate_by_step(slopes: np.ndarray, points: np.ndarray, similarity: Similarity) -> np.ndarray:
    """Return the derivatives ``[m,3,7]`` of residuals by the parameters of a step.

    The step moves ``points [m,3]`` before ``similarity`` moves the points. ``slopes [m,3,3]`` are the derivatives of
    the residuals by the moved points.
    """
    by_point = similarity.scale * matmul(slopes, similarity.rotation)
    x, y, z = points.T
    zero = np.zeros_like(x)
    by_rotation = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)
    by_scale = matmul(by_point, points[..., None])
    return np.concatenate([matmul(by_point, by_rotation), by_point, by_scale], 2)
