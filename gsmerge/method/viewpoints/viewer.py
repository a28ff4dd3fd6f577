"""Gaussians -> the place of the viewer around whom a scene was made, if it was made around one.

Pixels of a panorama, or of cameras that stand close together, become Gaussians whose sizes are proportional to their
distance from the viewer. Because of this proportion, the sizes determine the viewer's place, whatever the scene shows.
"""

from __future__ import annotations

import math

import numpy as np

from gsmerge.frozen import dataclass
from gsmerge.method.geometry.transforms import median, robust_weights
from gsmerge.method.kernels.elementary import cos, log, sin
from gsmerge.method.kernels.matrices import matmul, solve_symmetric
from gsmerge.types import Gaussians

GOLDEN = np.pi * (1 + math.sqrt(5))  # angle between successive directions that spreads them evenly
ALIKE = 0.5  # largest spread of the logarithms of angles, divided by the spread of the logarithms of sizes
# A place is likely if its error is at most this multiple of the least error. If a scene is one plane, places on both
# sides of it have equal errors. Of the likely places, the one with Gaussians in most directions is the viewer's
LIKELY = 1.1
CELLS = 100  # cells of directions, half of which the scene has to cover
# The radius of the empty space around a viewer is FREE times the distance within which the share NEAR_SHARE of the
# Gaussians lies
FREE = 0.25
NEAR_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class Viewer:
    """The viewer around whom a scene was made."""

    place: np.ndarray  # ``[3]``
    free_radius: float  # radius of the empty space around the place
    angle: float  # median angle at which the viewer sees a Gaussian's standard deviation, radians


def find_viewer(gaussians: Gaussians) -> Viewer | None:
    """Find the place of the viewer for whom finite Gaussians were made, from their sizes.

    Returns None if sizes do not grow with the distance from any place, or if too many directions show nothing.
    """
    means = gaussians.means.astype(np.float64)
    sizes = np.sort(gaussians.scales, 1)[:, 1].astype(np.float64)
    if not sizes.all() or _spread_of_logs(sizes) == 0:
        return None
    # The search has two starts: the middle of the smaller Gaussians, which are nearer, and a direct solution. The
    # direct solution is the place x = -b / 2a at which the function size^2 = a |x|^2 + b x + c, fitted with equal
    # relative errors, is least
    order = np.argsort(sizes, kind="stable")
    rows = np.concatenate([(means**2).sum(1, keepdims=True), means, np.ones((len(means), 1))], 1) / sizes[:, None] ** 2
    units = np.sqrt((rows**2).mean(0))
    units[units == 0] = 1
    rows /= units
    squares = solve_symmetric(matmul(rows.T, rows), rows.sum(0)) / units
    starts = np.median(means[order[: (len(means) + 1) // 2]], 0), -squares[1:4] / (2 * squares[0] or 1)
    solutions = [_solve_place(means, sizes, start) for start in starts]
    least = min(error for _, error in solutions)
    likely = [_look_around(means, place) for place, error in solutions if error <= LIKELY * least]
    place, distances, num_cells = max(likely, key=lambda result: result[2])
    angles = sizes / distances
    if 2 * num_cells < CELLS or _spread_of_logs(angles) >= ALIKE * _spread_of_logs(sizes):
        return None
    return Viewer(place, FREE * float(np.quantile(distances, NEAR_SHARE)), median(angles))


def _look_around(means: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Return a place, the distances ``[n]`` of Gaussians from it, and the number of directions with Gaussians."""
    offsets = means - place
    distances = np.sqrt((offsets**2).sum(1)) + np.finfo(np.float32).tiny
    return place, distances, len(np.unique(matmul(offsets / distances[:, None], spread_directions(CELLS).T).argmax(1)))


def _solve_place(means: np.ndarray, sizes: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, float]:
    """Move a place by Gauss-Newton steps until sizes are nearly proportional to distances; return place and error.

    The error of a place is the median difference of the logarithms of sizes and distances.
    """
    error = math.inf
    rounds = 8  # number of steps
    doubt_factor = 2.0  # errors of this multiple of the median error get half the weight
    least_error = 1e-3  # added to this multiple, so that weights are finite if half of the errors are 0
    for _ in range(rounds):
        offsets = means - place
        distances = np.sqrt((offsets**2).sum(1)) + np.finfo(np.float32).tiny
        angles = sizes / distances
        errors = log((angles / median(angles)).astype(np.float32)).astype(np.float64)
        error = median(np.abs(errors))
        slopes = np.concatenate([offsets / (distances**2)[:, None], np.ones((len(means), 1))], 1)
        weighted = (slopes * robust_weights(np.abs(errors), doubt_factor, least_error)[:, None]).T
        place = place - solve_symmetric(matmul(weighted, slopes), matmul(weighted, errors))[:3]
    return place, error


def _spread_of_logs(values: np.ndarray) -> float:
    """Return the logarithm of the factor between the quantiles 0.1 and 0.9 of positive values."""
    low, high = np.quantile(values, (0.1, 0.9))
    return float(log(high / low))


def spread_directions(count: int) -> np.ndarray:
    """Return directions ``[count,3]`` that are spread evenly over the sphere (golden spiral)."""
    i = np.arange(count) + 0.5
    height = 1 - 2 * i / count
    angle = GOLDEN * i
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * cos(angle), height, radius * sin(angle)], 1)
