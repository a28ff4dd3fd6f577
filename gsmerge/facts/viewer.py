"""Gaussians -> the place of the viewer around whom a scene was made, if it was.

Pixels of a panorama, or of cameras that stand close together, become Gaussians whose sizes are proportional to the
distance from there. So sizes tell the place, whatever lies in the distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gsmerge.geometry.transforms import median, robust_weights
from gsmerge.kernels.elementary import cos, log, sin
from gsmerge.kernels.matrices import matmul, solve_symmetric
from gsmerge.types import Gaussians

GOLDEN = np.pi * (1 + math.sqrt(5))  # angle between successive directions that spreads them evenly
ALIKE = 0.5  # angles have to vary less than half as much as sizes, as logarithms
# Of places that explain sizes equally well, up to chance, the one that sees most is the viewer's: a plane is seen alike
# from both sides
LIKELY = 1.1
CELLS = 100  # directions, half of which the scene has to cover
# Free radius around a viewer, as a share of the distance that so few Gaussians fall short of
FREE, NEAR_SHARE = 0.25, 0.05


@dataclass(frozen=True, eq=False)
class Viewer:
    """The viewer of a scene."""

    place: np.ndarray  # ``[3]``
    free: float  # radius around it in which nothing is
    angle: float  # median angle of a Gaussian's standard deviation


def find_viewer(gaussians: Gaussians) -> Viewer | None:
    """Find the viewer around whom finite Gaussians were made; None if sizes or missing directions deny one."""
    means, sizes = gaussians.means.astype(np.float64), np.sort(gaussians.scales, 1)[:, 1].astype(np.float64)
    if not sizes.all() or _spread(sizes) == 0:
        return None
    order = np.argsort(sizes, kind="stable")
    # Gaussians of the nearer half are smaller
    starts = np.median(means[order[: (len(means) + 1) // 2]], 0), _solve_squares(means, sizes)
    solutions = [_solve(means, sizes, start) for start in starts]
    least = min(error for _, error in solutions)
    views = [_look_around(means, place) for place, error in solutions if error <= LIKELY * least]
    place, distances, num_cells = max(views, key=lambda view: view[2])
    angles = sizes / distances
    if 2 * num_cells < CELLS or _spread(angles) >= ALIKE * _spread(sizes):
        return None
    return Viewer(place, FREE * float(np.quantile(distances, NEAR_SHARE)), median(angles))


def _look_around(means: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Return a place, the distances ``[n]`` of Gaussians from it, and in how many cells of directions some lie."""
    offsets = means - place
    distances = np.sqrt((offsets**2).sum(1)) + np.finfo(np.float32).tiny
    return place, distances, len(np.unique(matmul(offsets / distances[:, None], sphere(CELLS).T).argmax(1)))


def _solve(means: np.ndarray, sizes: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, float]:
    """Move a place until sizes are most nearly proportional to distances; return it and the median error."""
    error = math.inf
    rounds = 8  # steps of the solution
    doubt_factor = 2.0  # errors of sizes, as logarithms, count half from twice their median on
    least_error = 1e-3  # added to that, so that weights are finite where half of the errors are 0
    for _ in range(rounds):  # Gauss and Newton's steps
        offsets = means - place
        distances = np.sqrt((offsets**2).sum(1)) + np.finfo(np.float32).tiny
        angles = sizes / distances
        errors = log((angles / median(angles)).astype(np.float32)).astype(np.float64)
        error = median(np.abs(errors))
        slopes = np.concatenate([offsets / (distances**2)[:, None], np.ones((len(means), 1))], 1)
        weighted = (slopes * robust_weights(np.abs(errors), doubt_factor, least_error)[:, None]).T
        place = place - solve_symmetric(matmul(weighted, slopes), matmul(weighted, errors))[:3]
    return place, error


def _solve_squares(means: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Solve size^2 = a |x|^2 + b x + c with equal relative errors; the place ``[3]`` is -b / 2a."""
    rows = np.concatenate([(means**2).sum(1, keepdims=True), means, np.ones((len(means), 1))], 1) / sizes[:, None] ** 2
    units = np.sqrt((rows**2).mean(0))
    units[units == 0] = 1
    rows /= units
    solution = solve_symmetric(matmul(rows.T, rows), rows.sum(0)) / units
    return -solution[1:4] / (2 * solution[0] or 1)


def _spread(values: np.ndarray) -> float:
    """Return the logarithm of the factor between the tenths of positive values."""
    low, high = np.quantile(values, (0.1, 0.9))
    return float(log(high / low))


def sphere(count: int) -> np.ndarray:
    """Return directions ``[count,3]`` spread evenly over the sphere (golden spiral)."""
    i = np.arange(count) + 0.5
    height, angle = 1 - 2 * i / count, GOLDEN * i
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * cos(angle), height, radius * sin(angle)], 1)
